"""Diagnostics of a finished calibration: residuals, leverage, power, trade-offs, neighbours and changes, as tables.

A missing region, such as trees without a map, would explain most of the residuals by its extra loss. All rectangles of
a grid are tried, at several heights: the residuals are regressed on the length of the straight lines inside each. The
same search over residuals in random order shows the effect of chance (a scan statistic; M. Kulldorff, Communications in
Statistics 26, 1997).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import FEW
from calibray.measurements.placement import ends_of
from calibray.reporting.link_survey import measured_quantity, residual
from calibray.result.record import Record
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.uncertainty.residual_correlation import variogram
from calibray.validation.held_out_statistics import spatial_blocks

CLASSES: Final = 6
"""Largest number of classes of distance, with about the same number of links each."""

MOST_UNKNOWNS: Final = 300
"""Largest number of unknowns whose draws are compared pair by pair."""


STREETS: Final = 12
"""Most groups of neighbouring receivers."""


def diagnostics(result: Record) -> dict[str, pd.DataFrame]:
    """Compute tables that describe the residuals and the certainty of a calibration.

    Returns:
        Tables by name, without those that cannot be computed. "distance", "depth" and "group": number of links, mean
        and standard deviation of the residuals [dB] on the calibration links; residuals are predicted minus measured in
        the measured quantity. "obstruction" and "streets": the same by the length of the straight line below roofs, and
        by neighbouring receivers. "missing_region": the rectangle whose extra loss would explain most of the residuals.
        "leverage": leverage and residual of every calibration link. "power": share of the
        links' power by material and type of interaction. "trade_offs": correlation of the draws of every two unknowns.
        "neighbours": semivariance of the residuals over the distance between links, both ends counted. "moved": value
        of every parameter before and after, the change and the 95 % interval as shares of its range.
    """
    tables = {
        "distance": _by_distance(result),
        "depth": _by(result, "depth"),
        "group": _by(result, "group"),
        "obstruction": _by_obstruction(result),
        "streets": _by_street(result),
        "missing_region": _missing_region(result),
        "leverage": _leverage(result),
        "power": _power(result),
        "trade_offs": _trade_offs(result),
        "neighbours": _neighbours(result),
        "moved": _moved(result),
    }
    return {name: table for name, table in tables.items() if len(table)}


def calibration_links(result: Record) -> tuple[pd.DataFrame, NDArray[np.float64]]:
    """The calibration links with a path, and their residuals in the measured quantity [dB]."""
    residuals, links = residual(result.links, measured_quantity(result).sign), result.links
    used = links["has_path"].to_numpy(bool) | (result.study.objective.no_path == "censor")
    mask = used & np.isfinite(residuals) & ~links["held_out"].to_numpy(bool)
    return links[mask], residuals[mask]


def link_distance(links: pd.DataFrame) -> NDArray[np.float64] | None:
    """Length of the links [L], [m]; None without positions."""
    ends = ends_of(links)
    return None if ends is None else np.linalg.norm(ends[:, 3:] - ends[:, :3], axis=1)


def _by_distance(result: Record) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    distance = link_distance(links)
    if distance is None or len(residuals) < FEW:
        return pd.DataFrame()
    classes = np.array_split(np.argsort(distance, kind="stable"), min(CLASSES, len(residuals) // 4))
    return pd.DataFrame(
        [
            {
                "from_m": distance[members].min(),
                "to_m": distance[members].max(),
                **_statistics(residuals[members]),
            }
            for members in classes
        ]
    )


def _by(result: Record, column: str) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    if column not in links:
        return pd.DataFrame()
    values = links[column].to_numpy()
    distinct = sorted(pd.unique(values[pd.notna(values)]).tolist())
    return pd.DataFrame([{column: value, **_statistics(residuals[values == value])} for value in distinct])


def _by_obstruction(result: Record) -> pd.DataFrame:
    """Links in sight, and classes of links out of sight by the length of the straight line below roofs."""
    links, residuals = calibration_links(result)
    if not {OUT_OF_SIGHT, "obstruction_m"} <= set(links.columns) or len(residuals) < FEW:
        return pd.DataFrame()
    blocked, length = links[OUT_OF_SIGHT].to_numpy(float) > 0, links["obstruction_m"].to_numpy(float)
    order = np.flatnonzero(blocked)[np.argsort(length[blocked], kind="stable")]
    # Indoors nothing lies below a roof, so there is only one class.
    count = min(CLASSES, len(order) // FEW) if length[blocked].max(initial=0.0) >= 1.0 else 1
    classes = [np.flatnonzero(~blocked), *np.array_split(order, max(count, 1))]
    return pd.DataFrame(
        [
            {
                OUT_OF_SIGHT: bool(blocked[members[0]]),
                "from_m": length[members].min(),
                "to_m": length[members].max(),
                **_statistics(residuals[members]),
            }
            for members in classes
            if len(members)
        ]
    )


def _by_street(result: Record) -> pd.DataFrame:
    """Groups of neighbouring receivers, named by the position of their centre."""
    links, residuals = calibration_links(result)
    ends = ends_of(links)
    if ends is None or len(residuals) < 2 * FEW:
        return pd.DataFrame()
    place = ends[:, 3:5]
    street = spatial_blocks(place, min(STREETS, len(residuals) // FEW))
    middles = [place[street == number].mean(axis=0) for number in range(street.max() + 1)]
    return pd.DataFrame(
        [
            {
                "streets": f"receivers around ({x:.0f}, {y:.0f}) m",
                "x_m": x,
                "y_m": y,
                **_statistics(residuals[street == number]),
            }
            for number, (x, y) in enumerate(middles)
        ]
    )


def _missing_region(result: Record) -> pd.DataFrame:
    links, _ = calibration_links(result)
    ends = ends_of(links)
    if ends is None:
        return pd.DataFrame()
    known = links[OUT_OF_SIGHT].to_numpy(float) if OUT_OF_SIGHT in links else np.zeros(len(links))
    excess_db = links["measured_db"].to_numpy(float) - links["predicted_db"].to_numpy(float)
    region = _searched(np.column_stack([ends, excess_db, known]).tobytes())
    if region is None:
        return pd.DataFrame()
    row = asdict(region)
    west, south, east, north = row.pop("box")
    return pd.DataFrame([{"west": west, "south": south, "east": east, "north": north, **row}])


@lru_cache(maxsize=4)
def _searched(rows: bytes) -> MissingRegion | None:
    """The search over links: both ends, excess loss and whether out of sight. A page and its figures use it twice."""
    links = np.frombuffer(rows).reshape(-1, 8)
    return missing_region(links[:, :3], links[:, 3:6], links[:, 6], [links[:, 7]])


def _statistics(residuals: NDArray[np.float64]) -> dict[str, float]:
    return {
        "links": len(residuals),
        "mean_db": float(residuals.mean()),
        "standard_deviation_db": float(residuals.std()),
    }


def _leverage(result: Record) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    if "leverage" not in links or not np.isfinite(links["leverage"]).any():
        return pd.DataFrame()
    leverage = links["leverage"].to_numpy(float)
    return pd.DataFrame({"row": links["row"].to_numpy(), "leverage": leverage, "residual_db": residuals})


def _power(result: Record) -> pd.DataFrame:
    rows = [
        {"material": material, "interaction": kind, "share": share}
        for material, shares in result.fit.power_shares.items()
        for kind, share in shares.items()
    ]
    if not rows:
        return pd.DataFrame()
    return pd.DataFrame(rows).sort_values("share", ascending=False, ignore_index=True)


def _trade_offs(result: Record) -> pd.DataFrame:
    names = [name for name, values in result.uncertainty.draws.items() if np.ptp(values) > 0]
    if not 2 <= len(names) <= MOST_UNKNOWNS:
        return pd.DataFrame()
    matrix = np.atleast_2d(np.corrcoef([_scaled_draws(result, name) for name in names]))
    rows = [
        {"first": names[i], "second": names[k], "correlation": float(matrix[i, k])}
        for i, k in combinations(range(len(names)), 2)
    ]
    return pd.DataFrame(rows).sort_values("correlation", key=lambda column: -abs(column), ignore_index=True)


def _scaled_draws(result: Record, name: str) -> NDArray[np.float64]:
    """Draws of an unknown, logarithmic if the parameter is searched on a logarithmic scale."""
    values = np.array(result.uncertainty.draws[name])
    section = result.study.parameters.get(name)
    return np.log(values) if section is not None and section.scale == "log" else values


def _neighbours(result: Record) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    ends = ends_of(links)
    if ends is None or len(residuals) < FEW:
        return pd.DataFrame()
    # Distance in six dimensions: links of two transmitters to the same receiver are not neighbours.
    distance, semivariance, pairs = variogram(residuals, ends)
    return pd.DataFrame({"distance_m": distance, "semivariance_db2": semivariance, "pairs": pairs})


def _moved(result: Record) -> pd.DataFrame:
    rows = []
    for name, after in result.parameters.items():
        section, before = result.study.parameters[name], result.fit.initial_parameters[name]
        interval = result.intervals.get(name)
        ends = (np.nan, np.nan) if interval is None else (interval.lower, interval.upper)
        values = np.array([*section.bounds, before, after, *ends], dtype=float)
        lower, upper, start, end, low, high = np.log(values) if section.scale == "log" else values
        width = upper - lower
        rows.append(
            {
                "parameter": name,
                "before": before,
                "after": after,
                "moved": float((end - start) / width),
                "interval": float((high - low) / width),
            }
        )
    return pd.DataFrame(rows)


GRID: Final = 20
"""Number of cells along the longer side of the area."""

SAMPLES: Final = 128
"""Number of points along each line, several in each cell that it crosses."""

HEIGHTS: Final = (5.0, 10.0, 20.0)
"""Heights above the lowest antenna up to which the rectangles reach [m]: hedges, street trees, tall trees."""

FEWEST_LINKS: Final = 30
"""Fewest links that are searched."""

MOST: Final = 20_000
"""Largest number of links that are searched; of more, every second, third, ... one is taken."""

SHUFFLES: Final = 99
"""Number of random orders of the residuals; a rectangle is reported if none of them has a better one."""


NEGLIGIBLE: Final = 1e-6
"""Sum of squares of a rectangle's column, relative to the largest, below which rounding dominates."""


class Explained(NamedTuple):
    """The best rectangle of a width.

    Attributes:
        explained: Sum of squares that it explains.
        attenuation: Its attenuation [dB/m].
        cells: Its corners, counted in cells [2, 2].
        chance: Sum of squares that the best rectangle of this width explains for residuals in random order [k - 1].
    """

    explained: float
    attenuation: float
    cells: NDArray[np.int64]
    chance: NDArray[np.float64]


@dataclass(frozen=True)
class MissingRegion:
    """A rectangle whose extra loss would explain residuals.

    Attributes:
        box: West, south, east and north in the scene's frame [m].
        height: Height at which it ends [m].
        attenuation: Loss per length inside [dB/m].
        links: Number of links whose straight line crosses it.
        share: Share of the mean square of the residuals that it explains.
        chance: Median share that the best rectangle explains if residuals are in random order.
        significant: Whether it explains more than in any random order.
    """

    box: tuple[float, float, float, float]
    height: float
    attenuation: float
    links: int
    share: float
    chance: float
    significant: bool


def missing_region(
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    excess_db: NDArray[np.float64],
    known: Sequence[NDArray[np.float64]] = (),
) -> MissingRegion | None:
    """Search the rectangle whose extra loss explains most of the residuals.

    Args:
        tx: Transmitters [n, 3], [m].
        rx: Receivers [n, 3], [m].
        excess_db: Measured minus predicted path loss [n], [dB].
        known: Columns that explain residuals in another way, such as whether a link is out of sight [n].

    Returns:
        The rectangle; None if there are too few links, or no extra loss explains anything.
    """
    step = -(-len(excess_db) // MOST)
    tx, rx, excess_db = tx[::step], rx[::step], excess_db[::step]
    distance = np.log10(np.maximum(np.linalg.norm(rx - tx, axis=1), 1.0))
    design = np.column_stack([np.ones(len(distance)), distance, *(column[::step] for column in known)])
    basis, sizes, _ = np.linalg.svd(design, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes[0]]
    if len(excess_db) < FEWEST_LINKS:
        return None
    residual = excess_db - basis @ (basis.T @ excess_db)
    square = float(residual @ residual)
    if square <= 0:
        return None
    random = np.random.default_rng(0)
    orders = np.stack([residual, *(random.permutation(residual) for _ in range(SHUFFLES))])
    orders -= (orders @ basis) @ basis.T
    corner, cell = _grid(tx, rx)
    lowest = float(min(tx[:, 2].min(), rx[:, 2].min()))
    best, chance = None, np.zeros(SHUFFLES)
    for height in HEIGHTS:
        length = _lengths(tx, rx, corner, cell, lowest + height)
        inside = length - basis @ (basis.T @ length)
        rectangles = list(_rectangles(inside.T @ orders.T, inside.T @ inside))
        chance = np.maximum(chance, np.max([rectangle.chance for rectangle in rectangles], axis=0))
        top = max(rectangles, key=lambda rectangle: rectangle.explained)
        if top.explained / square > (0.0 if best is None else best.share):
            (west, south), (east, north) = (corner + cell * top.cells).tolist()
            crossing = length.reshape(-1, GRID, GRID)[:, slice(*top.cells[:, 0]), slice(*top.cells[:, 1])]
            best = MissingRegion(
                (west, south, east, north),
                lowest + height,
                top.attenuation,
                int((crossing.sum(axis=(1, 2)) > 0).sum()),
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
    """South-western corner [2] and width of the cells of a square grid over all links [m]."""
    ends = np.concatenate([tx, rx])[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    cell = max(float((high - low).max()) / GRID, 1e-3)
    return (low + high) / 2 - cell * GRID / 2, cell


def _lengths(
    tx: NDArray[np.float64], rx: NDArray[np.float64], corner: NDArray[np.float64], cell: float, top: float
) -> NDArray[np.float64]:
    """Length of every line below a height in every cell of the grid [n, cells], [m]."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    point = tx[:, None] + share[:, None] * (rx - tx)[:, None]
    index = np.clip(((point[..., :2] - corner) / cell).astype(np.int64), 0, GRID - 1)
    number = np.arange(len(tx))[:, None] * GRID**2 + index[..., 0] * GRID + index[..., 1]
    piece = np.linalg.norm(rx - tx, axis=1)[:, None] / SAMPLES * (point[..., 2] < top)
    counts = np.bincount(number.reshape(-1), piece.reshape(-1), len(tx) * GRID**2)
    return counts.reshape(len(tx), GRID**2).astype(np.float64)


def _rectangles(moments: NDArray[np.float64], products: NDArray[np.float64]) -> Iterator[Explained]:
    """The best rectangle of the grid, width by width.

    The arguments are products of residuals and the columns of the cells, with the residuals in order first [cells, k],
    and products of the columns of the cells [cells, cells].
    """
    moment = _summed(moments.reshape(GRID, GRID, -1), (0, 1))
    total = _summed(products.reshape((GRID,) * 4), (0, 1, 2, 3))
    largest = float(np.max(np.diagonal(products), initial=0.0))
    south, north = np.triu_indices(GRID + 1, 1)
    for columns in range(1, GRID + 1):
        west = np.arange(GRID + 1 - columns)
        east = west + columns
        strip = total[east, :, east] - total[east, :, west] - total[west, :, east] + total[west, :, west]
        square = (
            strip[:, north, north] - strip[:, north, south] - strip[:, south, north] + strip[:, south, south]
        )
        band = moment[columns:] - moment[:-columns]
        used = square > NEGLIGIBLE * largest
        root = np.where(used, 1.0 / np.sqrt(np.where(used, square, 1.0)), 0.0)
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
    """Cumulative sums along axes, starting at 0, so that sums over ranges are differences."""
    for axis in axes:
        values = np.insert(np.cumsum(values, axis=axis), 0, 0.0, axis=axis)
    return values
