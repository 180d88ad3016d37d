"""Support: code without radio: caches, output files, messages, progress, interruption."""
