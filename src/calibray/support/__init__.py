"""Support: code without radio: caches, output files, messages, progress, interruption."""

from typing import TYPE_CHECKING

from calibray.support.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from calibray.support.cache_folder import CACHE_VARIABLE as CACHE_VARIABLE
    from calibray.support.cache_folder import Store as Store
    from calibray.support.output_files import SIGNATURES as SIGNATURES

__all__, __getattr__, __dir__ = lazy_attributes(
    __name__, {"cache_folder": "CACHE_VARIABLE Store", "output_files": "SIGNATURES"}
)
