"""Calibrate the radio materials of a ray-traced scene from measurements."""
