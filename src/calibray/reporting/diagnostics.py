"""Tables that diagnose a finished calibration: residuals, leverage, power, trade-offs, neighbours and changes."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import FEW
from calibray.measurements.placement import ends_of
from calibray.reporting.link_survey import measured_quantity, residual
from calibray.result.record import Record
from calibray.result.verdict import RemarkKind
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.uncertainty.missing_region import MissingRegion, missing_region
from calibray.uncertainty.residual_correlation import variogram
from calibray.validation.held_out_statistics import spatial_blocks

CLASSES: Final = 6
"""Maximum number of distance classes; all classes contain about the same number of links."""

MOST_UNKNOWNS: Final = 300
"""Maximum number of unknowns for which correlations are computed between all pairs."""


STREETS: Final = 12
"""Maximum number of groups into which neighbouring receivers are divided."""


def diagnostics(result: Record) -> dict[str, pd.DataFrame]:
    """Compute tables that describe the residuals and the uncertainty of a calibration.

    Returns:
        Tables by name; a table that cannot be computed is omitted. "distance", "depth" and "group": number of links,
        mean and standard deviation of the residuals [dB] on the calibration links. Residuals are predicted minus
        measured values of the measured quantity. "obstruction" and "streets": the same statistics, by the length over
        which the straight line between the antennas lies below roofs, and by group of neighbouring receivers.
        "missing_region": the rectangle whose extra loss would explain the largest part of the residuals. "leverage":
        leverage and residual of every calibration link. "power": share of the links' power by material and type of
        interaction. "trade_offs": correlation between the draws of each pair of unknowns. "neighbours": semivariance of
        the residuals by distance between links, where this distance accounts for the positions of both ends. "moved":
        value of every parameter before and after calibration; the change and the width of the 95 % interval are given
        as shares of the parameter's range.
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
    """The links used in the calibration, and the residuals of these links in the measured quantity [dB]."""
    residuals, links = residual(result.links, measured_quantity(result).sign), result.links
    used = links["has_path"].to_numpy(bool) | (result.study.objective.no_path == "censor")
    mask = used & np.isfinite(residuals) & ~links["held_out"].to_numpy(bool)
    return links[mask], residuals[mask]


def link_distance(links: pd.DataFrame) -> NDArray[np.float64] | None:
    """Length of each link [L], [m]; None if the positions are unknown."""
    ends = ends_of(links)
    return None if ends is None else np.linalg.norm(ends[:, 3:] - ends[:, :3], axis=1)


def _by_distance(result: Record) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    distance = link_distance(links)
    if distance is None or len(residuals) < FEW:
        return pd.DataFrame()
    # Each class contains at least four links.
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
    """Line-of-sight links, and non-line-of-sight links in classes by the length of their straight line below roofs."""
    links, residuals = calibration_links(result)
    if not {OUT_OF_SIGHT, "obstruction_m"} <= set(links.columns) or len(residuals) < FEW:
        return pd.DataFrame()
    blocked, length = links[OUT_OF_SIGHT].to_numpy(float) > 0, links["obstruction_m"].to_numpy(float)
    order = np.flatnonzero(blocked)[np.argsort(length[blocked], kind="stable")]
    # Indoors, no part of a line is below a roof, so there is only one class.
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
    """Groups of neighbouring receivers; each group is named by the position of its centre."""
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
    """The rectangle in the remark on the calibrated model or, without a remark, that for the prediction model."""
    for remark in result.uncertainty.remarks:
        if remark.kind == RemarkKind.MISSING_REGION:
            return pd.DataFrame([{**remark.values, "significant": True}])
    links, _ = calibration_links(result)
    ends = ends_of(links)
    if ends is None:
        return pd.DataFrame()
    known = links[OUT_OF_SIGHT].to_numpy(float) if OUT_OF_SIGHT in links else np.zeros(len(links))
    # Excess loss is positive where the measured path loss exceeds the prediction.
    excess_db = links["measured_db"].to_numpy(float) - links["predicted_db"].to_numpy(float)
    region = _searched(np.column_stack([ends, excess_db, known]).tobytes())
    return pd.DataFrame() if region is None else pd.DataFrame([region.row()])


@lru_cache(maxsize=4)
def _searched(rows: bytes) -> MissingRegion | None:
    """Find and cache the missing region; `rows` contains the ends, the excess loss and the obstruction of each link."""
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
    # If an unknown is the same in all draws, its correlation with other unknowns is undefined.
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
    """Draws of an unknown, or their logarithms if the parameter is searched on a logarithmic scale."""
    values = np.array(result.uncertainty.draws[name])
    section = result.study.parameters.get(name)
    return np.log(values) if section is not None and section.scale == "log" else values


def _neighbours(result: Record) -> pd.DataFrame:
    links, residuals = calibration_links(result)
    ends = ends_of(links)
    if ends is None or len(residuals) < FEW:
        return pd.DataFrame()
    # Distances are computed in six dimensions, so links from two transmitters to the same receiver are not neighbours.
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
