"""Statistics of held-out errors: spatial blocks, comparison of two models, and widths of prediction intervals.

The interval is conformal: among n + 1 exchangeable errors, a new error has every rank with the same probability. With
probability p, the absolute value of a new error is therefore at most the ((n + 1) p)-th smallest of the n observed
absolute errors, regardless of their distribution (V. Vovk, A. Gammerman, G. Shafer, Algorithmic Learning in a Random
World, 2005; R. J. Barber et al., Ann. Statist. 49, 2021, for held-out links). Link errors have heavier tails than a
Gaussian distribution, so an interval computed from their RMS value would be too wide at 90 %. If there are few errors,
their largest values are too uncertain, and Student's t distribution is used instead.

For further observables, one baseline is linear in distance for times of flight, and linear in the logarithm of distance
otherwise. Models and baselines include device biases, which are fitted to the links that are not held out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import stdtrit

from calibray.fitting.observed import Observed
from calibray.fitting.problem import Problem
from calibray.measurements import Measurements
from calibray.measurements.observables import ROUND_TRIP, TIME_OF_FLIGHT
from calibray.result.held_out import (
    AVERAGE_OF,
    FITTED,
    WITHOUT_MATERIALS,
    BlockErrors,
    Judgement,
    Model,
    ObservableErrors,
)
from calibray.study.model import StudyModel

Errors = Mapping[Any, NDArray[np.float64]]
"""Residuals [n], [dB], by model; each key is a `Model` or its name."""

CLUSTER_LINKS: Final = 4
"""Number of neighbouring links that are resampled together, because neighbours share part of their noise."""

MOST_CLUSTERS: Final = 1000
"""Maximum number of clusters; larger data sets have larger clusters instead."""

RESAMPLES: Final = 2000

LEAST_GAIN: Final = 0.05
"""Minimum relative decrease in the RMSE for which another model is chosen. In Boulder, smaller decreases were due to a
single block, and the fitted model was up to 3 dB worse on separately held-out clusters. With simulated misfits, every
decrease was larger."""

REACHED: Final = 0.9
"""Fraction of the held-out links that are at most `BlockErrors.reach_m` from a link outside their own block."""

AVERAGE_LINKS: Final = 8
"""Weight, expressed as a number of links, that the mean square error of all links has in the estimate for
non-line-of-sight links. A few such links give little information about their own errors."""

FEWEST_FOR_RANKS: Final = 40
"""Minimum number of errors for which their ranks determine an interval; for fewer, Student's t distribution is
assumed."""


def spatial_blocks(position: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Divide positions [n, 2 or 3], [m], into compact blocks [n] of about equal size, numbered from 0.

    The largest block is halved across its longer side until there are `count` blocks, or n if `count` is larger.

    Example:
        >>> spatial_blocks(np.array([[0.0, 0.0], [9.0, 0.0], [1.0, 0.0], [8.0, 0.0]]), 2).tolist()
        [0, 1, 0, 1]
    """
    block = np.zeros(len(position), dtype=np.int64)
    for new_block in range(1, min(count, len(position))):
        largest = int(np.argmax(np.bincount(block)))
        members = np.flatnonzero(block == largest)
        axis = int(np.argmax(np.ptp(position[members], axis=0)))
        order = members[np.argsort(position[members, axis], kind="stable")]
        block[order[(len(order) + 1) // 2 :]] = new_block
    return block


def moving_end(links: Measurements) -> NDArray[np.float64]:
    """Positions of the receivers, or of the transmitters if these have more distinct positions [links, 3], [m]."""
    tx_places, rx_places = (len(np.unique(end, axis=0)) for end in (links.tx, links.rx))
    return links.tx if tx_places > rx_places else links.rx


def place_blocks(position: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Divide links by horizontal position [n, 3], [m], like `spatial_blocks`, but never split a position; blocks [n].

    Example:
        >>> place_blocks(np.array([[0.0, 0, 1], [0.0, 0, 4], [0.0, 0, 7], [9.0, 0, 1]]), 2).tolist()
        [0, 0, 0, 1]
    """
    _, first, place = np.unique(position[:, :2], axis=0, return_index=True, return_inverse=True)
    # Distinct positions keep the order of the links, because this order breaks ties between equal coordinates.
    order = np.argsort(first)
    block = np.empty(len(first), dtype=np.int64)
    block[order] = spatial_blocks(position[first[order], :2], count)
    return block[place.reshape(-1)]


def compare(errors: NDArray[np.float64], baselines: Errors, position: NDArray[np.float64]) -> Judgement:
    """Compare a model with its best baseline, by residuals on the same held-out links [n], [dB].

    The standard error of the difference is estimated by resampling clusters of links with neighbouring positions [n,
    3], [m]. The same clusters are used for both models. Links with a residual that is not finite are left out.
    """
    table = np.stack([errors, *baselines.values()])
    finite = np.isfinite(table).all(axis=0)
    square, count = table[:, finite] ** 2, int(finite.sum())
    if not count:
        return Judgement(0, np.nan, next(iter(baselines)), np.nan, None, 0)
    rmse = np.sqrt(square.mean(axis=1))
    best = 1 + int(np.argmin(rmse[1:]))
    # Two or more links form at least two clusters, because a single cluster gives no standard error.
    clusters = min(max(count // CLUSTER_LINKS, min(count, 2)), MOST_CLUSTERS)
    cluster = spatial_blocks(position[finite], clusters)
    size = np.bincount(cluster)
    total = np.stack([np.bincount(cluster, weights=square[row]) for row in (0, best)])
    resampled = np.random.default_rng(0).integers(len(size), size=(RESAMPLES, len(size)))
    # Clusters differ in size, so total sums of squares are divided by the total number of links.
    model_rmse, baseline_rmse = np.sqrt(total[:, resampled].sum(axis=2) / size[resampled].sum(axis=1))
    # Resampling k clusters underestimates the variance between new clusters by the factor (k - 1) / k.
    error = None
    if len(size) > 1:
        error = float(np.std(baseline_rmse - model_rmse) * np.sqrt(len(size) / (len(size) - 1)))
    name = list(baselines)[best - 1]
    return Judgement(count, float(rmse[0]), str(name), float(rmse[best]), error, len(size))


def choose(errors: Errors, position: NDArray[np.float64]) -> str:
    """Choose the prediction model by held-out residuals [n], [dB], which must include those of `Model.INITIAL`.

    The initial materials are kept unless another model is better by more than both the bootstrap standard error of the
    difference and `LEAST_GAIN`. Kriging is never chosen, because it predicts well only near the measured links.
    """
    chosen: str = Model.INITIAL
    for name in (least(errors, FITTED), *WITHOUT_MATERIALS):
        if name in errors:
            comparison = compare(errors[name], {chosen: errors[chosen]}, position)
            error_db = np.inf if comparison.error_db is None else comparison.error_db
            margin_db = max(error_db, LEAST_GAIN * comparison.baseline_rmse_db)
            chosen = name if comparison.gain_db > margin_db else chosen
    return chosen


def predicting(errors: Errors, position: NDArray[np.float64]) -> str:
    """The prediction model: the model chosen by held-out residuals, or the average (if any) that replaces this model.

    A log-distance model is not averaged if averaging increases the RMSE by more than `LEAST_GAIN`, because the scene
    may be a much worse model.
    """
    name = choose(errors, position)
    average = AVERAGE_OF.get(name, name)
    if average not in errors:
        return name
    rmse_db = [float(np.sqrt(np.mean(errors[model] ** 2))) for model in (name, average)]
    keeps = name in WITHOUT_MATERIALS and rmse_db[1] > (1.0 + LEAST_GAIN) * rmse_db[0]
    return name if keeps else average


def least(errors: Errors, names: tuple[str, ...]) -> str:
    """The model with the lowest RMSE among those `names` for which there are residuals [n], [dB]."""
    return min((name for name in names if name in errors), key=lambda name: float(np.mean(errors[name] ** 2)))


def two_levels(
    errors: NDArray[np.float64],
    block: NDArray[np.int64],
    position: NDArray[np.float64],
    fitted: NDArray[np.float64] | None = None,
) -> BlockErrors | None:
    """Variance of held-out errors [n], [dB], within and between blocks (random-effects analysis of variance).

    Each new street has its own error, so a few blocks contain less information than the number of links suggests.
    `position` [n, k] contains the positions of both ends of each link, in metres. `fitted` [m, k] contains those of the
    links to which the models were fitted; if None, the models were fitted to the links of the other blocks. The result
    is None if there are fewer than two blocks, or no more links than blocks.

    Example:
        >>> blocks = two_levels(np.array([3.0, 4, -4, -3, 1, 0]), np.array([0, 0, 1, 1, 2, 2]), np.eye(6))
        >>> round(blocks.within_db, 2), round(blocks.between_db, 1), blocks.blocks
        (0.71, 3.3, 3)
    """
    _, index, size = np.unique(block, return_inverse=True, return_counts=True)
    count, links = len(size), len(errors)
    if count < 2 or links <= count:
        return None
    # Around the common error of a block, the mean over its links has the variance `within / size`.
    mean = np.bincount(index, errors) / size
    within = float(np.sum((errors - mean[index]) ** 2)) / (links - count)
    # Predictions are not corrected for the mean error of a block, so its deviation is measured from zero.
    between = max(float(np.mean(mean**2 - within / size)), 0.0) * (1.0 + 1.0 / count)
    distance = np.empty(links)
    for number in range(count):
        here = index == number
        distance[here] = KDTree(position[~here] if fitted is None else fitted).query(position[here])[0]
    reach_m = float(np.quantile(distance, REACHED))
    return BlockErrors(float(np.sqrt(within)), float(np.sqrt(between)), count, reach_m)


def out_of_sight_ratio(errors: NDArray[np.float64], blocked: NDArray[np.bool_]) -> float:
    """RMS error of non-line-of-sight links, divided by the RMS error of all links, from residuals [n], [dB].

    The ratio is at least 1; line-of-sight links keep the interval of all links. If few links have no line of sight, the
    ratio is shrunk towards 1 (`AVERAGE_LINKS`).

    Example:
        >>> errors, blocked = np.array([1.0, -1, 1, 5, -5, 5, 5, -5, 5, -5, 5]), np.arange(11) > 2
        >>> round(out_of_sight_ratio(errors, blocked), 2), out_of_sight_ratio(errors, ~blocked)
        (1.09, 1.0)
    """
    mean = float(np.mean(errors**2))
    square = (float(np.sum(errors[blocked] ** 2)) + AVERAGE_LINKS * mean) / (blocked.sum() + AVERAGE_LINKS)
    return float(np.sqrt(max(square / mean, 1.0))) if mean > 0 else 1.0


def interval_half_width(absolute_errors: NDArray[np.float64], level: float) -> float:
    """Half-width [dB] of the interval that contains a new error with probability `level`.

    Absolute errors [n], [dB], are in ascending order.

    Example:
        >>> errors = np.sort(np.abs(np.random.default_rng(0).standard_normal(999)))
        >>> round(interval_half_width(errors, 0.9), 2), round(interval_half_width(errors[::100], 0.9), 2)
        (1.56, 1.48)
    """
    count, rank = len(absolute_errors), (len(absolute_errors) + 1) * level
    rms = float(np.sqrt(np.mean(np.square(absolute_errors))))
    student_t = float(stdtrit(count, (1 + level) / 2)) * rms
    if count < FEWEST_FOR_RANKS:
        return student_t
    # There are too few observed errors for their ranks to give an upper limit at this level.
    if rank > count:
        return max(student_t, float(absolute_errors[-1]))
    return float(np.interp(rank, np.arange(1, count + 1), absolute_errors))


MODELS: Final = ("calibrated", "mean", "law of distance")
"""The models that are compared on held-out links."""


def held_out_gaps(
    problem: Problem, best: NDArray[np.float64], held_out: NDArray[np.bool_]
) -> dict[str, NDArray[np.float64]]:
    """Predicted minus measured values [3, L] of every observable on held-out links, for the three `MODELS`.

    Each value has the unit of the observable. Biases are fitted to the other links. The optimum `best` [d] is in the
    parameters' units. The values of links that are not judged are NaN.
    """
    if not problem.observed:
        return {}
    modelled = problem.respond(best[None]).observed[0]
    weight, links, gaps = problem.objective.weight, problem.setup.links, {}
    for observable, values in zip(problem.observed, modelled, strict=True):
        features = [values / observable.scale, np.zeros(len(links)), _law(observable, links)]
        predicted = [
            _with_biases(observable, feature, weight, slope=index == 2)
            for index, feature in enumerate(features)
        ]
        judged = held_out & np.isfinite(observable.measured) & np.isfinite(values)
        gaps[observable.name] = np.where(judged, np.stack(predicted) - observable.measured, np.nan)
    return gaps


def observable_errors(
    gaps: Mapping[str, NDArray[np.float64]], study: StudyModel
) -> dict[str, ObservableErrors]:
    """RMS errors of the models by observable, from predicted minus measured values [3, L].

    Observables without a judged link are omitted.
    """
    errors = {}
    for name, gap in gaps.items():
        judged = gap[:, np.isfinite(gap).all(axis=0)]
        if judged.shape[1]:
            rms = np.sqrt(np.mean(judged**2, axis=1)).tolist()
            errors[name] = ObservableErrors(study.observables[name].unit, judged.shape[1], *rms)
    return errors


def _law(observable: Observed, links: Measurements) -> NDArray[np.float64]:
    distance = np.linalg.norm(links.tx - links.rx, axis=1)
    if observable.statistic.kind in (TIME_OF_FLIGHT, ROUND_TRIP):
        return distance
    return np.log10(np.maximum(distance, 1e-3))


def _with_biases(
    observable: Observed, feature: NDArray[np.float64], weight: NDArray[np.float64], *, slope: bool
) -> NDArray[np.float64]:
    """The feature, or a fitted multiple of it, plus fitted biases.

    Groups without links in the fit are assigned the mean bias.
    """
    used = observable.used(weight)
    used = used[np.isfinite(feature[used])]
    # The model has a bias only if the study states a bias; the mean and the law always include a constant.
    constant = slope or not np.any(feature)
    if observable.labels:
        groups = np.unique(observable.group[used])
        design = (observable.group[:, None] == groups).astype(np.float64)
        design[design.sum(axis=1) == 0] = 1.0 / max(len(groups), 1)
    else:
        design = np.ones((len(feature), 1 if constant else 0))
    if slope:
        columns = np.column_stack([design, feature])
        return columns @ np.linalg.lstsq(columns[used], observable.measured[used], rcond=None)[0]
    bias = np.linalg.lstsq(design[used], (observable.measured - feature)[used], rcond=None)[0]
    return feature + design @ bias
