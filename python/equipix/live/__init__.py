"""Calibration while the camera works: running averages, what they determine, what helps next."""
