"""Families of planted problems and landscapes in closed form, for judging methods where nobody tuned them."""
