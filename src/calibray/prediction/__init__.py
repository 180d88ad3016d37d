"""Prediction: path loss at new links, coverage maps, and suggestions where to measure next."""
