"""Receivers whose positions are known within an error: paths to displaced positions, and what they say of the noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.paths import Paths, take_links
from calibray.paths.selection import concatenate
from calibray.tracing.mounting import Mounting

DIRECTIONS: Final = np.sqrt(2.0) * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Displacements in units of the error: means over them equal those of a Gaussian error up to cubic terms (Stroud, the
spherical rule of degree three in the plane)."""


def displaced(links: Measurements, error_m: NDArray[np.float64]) -> Measurements:
    """Links to displaced receivers, all those in one direction after the other; errors are standard deviations [L]."""
    rx = np.tile(links.rx, (len(DIRECTIONS), 1))
    rx[:, :2] += (DIRECTIONS[:, None] * error_m[:, None]).reshape(-1, 2)
    tx = np.tile(links.tx, (len(DIRECTIONS), 1))
    return Measurements(tx=tx, rx=rx, path_loss_db=np.full(len(rx), np.nan))


def averaged(paths: Paths, links: Measurements) -> Paths:
    """Paths to displaced receivers as paths of their links, whose power sum is the mean over the displaced receivers.

    Displaced receivers that no path reaches do not count.
    """
    count, directions = len(links), len(DIRECTIONS)
    reached = np.bincount(paths.link, minlength=paths.num_links).reshape(directions, count) > 0
    parts = []
    for direction in range(directions):
        part = take_links(paths, np.arange(count) + direction * count)
        # Amplitudes, so that powers are divided by the number of displaced receivers.
        spreading = part.spreading / np.sqrt(reached.sum(axis=0)[part.link])
        parts.append(replace(part, spreading=spreading, tx_position=links.tx, rx_position=links.rx))
    return concatenate(parts)


def mounted_at_displaced(mountings: Mapping[str, Mounting], count: int) -> dict[str, Mounting]:
    """The antennas of displaced links, from those of the links."""
    link = np.tile(np.arange(count), len(DIRECTIONS))
    return {end: mounting.of_paths(link) for end, mounting in mountings.items()}


def spread_db(path_loss_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of the path loss of displaced links between the displacements of each link [L], [dB].

    It is 0 if a path reaches only one of them.
    """
    loss = path_loss_db.reshape(len(DIRECTIONS), -1)
    reached = np.isfinite(loss)
    number = np.maximum(reached.sum(axis=0), 1)
    mean = np.where(reached, loss, 0.0).sum(axis=0) / number
    return np.sqrt((np.where(reached, loss - mean, 0.0) ** 2).sum(axis=0) / number)
