"""Rescue: answers that were paid for, kept in a file of JSON lines where the ledger could not take them.

A file lies beside its ledger, or, where that folder is gone or full, in the user's own folder for state; the next run
with that ledger takes it up.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibray.engines.ledger.entry import LedgerEntry

BESIDE: Final = "ledger-rescue-"
ENDING: Final = ".jsonl"
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Rescued:
    """An answer on its way to the ledger.

    Attributes:
        problem: Fingerprint of the problem.
        engine: Name of the engine.
        parameters: Names of the parameters, in JSON.
        candidate: The candidate, by `key`.
        entry: What was answered.
    """

    problem: str
    engine: str
    parameters: str
    candidate: bytes
    entry: LedgerEntry

    @classmethod
    def of(
        cls, problem: str, engine: str, parameters: Sequence[str], candidate: bytes, entry: LedgerEntry
    ) -> Rescued:
        """An answer with its parameters by name."""
        return cls(problem, engine, json.dumps(list(parameters)), candidate, entry)

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
    def from_line(cls, line: str) -> Rescued:
        """The answer that `line` gave.

        Args:
            line: The line.

        Returns:
            The answer.

        Raises:
            ValueError: The line is another, or was changed.
        """
        try:
            content: dict[str, Any] = json.loads(line)
            entry = LedgerEntry(
                np.array(content["path_loss_db"], dtype="<f8"), content["seconds"], content["failure"]
            )
            candidate = bytes.fromhex(content["candidate"])
            digest = entry.digest(content["problem"], candidate).hex()
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(str(error)) from None
        if digest != content.get("digest") or entry.fault:
            raise ValueError("another checksum")
        return cls(content["problem"], content["engine"], content["parameters"], candidate, entry)


def keep(ledger: Path, answers: Iterable[Rescued]) -> Path | None:
    """Write answers to a new file, at the first place that takes them.

    Args:
        ledger: The ledger that they belong to.
        answers: The answers.

    Returns:
        The file; None if it could be written nowhere.
    """
    text = "".join(answer.line() for answer in answers)
    for folder, prefix in _places(ledger):
        file = folder / f"{prefix}{uuid.uuid4().hex}{ENDING}"
        partial = file.with_suffix(".part")
        try:
            if prefix != BESIDE:  # the ledger's own folder is not made again where somebody removed it
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


def waiting(ledger: Path) -> Iterator[tuple[Path, list[Rescued]]]:
    """The files that wait to be taken up by a ledger.

    Args:
        ledger: The ledger.

    Yields:
        Each file with its answers. Lines that cannot be read are told and left out, and their file is kept aside.
    """
    for folder, prefix in _places(ledger):
        for file in sorted(folder.glob(f"{prefix}*{ENDING}")):
            answers, faults = [], 0
            try:
                status = file.lstat()
                if not stat.S_ISREG(status.st_mode) or (prefix != BESIDE and status.st_uid != os.geteuid()):
                    continue  # in a folder that all can write to, another user's is none of ours
                lines = file.read_text(encoding="utf-8").splitlines()
            except (OSError, UnicodeDecodeError):
                continue
            for line in lines:
                try:
                    answers.append(Rescued.from_line(line))
                except ValueError:
                    faults += 1
            if faults:
                aside = file.with_name(file.name + ".damaged")
                log.warning(
                    "%s: %d of %d lines are damaged; kept aside as %s", file, faults, len(lines), aside
                )
                aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
            yield file, answers


def _places(ledger: Path) -> Iterator[tuple[Path, str]]:
    """Folders for rescued answers, and what the names of the files there begin with."""
    yield ledger.parent, BESIDE
    prefix = f"{BESIDE}{hashlib.sha256(str(ledger).encode()).hexdigest()[:16]}-"
    state = os.environ.get("XDG_STATE_HOME") or str(Path("~/.local/state").expanduser())
    if not state.startswith("~"):  # of a user without a home
        yield Path(state) / "calibray", prefix
    yield Path(tempfile.gettempdir()) / f"calibray-rescue-{os.geteuid()}", prefix
