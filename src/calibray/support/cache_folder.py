"""Calibray's cache folder, which keeps data between runs. All of these data can be recomputed.

The environment variable `CALIBRAY_CACHE` sets the folder; by default, it is `calibray` in the user's cache folder. An
empty `CALIBRAY_CACHE` disables caching.
"""

from __future__ import annotations

import hashlib
import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from platformdirs import user_cache_path

CACHE_VARIABLE: Final = "CALIBRAY_CACHE"
COMPILED_BYTES: Final = 512 * 2**20
"""Limit on the total size of compiled programs [bytes]."""
_NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
"""Length of the SHA-256 digest at the start of each entry [bytes]."""
_PRUNED_AT: Final = 16
"""Average number of writes per check of the total size. With 7,000 entries, a check takes 0.08 s, about as long as
compiling a small program."""


def cache_folder() -> Path | None:
    """The path of the cache folder, which need not exist; None if caching is disabled."""
    folder = os.environ.get(CACHE_VARIABLE)
    if folder is None:
        return user_cache_path("calibray", appauthor=False)
    return Path(folder) if folder else None


@dataclass(frozen=True)
class Store:
    """Store of entries with checksums, for data that must be trusted, in a folder to which only the user can write.

    An entry is either complete or absent, because it is moved into place only when it is fully written. A damaged entry
    is removed when it is read. Entries that cannot be read or written are skipped without an error.

    Attributes:
        path: The folder, which need not exist.
        suffix: The file extension of the entries.
        limit: Limit on the total size [bytes]. If the total size exceeds this limit, about one in `_PRUNED_AT` writes
            removes the least recently read entries.
    """

    path: Path
    suffix: str
    limit: int

    @property
    def trusted(self) -> bool:
        """Whether the folder belongs to the user and is not writable by others; it is created if necessary."""
        with suppress(OSError), self._folder():
            return True
        return False

    def get(self, name: str) -> bytes | None:
        """Read an entry; return None if it is absent or damaged, or if the folder is not trusted."""
        with suppress(OSError), self._folder() as folder:
            file = self._file(name, folder)
            with os.fdopen(os.open(file, os.O_RDONLY | _NO_LINK, dir_fd=folder), "rb") as stream:
                content = stream.read()
                digest, value = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
                if hashlib.sha256(value).digest() == digest:
                    os.utime(stream.fileno() if os.utime in os.supports_fd else file)
                    return value
            # The digest differs, so the entry is damaged.
            os.unlink(file, dir_fd=folder)
        return None

    def put(self, name: str, value: bytes) -> None:
        """Write an entry, if the folder is trusted."""
        with suppress(OSError), self._folder() as folder:
            file = self._file(name, folder)
            partial = f"{file}.{uuid.uuid4().hex[:8]}.part"
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK
            try:
                with os.fdopen(os.open(partial, flags, 0o600, dir_fd=folder), "wb") as stream:
                    stream.write(hashlib.sha256(value).digest() + value)
                os.replace(partial, file, src_dir_fd=folder, dst_dir_fd=folder)
            except OSError:
                with suppress(OSError):
                    os.unlink(partial, dir_fd=folder)
                raise
            # The digest of the entry's name decides whether the total size is checked; about one name in `_PRUNED_AT`
            # triggers a check.
            if hashlib.sha256(name.encode()).digest()[0] % _PRUNED_AT == 0:
                self._remove_oldest()

    @contextmanager
    def _folder(self) -> Iterator[int | None]:
        """Open the folder, which is created if necessary, and check who can write to it.

        The check applies to the folder as opened, because anyone who can write to a parent folder could replace the
        cache folder afterwards.

        Yields:
            The folder's file descriptor; None on Windows, where other users have no access to a user's folders.

        Raises:
            OSError: The folder cannot be opened, is a link, belongs to another user, or is writable by others.
        """
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.open not in os.supports_dir_fd:
            if not stat.S_ISDIR(self.path.lstat().st_mode):
                raise OSError(f"{self.path}: is not a folder")
            yield None
            return
        folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | _NO_LINK)
        try:
            status = os.fstat(folder)
            if status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                raise OSError(f"{self.path}: others can write to it")
            yield folder
        finally:
            os.close(folder)

    def entries(self) -> list[Path]:
        """The files of the entries, most recently read first; other files in the folder are ignored."""
        ages = []
        with suppress(OSError):
            for path in self.path.glob(f"*{self.suffix}"):
                with suppress(OSError):  # another process may remove the file in the meantime
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

    def _file(self, name: str, folder: int | None) -> str:
        """The file of an entry, relative to the folder if the folder is open."""
        file = f"{name}{self.suffix}"
        return file if folder is not None else str(self.path / file)


def compiled_programs() -> Store | None:
    """The store of compiled programs; None if caching is disabled."""
    folder = cache_folder()
    return None if folder is None else Store(folder / "compiled", ".xla", COMPILED_BYTES)
