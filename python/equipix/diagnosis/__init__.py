"""What a fit and its residuals say about a calibration."""
