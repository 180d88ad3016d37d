"""What a calibration found: a record that imports no machinery, its files and its tables."""

from calibray.result.record import FILES, Result

__all__ = ["FILES", "Result"]
