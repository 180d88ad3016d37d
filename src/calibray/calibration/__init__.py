"""Calibration: the story from a study to its result."""
