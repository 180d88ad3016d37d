"""Authoring: scenes made of maps, footprints, height models and floor plans."""
