"""Paths: the path program, and its compilation from the chains of interactions of any ray tracer."""

from calibray.paths.file_format import FORMAT_VERSION as FORMAT_VERSION
from calibray.paths.file_format import seal as seal
from calibray.paths.interactions import Diffraction as Diffraction
from calibray.paths.interactions import Diffuse as Diffuse
from calibray.paths.interactions import Kind as Kind
from calibray.paths.program import Paths as Paths
from calibray.paths.program import concatenate as concatenate
from calibray.paths.program import join_links as join_links
from calibray.paths.program import take as take
from calibray.paths.program import take_links as take_links
