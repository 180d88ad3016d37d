"""General-purpose code for caches, output files, messages, progress and interruption."""
