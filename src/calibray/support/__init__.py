"""Support: what knows nothing of radio: caches, output files, messages, progress, interruption."""
