"""What the data can tell of a parameter, from its profile: an interval, a verdict, and the reason in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.inference.profile import Evaluate, Profile, threshold_square

IDENTIFIED: Final = 0.25
"""Widest interval, of the range, of what is called identified."""

WEAKLY: Final = 0.5
"""Widest interval, of the range, of what is called weakly identified; a wider one tells nothing."""

SILENT_DB: Final = 1.0
"""Change of path loss below which no link is said to depend on a parameter [dB]."""

MOVED: Final = 0.25
"""Share of its range that another parameter moves by where it is said to make up for one."""


Shown = Callable[[int, float], float]
"""A parameter's place and its value to the value that words are to give, where the search has a scale of its own."""


def as_it_is(_: int, value: float) -> float:
    """The value itself."""
    return value


@dataclass(frozen=True)
class Verdict:
    """What the data tell of one parameter.

    Attributes:
        pieces: Lower and upper end of every piece of the confidence set, ascending; within the bounds.
        best: Value at the lowest point.
        name: "identified", "weakly identified", "ambiguous", "at bound" or "not identifiable".
        reason: Why, in words.
    """

    pieces: tuple[tuple[float, float], ...]
    best: float
    name: str
    reason: str

    @property
    def lower(self) -> float:
        """Lower end of the hull of all pieces."""
        return self.pieces[0][0]

    @property
    def upper(self) -> float:
        """Upper end of the hull of all pieces."""
        return self.pieces[-1][1]


def verdicts(
    curves: Sequence[Profile],
    evaluate: Evaluate,
    names: Sequence[str],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    freedom: int,
    *,
    level: float = 0.95,
    shown: Shown = as_it_is,
) -> list[Verdict]:
    """What the data tell of every parameter.

    Args:
        curves: The profile of every parameter, as `profiles` gives them.
        evaluate: What is minimised.
        names: Names of the parameters.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        freedom: Number of links less those of parameters and nuisances.
        level: Confidence.
        shown: What reasons give for a value.

    Returns:
        One verdict for every parameter.
    """
    lowest = min(curves, key=lambda curve: curve.square.min())
    least = float(lowest.square.min())
    best = lowest.point[np.argmin(lowest.square)]
    threshold = threshold_square(least, freedom, level)
    found = []
    for index, curve in enumerate(curves):
        pieces = curve.pieces(threshold)
        low, high = pieces[0][0], pieces[-1][1]
        share = sum(end - start for start, end in pieces) / (upper[index] - lower[index])
        ends = _touched(pieces, lower[index], upper[index])
        if share > WEAKLY:
            name = "not identifiable"
            reason = _blindness(curve, evaluate, names, best, upper - lower, threshold)
        elif len(pieces) > 1:
            name, reason = "ambiguous", _separate(curve, pieces, least, level, shown)
        elif ends:
            side = (
                f"below {shown(index, high):.4g}" if ends == ["lower"] else f"above {shown(index, low):.4g}"
            )
            reason = f"the interval ends at the {ends[0]} bound: the data say only that it lies {side}"
            name = "at bound"
        else:
            name = "identified" if share <= IDENTIFIED else "weakly identified"
            reason = f"the interval takes up {share:.0%} of the range"
        found.append(Verdict(pieces, float(best[index]), name, reason))
    return found


def _touched(pieces: tuple[tuple[float, float], ...], lower: float, upper: float) -> list[str]:
    """The bounds that a confidence set reaches."""
    slack, found = 1e-6 * (upper - lower), []
    if pieces[0][0] <= lower + slack:
        found.append("lower")
    if pieces[-1][1] >= upper - slack:
        found.append("upper")
    return found


def _separate(
    curve: Profile, pieces: tuple[tuple[float, float], ...], least: float, level: float, shown: Shown
) -> str:
    """The minima that fit, with how much worse each fits than the best."""
    parts = []
    for low, high in pieces:
        inside = (curve.value >= low) & (curve.value <= high)
        at = np.flatnonzero(inside)[np.argmin(curve.square[inside])]
        behind = float(np.sqrt(curve.square[at])) - float(np.sqrt(least))
        parts.append(f"{shown(curve.index, float(curve.value[at])):.4g} ({behind:.2f} dB behind the best)")
    return f"{len(pieces)} separate ranges fit at {level:.0%}: around {', '.join(parts)}"


def _blindness(
    curve: Profile,
    evaluate: Evaluate,
    names: Sequence[str],
    best: NDArray[np.float64],
    width: NDArray[np.float64],
    threshold: float,
) -> str:
    """Why most of the range fits: no link depends on it, another parameter makes up for it, or errors are large."""
    line = np.tile(best, (len(curve.value), 1))
    line[:, curve.index] = curve.value
    residuals = evaluate(line)[1]
    change = float(np.nanmax(np.ptp(np.where(np.isfinite(residuals), residuals, np.nan), axis=0)))
    if change < SILENT_DB:
        return f"no link's path loss changes by more than {change:.1f} dB over its whole range"
    fits = curve.square <= threshold
    moved = np.ptp(curve.point[fits], axis=0) / width
    moved[curve.index] = 0.0
    if moved.max() > MOVED:
        other = names[int(np.argmax(moved))]
        return f"{other} makes up for it: it moves over {moved.max():.0%} of its range while the fit stays as good"
    errors = np.sqrt(threshold)
    return (
        f"links change by up to {change:.1f} dB over its range, too little against errors of {errors:.1f} dB"
    )
