"""Chunks of links, and the processes and machines that process the chunks."""
