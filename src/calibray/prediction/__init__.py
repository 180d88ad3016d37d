"""Prediction: path loss where nobody measured, coverage maps, and where to measure next."""
