"""Calibration: from a study to its result."""
