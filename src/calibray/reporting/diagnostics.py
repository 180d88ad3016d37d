"""What is remarkable about a calibration, as tables: residuals, leverage, power, trade-offs, neighbours, priors."""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.result.record import Record
from calibray.tables import Column, Table

CLASSES: Final = 6
"""Classes of distance that residuals are shown in, of about equally many links."""

PAIRS: Final = 300
"""Unknowns up to which every pair of them is compared."""

STRONG: Final = 0.7
"""Correlation of two unknowns from which one is said to make up for the other."""

DECIDING: Final = 0.5
"""Leverage from which a link is said to decide something by itself."""

CLEAR: Final = 2.0
"""Standard errors beyond which a trend is not taken for chance."""

FEW: Final = 8
"""Links below which trends are not looked for."""

EVEN_DB: Final = 0.1
"""Mean residual below which classes of links are not told apart [dB]."""

PLACES: Final = tuple(f"{end}_{axis}" for end in ("tx", "rx") for axis in "xyz")


def diagnostics(result: Record) -> dict[str, pd.DataFrame]:
    """All that can be looked at, as tables.

    Args:
        result: The calibration.

    Returns:
        Tables by name, those that cannot be known left out. "distance", "depth" and "group": number, mean and standard
        deviation of the residuals [dB], model minus measurement, of the links calibrated on. "leverage": every such
        link's share in deciding the unknowns. "power": share of the links' power by material and kind of interaction.
        "trade_offs": correlation of every two unknowns over the draws. "neighbours": semivariance of residuals over the
        distance between links, both ends counted. "moved": where every parameter came from and went to, and what of its
        range is left.
    """
    found = {
        "distance": _over_distance(result),
        "depth": _by(result, "depth"),
        "group": _by(result, "group"),
        "leverage": _leverage(result),
        "power": _power(result),
        "trade_offs": _trade_offs(result),
        "neighbours": _neighbours(result),
        "moved": _moved(result),
    }
    return {name: table for name, table in found.items() if len(table)}


def remarkable(result: Record) -> Table:
    """The same in a few lines.

    Args:
        result: The calibration.

    Returns:
        A table: what was looked at, and what it says.
    """
    known = diagnostics(result)
    lines = {
        "power": _power_said(known),
        "over distance": _distance_said(result),
        "by depth": _spread_said(known, "depth", "paths of {} interactions"),
        "by group": _spread_said(known, "group", "group {}"),
        "neighbours": _neighbours_said(known),
        "leverage": _leverage_said(known),
        "trade-offs": _trade_offs_said(known),
        "moved": _moved_said(known),
    }
    rows = tuple((name, said) for name, said in lines.items() if said)
    return Table("Diagnostics", (Column(), Column()), rows)


def _used(result: Record) -> tuple[pd.DataFrame, NDArray[np.float64]]:
    """The links calibrated on whose residual is known, and these residuals [m], [dB]."""
    left = result.links["after_db"].to_numpy(float) - result.links["measured_db"].to_numpy(float)
    used = np.isfinite(left) & ~result.links["held_out"].to_numpy(bool)
    return result.links[used], left[used]


def _ends(links: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    if not set(PLACES) <= set(links.columns):
        return None
    ends = links[list(PLACES)].to_numpy(float)
    return ends[:, :3], ends[:, 3:]


def _distance(links: pd.DataFrame) -> NDArray[np.float64] | None:
    ends = _ends(links)
    return None if ends is None else np.linalg.norm(ends[1] - ends[0], axis=1)


def _over_distance(result: Record) -> pd.DataFrame:
    links, left = _used(result)
    distance = _distance(links)
    if distance is None or len(left) < FEW:
        return pd.DataFrame()
    parts = np.array_split(np.argsort(distance, kind="stable"), min(CLASSES, len(left) // 4))
    return pd.DataFrame(
        [
            {"from_m": distance[part].min(), "to_m": distance[part].max(), **_figures(left[part])}
            for part in parts
        ]
    )


def _by(result: Record, column: str) -> pd.DataFrame:
    links, left = _used(result)
    if column not in links:
        return pd.DataFrame()
    labels = links[column].to_numpy()
    known = pd.unique(labels[pd.notna(labels)])
    return pd.DataFrame(
        [{column: label, **_figures(left[labels == label])} for label in sorted(known.tolist())]
    )


def _figures(left: NDArray[np.float64]) -> dict[str, float]:
    return {"links": len(left), "mean_db": float(left.mean()), "standard_deviation_db": float(left.std())}


def _leverage(result: Record) -> pd.DataFrame:
    links, left = _used(result)
    if "leverage" not in links or not np.isfinite(links["leverage"]).any():
        return pd.DataFrame()
    return pd.DataFrame(
        {"row": links["row"].to_numpy(), "leverage": links["leverage"].to_numpy(float), "residual_db": left}
    )


def _power(result: Record) -> pd.DataFrame:
    rows = [
        {"material": material, "interaction": kind, "share": share}
        for material, kinds in result.fit.power_shares.items()
        for kind, share in kinds.items()
    ]
    return (
        pd.DataFrame(rows).sort_values("share", ascending=False, ignore_index=True)
        if rows
        else pd.DataFrame()
    )


def _trade_offs(result: Record) -> pd.DataFrame:
    names = [name for name, values in result.uncertainty.draws.items() if np.ptp(values) > 0]
    if not 2 <= len(names) <= PAIRS:
        return pd.DataFrame()
    matrix = np.atleast_2d(np.corrcoef([_searched(result, name) for name in names]))
    rows = [
        {"first": names[i], "second": names[k], "correlation": float(matrix[i, k])}
        for i, k in combinations(range(len(names)), 2)
    ]
    return pd.DataFrame(rows).sort_values("correlation", key=lambda column: -abs(column), ignore_index=True)


def _searched(result: Record, name: str) -> NDArray[np.float64]:
    """Draws of an unknown on the scale of the search."""
    values = np.array(result.uncertainty.draws[name])
    section = result.study.parameters.get(name)
    return np.log(values) if section is not None and section.scale == "log" else values


def _neighbours(result: Record) -> pd.DataFrame:
    from calibray.uncertainty.residual_correlation import variogram

    links, left = _used(result)
    ends = _ends(links)
    if ends is None or len(left) < FEW:
        return pd.DataFrame()
    # At one receiver the links of two transmitters are no neighbours.
    distance, half, pairs = variogram(left, np.hstack(ends))
    return pd.DataFrame({"distance_m": distance, "semivariance_db2": half, "pairs": pairs})


def _moved(result: Record) -> pd.DataFrame:
    rows = []
    for name, after in result.parameters.items():
        section, before = result.study.parameters[name], result.fit.initial_parameters[name]
        ends = np.array(section.bounds, dtype=float)
        log = section.scale == "log"
        scale = (lambda value: np.log(value)) if log else (lambda value: np.asarray(value, dtype=float))
        width = float(np.ptp(scale(ends)))
        interval = result.intervals.get(name)
        left = np.nan if interval is None else float(np.ptp(scale([interval.lower, interval.upper]))) / width
        moved = float(scale(after) - scale(before)) / width
        rows.append({"parameter": name, "before": before, "after": after, "moved": moved, "interval": left})
    return pd.DataFrame(rows)


def _power_said(known: dict[str, pd.DataFrame]) -> str:
    if "power" not in known:
        return ""
    rows = known["power"].head(5).itertuples()
    return ", ".join(
        f"{row.material} {row.interaction} {row.share:.0%}".replace("  ", " ") for row in rows
    ) + (" of the links' power, on the mean")


def _distance_said(result: Record) -> str:
    links, left = _used(result)
    distance = _distance(links)
    if distance is None or len(left) < FEW or np.ptp(distance) == 0:
        return ""
    decades = np.log10(distance) - np.log10(distance).mean()
    slope = float(decades @ left / (decades @ decades))
    rest = left - left.mean() - slope * decades
    error = float(np.sqrt(rest @ rest / (len(left) - 2) / (decades @ decades)))
    verdict = "a trend" if abs(slope) > CLEAR * error else "no trend"
    return f"{verdict}: residuals change by {slope:+.1f} dB per decade, standard error {error:.1f} dB"


def _spread_said(known: dict[str, pd.DataFrame], name: str, words: str) -> str:
    if name not in known or len(known[name]) < 2:
        return ""
    table = known[name]
    many = table[table["links"] >= 3]
    if not len(many):
        return ""
    worst = many.iloc[int(np.argmax(many["mean_db"].abs()))]
    if abs(worst["mean_db"]) < EVEN_DB:
        return ""
    label = f"{worst[name]:g}" if isinstance(worst[name], float) else str(worst[name])
    clear = (
        ""
        if abs(worst["mean_db"]) > CLEAR * worst["standard_deviation_db"] / np.sqrt(worst["links"])
        else ", which may be chance"
    )
    said = words.format(label)
    return f"furthest off are {said}: {worst['mean_db']:+.1f} dB on the mean of {worst['links']:.0f} links{clear}"


def _neighbours_said(known: dict[str, pd.DataFrame]) -> str:
    if "neighbours" not in known or len(known["neighbours"]) < 3:
        return ""
    table = known["neighbours"]
    nearest, level = table.iloc[0], float(table["semivariance_db2"].iloc[len(table) // 2 :].mean())
    share = 1.0 - nearest["semivariance_db2"] / level if level > 0 else 0.0
    # A semivariance of so many pairs is known to about this share of itself.
    if share < CLEAR * np.sqrt(2.0 / nearest["pairs"]):
        return f"links {nearest['distance_m']:.0f} m apart share no more of their errors than others do"
    return f"links {nearest['distance_m']:.0f} m apart share {share:.0%} of the variance of their errors"


def _leverage_said(known: dict[str, pd.DataFrame]) -> str:
    if "leverage" not in known:
        return ""
    from calibray.tables.text import rows_text

    table = known["leverage"]
    mighty = table[table["leverage"] > DECIDING]
    if len(mighty):
        rows = rows_text(mighty["row"].tolist())
        links = "link decides" if len(mighty) == 1 else "links decide"
        return f"{len(mighty)} {links} something almost alone (leverage above {DECIDING:g}): {rows}"
    top = table.iloc[int(np.argmax(table["leverage"]))]
    return f"no link decides anything alone; the largest is {top['leverage']:.2f}, in row {top['row']:.0f}"


def _trade_offs_said(known: dict[str, pd.DataFrame]) -> str:
    if "trade_offs" not in known:
        return ""
    table = known["trade_offs"]
    strong = table[table["correlation"].abs() > STRONG].head(3)
    if not len(strong):
        return "no two unknowns make up for one another"
    return "; ".join(f"{row.first} and {row.second} ({row.correlation:+.2f})" for row in strong.itertuples())


def _moved_said(known: dict[str, pd.DataFrame]) -> str:
    if "moved" not in known:
        return ""
    table = known["moved"]
    far = table.iloc[int(np.argmax(table["moved"].abs()))]
    return (
        f"furthest {far['parameter']}, from {far['before']:.4g} to {far['after']:.4g}: {abs(far['moved']):.0%} of "
        "its range"
    )
