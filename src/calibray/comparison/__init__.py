"""Comparison of methods at equal budgets, and the paper's experiment."""
