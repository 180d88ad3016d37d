"""What the data tell of a parameter, from draws of the posterior: an interval, a verdict, and the reason in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.result.verdict import Reason, ReasonKind
from calibray.result.verdict import Verdict as VerdictName
from calibray.uncertainty.credible_sets import credible_sets
from calibray.uncertainty.importance_sampling import Draws

JUDGED: Final = 0.9
"""Share of the posterior that verdicts go by: the last few per cent lie far out, where a rare model of the noise
explains the data as well, and say little of what is known."""

IDENTIFIED: Final = 0.25
"""Widest set, of the range, of what is called identified."""

WEAKLY: Final = 0.5
"""Widest set, of the range, of what is called weakly identified; a wider one tells nothing."""

SILENT_DB: Final = 1.0
"""Change of path loss below which no link is said to depend on a parameter [dB]."""

CHANCE: Final = 0.1
"""Distance from a bound, of the range, within which the end of a set is chance where no link depends on a parameter."""

TRADED: Final = 0.5
"""Rank correlation from which on another parameter is said to make up for one."""

LARGE: Final = 3.0
"""Change of path loss, by the size of errors, from which on single links would tell a parameter by themselves."""

LINE: Final = 25
"""Values over the range of a parameter that its effect is taken from."""


Modelled = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Points [n, d] to the path loss of the links that count [n, m], [dB]."""

Shown = Callable[[int, float], float]
"""A parameter's place and its value to the value that words are to give, where the search has a scale of its own."""


def as_it_is(_: int, value: float) -> float:
    """The value itself."""
    return value


@dataclass(frozen=True)
class Verdict:
    """What the data tell of one parameter.

    Attributes:
        pieces: Lower and upper end of every piece of the credible set, ascending; within the bounds.
        best: Value at the point of the highest density.
        name: The verdict.
        reason: Why.
    """

    pieces: tuple[tuple[float, float], ...]
    best: float
    name: VerdictName
    reason: Reason

    @property
    def lower(self) -> float:
        """Lower end of the hull of all pieces."""
        return self.pieces[0][0]

    @property
    def upper(self) -> float:
        """Upper end of the hull of all pieces."""
        return self.pieces[-1][1]


def verdicts(
    draws: Draws,
    modelled: Modelled,
    names: Sequence[str],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    noise_db: float,
    *,
    level: float = 0.95,
    shown: Shown = as_it_is,
    seen: Draws | None = None,
) -> list[Verdict]:
    """What the data tell of every parameter.

    Args:
        draws: The posterior.
        modelled: What depends on the parameters.
        names: Names of the parameters.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        noise_db: Size of the links' errors [dB].
        level: Share of the posterior that intervals hold.
        shown: What reasons give for a value.
        seen: The posterior of what the links lean on, where that may differ from what is asked for.

    Returns:
        One verdict for every parameter.
    """
    best = draws.point[np.argmax(draws.density)]
    found = []
    for index in range(len(names)):
        pieces, told = credible_sets(
            draws.point[:, index], draws.weight, float(lower[index]), float(upper[index]), (JUDGED, level)
        )
        low, high = pieces[0][0], pieces[-1][1]
        share = sum(end - start for start, end in pieces) / (upper[index] - lower[index])
        ends = _touched(pieces, lower[index], upper[index])
        lean, basis = pieces, draws
        if seen is not None and seen is not draws:
            basis = seen
            (lean,) = credible_sets(
                seen.point[:, index], seen.weight, float(lower[index]), float(upper[index]), (JUDGED,)
            )
        own = sum(end - start for start, end in lean) / (upper[index] - lower[index])
        ends = ends or _touched(lean, lower[index], upper[index])
        if share > WEAKLY >= own and len(lean) == 1 and not ends:
            name = VerdictName.WEAKLY_IDENTIFIED
            reason = Reason(ReasonKind.SEEN_BUILDINGS, {"share": float(own)})
        elif share > WEAKLY and own > WEAKLY:
            name, change = VerdictName.NOT_IDENTIFIABLE, _effect(index, modelled, best, lower, upper)
            if change < SILENT_DB:
                reason = Reason(ReasonKind.NO_EFFECT, {"change_db": change})
                told = (_evened(told, float(lower[index]), float(upper[index])),)
            else:
                reason = _blindness(index, draws, names, change, noise_db)
        elif max(len(pieces), len(lean)) > 1:
            several = (lean, basis) if len(lean) > 1 else (pieces, draws)
            name, reason = VerdictName.AMBIGUOUS, _separate(index, *several, shown)
        elif ends:
            other_end = shown(index, high if ends == ["lower"] else low)
            reason = Reason(ReasonKind.AT_BOUND, {"side": ends[0], "value": float(other_end)})
            name = VerdictName.AT_BOUND
        else:
            name = VerdictName.IDENTIFIED if share <= IDENTIFIED else VerdictName.WEAKLY_IDENTIFIED
            others = _apart(index, pieces, told, draws, shown)
            reason = Reason(ReasonKind.WIDTH, {"share": float(share)}, others)
        found.append(Verdict(told, float(best[index]), name, reason))
    return found


def _touched(pieces: tuple[tuple[float, float], ...], lower: float, upper: float) -> list[str]:
    """The bounds that a credible set reaches."""
    slack, found = 1e-6 * (upper - lower), []
    if pieces[0][0] <= lower + slack:
        found.append("lower")
    if pieces[-1][1] >= upper - slack:
        found.append("upper")
    return found


def _evened(pieces: tuple[tuple[float, float], ...], lower: float, upper: float) -> tuple[float, float]:
    """One range of what no link tells: what lies between pieces is chance, and so is little at the ends."""
    low, high, slack = pieces[0][0], pieces[-1][1], CHANCE * (upper - lower)
    return lower if low - lower < slack else low, upper if upper - high < slack else high


def _separate(index: int, pieces: tuple[tuple[float, float], ...], draws: Draws, shown: Shown) -> Reason:
    """The modes that explain the links, with their weights."""
    modes, value = [], draws.point[:, index]
    for low, high in pieces:
        inside = (value >= low) & (value <= high)
        middle = value[inside][np.argmax(draws.density[inside])] if inside.any() else 0.5 * (low + high)
        modes.append((float(shown(index, float(middle))), float(draws.weight[inside].sum())))
    return Reason(ReasonKind.SEPARATE_RANGES, ranges=tuple(modes))


def _apart(
    index: int,
    pieces: tuple[tuple[float, float], ...],
    told: tuple[tuple[float, float], ...],
    draws: Draws,
    shown: Shown,
) -> tuple[tuple[float, float, float], ...]:
    """Pieces of the reported interval outside the judged set, with their weights; mostly none."""
    others, value = [], draws.point[:, index]
    for low, high in told:
        if not any(start <= high and low <= end for start, end in pieces):
            weight = draws.weight[(value >= low) & (value <= high)].sum()
            others.append((float(shown(index, low)), float(shown(index, high)), float(weight)))
    return tuple(others)


def _effect(
    index: int,
    modelled: Modelled,
    best: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> float:
    """Largest change of a link's path loss over the range of a parameter, all others kept [dB]."""
    line = np.tile(best, (LINE, 1))
    line[:, index] = np.linspace(lower[index], upper[index], LINE)
    loss = modelled(line)
    return float(np.nanmax(np.ptp(np.where(np.isfinite(loss), loss, np.nan), axis=0)))


def _blindness(index: int, draws: Draws, names: Sequence[str], change: float, noise_db: float) -> Reason:
    """Why most of the range fits though links depend on it: another parameter makes up for it, or errors are large."""
    rank = np.argsort(np.argsort(draws.resampled(400), axis=0), axis=0)
    varied = np.ptp(rank, axis=0) > 0
    traded = np.zeros(len(names))
    if varied[index]:
        traded[varied] = np.abs(
            np.corrcoef(rank[:, varied].T).reshape(varied.sum(), -1)[varied[:index].sum()]
        )
    traded[index] = 0.0
    if traded.max() > TRADED:
        other = names[int(np.argmax(traded))]
        return Reason(ReasonKind.TRADE_OFF, {"parameter": other, "correlation": float(traded.max())})
    if change > LARGE * noise_db:
        return Reason(ReasonKind.CONFOUNDED, {"change_db": change})
    return Reason(ReasonKind.NOISE, {"change_db": change, "noise_db": noise_db})
