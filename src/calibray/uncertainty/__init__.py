"""Uncertainty: credible intervals, verdicts and remarks on the calibrated values."""
