"""Fitting: the objective of a calibration, and the search for its optimum."""
