"""Chunks of links, and the worker processes and machines that trace and replay them."""
