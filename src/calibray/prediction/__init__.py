"""Prediction: path loss at new links, coverage maps, and suggestions of where to measure next."""
