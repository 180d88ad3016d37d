"""Calibration: the one loop around an engine, and what it needs and leaves behind."""

from calibray.calibration.calibrate import calibrate

__all__ = ["calibrate"]
