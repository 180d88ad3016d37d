"""Claims state which run works on which candidate, so that two runs with one ledger do not both pay for it.

A claim is valid while its run renews it, and ends at once if the run's process has certainly ended. Each observer uses
its own clock to time renewals, because the clocks of two machines may differ by hours.
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

from calibray.engines.process_owner import ProcessOwner

TABLE: Final = """CREATE TABLE IF NOT EXISTS claims (
    problem TEXT NOT NULL, candidate BLOB NOT NULL, run TEXT NOT NULL, owner TEXT NOT NULL, expires REAL NOT NULL,
    PRIMARY KEY (problem, candidate)) WITHOUT ROWID"""
EXPIRY: Final = 300.0  # time without a renewal after which a claim ends, as the observer measures it [s]
SKEW: Final = 86_400.0  # largest difference between the clocks of two machines [s]; older claims end at once
RENEWAL: Final = 60.0  # interval between renewals [s]
RELEASE_WAIT: Final = 500  # longest wait of `release` for other writers [ms]
_active_runs: set[str] = set()  # the runs of this process
_observed: dict[tuple[str, bytes, str], tuple[float, float]] = {}
"""Claims of other runs: their `expires` at its last change, and this process's clock at that time [s]."""


def claim(connection: sqlite3.Connection, run: str, problem: str, candidates: Sequence[bytes]) -> list[bytes]:
    """Claim candidates within a transaction of the caller, and return those that no other run has claimed."""
    now, owner = time.time(), json.dumps(ProcessOwner.current().record())
    _active_runs.add(run)
    claimed = []
    for candidate in candidates:
        row = connection.execute(
            "SELECT run, owner, expires FROM claims WHERE problem = ? AND candidate = ?", (problem, candidate)
        ).fetchone()
        if (
            row is None
            or row[0] == run
            or not _is_valid((problem, candidate, str(row[0])), row[1], row[2], now)
        ):
            connection.execute(
                "INSERT OR REPLACE INTO claims VALUES (?, ?, ?, ?, ?)",
                (problem, candidate, run, owner, now + EXPIRY),
            )
            claimed.append(candidate)
    return claimed


def _is_valid(claimed: tuple[str, bytes, str], owner: object, expires: object, now: float) -> bool:
    """Whether a claim of another run is still valid.

    A claim is invalid if its process has ended, or has not renewed it for `EXPIRY`. `expires` and `now` are times [s
    since 1970], by the clock of the claim's machine and of this machine.
    """
    if not isinstance(expires, float) or not abs(expires - now) <= SKEW + EXPIRY:
        return False
    try:
        holder = ProcessOwner.from_record(json.loads(owner))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    if holder is None or holder.is_gone:
        return False
    if holder.is_current:
        return claimed[2] in _active_runs
    last, since = _observed.get(claimed, (None, 0.0))
    if last != expires:
        _observed[claimed] = expires, time.monotonic()
        return True
    return time.monotonic() - since <= EXPIRY


def release(connection: sqlite3.Connection, run: str) -> None:
    """Release all claims of a run; if the ledger cannot be written, they end with the process."""
    _active_runs.discard(run)
    with suppress(sqlite3.Error):
        (timeout,) = connection.execute("PRAGMA busy_timeout").fetchone()
        connection.execute(f"PRAGMA busy_timeout = {RELEASE_WAIT}")
        try:
            connection.execute("DELETE FROM claims WHERE run = ?", (run,))
        finally:
            connection.execute(f"PRAGMA busy_timeout = {timeout}")


@contextmanager
def renewing(file: Path, run: str) -> Iterator[None]:
    """Renew a run's claims while its engine works."""
    ended = Event()
    thread = Thread(target=_renew, args=(file, run, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _renew(file: Path, run: str, ended: Event) -> None:
    while not ended.wait(RENEWAL):
        # If the ledger cannot be written, the engine's next answer fails and reports it.
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, isolation_level=None)) as ledger,
        ):
            ledger.execute("UPDATE claims SET expires = ? WHERE run = ?", (time.time() + EXPIRY, run))
