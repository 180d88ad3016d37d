"""Chunks of links, and the processes and machines that work on them."""
