"""Enclosed antennas: links whose ends stand inside closed bodies of the scene, most often by a wrong position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class EnclosedAntennas:
    """Antennas that stand inside closed bodies of the scene.

    Attributes:
        tx: Lines in the source file of the links whose transmitter is enclosed.
        rx: The same for receivers.
        indoors: Whether most are, as they are in a building's inside; then none is suspect.
    """

    tx: tuple[int, ...] = ()
    rx: tuple[int, ...] = ()
    indoors: bool = False

    @classmethod
    def of(cls, row: NDArray[np.integer], tx: NDArray[np.bool_], rx: NDArray[np.bool_]) -> EnclosedAntennas:
        """Sort out which antennas are enclosed.

        Args:
            row: Line of every link in the source file [L].
            tx: Whether its transmitter is enclosed [L].
            rx: Whether its receiver is enclosed [L].

        Returns:
            The lines of the links concerned.
        """
        indoors = bool(np.mean(tx | rx) > 0.5)
        return cls(tuple(row[tx].tolist()), tuple(row[rx].tolist()), indoors)
