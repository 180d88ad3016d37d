"""Calibray's use of JAX: settings, compilation, and a store of compiled programs.

Outside calls to Calibray, the user's settings apply.

Within `jax_settings`, JAX computes in double precision and keeps compiled programs in a folder across processes. A
compiled program is machine code, so Calibray reads it only from a folder to which only the user can write
(`calibray.support.cache_folder.Store`). JAX's own cache on disk writes entries in place and does not check them.
Calibray uses JAX's keys, which include everything on which a program depends, but reads and writes entries through its
own store. If the user has set a folder for JAX's cache (`JAX_COMPILATION_CACHE_DIR`), JAX uses that folder instead.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, Final

import jax

from calibray.errors import InputError
from calibray.support import cache_folder
from calibray.support.messages import first_line, shortened

_lock = threading.Lock()
_calls = 0
"""Number of calls in progress that use the store, in all threads."""
_users_cache: Any = None
"""The cache that JAX used before the first of these calls."""


@contextmanager
def jax_settings() -> Iterator[None]:
    """Compute in double precision and keep compiled programs; on exit, the user's JAX settings are restored.

    Every numerical function of `calibray.fields` uses these settings. Enter this context yourself before you
    differentiate or compile code that calls one of the pure functions.

    Raises:
        InputError: JAX finds no device to compute on.

    Example:
        >>> import jax.numpy as jnp
        >>> with jax_settings():
        ...     print(jnp.asarray(1.0).dtype)
        float64
        >>> jax.config.jax_enable_x64
        False
    """
    _check_device()
    with jax.enable_x64(True):
        # A folder is already set if the user chose one, or within another call to Calibray.
        programs = _kept_programs() if jax.config.values["jax_compilation_cache_dir"] is None else None
        if programs is None:
            yield
        else:
            with _cache_of_jax(programs):
                yield


@cache
def _check_device() -> None:
    """Raise an error if JAX has no device on the chosen platform."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError, ValueError) as error:
        platforms = os.environ.get("JAX_PLATFORMS", "")
        raise InputError(
            f"JAX finds no device to compute on (JAX_PLATFORMS = {shortened(platforms)!r}): {first_line(error)}; unset "
            "JAX_PLATFORMS, or install JAX for that device"
        ) from None


@contextmanager
def _cache_of_jax(programs: Any) -> Iterator[None]:
    """Make the store JAX's cache on disk.

    JAX has one cache for all threads, but each thread has its own setting for the folder. The store is therefore used
    only in threads whose setting is the store's folder, so that the user's own programs are not stored.
    """
    global _calls, _users_cache
    from jax._src import compilation_cache, config

    with _lock:
        if _calls == 0:
            _users_cache, compilation_cache._cache = compilation_cache._cache, programs
        _calls += 1
    try:
        with (
            config.compilation_cache_dir(str(programs._path)),
            # Keep programs regardless of their compilation time.
            config.persistent_cache_min_compile_time_secs(0.0),
        ):
            yield
    finally:
        with _lock:
            _calls -= 1
            if _calls == 0:
                compilation_cache._cache = _users_cache


@cache
def _kept_programs() -> Any:
    """The store as a JAX cache; None if its folder cannot be trusted or JAX has no interface for caches."""
    store = cache_folder.compiled_programs()
    if store is None or not store.trusted:
        return None
    try:
        # JAX has no public interface for a custom store.
        from jax._src import compilation_cache, config
        from jax._src.compilation_cache_interface import CacheInterface
    except ImportError:
        return None
    needed = {"compilation_cache_dir", "persistent_cache_min_compile_time_secs"}
    if not hasattr(compilation_cache, "_cache") or not needed <= vars(config).keys():
        return None

    class KeptPrograms(CacheInterface):
        _path = store.path

        def get(self, key: str) -> bytes | None:  # pyright: ignore[reportIncompatibleMethodOverride]
            return store.get(_entry_name(key)) if self._is_set() else None

        def put(self, key: str, value: bytes) -> None:
            if self._is_set():
                store.put(_entry_name(key), value)

        def _is_set(self) -> bool:
            return config.compilation_cache_dir.value == str(self._path)

    return KeptPrograms()


def _entry_name(key: str) -> str:
    """Name of an entry, which depends on the processor because compiled code can crash on a different processor."""
    return hashlib.sha256(f"{key} {_processor()}".encode()).hexdigest()


@cache
def _processor() -> str:
    """Model and instruction sets of this machine's processor, as far as the system reports them."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        features = {line for line in lines if line.startswith(("flags", "Features", "model name"))}
        return " ".join(sorted(features))
    return f"{platform.machine()} {platform.processor()} {platform.node()}"


WIDE: Final = {"xla_cpu_prefer_vector_width": 512}
"""Compiler option for 512-bit vectors. XLA prefers 256-bit vectors even on processors with wider ones. On other
processors, the option has no effect. The option does not change results."""

_QUICK: Final = WIDE | {"xla_cpu_use_fusion_emitters": False}
"""The same options without XLA's fusion emitters, for faster compilation. Results with and without the emitters differ
by rounding errors."""


def compiled(
    function: Callable[..., Any] | None = None, *, static_argnums: int | tuple[int, ...] = ()
) -> Callable[..., Any]:
    """Compile a function as `jax.jit` does; its first argument must be a program or have an attribute `program`.

    The function is compiled anew for each value of the arguments at the positions `static_argnums`. If no function is
    given, `compiled` returns a decorator.
    """
    if function is None:
        return lambda function: compiled(function, static_argnums=static_argnums)
    to_run_fast = jax.jit(function, static_argnums=static_argnums, compiler_options=WIDE)
    compiled_fast = jax.jit(function, static_argnums=static_argnums, compiler_options=_QUICK)

    @wraps(function)
    def call(first: Any, *arguments: Any) -> Any:
        quick = getattr(first, "program", first).is_small and _xla_has_the_option()
        return (compiled_fast if quick else to_run_fast)(first, *arguments)

    return call


@cache
def _xla_has_the_option() -> bool:
    """Whether this version of XLA supports the options in `_QUICK`; XLA raises an error for unknown options."""
    try:
        jax.jit(lambda: 0, compiler_options=_QUICK)()
    except jax.errors.JaxRuntimeError:
        return False
    return True
