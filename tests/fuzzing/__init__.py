"""Hostile input of every kind, made from a seed, and what must come of it; `benchmarks/fuzz.py` runs it at scale."""
