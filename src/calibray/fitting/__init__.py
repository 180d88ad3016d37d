"""Fitting: what a calibration minimizes, and the search for its optimum."""
