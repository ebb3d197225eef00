"""Calibration: from the images of a waved reference bar to cameras with known quality."""
