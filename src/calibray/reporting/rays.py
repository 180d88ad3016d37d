"""The strongest paths of every link, with their power in the calibrated scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fields import path_gains
from calibray.paths import Paths, take
from calibray.result.record import Record
from calibray.study import Setup
from calibray.support.progress import Progress

PER_LINK: Final = 12
"""Paths of a link that are shown."""

INTERACTIONS: Final = 400_000
"""Interactions that are shown in all; where there are more, fewer paths of every link are."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths to be drawn.

    Attributes:
        paths: The strongest paths of every link, strongest first.
        vertex: Their points of interaction [I, 3], [m].
        gain_db: Their power gain in the calibrated scene, without offset [P], [dB].
        per_link: How many of a link are kept at most.
        traced: How many were traced.
        meets: Links of which any traced path meets a material, by material.
    """

    paths: Paths
    vertex: NDArray[np.float32] | NDArray[np.float64]
    gain_db: NDArray[np.float64]
    per_link: int
    traced: int
    meets: dict[str, int]


def rays(result: Record, progress: Progress | None = None) -> Rays:
    """The strongest paths of every link of a calibration.

    Args:
        result: The calibration; paths that it does not hold are taken from the cache, or else traced.
        progress: Called with the stage "tracing" after every launch.

    Returns:
        The paths.

    Raises:
        InputError: Scene or links of the study cannot be used any more.
        EngineError: The tracer failed.
    """
    paths = result.paths
    if paths is None:
        paths = Setup.open(result.study).trace(progress=progress)
    return strongest(paths, result)


def strongest(paths: Paths, result: Record) -> Rays:
    """The strongest paths of every link.

    Args:
        paths: What was traced.
        result: The calibration whose materials they are evaluated with.

    Returns:
        The paths that are shown.
    """
    gain = path_gains(paths, result.materials).reshape(paths.num_paths, -1)
    # Summed over receive ports and averaged over transmit ports, as path loss is.
    power = (np.abs(gain) ** 2).sum(axis=1) / paths.tx_field.shape[1]
    gain_db = 10 * np.log10(np.maximum(power, 1e-40))
    order = np.lexsort((-gain_db, paths.link))
    link = paths.link[order]
    rank = np.arange(len(link)) - np.searchsorted(link, link)
    depth = np.cumsum(
        np.bincount(rank[rank < PER_LINK], np.diff(paths.first)[order][rank < PER_LINK], PER_LINK)
    )
    per_link = int(np.clip(np.searchsorted(depth, INTERACTIONS, side="right"), 1, PER_LINK))
    chosen = order[rank < per_link]
    touched = np.unique(
        np.stack([np.repeat(paths.link, np.diff(paths.first)), paths.material], axis=1), axis=0
    )[:, 1]
    meets = np.bincount(touched, minlength=len(paths.materials))
    shown = take(paths, chosen)
    return Rays(
        shown,
        shown.vertex,
        gain_db[chosen],
        per_link,
        paths.num_paths,
        dict(zip(paths.materials, meets.tolist(), strict=True)),
    )
