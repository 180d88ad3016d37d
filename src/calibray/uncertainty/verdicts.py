"""Verdicts from draws of the posterior: a credible interval, a verdict and a reason for every parameter.

A credible set is the smallest set that contains a given fraction of the posterior. The set consists of two intervals if
two distant ranges fit the data. Gaussian kernels with locally adapted widths smooth the density of the weighted draws
(B. W. Silverman, Density Estimation for Statistics and Data Analysis, 1986, section 5.2). The kernels are mirrored at
the bounds.

If the posterior cannot be sampled, linear theory is used instead: intervals and covariances follow from the curvature
of the sum of squares at the optimum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from calibray.fitting.problem import Evaluation, Problem
from calibray.fitting.search import Trail
from calibray.result.verdict import CONFIDENCE, Interval, Reason, ReasonKind, Verdict
from calibray.uncertainty.draws import Draws, systematic_resampling


def local_intervals(problem: Problem, trail: Trail, optimum: Evaluation) -> dict[str, Interval]:
    """Intervals by parameter, from linear theory in the search space, which is logarithmic for some parameters.

    `optimum` is the evaluation at the optimum, with derivatives.
    """
    parameters = problem.parameters
    # Compressed residuals are scaled so that their sum of squares equals that of the full residuals.
    scale = np.sqrt(optimum.num_rows / optimum.residuals.shape[1])
    searched = linear_intervals(
        parameters.to_search(trail.best),
        optimum.residuals[0] * scale,
        optimum.slopes[0] * scale,
        *parameters.search_bounds,
        optimum.num_rows - problem.unknowns,
    )
    lower = parameters.from_search(np.array([interval.lower for interval in searched]))
    upper = parameters.from_search(np.array([interval.upper for interval in searched]))
    unit = parameters.search_slope(trail.best)
    return {
        name: Interval(
            interval.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), interval.verdict
        )
        for k, (name, interval) in enumerate(zip(parameters.names, searched, strict=True))
    }


def with_reason(local: dict[str, Interval], reason: Reason) -> dict[str, Interval]:
    """Add to the intervals from linear theory the reason why the posterior was not sampled.

    Curvature alone does not show other minima or correlated errors, so no parameter is more than weakly identified,
    unless the data contain no noise.
    """
    exact, identified = reason.kind == ReasonKind.NO_NOISE, Verdict.IDENTIFIED
    capped = {identified: identified if exact else Verdict.WEAKLY_IDENTIFIED}
    return {
        name: replace(interval, verdict=capped.get(interval.verdict, interval.verdict), reason=reason)
        for name, interval in local.items()
    }


def linear_intervals(
    best: NDArray[np.float64],
    residuals: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    freedom: int,
) -> list[Interval]:
    """95 % confidence intervals from the curvature of the sum of squares at the optimum, one for each of d parameters.

    A parameter is not identifiable if its interval is wider than half the range between its bounds [d]. Other minima
    and correlated errors can make the true interval wider. The nuisance is eliminated from the residuals [m], [dB], and
    their derivatives [m, d]; `freedom` is the number of full residuals minus unknowns.
    """
    freedom = max(freedom, 1)
    quantile = float(stdtrit(freedom, (1 + CONFIDENCE) / 2))  # of Student's t
    variance = float(residuals @ residuals) / freedom
    # Scale the derivatives by the parameters' ranges, which makes the eigenvalues comparable.
    scaled = jacobian * (upper - lower)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    # A direction without effect is assigned a large but finite variance.
    values = np.maximum(values, values.max(initial=0.0) * 1e-12 + 1e-300)
    errors = np.sqrt(variance * ((vectors**2) @ (1 / values))) * (upper - lower)
    result = []
    for value, error, low, high in zip(best, errors, lower, upper, strict=True):
        ends = max(value - quantile * error, low), min(value + quantile * error, high)
        span = high - low
        verdict = Verdict.IDENTIFIED
        if 2 * quantile * error > span / 2:
            verdict = Verdict.NOT_IDENTIFIABLE
        elif min(value - low, high - value) < 1e-6 * span:
            verdict = Verdict.AT_BOUND
        result.append(Interval(float(error), float(ends[0]), float(ends[1]), verdict))
    return result


JUDGED: Final = 0.9
"""Probability level of the credible sets on which the verdicts are based. The last few per cent of a 95 % interval can
lie far from the rest if they come from a noise model with a small weight."""

IDENTIFIED: Final = 0.25
"""Maximum width of the credible set of an identified parameter, as a fraction of the range."""

WEAKLY: Final = 0.5
"""Maximum width of the credible set of a weakly identified parameter, as a fraction of the range; a parameter with a
wider set is not identifiable."""

NO_EFFECT_DB: Final = 1.0
"""Change in path loss over a parameter's range below which a link counts as independent of the parameter [dB]."""

END: Final = 0.1
"""If no link depends on a parameter, distances between an interval's end and the bound are attributed to chance up to
this fraction of the range."""

TRADE_OFF: Final = 0.5
"""Rank correlation above which one parameter is reported to compensate for another."""

LARGE_EFFECT: Final = 3.0
"""Change in path loss, in standard deviations of the errors, above which a single link would determine the
parameter."""

RANKED: Final = 400
"""Number of draws of equal weight from which rank correlations are computed."""

LINE: Final = 25
"""Number of values over the range of a parameter at which the effect of the parameter is computed."""

QUANTILES: Final = 400
"""Number of quantiles that represent the draws."""

GRID: Final = 101
"""Number of equally spaced points over the whole range that are used in addition to the quantiles."""

STEPS: Final = np.array([0.5, 1.0, 1.5, 2.0, 3.0])
"""Distances, in kernel widths, from the outermost quantiles to the points beyond them."""

KERNEL_SHARE: Final = 0.08
"""Fraction of the draws within the width of a kernel, for up to 200 draws; more draws allow narrower kernels
(Silverman)."""

MOST_INDEPENDENT: Final = 1000
"""Maximum number of draws that count as independent; further draws are mostly later states of the same members. In four
districts, 90 % sets then contain 0.88 to 0.90 of a reference posterior. For the constants of window glass, these sets
have 1.5 pieces on average, compared with 1.1 for the reference. If all draws counted as independent, the 90 % sets
would contain 0.87 to 0.90 of the reference posterior, and the sets for window glass would have 2.0 pieces
(`benchmarks/simulation_based.py --reference`)."""

LEAST_SHARE: Final = 0.005
"""Minimum fraction of the posterior in one piece (interval) of a credible set; smaller fractions are attributed to
chance."""

REACH: Final = 8.5
"""Number of kernel widths beyond which the tail of a Gaussian is zero in double precision."""

LEAST_GAP: Final = 0.03
"""A gap between pieces is attributed to chance if it is narrower than both this fraction of the range and the wider
piece. Pieces that all lie within this fraction of the range are merged, because a user would regard them as one
value."""


Modelled = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Maps points [n, d] to the path loss [n, m], [dB], of the m links used."""


@dataclass(frozen=True, eq=False)
class Axes:
    """The axes of the search space.

    Attributes:
        names: Names of the parameters.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        value: Maps the index of a parameter and a search coordinate to the value that is stated in reasons.
        customary: Usual widths [d] of the parameters' ranges; if None, the widths between the bounds. Fractions refer
            to the smaller of the two widths, so that wider bounds do not improve a verdict.
    """

    names: Sequence[str]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    value: Callable[[int, float], float] = lambda _, coordinate: coordinate
    customary: NDArray[np.float64] | None = None

    def extent(self, index: int) -> float:
        """Width of the range to which fractions refer."""
        width = float(self.upper[index] - self.lower[index])
        return width if self.customary is None else min(width, float(self.customary[index]))


@dataclass(frozen=True)
class JudgedSet:
    """The credible set of one parameter, with its verdict.

    Attributes:
        pieces: Lower and upper ends of the pieces of the credible set, in ascending order and within the bounds.
        name: The verdict.
        reason: Its reason.
        seen: The pieces for the measured buildings; equal to `pieces` if the draws do not distinguish these buildings.
    """

    pieces: tuple[tuple[float, float], ...]
    name: Verdict
    reason: Reason
    seen: tuple[tuple[float, float], ...] = ()

    @property
    def lower(self) -> float:
        """Lower end of the lowest piece."""
        return self.pieces[0][0]

    @property
    def upper(self) -> float:
        """Upper end of the highest piece."""
        return self.pieces[-1][1]


def verdicts(
    draws: Draws,
    modelled: Modelled,
    axes: Axes,
    noise_db: float,
    *,
    level: float = 0.95,
    seen: Draws | None = None,
) -> list[JudgedSet]:
    """Judge every parameter by its posterior or, if buildings differ, by the posterior of its mean over all buildings.

    `noise_db` is the standard deviation of the links' errors [dB]. Intervals cover the fraction `level` of the
    posterior. `seen` is the posterior for the measured buildings; if None, `draws` is used.
    """
    best = draws.point[np.argmax(draws.density)]
    seen = draws if seen is None else seen
    result = []
    for index in range(len(axes.names)):
        lower, upper = float(axes.lower[index]), float(axes.upper[index])
        pieces, reported = credible_sets(draws.point[:, index], draws.weight, lower, upper, (JUDGED, level))
        seen_pieces, seen_reported = pieces, reported
        if seen is not draws:
            seen_pieces, seen_reported = credible_sets(
                seen.point[:, index], seen.weight, lower, upper, (JUDGED, level)
            )
        extent = axes.extent(index)
        share, seen_share = _width(pieces) / extent, _width(seen_pieces) / extent
        range_ = {"customary": True} if extent < upper - lower else {}
        seen_ends = _bounds_reached(seen_pieces, lower, upper)
        # If the posterior for all buildings is flat, the credible set reaches both bounds, and its pieces are due to
        # chance.
        judged = pieces if share <= WEAKLY else seen_pieces
        ends = _bounds_reached(judged, lower, upper) or seen_ends
        if share > WEAKLY >= seen_share and len(seen_pieces) == 1 and not seen_ends:
            name = Verdict.WEAKLY_IDENTIFIED
            reason = Reason(ReasonKind.SEEN_BUILDINGS, {"share": float(seen_share), **range_})
        elif share > WEAKLY and seen_share > WEAKLY:
            name, change = Verdict.NOT_IDENTIFIABLE, _effect(index, modelled, best, axes)
            if change < NO_EFFECT_DB:
                reason = Reason(ReasonKind.NO_EFFECT, {"change_db": change})
                reported = (_without_chance(reported, lower, upper),)
            else:
                reason = _confounding(index, draws, axes.names, change, noise_db)
        elif len(seen_pieces) > 1:
            name, reason = Verdict.AMBIGUOUS, _modes(index, seen_pieces, seen, axes)
        elif len(judged) > 1:
            name, reason = Verdict.AMBIGUOUS, _modes(index, judged, draws, axes)
        elif ends and judged:
            other_end = axes.value(index, judged[-1][1] if ends == ["lower"] else judged[0][0])
            reason = Reason(ReasonKind.AT_BOUND, {"side": ends[0], "value": float(other_end)})
            name = Verdict.AT_BOUND
        else:
            sure = share <= IDENTIFIED and draws.agree
            name = Verdict.IDENTIFIED if sure else Verdict.WEAKLY_IDENTIFIED
            others = _outlying_pieces(index, pieces, reported, draws, axes)
            reason = Reason(ReasonKind.WIDTH, {"share": float(share), **range_}, others)
        result.append(JudgedSet(reported, name, reason, seen_reported))
    return result


def _width(pieces: tuple[tuple[float, float], ...]) -> float:
    return sum(end - start for start, end in pieces)


def _bounds_reached(pieces: tuple[tuple[float, float], ...], lower: float, upper: float) -> list[str]:
    """Names of the bounds that a credible set reaches."""
    slack, reached = 1e-6 * (upper - lower), []
    if pieces[0][0] <= lower + slack:
        reached.append("lower")
    if pieces[-1][1] >= upper - slack:
        reached.append("upper")
    return reached


def _without_chance(
    pieces: tuple[tuple[float, float], ...], lower: float, upper: float
) -> tuple[float, float]:
    """A single range for a parameter without effect; gaps between pieces and short distances to a bound are ignored."""
    low, high, slack = pieces[0][0], pieces[-1][1], END * (upper - lower)
    return lower if low - lower < slack else low, upper if upper - high < slack else high


def _modes(index: int, pieces: tuple[tuple[float, float], ...], draws: Draws, axes: Axes) -> Reason:
    """The modes of the posterior with their weights."""
    modes, value = [], draws.point[:, index]
    for low, high in pieces:
        inside = (value >= low) & (value <= high)
        middle = value[inside][np.argmax(draws.density[inside])] if inside.any() else 0.5 * (low + high)
        modes.append((float(axes.value(index, float(middle))), float(draws.weight[inside].sum())))
    return Reason(ReasonKind.SEPARATE_RANGES, ranges=tuple(modes))


def _outlying_pieces(
    index: int,
    pieces: tuple[tuple[float, float], ...],
    reported: tuple[tuple[float, float], ...],
    draws: Draws,
    axes: Axes,
) -> tuple[tuple[float, float, float], ...]:
    """Pieces of the reported interval that lie outside the judged set, with their weights; usually there are none."""
    others, value = [], draws.point[:, index]
    for low, high in reported:
        if not any(start <= high and low <= end for start, end in pieces):
            weight = draws.weight[(value >= low) & (value <= high)].sum()
            others.append((float(axes.value(index, low)), float(axes.value(index, high)), float(weight)))
    return tuple(others)


def _effect(index: int, modelled: Modelled, best: NDArray[np.float64], axes: Axes) -> float:
    """Largest change [dB] in a link's path loss over the range of a parameter, with the other parameters fixed."""
    line = np.tile(best, (LINE, 1))
    line[:, index] = np.linspace(axes.lower[index], axes.upper[index], LINE)
    loss = modelled(line)
    return float(np.nanmax(np.ptp(np.where(np.isfinite(loss), loss, np.nan), axis=0)))


def _confounding(index: int, draws: Draws, names: Sequence[str], change: float, noise_db: float) -> Reason:
    """The reason why most of the range fits, although links depend on the parameter: a trade-off or large errors."""
    drawn = draws.point[systematic_resampling(draws.weight, RANKED, np.random.default_rng(0))]
    # Spearman's correlation is the correlation of the ranks.
    rank = np.argsort(np.argsort(drawn, axis=0), axis=0)
    varied = np.ptp(rank, axis=0) > 0
    correlation = np.zeros(len(names))
    if varied[index]:
        matrix = np.corrcoef(rank[:, varied].T).reshape(varied.sum(), -1)
        correlation[varied] = np.abs(matrix[varied[:index].sum()])
    correlation[index] = 0.0
    if correlation.max() > TRADE_OFF:
        other = names[int(np.argmax(correlation))]
        return Reason(ReasonKind.TRADE_OFF, {"parameter": other, "correlation": float(correlation.max())})
    if change > LARGE_EFFECT * noise_db:
        return Reason(ReasonKind.CONFOUNDED, {"change_db": change})
    return Reason(ReasonKind.NOISE, {"change_db": change, "noise_db": noise_db})


def consistent(interval: Interval, value: float) -> Interval:
    """The interval; an identified or weakly identified one that excludes the calibrated value becomes ambiguous."""
    identified = interval.verdict in (Verdict.IDENTIFIED, Verdict.WEAKLY_IDENTIFIED)
    if not identified or interval.contains(value, 1e-9 * abs(value)):
        return interval
    reason = Reason(ReasonKind.OUTSIDE_INTERVAL, {"value": float(value)})
    return replace(interval, verdict=Verdict.AMBIGUOUS, reason=reason)


def credible_sets(
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    lower: float,
    upper: float,
    levels: Sequence[float],
) -> list[tuple[tuple[float, float], ...]]:
    """For each level, the smallest set that contains this fraction of the posterior, from one smoothed density.

    Draws [n] have weights [n]. A set consists of the lower and upper ends of its pieces, in ascending order.

    Example:
        >>> draws = np.random.default_rng(0).normal(5.0, 0.1, 4000)
        >>> (((low, high),),) = credible_sets(draws, np.full(4000, 1 / 4000), 0.0, 10.0, [0.95])
        >>> round(low, 1), round(high, 1)
        (4.8, 5.2)
    """
    width = upper - lower
    edges, mass = _masses((value - lower) / width, weight)
    # Add intervals in order of decreasing density until the level is reached.
    order = np.argsort(-mass / np.diff(edges), kind="stable")
    covered, sets = np.cumsum(mass[order]), []
    for level in levels:
        inside = np.zeros(len(mass), dtype=bool)
        inside[order[: int(np.searchsorted(covered, level * covered[-1])) + 1]] = True
        pieces = _pieces(edges, mass / mass.sum(), inside)
        sets.append(tuple((lower + low * width, lower + high * width) for low, high in pieces))
    return sets


def _masses(
    unit: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Edges of intervals, densest around the draws, and the smoothed mass of the posterior in each interval."""
    order = np.argsort(unit, kind="stable")
    independent = min(weight.sum() ** 2 / np.sum(weight**2), MOST_INDEPENDENT)
    total = np.cumsum(weight[order]) / weight.sum()
    index = np.searchsorted(total, (np.arange(QUANTILES) + 0.5) / QUANTILES)
    quantile = unit[order][np.minimum(index, len(unit) - 1)]
    # A kernel is as wide as the range spanned by a fraction of the draws, on the side where the draws are denser.
    near = round(QUANTILES * KERNEL_SHARE * min(1.0, (200.0 / independent) ** 0.2))
    above, below = np.full(QUANTILES, np.inf), np.full(QUANTILES, np.inf)
    above[:-near] = below[near:] = quantile[near:] - quantile[:-near]
    size = np.maximum(np.minimum(above, below), 1e-9)
    ends = (quantile[0] - size[0] * STEPS, quantile[-1] + size[-1] * STEPS)
    edges = np.unique(np.clip(np.concatenate([np.linspace(0, 1, GRID), quantile, *ends]), 0.0, 1.0))
    edges = np.unique(np.concatenate([edges, 0.5 * (edges[1:] + edges[:-1])]))
    # Mirror only the kernels that extend beyond a bound.
    low, high = quantile < REACH * size, 1.0 - quantile < REACH * size
    centre = np.concatenate([quantile, -quantile[low], 2.0 - quantile[high]])
    cumulative = ndtr((edges[:, None] - centre) / np.concatenate([size, size[low], size[high]]))
    return edges, np.diff(cumulative.sum(axis=1)) / QUANTILES


def _pieces(
    edges: NDArray[np.float64], mass: NDArray[np.float64], inside: NDArray[np.bool_]
) -> list[tuple[float, float]]:
    """Merge adjacent intervals into pieces; drop pieces and close gaps that are attributed to chance."""
    first = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
    last = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]]))
    kept: list[tuple[float, float]] = []
    for low, high in zip(first.tolist(), last.tolist(), strict=True):
        if mass[low : high + 1].sum() < LEAST_SHARE:
            continue
        start, end = float(edges[low]), float(edges[high + 1])
        if kept and (
            end - kept[0][0] < LEAST_GAP
            or start - kept[-1][1] < min(LEAST_GAP, max(end - start, kept[-1][1] - kept[-1][0]))
        ):
            start = kept.pop()[0]
        kept.append((start, end))
    return kept
