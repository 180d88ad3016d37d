"""One RT call as a ledger keeps it: with a digest, so that what the disk changed is not taken for an answer."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

RANGE_DB: Final = (-100.0, 10_000.0)  # what no engine's path loss leaves


@dataclass(frozen=True, eq=False)
class LedgerEntry:
    """One RT call of a ledger.

    Attributes:
        path_loss_db: Path loss [L], [dB]; +inf where a link has no path.
        seconds: Time that the engine took [s].
        failure: What went wrong; empty if nothing did.
    """

    path_loss_db: NDArray[np.float64]
    seconds: float
    failure: str = ""

    @property
    def blob(self) -> bytes:
        """The path loss as little-endian doubles."""
        return np.ascontiguousarray(self.path_loss_db, "<f8").tobytes()

    def digest(self, problem: str, candidate: bytes) -> bytes:
        """SHA-256 of all that the entry says, and of what it answers.

        Args:
            problem: Fingerprint of the problem.
            candidate: The candidate, by `key`.

        Returns:
            The digest.
        """
        digest = hashlib.sha256()
        for part in (
            problem.encode(),
            candidate,
            self.blob,
            repr(self.seconds).encode(),
            self.failure.encode(),
        ):
            digest.update(len(part).to_bytes(8, "little"))
            digest.update(part)
        return digest.digest()

    @property
    def fault(self) -> str:
        """Why the entry cannot be what an engine answered; empty if it can."""
        values, (lower, upper) = self.path_loss_db, RANGE_DB
        outside = ~((values >= lower) & (values <= upper) | np.isposinf(values))
        if outside.any():
            return f"path loss {values[outside][0]:g} dB"
        if self.failure and np.isfinite(values).any():
            return "path loss of a failed call"
        return "" if self.seconds >= 0 else f"{self.seconds:g} s"


def read_entry(
    problem: str,
    candidate: bytes,
    columns: tuple[object, ...],
    num_links: int | None = None,
) -> LedgerEntry | str:
    """An entry from a row of a ledger, where it is whole.

    Args:
        problem: Fingerprint of the problem.
        candidate: The candidate, by `key`.
        columns: Path loss as bytes, seconds, failure and digest; entries of the first version have no digest.
        num_links: Number of links L; any if None.

    Returns:
        The entry, or what is wrong with the row.
    """
    blob, seconds, failure, digest = columns
    if not (isinstance(problem, str) and isinstance(candidate, bytes) and isinstance(blob, bytes)):
        return "a value of another type"
    if not (isinstance(seconds, float) and isinstance(failure, str)):
        return "a value of another type"
    if len(blob) % 8 or (num_links is not None and len(blob) != 8 * num_links):
        return f"{len(blob)} bytes of path loss" + ("" if num_links is None else f" for {num_links} links")
    entry = LedgerEntry(np.frombuffer(blob, "<f8").copy(), seconds, failure)
    if digest is not None and digest != entry.digest(problem, candidate):
        return "another checksum"
    return entry.fault or entry


def key(candidate: NDArray[np.float64]) -> bytes:
    """A candidate [d] as the ledger keeps it: little-endian doubles, zero without a sign."""
    return (np.asarray(candidate, dtype="<f8") + 0.0).tobytes()
