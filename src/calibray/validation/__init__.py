"""Validation: accuracy of models on links to which they were not fitted."""
