"""Prediction: path loss of new links, coverage maps, and suggestions of where to measure next."""
