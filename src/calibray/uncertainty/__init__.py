"""Uncertainty: how far the calibrated values can be trusted."""
