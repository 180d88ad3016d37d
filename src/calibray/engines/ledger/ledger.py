"""The ledger: every RT call that was ever paid for, in one SQLite file.

An answer is committed before anyone sees it, so that a run that was killed finds it when it is started again. Several
runs may write to one ledger at once; it must lie on a local disk, because SQLite's write-ahead log needs one. Where the
ledger cannot take an answer, a file beside it does (see `rescue`).
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import sqlite3
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from calibray.engines.ledger import claims, rescue
from calibray.engines.ledger import database as schema
from calibray.engines.ledger.database import explain, set_up, transaction
from calibray.engines.ledger.entry import LedgerEntry, read_entry
from calibray.engines.ledger.rescue import Rescued
from calibray.errors import EngineError, InputError

LEDGER_FILE: Final = "ledger.sqlite"
COLUMNS: Final = ("problem", "engine", "time", "seconds", "status", "message")
ENTRY: Final = "path_loss_db, seconds, failure, digest"
log = logging.getLogger(__name__)


class Ledger:
    """RT calls by problem and candidate.

    Args:
        path: The SQLite file; made if absent, with its folder. One that cannot be written is read.

    Attributes:
        read_only: Whether the file cannot be written.

    Raises:
        InputError: The file cannot be opened, is no ledger, is damaged, or one of another version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()
        self.read_only = self.path.is_file() and not (
            os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK | os.X_OK)
        )
        self._run, self._copy = uuid.uuid4().hex, None
        try:
            self._connection = self._opened()
            try:
                set_up(self._connection, self.path)
                self._file = _identity(self.path)
            except BaseException:
                self.close()
                raise
        except (sqlite3.Error, OSError) as error:
            raise InputError(f"{self.path}: cannot be used as a ledger ({explain(error)})") from None
        if not self.read_only:
            self._take_up()

    def _opened(self) -> sqlite3.Connection:
        file = self.path
        if self.read_only:  # even to read it, SQLite would write files beside it
            self._copy = tempfile.TemporaryDirectory(prefix="calibray-ledger-", ignore_cleanup_errors=True)
            file = Path(self._copy.name) / LEDGER_FILE
            for ending in ("", "-wal"):
                with suppress(FileNotFoundError):
                    shutil.copyfile(f"{self.path}{ending}", f"{file}{ending}")
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
        # Every statement is a transaction of its own, committed when `execute` returns.
        return sqlite3.connect(file, timeout=schema.PATIENCE, isolation_level=None)

    def _take_up(self) -> None:
        for file, answers in rescue.waiting(self.path):
            with self._told():
                for answer in answers:
                    self._connection.execute(
                        "INSERT OR IGNORE INTO problems VALUES (?, ?, ?)",
                        (answer.problem, answer.engine, answer.parameters),
                    )
                    self._insert(answer.problem, answer.candidate, answer.entry)
            with suppress(OSError):
                file.unlink()
            log.warning("%s: %d answers taken up from %s", self.path, len(answers), file)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        if self._copy is not None:
            self._copy.cleanup()

    def describe(self, problem: str, engine: str, parameters: Sequence[str]) -> None:
        """Say what a problem's candidates stand for.

        Args:
            problem: Fingerprint of the problem.
            engine: Name of the engine.
            parameters: Names of the parameters.

        Raises:
            EngineError: The ledger cannot be written.
        """
        with self._told():
            self._connection.execute(
                "INSERT OR IGNORE INTO problems VALUES (?, ?, ?)",
                (problem, engine, json.dumps(list(parameters))),
            )

    def find(self, problem: str, candidate: bytes, num_links: int) -> LedgerEntry | None:
        """The entry of a candidate; one that is damaged is told, and dropped.

        Args:
            problem: Fingerprint of the problem.
            candidate: The candidate, by `key`.
            num_links: Number of links L.

        Returns:
            The entry, or None if the candidate was never run.

        Raises:
            EngineError: The ledger cannot be read.
        """
        with self._told():
            row = self._connection.execute(
                f"SELECT id, {ENTRY} FROM answers WHERE problem = ? AND candidate = ?", (problem, candidate)
            ).fetchone()
            if row is None:
                return None
            entry = read_entry(problem, candidate, row[1:], num_links)
            if isinstance(entry, LedgerEntry):
                return entry
            log.warning("%s: call %d is damaged (%s); dropped, and run again", self.path, row[0], entry)
            self._connection.execute("DELETE FROM answers WHERE id = ?", (row[0],))
        return None

    def claim(self, problem: str, candidates: Sequence[bytes], num_links: int) -> list[bytes]:
        """Claim candidates that this run shall pay for; `commit` and `release` end the claims.

        Args:
            problem: Fingerprint of the problem, described before.
            candidates: The candidates, by `key`.
            num_links: Number of links L.

        Returns:
            Those that are not answered, and that no other run is on.

        Raises:
            InputError: The ledger cannot be written at all.
            EngineError: The ledger cannot be written now.
        """
        if self.read_only:
            raise InputError(
                f"{self.path}: cannot be written, and {len(candidates)} candidates are not in it; "
                "make it and its folder writable, or name another folder"
            )
        self._check_place()
        with self._told(), transaction(self._connection):
            missing = [each for each in candidates if self.find(problem, each, num_links) is None]
            return claims.claim(self._connection, self._run, problem, missing)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Keep this run's claims while its engine works, and give them up afterwards."""
        try:
            with claims.beating(self.path, self._run):
                yield
        finally:
            claims.release(self._connection, self._run)

    def commit(self, problem: str, candidate: bytes, entry: LedgerEntry) -> LedgerEntry:
        """Write an entry, unless another run was faster.

        Args:
            problem: Fingerprint of the problem, described before.
            candidate: The candidate, by `key`.
            entry: The entry.

        Returns:
            What the ledger holds, on disk, when this returns: the entry, or the other run's.

        Raises:
            EngineError: The ledger cannot take it; `rescue` keeps it elsewhere.
        """
        with self._told(), transaction(self._connection):
            earlier = self.find(problem, candidate, len(entry.path_loss_db))
            if earlier is None:
                self._insert(problem, candidate, entry)
            self._connection.execute(
                "DELETE FROM claims WHERE problem = ? AND candidate = ?", (problem, candidate)
            )
        self._check_place()
        return earlier or entry

    def _insert(self, problem: str, candidate: bytes, entry: LedgerEntry) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        digest = entry.digest(problem, candidate)
        self._connection.execute(
            "INSERT OR IGNORE INTO answers VALUES (NULL, ?, ?, ?, ?, ?, ?, ?)",
            (problem, candidate, entry.blob, entry.seconds, entry.failure, now, digest),
        )

    def rescue(self, answers: Sequence[Rescued]) -> str:
        """Keep answers that the ledger could not take in a file elsewhere.

        Args:
            answers: The answers.

        Returns:
            A sentence that says where they are.
        """
        answers_are = "1 answer is" if len(answers) == 1 else f"{len(answers)} answers are"
        file = rescue.keep(self.path, answers)
        if file is None:
            return f"{answers_are} lost, for no other place could be written either"
        return f"{answers_are} kept in {file}, and taken up when the run is started again"

    def _all(self) -> list[Rescued]:
        rows = self._connection.execute(
            f"SELECT problem, engine, parameters, candidate, {ENTRY} FROM answers JOIN problems USING (problem)"
        ).fetchall()
        entries = [(row, read_entry(row[0], row[3], row[4:])) for row in rows]
        return [
            Rescued(problem, engine, parameters, candidate, entry)
            for (problem, engine, parameters, candidate, *_), entry in entries
            if isinstance(entry, LedgerEntry)
        ]

    def forget_failures(self, problem: str | None = None) -> int:
        """Take out failed calls, so that they are run again.

        Args:
            problem: Fingerprint of the problem; all problems if None.

        Returns:
            How many there were.

        Raises:
            InputError: The ledger cannot be written at all.
            EngineError: The ledger cannot be written now.
        """
        if self.read_only:
            raise InputError(f"{self.path}: cannot be written; make it and its folder writable")
        with self._told():
            return self._connection.execute(
                "DELETE FROM answers WHERE failure <> '' AND (?1 IS NULL OR problem = ?1)", (problem,)
            ).rowcount

    def table(self, path_loss: bool = False) -> pd.DataFrame:
        """All RT calls in the order in which they were committed; damaged ones are told and left out.

        Args:
            path_loss: Add one column per link: `link_1`, `link_2`, ... [dB].

        Returns:
            Columns `problem` (the start of its fingerprint), `engine`, `time`, `seconds`, `status` ("ok" or "failed"),
            `message`, and one per parameter.

        Raises:
            EngineError: The ledger cannot be read.
        """
        with self._told():
            rows = self._connection.execute(
                f"""SELECT id, problem, engine, time, parameters, candidate, {ENTRY}
                FROM answers JOIN problems USING (problem) ORDER BY id"""
            ).fetchall()
        records = []
        for number, problem, engine, when, parameters, candidate, *columns in rows:
            entry = read_entry(problem, candidate, tuple(columns))
            try:
                names, numbers = json.loads(parameters), np.frombuffer(candidate, "<f8").tolist()
                values = dict(zip(names, numbers, strict=True))
            except (TypeError, ValueError):
                entry, values = "no candidate", {}
            if not isinstance(entry, LedgerEntry):
                log.warning("%s: call %d is damaged (%s); left out", self.path, number, entry)
                continue
            status = "failed" if entry.failure else "ok"
            texts = (problem[:12], engine, when, entry.seconds, status, entry.failure)
            record = dict(zip(COLUMNS, texts, strict=True)) | values
            if path_loss:
                record |= {f"link_{k}": value for k, value in enumerate(entry.path_loss_db.tolist(), start=1)}
            records.append(record)
        return pd.DataFrame(records, columns=None if records else COLUMNS)

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise EngineError(f"{self.path}: the ledger cannot be used ({explain(error)})") from None

    def _check_place(self) -> None:
        if not self.read_only and _identity(self.path) != self._file:
            # What was removed can still be read, for as long as it is held open.
            with self._told():
                kept = self.rescue(self._all())
            raise EngineError(f"{self.path}: was removed or replaced while the run went on; {kept}")


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


def _identity(path: Path) -> tuple[int, int] | None:
    """What file lies at a path."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
