"""Links parted by where they stand: blocks to hold out as a whole, and clusters of neighbours to resample together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def blocks(position: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Part places into blocks of about equal numbers, each as compact as halving makes it.

    The largest block is halved across its longer side until there are enough.

    Args:
        position: Places [n, 2 or 3], [m].
        count: Number of blocks, at most that of places.

    Returns:
        Block of every place, from 0 [n].

    Example:
        >>> blocks(np.array([[0.0, 0.0], [9.0, 0.0], [1.0, 0.0], [8.0, 0.0]]), 2).tolist()
        [0, 1, 0, 1]
    """
    found = np.zeros(len(position), dtype=np.int64)
    for new in range(1, min(count, len(position))):
        largest = int(np.argmax(np.bincount(found)))
        members = np.flatnonzero(found == largest)
        axis = int(np.argmax(np.ptp(position[members], axis=0)))
        order = members[np.argsort(position[members, axis], kind="stable")]
        found[order[(len(order) + 1) // 2 :]] = new
    return found
