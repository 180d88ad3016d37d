"""Path files of other origin, read first in a process with limits.

The HDF5 library can hang or crash on a file whose content was changed and sealed again (5 of 3,000 such files did not
end within a minute). A file that this user's Calibray wrote or validated before is known by its checksum and read at
once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from calibray.errors import InputError
from calibray.support.cache_folder import Store, cache_folder
from calibray.support.limited_process import run_limited

KNOWN_BYTES: Final = 2**20
"""Size limit of the entries of known files [bytes]; each takes 32 bytes."""

_CODE: Final = """
from calibray.errors import InputError
from calibray.paths.program import read_paths
try:
    read_paths({file!r})
except InputError as error:
    refuse(error)
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
    """Read a path file, whose checksum agrees, in another process, unless its checksum is known.

    Raises:
        InputError: The file is damaged, or reading it does not end; the message lacks its name.
    """
    store = _known_files()
    if digest in _known_here or (store is not None and store.trusted and store.get(digest) is not None):
        return
    size = file.stat().st_size
    try:
        is_read = run_limited(_CODE.format(file=str(file.resolve())), 4 * 2**30 + 8 * size, size)
    except TimeoutError as error:
        raise InputError(
            f"is damaged (the HDF5 library does not finish reading it {error}); trace again"
        ) from None
    if not is_read:
        raise InputError("is damaged (the HDF5 library fails while it reads it); trace again")
    remember(digest)


def _known_files() -> Store | None:
    """The store of checksums of known files; None if caching is disabled."""
    folder = cache_folder()
    return None if folder is None else Store(folder / "known", ".h5sum", KNOWN_BYTES)
