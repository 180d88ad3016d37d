"""Checks of scenes: meshes, positions and what a ray tracer would stumble over."""
