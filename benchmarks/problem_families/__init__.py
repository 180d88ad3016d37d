"""Families of planted problems, and landscapes in closed form, for judging methods that were not tuned on them."""
