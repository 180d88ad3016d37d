"""The SQLite file of a ledger: tables, transactions, errors, and entries with digests that reveal damage.

A rescue file is written next to the ledger. If the ledger's folder is missing or full, the rescue file is written to
the user's state folder or the temporary folder. The next run with the same ledger reads the rescue file.

A claim states which run computes a candidate, so that two runs with the same ledger do not compute it twice. A
claim is valid as long as its run renews it. A claim ends immediately if its run's process is known to have ended. Each
run times the renewals of other runs by its own clock, because the clocks of two machines can differ by hours.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sqlite3
import stat
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Thread
from typing import Final

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_state_path

from calibray.engines.process_owner import ProcessOwner
from calibray.errors import InputError

_CLAIMS: Final = """CREATE TABLE IF NOT EXISTS claims (
    problem TEXT NOT NULL, candidate BLOB NOT NULL, run TEXT NOT NULL, owner TEXT NOT NULL, expires REAL NOT NULL,
    PRIMARY KEY (problem, candidate)) WITHOUT ROWID"""
EXPIRY: Final = 300.0  # a claim ends if another run observes no renewal for this time [s]
SKEW: Final = 86_400.0  # maximum accepted difference between the clocks of two machines [s]
RENEWAL: Final = EXPIRY / 5  # interval between renewals [s]; a few renewals may fail
_active_runs: set[str] = set()  # the runs of this process
_observed: dict[tuple[str, bytes, str], tuple[float, float]] = {}
"""For each claim of another run, the latest value of `expires` and the time [s] at which this value last changed, by
the clock of this process."""


def claim(connection: sqlite3.Connection, run: str, problem: str, candidates: Sequence[bytes]) -> list[bytes]:
    """Claim the candidates that no other run has claimed, within the caller's transaction, and return them."""
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

    A claim is invalid if its process has ended, or has not renewed it for longer than `EXPIRY`. `expires` and
    `now` are times [s since 1970] by the clocks of the claim's machine and of this machine, respectively.
    """
    # A clock may be wrong by up to `SKEW`. If a claim's expiry is further than this from the present time, the claim is
    # damaged or abandoned.
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
    """Release all claims of a run. If the ledger cannot be written, the claims become invalid when the process ends."""
    _active_runs.discard(run)
    with suppress(sqlite3.Error):
        (timeout,) = connection.execute("PRAGMA busy_timeout").fetchone()
        connection.execute(f"PRAGMA busy_timeout = {500}")
        try:
            connection.execute("DELETE FROM claims WHERE run = ?", (run,))
        finally:
            connection.execute(f"PRAGMA busy_timeout = {timeout}")


@contextmanager
def renewing(file: Path, run: str) -> Iterator[None]:
    """Renew a run's claims while its engine is running."""
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
        # If the ledger cannot be written, the attempt to store the engine's next answer will report the error.
        with (
            suppress(sqlite3.Error),
            closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, isolation_level=None)) as ledger,
        ):
            ledger.execute("UPDATE claims SET expires = ? WHERE run = ?", (time.time() + EXPIRY, run))


RANGE_DB: Final = (-100.0, 10_000.0)
"""Range of the path loss [dB] in any valid answer; values outside this range indicate damage."""


@dataclass(frozen=True, eq=False)
class LedgerEntry:
    """One RT call of a ledger.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf for a link without a path.
        seconds: Duration of the call [s].
        failure: Error message; empty if the call succeeded.
        rays: Rays or further observables, as in `engines.protocol.Answer`; empty if there are none.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""
    rays: bytes = b""

    @property
    def blob(self) -> bytes:
        """The path loss as little-endian doubles."""
        return np.ascontiguousarray(self.path_loss_db, "<f8").tobytes()

    def digest(self, problem: str, candidate: bytes) -> bytes:
        """SHA-256 of the entry, its problem and its candidate."""
        digest = hashlib.sha256()
        parts = [problem.encode(), candidate, self.blob, repr(self.seconds).encode(), self.failure.encode()]
        for part in [*parts, self.rays] if self.rays else parts:
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        return digest.digest()

    @property
    def fault(self) -> str:
        """The reason why this answer cannot come from an engine; empty if it can."""
        values, (lower, upper) = self.path_loss_db, RANGE_DB
        outside = ~((values >= lower) & (values <= upper) | np.isposinf(values))
        if outside.any():
            return f"path loss {values[outside][0]:g} dB"
        if self.failure and np.isfinite(values).any():
            return "path loss of a failed call"
        return "" if self.seconds >= 0 else f"{self.seconds:g} s"


def read_entry(
    problem: str, candidate: bytes, columns: tuple[object, ...], num_links: int | None = None
) -> LedgerEntry | str:
    """Read a ledger row (path loss as bytes, seconds, failure, digest, rays), or describe its damage."""
    blob, seconds, failure, digest, rays = columns
    if not (isinstance(problem, str) and isinstance(candidate, bytes) and isinstance(blob, bytes)):
        return "a value of the wrong type"
    if not (isinstance(seconds, float) and isinstance(failure, str) and isinstance(rays, bytes | None)):
        return "a value of the wrong type"
    if len(blob) % 8 or (num_links is not None and len(blob) != 8 * num_links):
        return f"{len(blob)} bytes of path loss" + ("" if num_links is None else f" for {num_links} links")
    entry = LedgerEntry(np.frombuffer(blob, "<f8").copy(), seconds, failure, rays or b"")
    if digest != entry.digest(problem, candidate):
        return "a wrong checksum"
    return entry.fault or entry


def key(candidate: NDArray[np.float64]) -> bytes:
    """A candidate [d] in the ledger's format: little-endian doubles, with -0.0 as 0.0."""
    return (np.asarray(candidate, dtype="<f8") + 0.0).tobytes()


VERSION: Final = 2
ENDINGS: Final = ("", "-wal", "-shm", "-journal")  # endings that SQLite appends to the ledger's name
LOCK_WAIT: Final = 60.0  # maximum time to wait for other writers [s]
_PROBLEMS: Final = """CREATE TABLE IF NOT EXISTS problems (
    problem TEXT PRIMARY KEY, engine TEXT NOT NULL, parameters TEXT NOT NULL) WITHOUT ROWID"""
_ANSWERS: Final = """CREATE TABLE IF NOT EXISTS answers (
    id INTEGER PRIMARY KEY, problem TEXT NOT NULL REFERENCES problems, candidate BLOB NOT NULL,
    path_loss_db BLOB NOT NULL, seconds REAL NOT NULL, failure TEXT NOT NULL, time TEXT NOT NULL,
    digest BLOB, UNIQUE (problem, candidate))"""
_RAYS: Final = """CREATE TABLE IF NOT EXISTS rays (
    problem TEXT NOT NULL, candidate BLOB NOT NULL, rays BLOB NOT NULL, PRIMARY KEY (problem, candidate))"""
_PROGRAMS: Final = """CREATE TABLE IF NOT EXISTS programs (
    problem TEXT NOT NULL, file TEXT NOT NULL, digest TEXT NOT NULL, PRIMARY KEY (problem, file)) WITHOUT ROWID"""
_COLUMNS: Final = {
    "problems": ["problem", "engine", "parameters"],
    "answers": ["id", "problem", "candidate", "path_loss_db", "seconds", "failure", "time", "digest"],
    "rays": ["problem", "candidate", "rays"],
    "programs": ["problem", "file", "digest"],
    "claims": ["problem", "candidate", "run", "owner", "expires"],
}


def check_own_file(path: Path) -> None:
    """Refuse a ledger path through which SQLite would write to another file.

    Raises:
        InputError: The file, or a file that SQLite keeps next to the ledger, is a link, a folder, a device or a FIFO,
            or has several names (hard links).
    """
    for ending in ENDINGS:
        file = path.with_name(path.name + ending)
        try:
            status = file.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        if not stat.S_ISREG(status.st_mode):
            raise InputError(
                f"{file}: must be a regular file, but is a link, a folder, a device or a FIFO; move it away or "
                "choose another folder"
            )
        if status.st_nlink > 1:
            raise InputError(
                f"{file}: must be a file with a single name, but has {status.st_nlink} names (hard links); replace "
                "the file with a copy, or choose another folder"
            )


def set_up(connection: sqlite3.Connection, path: Path) -> None:
    """Create the tables of a new ledger, and refuse a file that is not a ledger.

    Raises:
        InputError: The file is another database, or a ledger of another version.
        sqlite3.OperationalError: Another program locks the file for too long, or the file cannot be used.
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
            f"{path}: is a ledger of version {version}, but Calibray uses version {VERSION}; choose another folder"
        )
    if version == 0 and tables - set(_COLUMNS):
        raise InputError(
            f"{path}: is a database with a table {min(tables - set(_COLUMNS))!r}, not a ledger; choose another folder"
        )
    if tables and (fault := run("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
        raise sqlite3.DatabaseError(f"database disk image is malformed: {fault.splitlines()[-1]}")
    run("PRAGMA journal_mode = WAL")
    run("PRAGMA synchronous = FULL")  # committed answers survive a power failure
    with transaction(connection):
        for table in (_PROBLEMS, _ANSWERS, _RAYS, _PROGRAMS, _CLAIMS):
            run(table)
        for table, columns in _COLUMNS.items():
            names = [row[1] for row in run(f"PRAGMA table_info({table})")]
            if names != columns:
                raise InputError(
                    f"{path}: is not a ledger: its table {table!r} has the columns {', '.join(names)}; it must have "
                    f"{', '.join(columns)}; choose another folder"
                )
        if version != VERSION:
            run(f"PRAGMA user_version = {VERSION}")


def insert_problem(
    connection: sqlite3.Connection, problem: str, engine: str, parameters: Sequence[str]
) -> None:
    """Write a problem's engine and the names of its parameters, unless the ledger already contains them."""
    connection.execute(
        "INSERT OR IGNORE INTO problems VALUES (?, ?, ?)", (problem, engine, json.dumps(list(parameters)))
    )


def insert_answer(connection: sqlite3.Connection, problem: str, candidate: bytes, entry: LedgerEntry) -> None:
    """Write an answer, unless the ledger already contains one."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    digest = entry.digest(problem, candidate)
    connection.execute(
        "INSERT OR IGNORE INTO answers VALUES (NULL, ?, ?, ?, ?, ?, ?, ?)",
        (problem, candidate, entry.blob, entry.seconds, entry.failure, now, digest),
    )
    if entry.rays:
        connection.execute("INSERT OR IGNORE INTO rays VALUES (?, ?, ?)", (problem, candidate, entry.rays))


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Commit several statements together; if one fails, commit none of them."""
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
    """The text of a ledger error, followed by a remedy."""
    # The lowest byte of the code states the type of error; the other bytes state details.
    code = (getattr(error, "sqlite_errorcode", None) or 0) & 0xFF
    damaged = "move the ledger away and start again, or recover its contents with `sqlite3 FILE .recover`"
    end_program = "end that program and start again"
    remedy = {
        sqlite3.SQLITE_FULL: "free disk space and start again",
        sqlite3.SQLITE_IOERR: "free disk space, or repair the disk, and start again",
        sqlite3.SQLITE_BUSY: f"another program has locked the ledger for {LOCK_WAIT:g} s: {end_program}",
        sqlite3.SQLITE_LOCKED: f"another program has locked the ledger: {end_program}",
        sqlite3.SQLITE_READONLY: "make the ledger and its folder writable and start again",
        sqlite3.SQLITE_CANTOPEN: "make the ledger's folder writable and start again",
        sqlite3.SQLITE_CORRUPT: damaged,
    }.get(code, damaged if "malformed" in str(error) else "choose another folder")
    return f"{error}; {remedy}"


PREFIX: Final = "ledger-rescue-"
SUFFIX: Final = ".sqlite"
_LOG: Final = logging.getLogger(__name__)


def write_rescue_file(ledger: Path, fill: Callable[[sqlite3.Connection], None]) -> Path | None:
    """Write a ledger's rescue file to the first writable folder, and return its path; None if no folder is writable."""
    for folder, prefix in _folders(ledger):
        file = folder / f"{prefix}{uuid.uuid4().hex}{SUFFIX}"
        partial = file.with_suffix(".part")
        try:
            if folder != ledger.parent:  # a removed ledger folder is not created again
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
    """The rescue files of a ledger; damaged files are renamed, with a warning."""
    for folder, prefix in _folders(ledger):
        for file in sorted(folder.glob(f"{prefix}*{SUFFIX}")):
            try:
                status = file.lstat()
                # All users can write to the temporary folder, so a file that belongs to another user must not be
                # accepted.
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
    """The folders for a ledger's rescue files, each with the prefix that the names of these files have there."""
    yield ledger.parent, PREFIX
    prefix = f"{PREFIX}{hashlib.sha256(str(ledger).encode()).hexdigest()[:16]}-"
    state = user_state_path("calibray", appauthor=False)
    if state.is_absolute():  # the path begins with "~" for a user without a home folder
        yield state, prefix
    yield Path(tempfile.gettempdir()) / f"calibray-rescue-{os.geteuid()}", prefix
