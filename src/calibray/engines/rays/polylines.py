"""The rows of a ray table, from paths in the form of other programs: points, types of interaction and power."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.rays.table import ENDS
from calibray.errors import InputError
from calibray.measurements import SourceTable


class Polyline(NamedTuple):
    """One path.

    Attributes:
        points: Points from the transmitter to the receiver [n, 3], [m].
        types: Types of the n - 2 interactions, as in the column `type`.
        power_db: Path gain [dB].
        delay: Propagation delay [s]; NaN if not stated.
    """

    points: NDArray[np.floating]
    types: Sequence[str]
    power_db: float
    delay: float = np.nan


def rows_of(paths: Iterable[Polyline], source: str) -> SourceTable:
    """The ray table of paths, in their order.

    Raises:
        InputError: The list is empty, or the numbers of points, interactions and ends of a path do not match.
    """
    paths = list(paths)
    if not paths:
        raise InputError(f"{source}: contains no path; export the rays of at least one link")
    for number, path in enumerate(paths):
        if len(path.points) != len(path.types) + 2:
            raise InputError(
                f"{source}: path {number} has {len(path.points)} points and {len(path.types)} interactions; it needs "
                "two points more than interactions, its transmitter and its receiver"
            )
    count = [len(path.points) for path in paths]
    per_path = {
        "path": np.arange(len(paths)),
        "power_db": [path.power_db for path in paths],
        "delay": [path.delay for path in paths],
    }
    frame = pd.DataFrame({name: np.repeat(values, count) for name, values in per_path.items()})
    frame["point"] = np.concatenate([np.arange(number) for number in count])
    frame["type"] = [name for path in paths for name in (ENDS[0], *path.types, ENDS[1])]
    frame[["x", "y", "z"]] = np.concatenate([np.asarray(path.points, dtype=float) for path in paths])
    return SourceTable(frame.dropna(axis=1, how="all"), source=source)
