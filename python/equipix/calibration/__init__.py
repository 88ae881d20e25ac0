"""Shift calibration: sensitivity and beam from exposures of one beam at several positions."""
