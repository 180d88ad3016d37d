"""Answers as a ledger keeps them, with a digest against damage, and rescue files for answers that it could not take.

A rescue file of JSON lines is written next to the ledger or, if that folder is gone or full, into the user's own state
folder. The next run with the ledger reads it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import platformdirs
from numpy.typing import NDArray

RANGE_DB: Final = (-100.0, 10_000.0)
"""Range of path loss that no engine leaves [dB]; other values are damage."""

RESCUE_PREFIX: Final = "ledger-rescue-"
RESCUE_SUFFIX: Final = ".jsonl"
_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LedgerEntry:
    """One RT call of a ledger.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf where a link has no path.
        seconds: Time of the call [s].
        failure: Error message; empty if the call succeeded.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""

    @property
    def blob(self) -> bytes:
        """The path loss as little-endian doubles."""
        return np.ascontiguousarray(self.path_loss_db, "<f8").tobytes()

    def digest(self, problem: str, candidate: bytes) -> bytes:
        """SHA-256 of the entry and of what it answers.

        Args:
            problem: Fingerprint of the problem.
            candidate: The candidate, by `key`.
        """
        digest = hashlib.sha256()
        parts = (problem.encode(), candidate, self.blob, repr(self.seconds).encode(), self.failure.encode())
        for part in parts:
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        return digest.digest()

    @property
    def fault(self) -> str:
        """Why an engine cannot have given this answer; empty if it can."""
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
    """Read an entry from a row of a ledger.

    Args:
        problem: Fingerprint of the problem.
        candidate: The candidate, by `key`.
        columns: Path loss as bytes, seconds, failure and digest.
        num_links: Number of links L; any if None.

    Returns:
        The entry, or the damage of the row.
    """
    blob, seconds, failure, digest = columns
    if not (isinstance(problem, str) and isinstance(candidate, bytes) and isinstance(blob, bytes)):
        return "a value of another type"
    if not (isinstance(seconds, float) and isinstance(failure, str)):
        return "a value of another type"
    if len(blob) % 8 or (num_links is not None and len(blob) != 8 * num_links):
        return f"{len(blob)} bytes of path loss" + ("" if num_links is None else f" for {num_links} links")
    entry = LedgerEntry(np.frombuffer(blob, "<f8").copy(), seconds, failure)
    if digest != entry.digest(problem, candidate):
        return "another checksum"
    return entry.fault or entry


def key(candidate: NDArray[np.float64]) -> bytes:
    """A candidate [d] as the ledger keeps it: little-endian doubles, with -0.0 as 0.0."""
    return (np.asarray(candidate, dtype="<f8") + 0.0).tobytes()


@dataclass(frozen=True, eq=False)
class RescuedAnswer:
    """An answer on its way to the ledger.

    Attributes:
        problem: Fingerprint of the problem.
        engine: Name of the engine.
        parameters: Names of the parameters, in JSON.
        candidate: The candidate, by `key`.
        entry: The answer.
    """

    problem: str
    engine: str
    parameters: str
    candidate: bytes
    entry: LedgerEntry

    def line(self) -> str:
        """The answer in one line of JSON."""
        content = {
            "problem": self.problem,
            "engine": self.engine,
            "parameters": self.parameters,
            "candidate": self.candidate.hex(),
            "path_loss_db": self.entry.path_loss_db.tolist(),
            "seconds": self.entry.seconds,
            "failure": self.entry.failure,
            "digest": self.entry.digest(self.problem, self.candidate).hex(),
        }
        return json.dumps(content) + "\n"

    @classmethod
    def from_line(cls, line: str) -> RescuedAnswer:
        """The answer from its line.

        Args:
            line: The line.

        Returns:
            The answer.

        Raises:
            ValueError: The line is malformed or damaged.
        """
        try:
            content: dict[str, Any] = json.loads(line)
            path_loss = np.array(content["path_loss_db"], dtype="<f8")
            entry = LedgerEntry(path_loss, content["seconds"], content["failure"])
            candidate = bytes.fromhex(content["candidate"])
            digest = entry.digest(content["problem"], candidate).hex()
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(str(error)) from None
        if digest != content.get("digest") or entry.fault:
            raise ValueError("another checksum")
        return cls(content["problem"], content["engine"], content["parameters"], candidate, entry)


def write_rescue_file(ledger: Path, answers: Iterable[RescuedAnswer]) -> Path | None:
    """Write answers to a new file in the first folder that can be written.

    Args:
        ledger: The ledger that the answers belong to.
        answers: The answers.

    Returns:
        The file; None if no folder can be written.
    """
    text = "".join(answer.line() for answer in answers)
    for folder, prefix in _rescue_folders(ledger):
        file = folder / f"{prefix}{uuid.uuid4().hex}{RESCUE_SUFFIX}"
        partial = file.with_suffix(".part")
        try:
            if folder != ledger.parent:  # a ledger's folder that somebody removed stays removed
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with partial.open("x", encoding="utf-8") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(file)
        except OSError:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            continue
        return file
    return None


def read_rescue_files(ledger: Path) -> Iterator[tuple[Path, list[RescuedAnswer]]]:
    """The rescue files of a ledger.

    Args:
        ledger: The ledger.

    Yields:
        Each file with its answers. Damaged lines are left out with a warning, and their file is kept as a copy.
    """
    for folder, prefix in _rescue_folders(ledger):
        for file in sorted(folder.glob(f"{prefix}*{RESCUE_SUFFIX}")):
            try:
                status = file.lstat()
                # The temporary folder is open to all users: another user's file must not become an answer.
                if not stat.S_ISREG(status.st_mode) or (
                    folder != ledger.parent and status.st_uid != os.geteuid()
                ):
                    continue
                lines = file.read_text(encoding="utf-8").splitlines()
            except (OSError, UnicodeDecodeError):
                continue
            answers = []
            for line in lines:
                with suppress(ValueError):
                    answers.append(RescuedAnswer.from_line(line))
            if damaged := len(lines) - len(answers):
                copy = file.with_name(file.name + ".damaged")
                _LOG.warning("%s: %d of %d lines are damaged; copied to %s", file, damaged, len(lines), copy)
                copy.write_text("\n".join(lines) + "\n", encoding="utf-8")
            yield file, answers


def _rescue_folders(ledger: Path) -> Iterator[tuple[Path, str]]:
    """Folders for rescue files, and the prefix of the ledger's files in each."""
    yield ledger.parent, RESCUE_PREFIX
    prefix = f"{RESCUE_PREFIX}{hashlib.sha256(str(ledger).encode()).hexdigest()[:16]}-"
    yield platformdirs.user_state_path("calibray"), prefix
    yield Path(tempfile.gettempdir()) / f"calibray-rescue-{os.geteuid()}", prefix
