"""Comparison: methods side by side from many seeds at equal budgets."""
