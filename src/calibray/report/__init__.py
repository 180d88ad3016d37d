"""What a calibration looks like: figures."""
