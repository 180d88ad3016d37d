"""Programs that XLA compiled, kept between runs.

A compiled program is machine code, so that it is taken only from a folder that nobody but the user can write
(`support.cache_folder.Store`). JAX has a cache of its own, which writes entries in place and checks nothing. Its keys,
which tell all that a program depends on, are used here; what it reads and writes goes through the store. Where the user
has named a folder for JAX's own in JAX_COMPILATION_CACHE_DIR, it is left alone.
"""

from __future__ import annotations

import hashlib
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax

from calibray.support import cache_folder as caching


def keep_compiled() -> bool:
    """Keep what JAX compiles from here on, and take what was kept.

    Returns:
        Whether it does: there is a folder for it that can be trusted, and JAX can be told of it.
    """
    kept = caching.compiled_programs()
    if kept is None or jax.config.values["jax_compilation_cache_dir"] is not None or not kept.trusted:
        return False
    try:
        # JAX offers no other way to bring one's own storage.
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface
    except ImportError:
        return False

    class Kept(CacheInterface):
        _path = kept.path

        def get(self, key: str) -> bytes | None:  # pyright: ignore[reportIncompatibleMethodOverride]
            return kept.get(_name(key))

        def put(self, key: str, value: bytes) -> None:
            kept.put(_name(key), value)

    if not {"_cache", "_cache_initialized"} <= vars(compilation_cache).keys():
        return False
    compilation_cache._cache, compilation_cache._cache_initialized = Kept(), True
    jax.config.update("jax_compilation_cache_dir", str(kept.path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return True


def _name(key: str) -> str:
    """Name of an entry: code for one processor may stop another that shares the folder."""
    return hashlib.sha256(f"{key} {_processor()}".encode()).hexdigest()


@cache
def _processor() -> str:
    """What this machine's processor can do, as well as the system tells."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        told = {line for line in lines if line.startswith(("flags", "Features", "model name"))}
        return " ".join(sorted(told))
    return f"{platform.machine()} {platform.processor()} {platform.node()}"
