"""Support: code without radio: caches, output files, messages, progress, interruption."""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.support.cache_folder import CACHE_VARIABLE as CACHE_VARIABLE
    from calibray.support.cache_folder import Store as Store
    from calibray.support.output_files import SIGNATURES as SIGNATURES

_HOMES = {
    "CACHE_VARIABLE": "calibray.support.cache_folder",
    "SIGNATURES": "calibray.support.output_files",
    "Store": "calibray.support.cache_folder",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = lazy_attributes(__name__, _HOMES)
