"""Support code independent of radio: caches, output files, messages, progress and interruption."""
