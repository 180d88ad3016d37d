"""Tracing: finding the paths of links. `tracing.sionna` holds Sionna RT, and is imported when something is traced."""
