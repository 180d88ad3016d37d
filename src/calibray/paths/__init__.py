"""Paths: the path program, and the chains of interactions that any tracer hands over to make one."""

from calibray.paths.interactions import Diffraction, Diffuse, Kind
from calibray.paths.program import Paths, concatenate, take, take_links
from calibray.paths.schema import SCHEMA_VERSION
from calibray.paths.sealing import seal

__all__ = [
    "SCHEMA_VERSION",
    "Diffraction",
    "Diffuse",
    "Kind",
    "Paths",
    "concatenate",
    "seal",
    "take",
    "take_links",
]
