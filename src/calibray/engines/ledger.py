"""The ledger: every RT call that was ever paid for, in one SQLite file.

An answer is committed before anyone sees it, so that a run that was killed finds it when it is started again. Several
runs may write to one ledger at once; it must lie on a local disk, because SQLite's write-ahead log needs one.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError

LEDGER_FILE: Final = "ledger.sqlite"
VERSION: Final = 1
PATIENCE: Final = 60.0  # how long to wait for others to finish writing [s]
COLUMNS: Final = ("problem", "engine", "time", "seconds", "status", "message")
_TABLES: Final = (
    """CREATE TABLE IF NOT EXISTS problems (
        problem TEXT PRIMARY KEY, engine TEXT NOT NULL, parameters TEXT NOT NULL) WITHOUT ROWID""",
    """CREATE TABLE IF NOT EXISTS answers (
        id INTEGER PRIMARY KEY, problem TEXT NOT NULL REFERENCES problems, candidate BLOB NOT NULL,
        path_loss_db BLOB NOT NULL, seconds REAL NOT NULL, failure TEXT NOT NULL, time TEXT NOT NULL,
        UNIQUE (problem, candidate))""",
)


@dataclass(frozen=True, eq=False)
class Entry:
    """One RT call of a ledger.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf where a link has no path.
        seconds: Time that the engine took [s].
        failure: What went wrong; empty if nothing did.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""


class Ledger:
    """RT calls by problem and candidate.

    Args:
        path: The SQLite file; made if absent, with its folder.

    Raises:
        InputError: The file cannot be opened, is no ledger, or one of another version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # Every statement is a transaction of its own, committed when `execute` returns.
            self._connection = sqlite3.connect(self.path, timeout=PATIENCE, isolation_level=None)
            self._set_up()
        except (sqlite3.Error, OSError) as error:
            raise InputError(
                f"{self.path}: cannot be used as a ledger ({error}); name another folder"
            ) from None

    def _set_up(self) -> None:
        run = self._connection.execute
        _switch_to_wal(self._connection)
        run("PRAGMA synchronous = FULL")  # committed answers survive a loss of power too
        version = run("PRAGMA user_version").fetchone()[0]
        if version not in (0, VERSION):
            raise InputError(
                f"{self.path}: is a ledger of version {version}, this Calibray writes {VERSION}; name another folder"
            )
        run("BEGIN IMMEDIATE")
        for table in _TABLES:
            run(table)
        run(f"PRAGMA user_version = {VERSION}")
        run("COMMIT")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def describe(self, problem: str, engine: str, parameters: Sequence[str]) -> None:
        """Say what a problem's candidates stand for.

        Args:
            problem: Fingerprint of the problem.
            engine: Name of the engine.
            parameters: Names of the parameters.
        """
        self._connection.execute(
            "INSERT OR IGNORE INTO problems VALUES (?, ?, ?)", (problem, engine, json.dumps(list(parameters)))
        )

    def find(self, problem: str, candidate: bytes) -> Entry | None:
        """The entry of a candidate.

        Args:
            problem: Fingerprint of the problem.
            candidate: The candidate, by `key`.

        Returns:
            The entry, or None if the candidate was never run.
        """
        row = self._connection.execute(
            "SELECT path_loss_db, seconds, failure FROM answers WHERE problem = ? AND candidate = ?",
            (problem, candidate),
        ).fetchone()
        return None if row is None else Entry(np.frombuffer(row[0], "<f8").copy(), row[1], row[2])

    def commit(self, problem: str, candidate: bytes, entry: Entry) -> Entry:
        """Write an entry, unless another run was faster.

        Args:
            problem: Fingerprint of the problem, described before.
            candidate: The candidate, by `key`.
            entry: The entry.

        Returns:
            What the ledger holds, on disk, when this returns: the entry, or the other run's.
        """
        loss = np.ascontiguousarray(entry.path_loss_db, "<f8").tobytes()
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        written = self._connection.execute(
            "INSERT OR IGNORE INTO answers VALUES (NULL, ?, ?, ?, ?, ?, ?)",
            (problem, candidate, loss, entry.seconds, entry.failure, now),
        )
        return entry if written.rowcount else self.find(problem, candidate) or entry

    def forget_failures(self, problem: str | None = None) -> int:
        """Take out failed calls, so that they are run again.

        Args:
            problem: Fingerprint of the problem; all problems if None.

        Returns:
            How many there were.
        """
        return self._connection.execute(
            "DELETE FROM answers WHERE failure <> '' AND (?1 IS NULL OR problem = ?1)", (problem,)
        ).rowcount

    def table(self, path_loss: bool = False) -> pd.DataFrame:
        """All RT calls in the order in which they were committed.

        Args:
            path_loss: Add one column per link: `link_1`, `link_2`, ... [dB].

        Returns:
            Columns `problem` (the start of its fingerprint), `engine`, `time`, `seconds`, `status` ("ok" or "failed"),
            `message`, and one per parameter.
        """
        rows = self._connection.execute(
            """SELECT problem, engine, time, seconds, failure, parameters, candidate, path_loss_db
            FROM answers JOIN problems USING (problem) ORDER BY id"""
        )
        records = []
        for problem, engine, when, seconds, failure, parameters, candidate, loss in rows:
            status = "failed" if failure else "ok"
            record = dict(zip(COLUMNS, (problem[:12], engine, when, seconds, status, failure), strict=True))
            record |= zip(json.loads(parameters), np.frombuffer(candidate, "<f8").tolist(), strict=True)
            if path_loss:
                record |= {f"link_{k}": value for k, value in enumerate(np.frombuffer(loss, "<f8"), start=1)}
            records.append(record)
        return pd.DataFrame(records, columns=None if records else COLUMNS)


def open_ledger(folder: str | Path) -> Ledger:
    """The ledger of a folder that `calibray run` writes into.

    Args:
        folder: The folder.

    Returns:
        Its ledger.

    Raises:
        InputError: There is none, or it cannot be read.
    """
    path = Path(folder) / LEDGER_FILE
    if not path.is_file():
        raise InputError(
            f"{path}: no such ledger; name a folder that `calibray run` wrote with engine retrace or command"
        )
    return Ledger(path)


def key(candidate: NDArray[np.float64]) -> bytes:
    """A candidate [d] as the ledger keeps it: little-endian doubles, zero without a sign."""
    return (np.asarray(candidate, dtype="<f8") + 0.0).tobytes()


def _switch_to_wal(connection: sqlite3.Connection) -> None:
    """Switch to write-ahead logging; SQLite does not wait by itself for others that are about to do the same."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
            time.sleep(0.05)
        else:
            return
