"""Calibration: the one loop around an engine."""

from calibray.calibration.calibration import calibrate

__all__ = ["calibrate"]
