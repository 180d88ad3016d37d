"""Claims: which run is on which candidate, so that two runs on one ledger do not pay for it twice.

A claim holds while its run tells that it is alive, and ends at once where the system knows that the run's process is
gone.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Final

from calibray.engines.ledger.owner import Owner

TABLE: Final = """CREATE TABLE IF NOT EXISTS claims (
    problem TEXT NOT NULL, candidate BLOB NOT NULL, run TEXT NOT NULL, owner TEXT NOT NULL, expires REAL NOT NULL,
    PRIMARY KEY (problem, candidate)) WITHOUT ROWID"""
EXPIRY: Final = 300.0  # without a sign of life, of a run that the system cannot tell anything about [s]
BEAT: Final = 60.0  # between signs of life [s]
RELEASE_PATIENCE: Final = 500  # for a ledger that others write to [ms]
_at_work: set[str] = set()  # the runs of this process


def claim(connection: sqlite3.Connection, run: str, problem: str, candidates: Sequence[bytes]) -> list[bytes]:
    """Claim candidates, within a transaction of the caller's.

    Args:
        connection: The ledger.
        run: Whose the claims are.
        problem: Fingerprint of the problem.
        candidates: The candidates, by `key`.

    Returns:
        Those that no other run is on.
    """
    now, owner = time.time(), json.dumps(Owner.here().record())
    _at_work.add(run)
    claimed = []
    for candidate in candidates:
        row = connection.execute(
            "SELECT run, owner, expires FROM claims WHERE problem = ? AND candidate = ?", (problem, candidate)
        ).fetchone()
        if row is None or row[0] == run or not _holds(row[0], row[1], row[2], now):
            connection.execute(
                "INSERT OR REPLACE INTO claims VALUES (?, ?, ?, ?, ?)",
                (problem, candidate, run, owner, now + EXPIRY),
            )
            claimed.append(candidate)
    return claimed


def _holds(run: object, owner: object, expires: object, now: float) -> bool:
    # A clock that was set back must not make a claim hold for longer than it could.
    if not isinstance(expires, float) or not now < expires <= now + 2 * EXPIRY:
        return False
    try:
        holder = Owner.from_record(json.loads(owner))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    if holder == Owner.here():
        return run in _at_work
    return holder is not None and not holder.gone


def release(connection: sqlite3.Connection, run: str) -> None:
    """Give up all claims of a run; where the ledger cannot be written, they end with the process.

    Args:
        connection: The ledger.
        run: Whose the claims are.
    """
    _at_work.discard(run)
    with suppress(sqlite3.Error):
        (patience,) = connection.execute("PRAGMA busy_timeout").fetchone()
        connection.execute(f"PRAGMA busy_timeout = {RELEASE_PATIENCE}")
        try:
            connection.execute("DELETE FROM claims WHERE run = ?", (run,))
        finally:
            connection.execute(f"PRAGMA busy_timeout = {patience}")


@contextmanager
def beating(file: Path, run: str) -> Iterator[None]:
    """Tell that a run is alive while its engine works.

    Args:
        file: The ledger.
        run: Whose the claims are.
    """
    ended = Event()
    thread = Thread(target=_beat, args=(file, run, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _beat(file: Path, run: str, ended: Event) -> None:
    while not ended.wait(BEAT):
        # Where the ledger cannot be written, the engine's next answer finds that out and tells it.
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, isolation_level=None)) as ledger,
        ):
            ledger.execute("UPDATE claims SET expires = ? WHERE run = ?", (time.time() + EXPIRY, run))
