"""The ledger stores every completed RT call in one SQLite file.

Each answer is committed before the optimizer receives it, so that a killed run finds all its answers when it is
restarted. Several runs can write to one ledger at the same time. The ledger must be on a local disk, as SQLite's
write-ahead log requires. Answers that the ledger cannot store are written to a rescue file (see `Ledger.rescue`).
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import sqlite3
import tempfile
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, final

import numpy as np
import pandas as pd

from calibray.engines.ledger import database
from calibray.errors import EngineError, InputError
from calibray.support.messages import counted

LEDGER_FILE: Final = "ledger.sqlite"
COLUMNS: Final = ("problem", "engine", "time", "seconds", "status", "message")
ENTRY: Final = "path_loss_db, seconds, failure, digest, rays"
ANSWERS: Final = "answers LEFT JOIN rays USING (problem, candidate)"
_LOG: Final = logging.getLogger(__name__)


@final
class Ledger:
    """Stored RT calls by problem and candidate.

    Args:
        path: The SQLite file; if it does not exist, it is created, together with its folder. A file that cannot be
            written is opened read-only.

    Attributes:
        read_only: Whether the file cannot be written.

    Raises:
        InputError: The file cannot be opened, is damaged, is not a ledger of this version, or is a symbolic or hard
            link.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()
        self.read_only = self.path.is_file() and not (
            os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK | os.X_OK)
        )
        self._run, self._copy = uuid.uuid4().hex, None
        try:
            database.check_own_file(self.path)
            self._connection = self._connect()
            try:
                # SQLite opens the file by name, so the file may have been replaced since the check.
                database.check_own_file(self.path)
                database.set_up(self._connection, self.path)
                self._file = _identity(self.path)
            except BaseException:
                self.close()
                raise
        except (sqlite3.Error, OSError) as error:
            raise InputError(f"{self.path}: cannot be used as a ledger ({database.explain(error)})") from None
        if not self.read_only:
            self._insert_rescued()

    def _connect(self) -> sqlite3.Connection:
        file = self.path
        if self.read_only:  # SQLite writes files next to a database even when reading it, so a copy is read
            self._copy = tempfile.TemporaryDirectory(prefix="calibray-ledger-", ignore_cleanup_errors=True)
            file = Path(self._copy.name) / LEDGER_FILE
            for ending in ("", "-wal"):
                with suppress(FileNotFoundError):
                    shutil.copyfile(f"{self.path}{ending}", f"{file}{ending}")
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
        # Without an isolation level, every statement is a transaction that is committed when `execute` returns.
        return sqlite3.connect(file, timeout=database.LOCK_WAIT, isolation_level=None)

    def _insert_rescued(self) -> None:
        columns = "problem, candidate, path_loss_db, seconds, failure, time, digest"
        for file in database.rescue_files(self.path):
            run = self._connection.execute
            with self._errors():
                run("ATTACH ? AS rescue", (str(file),))
                try:
                    with database.transaction(self._connection):
                        run("INSERT OR IGNORE INTO problems SELECT * FROM rescue.problems")
                        answers = run(
                            f"INSERT OR IGNORE INTO answers ({columns}) SELECT {columns} FROM rescue.answers"
                        ).rowcount
                        run("INSERT OR IGNORE INTO rays SELECT * FROM rescue.rays")
                finally:
                    run("DETACH rescue")
            with suppress(OSError):
                file.unlink()
            _LOG.warning("%s: %s read from the rescue file %s", self.path, counted(answers, "answer"), file)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()
        if self._copy is not None:
            self._copy.cleanup()

    def describe(self, problem: str, engine: str, parameters: Sequence[str]) -> None:
        """Write a problem's engine and the names of its parameters.

        Raises:
            EngineError: The ledger cannot be written.
        """
        with self._errors():
            database.insert_problem(self._connection, problem, engine, parameters)

    def changed_program_files(self, problem: str, files: Mapping[str, str]) -> list[str]:
        """Names of those files of a program that have changed since the program's calls were stored.

        `files` contains the current files with their digests. If the problem has no stored calls, the current digests
        are stored.

        Raises:
            EngineError: The ledger cannot be read or written.
        """
        with self._errors():
            run = self._connection.execute
            (stored,) = run("SELECT EXISTS (SELECT 1 FROM answers WHERE problem = ?)", (problem,)).fetchone()
            if not stored and not self.read_only:
                for file, digest in files.items():
                    run("INSERT OR REPLACE INTO programs VALUES (?, ?, ?)", (problem, file, digest))
            earlier = dict(run("SELECT file, digest FROM programs WHERE problem = ?", (problem,)))
        return [name for name, digest in files.items() if earlier.get(name, digest) != digest]

    def find(self, problem: str, candidate: bytes, num_links: int) -> database.LedgerEntry | None:
        """The entry of a candidate; None if there is no entry. A damaged entry is deleted, with a warning.

        Raises:
            EngineError: The ledger cannot be read.
        """
        with self._errors():
            row = self._connection.execute(
                f"SELECT id, {ENTRY} FROM {ANSWERS} WHERE problem = ? AND candidate = ?", (problem, candidate)
            ).fetchone()
            if row is None:
                return None
            entry = database.read_entry(problem, candidate, row[1:], num_links)
            if isinstance(entry, database.LedgerEntry):
                return entry
            _LOG.warning(
                "%s: call %d is damaged (%s); the call is deleted and run again", self.path, row[0], entry
            )
            self._connection.execute("DELETE FROM answers WHERE id = ?", (row[0],))
            self._connection.execute(
                "DELETE FROM rays WHERE problem = ? AND candidate = ?", (problem, candidate)
            )
        return None

    def claim(self, problem: str, candidates: Sequence[bytes], num_links: int) -> list[bytes]:
        """Claim the candidates that this run will compute; `commit` and the end of `working` release the claims.

        Returns the candidates that have no answer and are not claimed by another run.

        Raises:
            InputError: The ledger is read-only.
            EngineError: The ledger cannot be written at present.
        """
        if self.read_only:
            raise InputError(
                f"{self.path}: cannot be written, and has no answer for {counted(len(candidates), 'candidate')}; "
                "make the ledger and its folder writable, or choose another folder"
            )
        self._check_identity()
        with self._errors(), database.transaction(self._connection):
            missing = [
                candidate for candidate in candidates if self.find(problem, candidate, num_links) is None
            ]
            return database.claim(self._connection, self._run, problem, missing)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Renew this run's claims while its engine is running, and release them afterwards."""
        try:
            with database.renewing(self.path, self._run):
                yield
        finally:
            database.release(self._connection, self._run)

    def commit(self, problem: str, candidate: bytes, entry: database.LedgerEntry) -> database.LedgerEntry:
        """Write the entry of a candidate, unless another run has already written one; return the stored entry.

        Raises:
            EngineError: The ledger cannot store the entry; `rescue` can write the entry to a rescue file.
        """
        with self._errors(), database.transaction(self._connection):
            earlier = self.find(problem, candidate, len(entry.path_loss_db))
            if earlier is None:
                database.insert_answer(self._connection, problem, candidate, entry)
            self._connection.execute(
                "DELETE FROM claims WHERE problem = ? AND candidate = ?", (problem, candidate)
            )
        self._check_identity()
        return earlier or entry

    def rescue(
        self,
        problem: str,
        engine: str,
        parameters: Sequence[str],
        answers: Sequence[tuple[bytes, database.LedgerEntry]],
    ) -> str:
        """Write answers missing from the ledger to a rescue file, and return a sentence with the file's path."""

        def fill(connection: sqlite3.Connection) -> None:
            database.set_up(connection, self.path)
            with database.transaction(connection):
                database.insert_problem(connection, problem, engine, parameters)
                for candidate, entry in answers:
                    database.insert_answer(connection, problem, candidate, entry)

        return _describe_rescue(database.write_rescue_file(self.path, fill), len(answers))

    def forget_failures(self, problem: str | None = None) -> int:
        """Delete the failed calls of one problem or of all, so that they are run again; return how many were deleted.

        Raises:
            InputError: The ledger is read-only.
            EngineError: The ledger cannot be written at present.
        """
        if self.read_only:
            raise InputError(f"{self.path}: cannot be written; make the ledger and its folder writable")
        with self._errors():
            return self._connection.execute(
                "DELETE FROM answers WHERE failure <> '' AND (?1 IS NULL OR problem = ?1)", (problem,)
            ).rowcount

    def table(self, path_loss: bool = False) -> pd.DataFrame:
        """All RT calls in the order in which they were committed; damaged calls are omitted, with a warning.

        The columns are `problem` (the start of the problem's fingerprint), `engine`, `time`, `seconds`, `status` ("ok"
        or "failed"), `message` and one column per parameter. With `path_loss`, there is also one column per link:
        `link_1`, `link_2`, ... [dB].

        Raises:
            EngineError: The ledger cannot be read.
        """
        with self._errors():
            rows = self._connection.execute(
                f"""SELECT id, problem, engine, time, parameters, candidate, {ENTRY}
                FROM {ANSWERS} JOIN problems USING (problem) ORDER BY id"""
            ).fetchall()
        records = []
        for number, problem, engine, when, parameters, candidate, *columns in rows:
            entry = database.read_entry(problem, candidate, tuple(columns))
            try:
                names, numbers = json.loads(parameters), np.frombuffer(candidate, "<f8").tolist()
                values = dict(zip(names, numbers, strict=True))
            except (TypeError, ValueError):
                entry, values = "no candidate", {}
            if not isinstance(entry, database.LedgerEntry):
                _LOG.warning("%s: call %d is damaged (%s) and is omitted", self.path, number, entry)
                continue
            status = "failed" if entry.failure else "ok"
            texts = (problem[:12], engine, when, entry.seconds, status, entry.failure)
            record = dict(zip(COLUMNS, texts, strict=True)) | values
            if path_loss:
                record |= {f"link_{k}": value for k, value in enumerate(entry.path_loss_db.tolist(), start=1)}
            records.append(record)
        return pd.DataFrame(records, columns=None if records else COLUMNS)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Convert an SQLite error to an EngineError that states a remedy."""
        try:
            yield
        except sqlite3.Error as error:
            raise EngineError(f"{self.path}: the ledger cannot be used ({database.explain(error)})") from None

    def _check_identity(self) -> None:
        """If the file was removed or replaced, rescue all answers and end the run."""
        if self.read_only or _identity(self.path) == self._file:
            return
        with self._errors():
            # A file that was removed can still be read while it is open.
            (count,) = self._connection.execute("SELECT COUNT(*) FROM answers").fetchone()
            rescued = _describe_rescue(database.write_rescue_file(self.path, self._connection.backup), count)
        raise EngineError(f"{self.path}: was removed or replaced during the run; {rescued}")


def open_ledger(folder: str | Path) -> Ledger:
    """Open the ledger in a folder that `calibray run` has written.

    Raises:
        InputError: The folder contains no ledger, or the ledger cannot be read.
    """
    path = Path(folder) / LEDGER_FILE
    if not path.is_file():
        raise InputError(
            f"{path}: no such ledger; give a folder that `calibray run` wrote with the engine retrace or command"
        )
    return Ledger(path)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device number and inode of the file at a path."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _describe_rescue(file: Path | None, count: int) -> str:
    answers_are = "1 answer is" if count == 1 else f"{count} answers are"
    if file is None:
        return f"{answers_are} lost, because no other folder was writable either"
    return f"{answers_are} kept in {file}, and used when the run is started again"
