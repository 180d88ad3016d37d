"""The SQLite file of a ledger: its tables, its transactions, and its errors."""

from __future__ import annotations

import json
import sqlite3
import stat
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from calibray.engines.ledger import claims
from calibray.engines.ledger.answers import LedgerEntry
from calibray.errors import InputError

VERSION: Final = 2
ENDINGS: Final = ("", "-wal", "-shm", "-journal")  # names of the files that SQLite writes, after the ledger's
LOCK_WAIT: Final = 60.0  # longest wait for other writers [s]
_PROBLEMS: Final = """CREATE TABLE IF NOT EXISTS problems (
    problem TEXT PRIMARY KEY, engine TEXT NOT NULL, parameters TEXT NOT NULL) WITHOUT ROWID"""
_ANSWERS: Final = """CREATE TABLE IF NOT EXISTS answers (
    id INTEGER PRIMARY KEY, problem TEXT NOT NULL REFERENCES problems, candidate BLOB NOT NULL,
    path_loss_db BLOB NOT NULL, seconds REAL NOT NULL, failure TEXT NOT NULL, time TEXT NOT NULL,
    digest BLOB, UNIQUE (problem, candidate))"""
_COLUMNS: Final = {
    "problems": ["problem", "engine", "parameters"],
    "answers": ["id", "problem", "candidate", "path_loss_db", "seconds", "failure", "time", "digest"],
    "claims": ["problem", "candidate", "run", "owner", "expires"],
}


def check_own_file(path: Path) -> None:
    """Refuse a ledger that is another file under this name: SQLite would follow it, and write there.

    Args:
        path: The SQLite file, which need not exist.

    Raises:
        InputError: It, or a file that SQLite keeps next to it, is a link, a folder, a device or a FIFO, or has further
            names (hard links).
    """
    for ending in ENDINGS:
        file = path.with_name(path.name + ending)
        try:
            status = file.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        if not stat.S_ISREG(status.st_mode):
            raise InputError(
                f"{file}: must be a file of the ledger's own, but is a link, a folder, a device or a FIFO; move it "
                "away, or name another folder"
            )
        if status.st_nlink > 1:
            raise InputError(
                f"{file}: must be a file of the ledger's own, but has {status.st_nlink} names (hard links); replace "
                "it with a copy, or name another folder"
            )


def set_up(connection: sqlite3.Connection, path: Path) -> None:
    """Create the tables of a new ledger, and refuse a file that is not a ledger.

    Raises:
        InputError: The file is another database, or a ledger of another version.
        sqlite3.OperationalError: Other programs lock the file for too long, or it cannot be used.
        sqlite3.DatabaseError: The file is damaged.
    """
    deadline = time.monotonic() + LOCK_WAIT
    while True:
        try:
            _set_up(connection, path)
        except sqlite3.OperationalError as error:
            # SQLite itself does not wait while another process switches to write-ahead logging.
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
            time.sleep(0.05)
        else:
            return


def _set_up(connection: sqlite3.Connection, path: Path) -> None:
    run = connection.execute
    version = run("PRAGMA user_version").fetchone()[0]
    tables = {name for (name,) in run("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if version not in (0, VERSION):
        raise InputError(
            f"{path}: is a ledger of version {version}, this Calibray uses {VERSION}; name another folder"
        )
    if version == 0 and tables - set(_COLUMNS):
        raise InputError(
            f"{path}: is not a ledger but a database with a table {min(tables - set(_COLUMNS))!r}; "
            "name another folder"
        )
    if tables and (fault := run("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
        raise sqlite3.DatabaseError(f"database disk image is malformed: {fault.splitlines()[-1]}")
    run("PRAGMA journal_mode = WAL")
    run("PRAGMA synchronous = FULL")  # committed answers survive a power failure
    with transaction(connection):
        for table in (_PROBLEMS, _ANSWERS, claims.TABLE):
            run(table)
        for table, columns in _COLUMNS.items():
            names = [row[1] for row in run(f"PRAGMA table_info({table})")]
            if names != columns:
                raise InputError(
                    f"{path}: is not a ledger, its table {table!r} has the columns {', '.join(names)}, must have "
                    f"{', '.join(columns)}; name another folder"
                )
        if version != VERSION:
            run(f"PRAGMA user_version = {VERSION}")


def insert_problem(
    connection: sqlite3.Connection, problem: str, engine: str, parameters: Sequence[str]
) -> None:
    """Write the names that a problem's candidates are listed with, unless they are there."""
    connection.execute(
        "INSERT OR IGNORE INTO problems VALUES (?, ?, ?)", (problem, engine, json.dumps(list(parameters)))
    )


def insert_answer(connection: sqlite3.Connection, problem: str, candidate: bytes, entry: LedgerEntry) -> None:
    """Write an answer, unless there is one."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    digest = entry.digest(problem, candidate)
    connection.execute(
        "INSERT OR IGNORE INTO answers VALUES (NULL, ?, ?, ?, ?, ?, ?, ?)",
        (problem, candidate, entry.blob, entry.seconds, entry.failure, now, digest),
    )


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Several statements that are committed together, or not at all."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            if connection.in_transaction:
                connection.execute("ROLLBACK")
        raise


def explain(error: sqlite3.Error | OSError) -> str:
    """An error of a ledger as a text with its remedy."""
    # The lower byte is the kind of error; the upper ones are details.
    code = (getattr(error, "sqlite_errorcode", None) or 0) & 0xFF
    damaged = "move it away and start again, or recover its contents with `sqlite3 FILE .recover`"
    remedy = {
        sqlite3.SQLITE_FULL: "make room on the disk and start again",
        sqlite3.SQLITE_IOERR: "make room on the disk, or repair it, and start again",
        sqlite3.SQLITE_BUSY: f"another program has locked it for {LOCK_WAIT:g} s: end that and start again",
        sqlite3.SQLITE_LOCKED: "another program has locked it: end that and start again",
        sqlite3.SQLITE_READONLY: "make it and its folder writable and start again",
        sqlite3.SQLITE_CANTOPEN: "make its folder writable and start again",
        sqlite3.SQLITE_CORRUPT: damaged,
    }.get(code, damaged if "malformed" in str(error) else "name another folder")
    return f"{error}; {remedy}"
