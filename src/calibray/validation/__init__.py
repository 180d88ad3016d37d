"""Validation: accuracy of models on links that they were not fitted to."""
