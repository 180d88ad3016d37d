"""Inference: what a calibration minimizes, and how far its answer can be trusted."""
