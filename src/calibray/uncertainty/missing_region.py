"""Search for a missing region, such as unmapped trees, whose extra loss best explains the residuals.

For each rectangle of cells of a grid, at several heights, the residuals are regressed on the length, inside the
rectangle, of every link's straight line. Repeating the search on randomly permuted residuals shows how much a rectangle
can explain by chance alone (a scan statistic; M. Kulldorff, Communications in Statistics 26, 1997).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.measurements import FEW

GRID: Final = 20
"""Number of cells along the longer side of the area."""

SAMPLES: Final = 128
"""Number of points along each line, enough for several points in each cell that the line crosses."""

HEIGHTS: Final = (5.0, 10.0, 20.0)
"""Heights [m] of the rectangles' tops above the lowest antenna, for hedges, street trees and tall trees."""

FEWEST_LINKS: Final = 30
"""Minimum number of links for a search."""

MOST: Final = 20_000
"""Maximum number of links in a search; if there are more links, only every kth link is used."""

SHUFFLES: Final = 99
"""Number of random permutations of the residuals. A rectangle is significant only if it explains more than the best
rectangle of every permutation."""


class Explained(NamedTuple):
    """The best rectangle of a given width.

    Attributes:
        explained: Sum of squares that the rectangle explains.
        attenuation: Its attenuation [dB/m].
        cells: South-west and north-east corners [2, 2] of the rectangle, in cells.
        chance: Sum of squares [k - 1] that the best rectangle of this width explains for each permutation.
    """

    explained: float
    attenuation: float
    cells: NDArray[np.int64]
    chance: NDArray[np.float64]


@dataclass(frozen=True)
class MissingRegion:
    """A rectangle with an extra loss that would explain part of the residuals.

    Attributes:
        box: Coordinates of the west, south, east and north sides in the scene frame [m].
        height: Height of the top of the rectangle in the scene frame [m].
        attenuation: Loss per length inside [dB/m].
        links: Number of links whose straight line crosses the region; an estimate if not all links are used.
        share: Fraction of the mean square of the residuals that the rectangle explains.
        chance: Median, over permutations, of the fraction of the mean square that the best rectangle explains.
        significant: Whether at least `FEW` links cross the region, and the best rectangle of every permutation explains
            less.
    """

    box: tuple[float, float, float, float]
    height: float
    attenuation: float
    links: int
    share: float
    chance: float
    significant: bool

    def row(self) -> dict[str, Any]:
        """The attributes by name, with the four sides of the box as separate values."""
        sides = dict(zip(("west", "south", "east", "north"), self.box, strict=True))
        return sides | {name: value for name, value in asdict(self).items() if name != "box"}


def missing_region(
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    excess_db: NDArray[np.float64],
    known: Sequence[NDArray[np.float64]] = (),
) -> MissingRegion | None:
    """Search for the rectangle whose extra loss explains the largest part of the residuals.

    Args:
        tx: Positions of the transmitters [n, 3], [m].
        rx: Positions of the receivers [n, 3], [m].
        excess_db: Measured minus predicted path loss [n], [dB].
        known: Columns [n] that could also explain the residuals, such as whether a link is out of sight.

    Returns:
        The rectangle; None if there are too few links, or if no rectangle with extra loss explains any part of the
        residuals.
    """
    if len(excess_db) < FEWEST_LINKS:
        return None
    step = -(-len(excess_db) // MOST)
    tx, rx, excess_db = tx[::step], rx[::step], excess_db[::step]
    distance = np.log10(np.maximum(np.linalg.norm(rx - tx, axis=1), 1.0))
    design = np.column_stack([np.ones(len(distance)), distance, *(column[::step] for column in known)])
    basis, sizes, _ = np.linalg.svd(design, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes[0]]
    residual = excess_db - basis @ (basis.T @ excess_db)
    square = float(residual @ residual)
    if square <= 0:
        return None
    random = np.random.default_rng(0)
    orders = np.stack([residual, *(random.permutation(residual) for _ in range(SHUFFLES))])
    # Permuted residuals are no longer orthogonal to the fitted columns.
    orders -= (orders @ basis) @ basis.T
    corner, cell = _grid(tx, rx)
    lowest = float(min(tx[:, 2].min(), rx[:, 2].min()))
    best, chance = None, np.zeros(SHUFFLES)
    for height in HEIGHTS:
        length = _lengths(tx, rx, corner, cell, lowest + height)
        # Keep the part of the lengths that the fitted columns do not explain.
        inside = length - basis @ (basis.T @ length)
        rectangles = list(_rectangles(inside.T @ orders.T, inside.T @ inside))
        # Permuted residuals are searched with the same heights and rectangles.
        chance = np.maximum(chance, np.max([rectangle.chance for rectangle in rectangles], axis=0))
        top = max(rectangles, key=lambda rectangle: rectangle.explained)
        if top.explained / square > (0.0 if best is None else best.share):
            (west, south), (east, north) = (corner + cell * top.cells).tolist()
            crossing = length.reshape(-1, GRID, GRID)[:, slice(*top.cells[:, 0]), slice(*top.cells[:, 1])]
            best = MissingRegion(
                (west, south, east, north),
                lowest + height,
                top.attenuation,
                step * int((crossing.sum(axis=(1, 2)) > 0).sum()),
                top.explained / square,
                0.0,
                False,
            )
    if best is None:
        return None
    return replace(
        best,
        chance=float(np.median(chance)) / square,
        significant=bool(best.share * square > chance.max()) and best.links >= FEW,
    )


def _grid(tx: NDArray[np.float64], rx: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """South-west corner [2] and width of the cells of a square grid over all links [m]."""
    ends = np.concatenate([tx, rx])[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    cell = max(float((high - low).max()) / GRID, 1e-3)
    return (low + high) / 2 - cell * GRID / 2, cell


def _lengths(
    tx: NDArray[np.float64], rx: NDArray[np.float64], corner: NDArray[np.float64], cell: float, top: float
) -> NDArray[np.float64]:
    """Length [n, cells], [m], in each cell of the grid, of the part of each line below the height `top`."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    point = tx[:, None] + share[:, None] * (rx - tx)[:, None]
    index = np.clip(((point[..., :2] - corner) / cell).astype(np.int64), 0, GRID - 1)
    number = np.arange(len(tx))[:, None] * GRID**2 + index[..., 0] * GRID + index[..., 1]
    # Each point represents a segment of its line; segments above `top` do not count.
    piece = np.linalg.norm(rx - tx, axis=1)[:, None] / SAMPLES * (point[..., 2] < top)
    counts = np.bincount(number.reshape(-1), piece.reshape(-1), len(tx) * GRID**2)
    return counts.reshape(len(tx), GRID**2).astype(np.float64)


def _rectangles(moments: NDArray[np.float64], products: NDArray[np.float64]) -> Iterator[Explained]:
    """The best rectangle of the grid for each width.

    `moments` [cells, k] contains the scalar products of the cells' columns with the residuals, unpermuted residuals
    first. `products` [cells, cells] contains the scalar products of the cells' columns with each other.
    """
    moment = _summed(moments.reshape(GRID, GRID, -1), (0, 1))
    total = _summed(products.reshape((GRID,) * 4), (0, 1, 2, 3))
    largest = float(np.max(np.diagonal(products), initial=0.0))
    south, north = np.triu_indices(GRID + 1, 1)
    for columns in range(1, GRID + 1):
        west = np.arange(GRID + 1 - columns)
        east = west + columns
        # Products of the rectangles' columns with themselves: differences along x, then along y, in both indices.
        strip = total[east, :, east] - total[east, :, west] - total[west, :, east] + total[west, :, west]
        square = (
            strip[:, north, north] - strip[:, north, south] - strip[:, south, north] + strip[:, south, south]
        )
        band = moment[columns:] - moment[:-columns]
        # Below this limit, rounding errors dominate.
        used = square > 1e-6 * largest
        root = np.where(used, 1.0 / np.sqrt(np.where(used, square, 1.0)), 0.0)
        # Signed root of the sum of squares that a rectangle explains; only extra loss, which has a positive sign,
        # counts.
        loss = band[:, north]
        loss -= band[:, south]
        loss *= root[..., None]
        at, rows = np.unravel_index(np.argmax(loss[..., 0]), root.shape)
        explained = np.maximum(loss.max(axis=(0, 1)), 0.0) ** 2
        yield Explained(
            float(explained[0]),
            float(max(loss[at, rows, 0], 0.0) * root[at, rows]),
            np.array([[west[at], south[rows]], [east[at], north[rows]]]),
            explained[1:],
        )


def _summed(values: NDArray[np.float64], axes: Sequence[int]) -> NDArray[np.float64]:
    """Cumulative sums along axes, starting at 0; the sum over any range is then a difference of two values."""
    for axis in axes:
        values = np.insert(np.cumsum(values, axis=axis), 0, 0.0, axis=axis)
    return values
