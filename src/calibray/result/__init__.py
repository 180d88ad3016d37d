"""The record of a finished calibration: sections of plain data, their files, and their wording."""
