"""Path files of other origin, read first in a process with limits.

The HDF5 library can hang or crash on a file whose content was changed and sealed again (5 of 3,000 such files did not
end within a minute). A file that this user's Calibray wrote or validated before is known by its checksum and read at
once.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from calibray.errors import InputError
from calibray.support.cache_folder import Store, cache_folder

SECONDS: Final = 20.0
"""Time that a small file may take to be read [s]; most of it is the start of the process on a busy machine."""

BYTES_PER_SECOND: Final = 20e6
"""Slowest rate at which a large file is read [bytes/s]."""

KNOWN_BYTES: Final = 2**20
"""Size limit of the entries of known files [bytes]; each takes 32 bytes."""

_REFUSED: Final = 3
"""Exit status of the process for a file that is refused; its message is on stdout."""

_PROGRAM: Final = """
import sys
sys.path[:] = {path!r}
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}))
except (ImportError, ValueError, OSError):
    pass
from calibray.errors import InputError
from calibray.paths.program import read_paths
try:
    read_paths({file!r})
except InputError as error:
    print(error)
    sys.exit({refused})
"""


_known_here: Final[set[str]] = set()
"""Checksums that this process knows, with or without a cache folder."""


def remember(digest: str) -> None:
    """Note that this user's Calibray wrote or validated the file with a checksum."""
    _known_here.add(digest)
    store = _known_files()
    if store is not None and store.trusted:
        store.put(digest, b"")


def validate(file: Path, digest: str) -> None:
    """Read a path file in another process, unless its checksum is known.

    Args:
        file: The file, whose checksum agrees.
        digest: The checksum.

    Raises:
        InputError: The file is damaged, or reading it does not end; the message lacks its name.
    """
    store = _known_files()
    if digest in _known_here or (store is not None and store.trusted and store.get(digest) is not None):
        return
    if not sys.executable:
        return  # an embedded interpreter cannot start another one
    size = file.stat().st_size
    program = _PROGRAM.format(
        path=sys.path, memory=4 * 2**30 + 8 * size, file=str(file.resolve()), refused=_REFUSED
    )
    limit = SECONDS + size / BYTES_PER_SECOND
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=limit, check=False,
            # Threads would count against the limit of the address space.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise InputError(
            f"is damaged (the HDF5 library does not finish reading it within {limit:.0f} s); trace again"
        ) from None
    if done.returncode == _REFUSED:
        raise InputError(done.stdout.strip())
    if done.returncode:
        raise InputError("is damaged (the HDF5 library fails while it reads it); trace again")
    remember(digest)


def _known_files() -> Store | None:
    """The store of checksums of known files; None if caching is disabled."""
    folder = cache_folder()
    return None if folder is None else Store(folder / "known", ".h5sum", KNOWN_BYTES)
