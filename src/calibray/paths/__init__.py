"""Paths: the path program, and the chains of interactions that any tracer hands over to make one."""

from calibray.paths.interactions import Diffraction, Diffuse, Kind
from calibray.paths.program import SCHEMA_VERSION, Paths, concatenate, take, take_links

__all__ = ["SCHEMA_VERSION", "Diffraction", "Diffuse", "Kind", "Paths", "concatenate", "take", "take_links"]
