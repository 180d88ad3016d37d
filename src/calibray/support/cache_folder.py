"""Calibray's cache folder: what can be had again, kept between runs.

The folder is `CALIBRAY_CACHE`, else `calibray` in the user's cache folder; an empty `CALIBRAY_CACHE` switches it off.
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

CACHE_VARIABLE: Final = "CALIBRAY_CACHE"
MOST: Final = 512 * 2**20
"""Size that compiled programs may take [bytes]."""
_SEAL: Final = 32
"""Bytes of the SHA-256 that an entry begins with."""


def cache_folder() -> Path | None:
    """Where things are kept, whether it is there yet or not; None where they are not."""
    named = os.environ.get(CACHE_VARIABLE)
    if named == "":
        return None
    if named is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        return Path(home) / "calibray"
    return Path(named)


@dataclass(frozen=True)
class Store:
    """Sealed entries in a folder that nobody else can write, for what must be trusted, such as machine code.

    An entry is whole or it is none: it is moved into its place when it is complete, and one that was damaged is
    removed when it is asked for. What cannot be read or written is simply not kept.

    Attributes:
        path: The folder, which need not exist.
        suffix: What the entries' names end with.
        most: Size at which the entries that were not asked for the longest are removed [bytes].
    """

    path: Path
    suffix: str
    most: int

    @property
    def trusted(self) -> bool:
        """Whether the folder, made if need be, is the user's own and nobody else can write into it."""
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = self.path.lstat()
        except OSError:
            return False
        if not stat.S_ISDIR(status.st_mode):
            return False
        if not hasattr(os, "geteuid"):  # Windows, where a user's folders are the user's
            return True
        return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)

    def get(self, name: str) -> bytes | None:
        """An entry.

        Args:
            name: Its name.

        Returns:
            What was kept, or None where nothing was or it was damaged.
        """
        path = self._path(name)
        try:
            sealed = path.read_bytes()
            if hashlib.sha256(sealed[_SEAL:]).digest() == sealed[:_SEAL]:
                path.touch()
                return sealed[_SEAL:]
            path.unlink()
        except OSError:
            pass
        return None

    def put(self, name: str, value: bytes) -> None:
        """Keep an entry.

        Args:
            name: Its name.
            value: What to keep.
        """
        path = self._path(name)
        partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.part")
        try:
            partial.write_bytes(hashlib.sha256(value).digest() + value)
            partial.replace(path)
            self._make_room()
        except OSError:
            with suppress(OSError):
                partial.unlink(missing_ok=True)

    def kept(self) -> list[Path]:
        """The entries, the one asked for last first; no other file of the folder."""
        ages = []
        with suppress(OSError):
            for path in self.path.glob(f"*{self.suffix}"):
                with suppress(OSError):  # another process may remove it meanwhile
                    if stat.S_ISREG((status := path.lstat()).st_mode):
                        ages.append((status.st_mtime, path))
        return [path for _, path in sorted(ages, reverse=True)]

    def _make_room(self) -> None:
        total = 0
        for path in self.kept():
            with suppress(OSError):
                total += path.stat().st_size
                if total > self.most:
                    path.unlink()

    def _path(self, name: str) -> Path:
        return self.path / f"{name}{self.suffix}"


def compiled_programs() -> Store | None:
    """Where compiled programs are kept; None where nothing is."""
    here = cache_folder()
    return None if here is None else Store(here / "compiled", ".xla", MOST)
