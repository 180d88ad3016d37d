"""Tracing: finding the paths of links.

`protocol` defines what any ray tracer must do, `default_tracer` opens Sionna RT, and only the room `tracing.sionna`
imports it.
"""
