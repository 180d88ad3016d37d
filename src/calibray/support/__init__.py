"""General-purpose support code: caches, output files, messages, progress and interruption."""
