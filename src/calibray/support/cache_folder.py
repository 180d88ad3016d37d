"""Calibray's cache folder: data kept between runs that can be computed again.

The folder is `CALIBRAY_CACHE`, else `calibray` in the user's cache folder; an empty `CALIBRAY_CACHE` disables caching.
"""

from __future__ import annotations

import hashlib
import os
import stat
import uuid
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from platformdirs import user_cache_path

CACHE_VARIABLE: Final = "CALIBRAY_CACHE"
COMPILED_BYTES: Final = 512 * 2**20
"""Size limit of compiled programs [bytes]."""
_DIGEST_BYTES: Final = 32
"""Bytes of the SHA-256 at the start of each entry."""


def cache_folder() -> Path | None:
    """The cache folder, which need not exist; None if caching is disabled."""
    folder = os.environ.get(CACHE_VARIABLE)
    if folder is None:
        return user_cache_path("calibray", appauthor=False)
    return Path(folder) if folder else None


@dataclass(frozen=True)
class Store:
    """Checksummed entries in a folder that nobody else can write, for data that must be trusted, such as machine code.

    An entry is complete or absent: it is moved into place once it is written, and a damaged one is removed when it is
    read. Entries that cannot be read or written are skipped without an error.

    Attributes:
        path: The folder, which need not exist.
        suffix: The end of the entries' file names.
        limit: Size limit; the entries read least recently are removed above it [bytes].
    """

    path: Path
    suffix: str
    limit: int

    @property
    def trusted(self) -> bool:
        """Whether the folder, created if need be, belongs to the user and nobody else can write to it."""
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = self.path.lstat()
        except OSError:
            return False
        if not stat.S_ISDIR(status.st_mode):
            return False
        if not hasattr(os, "geteuid"):  # Windows keeps other users out of a user's folders
            return True
        return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)

    def get(self, name: str) -> bytes | None:
        """Read an entry; None if it is absent or damaged."""
        path = self._path(name)
        with suppress(OSError):
            content = path.read_bytes()
            digest, value = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
            if hashlib.sha256(value).digest() == digest:
                path.touch()
                return value
            path.unlink()
        return None

    def put(self, name: str, value: bytes) -> None:
        """Write an entry."""
        path = self._path(name)
        partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
        try:
            partial.write_bytes(hashlib.sha256(value).digest() + value)
            partial.replace(path)
            self._remove_oldest()
        except OSError:
            with suppress(OSError):
                partial.unlink(missing_ok=True)

    def entries(self) -> list[Path]:
        """The files of the entries, the one read last first; no other file of the folder."""
        ages = []
        with suppress(OSError):
            for path in self.path.glob(f"*{self.suffix}"):
                with suppress(OSError):  # another process may remove it meanwhile
                    status = path.lstat()
                    if stat.S_ISREG(status.st_mode):
                        ages.append((status.st_mtime, path))
        return [path for _, path in sorted(ages, reverse=True)]

    def _remove_oldest(self) -> None:
        total = 0
        for path in self.entries():
            with suppress(OSError):
                total += path.stat().st_size
                if total > self.limit:
                    path.unlink()

    def _path(self, name: str) -> Path:
        return self.path / f"{name}{self.suffix}"


def compiled_programs() -> Store | None:
    """The store of compiled programs; None if caching is disabled."""
    folder = cache_folder()
    return None if folder is None else Store(folder / "compiled", ".xla", COMPILED_BYTES)
