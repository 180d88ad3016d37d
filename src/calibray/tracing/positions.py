"""Positions of the antennas: checked before a trace, and compared with the buildings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.tracing.protocol import Links

LARGEST_COORDINATE: Final = 1e9
"""Largest coordinate of an antenna [m], as in a path file."""

LEAST_DISTANCE: Final = 1e-3
"""Distance below which the ends of a link coincide [m]."""


def link_positions(links: Links) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions of transmitters and receivers [L, 3] each, [m], checked.

    Raises:
        InputError: There is no link, a position is not finite or too far away, or the ends of a link coincide.
    """
    tx, rx = np.asarray(links.tx, dtype=float), np.asarray(links.rx, dtype=float)
    if tx.shape != rx.shape or tx.ndim != 2 or tx.shape[1:] != (3,) or not len(tx):
        raise InputError(
            f"links: tx has the shape {tx.shape}, rx {rx.shape}; both must be [links, 3], with at least one link"
        )
    for name, position in (("tx", tx), ("rx", rx)):
        # NaN fails the comparison.
        wrong = np.flatnonzero(~(np.abs(position) <= LARGEST_COORDINATE).all(axis=1))
        if len(wrong):
            link = wrong[0]
            fault = "is not finite" if not np.isfinite(position[link]).all() else "is too far away"
            raise InputError(f"link {link}: {name} position {position[link]} {fault}; give metres")
    coincident = np.flatnonzero(np.linalg.norm(tx - rx, axis=1) < LEAST_DISTANCE)
    if len(coincident):
        link = coincident[0]
        raise InputError(f"link {link}: transmitter and receiver coincide at {tx[link]}; check the columns")
    return tx, rx


@dataclass(frozen=True)
class EnclosedAntennas:
    """Antennas inside closed bodies of the scene, most often because of a wrong position.

    Attributes:
        tx: Rows of the source file whose transmitter is enclosed.
        rx: Rows of the source file whose receiver is enclosed.
        indoors: Whether most links are enclosed, as in an indoor scene; then none of them is suspect.
    """

    tx: tuple[int, ...] = ()
    rx: tuple[int, ...] = ()
    indoors: bool = False

    @classmethod
    def of(cls, row: NDArray[np.integer], tx: NDArray[np.bool_], rx: NDArray[np.bool_]) -> EnclosedAntennas:
        """Collect the rows of the source file [L] whose transmitter or receiver is enclosed [L]."""
        indoors = bool(np.mean(tx | rx) > 0.5)
        return cls(tuple(row[tx].tolist()), tuple(row[rx].tolist()), indoors)
