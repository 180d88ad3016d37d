"""Rescue files: ledgers for answers that the ledger itself could not take.

A rescue file is written next to the ledger or, if that folder is gone or full, into the user's own state folder or the
temporary folder. The next run with the ledger reads it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sqlite3
import stat
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from platformdirs import user_state_path

from calibray.engines.ledger.database import ENDINGS, set_up
from calibray.errors import InputError

PREFIX: Final = "ledger-rescue-"
SUFFIX: Final = ".sqlite"
_LOG: Final = logging.getLogger(__name__)


def write_rescue_file(ledger: Path, fill: Callable[[sqlite3.Connection], None]) -> Path | None:
    """Write a ledger's rescue file in the first folder that can be written; None if there is none."""
    for folder, prefix in _folders(ledger):
        file = folder / f"{prefix}{uuid.uuid4().hex}{SUFFIX}"
        partial = file.with_suffix(".part")
        try:
            if folder != ledger.parent:  # a ledger's folder that somebody removed stays removed
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with closing(sqlite3.connect(partial, isolation_level=None)) as connection:
                fill(connection)
                connection.execute("PRAGMA journal_mode = DELETE")  # one file, without a write-ahead log
            partial.replace(file)
        except (OSError, sqlite3.Error):
            for ending in ENDINGS:
                with suppress(OSError):
                    Path(f"{partial}{ending}").unlink(missing_ok=True)
            continue
        return file
    return None


def rescue_files(ledger: Path) -> Iterator[Path]:
    """The rescue files of a ledger; a damaged file is renamed with a warning."""
    for folder, prefix in _folders(ledger):
        for file in sorted(folder.glob(f"{prefix}*{SUFFIX}")):
            try:
                status = file.lstat()
                # The temporary folder is open to all users: another user's file must not become an answer.
                if not stat.S_ISREG(status.st_mode) or (
                    folder != ledger.parent and status.st_uid != os.geteuid()
                ):
                    continue
                with closing(sqlite3.connect(file, isolation_level=None)) as connection:
                    set_up(connection, file)
                    connection.execute("PRAGMA journal_mode = DELETE")
            except OSError:
                continue
            except (sqlite3.Error, InputError) as error:
                damaged = file.with_name(file.name + ".damaged")
                _LOG.warning("%s: is damaged (%s); renamed to %s", file, error, damaged)
                with suppress(OSError):
                    file.replace(damaged)
                continue
            yield file


def _folders(ledger: Path) -> Iterator[tuple[Path, str]]:
    """Folders for rescue files, and the prefix of the ledger's files in each."""
    yield ledger.parent, PREFIX
    prefix = f"{PREFIX}{hashlib.sha256(str(ledger).encode()).hexdigest()[:16]}-"
    state = user_state_path("calibray", appauthor=False)
    if state.is_absolute():  # it begins with "~" for a user without a home folder
        yield state, prefix
    yield Path(tempfile.gettempdir()) / f"calibray-rescue-{os.geteuid()}", prefix
