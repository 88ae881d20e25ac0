"""A calibration experiment on disk: its description and its evaluation."""
