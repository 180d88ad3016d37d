"""Validation: models judged on links that they were not fitted to."""
