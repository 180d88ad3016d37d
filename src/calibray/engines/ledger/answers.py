"""Answers as a ledger keeps them, with a digest against damage."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

RANGE_DB: Final = (-100.0, 10_000.0)
"""Range of path loss that no engine leaves [dB]; other values are damage."""


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
        """SHA-256 of the entry, its problem and its candidate."""
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
    """Read an entry from a row of a ledger: path loss as bytes, seconds, failure and digest; or its damage."""
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
