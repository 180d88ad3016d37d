"""Comparison of methods at equal budgets, and the experiment of the paper."""
