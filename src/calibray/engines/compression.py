"""Compression replaces tens of thousands of paths by a few weighted paths, with a stated maximum error in path loss.

The power of a link is a sum over its paths, P(x) = sum_p p_p(x), where x is the candidate. Within the bounds of a few
parameters, the functions p_p(x) span a low-dimensional space, so a few paths with weights w_p >= 0 suffice. The
weighted sum sum_p w_p p_p(x) is fitted to P(x) at training candidates by non-negative least squares. Paths are added
greedily until the fit is sufficiently accurate (C. Farhat, T. Chapman, P. Avery, Int. J. Numer. Methods Eng. 102 (2015)
1077).

The weights are non-negative and the paths are physical, so the power of a compressed link remains physically plausible
between the training candidates. Nevertheless, the error is checked at new candidates, many of which have parameters at
their bounds. If a link's error at these candidates exceeds half the tolerance, they join the training candidates and
the link is fitted again. After several failed fits, the link keeps all its paths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from calibray.engines.replay import TABLE_TOLERANCE
from calibray.errors import InputError
from calibray.fields import FINEST, layout, path_losses, path_powers
from calibray.parameters import Parameters
from calibray.paths import Paths, take

TOLERANCE_DB: Final = 0.01
"""Default maximum error in a link's path loss [dB]."""

MIN_PATHS: Final = 64
"""Number of paths up to which a link is not compressed, because the benefit would be small."""

FIT_SHARE: Final = 0.1
"""Maximum error of the fit as a share of the tolerance; the rest is a margin for candidates other than the training
candidates."""

CHECK_SHARE: Final = 0.5
"""Maximum error at new candidates as a share of the tolerance; the rest is a margin for unchecked candidates."""

TRAINING: Final = 16
"""For d parameters, the first fit uses TRAINING * (d + 1) random candidates in addition to the corners of the
bounds."""

CORNER_PARAMETERS: Final = 5
"""Maximum number of parameters whose bounds are combined into corners; all others are in the middle of their ranges."""

CHECKED: Final = 48
"""Number of new candidates in every check."""

ROUNDS: Final = 6
"""Maximum number of fits of a link; if all fits fail the check, the link keeps all its paths."""

RANKING: Final = 16
"""Number of candidates at which the paths are ranked by power."""

POOL: Final = 2000
"""Maximum number of a link's strongest paths in the fit, and also of its other paths, which are chosen at random."""

BATCH_POWERS: Final = 400_000_000
"""Maximum number of powers (paths times candidates) in memory at once."""

FIRST_INTERVALS: Final = 512
"""Initial number of intervals in a table of coefficients."""


@dataclass(frozen=True)
class Compressed:
    """A compressed program.

    Attributes:
        paths: The compressed program of the same links. The weights are included in the spreading factors of its paths.
            The compressed program is therefore valid only for sums of powers, not for delays or sums of fields.
        error_db: Largest difference [L], [dB], between the path loss of the compressed and of the full program at the
            checked candidates.
        candidates: Number of candidates, none of them used in the fit, at which every compressed link was checked.
    """

    paths: Paths
    error_db: NDArray[np.float64]
    candidates: int


def compress(paths: Paths, parameters: Parameters, tolerance_db: float = TOLERANCE_DB) -> Compressed:
    """Compress a program. The result is valid for parameters within their bounds and for power summed over paths.

    `tolerance_db` is the maximum permitted error in a link's path loss [dB]. Returns the compressed program and its
    error.

    Raises:
        InputError: The tolerance is not a positive number, or a parameter's material is not in the paths.
    """
    if not (np.isfinite(tolerance_db) and tolerance_db > 0):
        raise InputError(f"tolerance_db = {tolerance_db}: must be a positive number of dB")
    candidates = _candidate_sets(parameters)
    intervals = FIRST_INTERVALS
    totals, strength, table_error = _evaluate_all(paths, parameters, candidates, intervals)
    while table_error > TABLE_TOLERANCE and intervals < FINEST:
        intervals *= 2
        totals, strength, table_error = _evaluate_all(paths, parameters, candidates, intervals)
    pool = _pool(paths, strength)
    weight, error = np.ones(paths.num_paths), np.zeros(paths.num_links)
    links = np.unique(paths.link[pool])
    ends = np.searchsorted(paths.link[pool], np.arange(paths.num_links + 1))
    for batch in _batches(links, np.diff(ends), sum(len(values) for values in candidates)):
        start, stop = ends[batch[0]], ends[batch[-1] + 1]
        powers = _Powers(take(paths, pool[start:stop]), parameters, candidates, intervals)
        for link in batch:
            in_batch = slice(ends[link] - start, ends[link + 1] - start)
            fit = _fit_link(powers, in_batch, [total[:, link] for total in totals], tolerance_db)
            if fit is not None:
                # Paths of the link outside the pool are left out.
                weight[slice(*np.searchsorted(paths.link, [link, link + 1]))] = 0.0
                weight[pool[ends[link] : ends[link + 1]]], error[link] = fit
    kept = np.flatnonzero(weight > 0)
    compressed = take(paths, kept)
    compressed = replace(
        compressed,
        # Weights multiply powers; spreading factors multiply amplitudes.
        spreading=compressed.spreading * np.sqrt(weight[kept]),
        settings={**compressed.settings, "compressed_db": tolerance_db},
    )
    return Compressed(compressed, error, CHECKED)


def strongest(paths: Paths, parameters: Parameters, share: float) -> Paths:
    """Omit the weakest paths of every link, which together carry at most `share` of the link's power.

    A path's shares of the power are summed over candidates spread over the parameters' bounds, so the omitted paths
    carry at most `share` of the power at each of these candidates. The returned program is valid for sums of powers.
    Raises InputError if a parameter's material is not in the paths.
    """
    from scipy.stats import qmc  # the import takes 0.4 s

    candidates = parameters.from_unit(qmc.Sobol(len(parameters), rng=0).random(RANKING))
    _, strength, _ = _evaluate_all(paths, parameters, [candidates], FIRST_INTERVALS)
    order = np.lexsort((strength, paths.link))
    total = np.concatenate([[0.0], np.cumsum(strength[order])])
    # Combined power share of a path and all weaker paths of its link.
    weaker = total[1:] - total[np.searchsorted(paths.link, paths.link[order])]
    return take(paths, np.sort(order[weaker > share]))


def _candidate_sets(parameters: Parameters) -> list[NDArray[np.float64]]:
    """Sets of candidates [n, d]: first for training, including the corners of the bounds, then for each check.

    A fit is least accurate where it extrapolates. In half of the candidates of each check, every parameter is therefore
    set to one of its bounds with probability one half.
    """
    from scipy.stats import qmc  # the import takes 0.4 s

    d, random = len(parameters), np.random.default_rng(0)
    corners = np.full((2 ** min(d, CORNER_PARAMETERS), d), 0.5)
    corners[:, :CORNER_PARAMETERS] = list(product([0.0, 1.0], repeat=min(d, CORNER_PARAMETERS)))
    sets = [np.vstack([corners, qmc.LatinHypercube(d, rng=random).random(TRAINING * (d + 1))])]
    for _ in range(ROUNDS):
        unit = qmc.LatinHypercube(d, rng=random).random(CHECKED)
        on_face = random.random(unit.shape) < 0.5
        on_face[: CHECKED // 2] = False
        sets.append(np.where(on_face, unit.round(), unit))
    return [parameters.from_unit(unit) for unit in sets]


def _evaluate_all(
    paths: Paths, parameters: Parameters, candidates: list[NDArray[np.float64]], intervals: int
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64], float]:
    """Evaluate the whole program.

    Returns the power of every link for each set of candidates [n, L], the strength of every path [P], and the largest
    error of any tabulated coefficient. The strength of a path is its share of the link's power, summed over the ranking
    candidates.
    """
    plan = layout(paths, np.float32, intervals, phases=False)
    totals, errors = [], []
    for values in candidates:
        tables = parameters.constants_of(values, paths.materials).astype(np.float32)
        loss, error = path_losses(plan.program, tables)
        totals.append(10 ** (-np.asarray(loss, dtype=float) / 10))
        errors.append(float(error.max()))
    strength = np.zeros(paths.num_paths)
    for candidate, total in zip(candidates[0][:RANKING], totals[0], strict=False):
        table = parameters.constants_of(candidate[None], paths.materials)[0].astype(np.float32)
        power = np.asarray(path_powers(plan.program, table))
        strength[plan.order] += power / np.where(total > 0, total, np.inf)[paths.link[plan.order]]
    return totals, strength, max(errors)


def _pool(paths: Paths, strength: NDArray[np.float64]) -> NDArray[np.int64]:
    """Ascending indices of the paths in the fits: of links with many paths, the strongest and some random ones."""
    random, pool = np.random.default_rng(0), []
    for of_link in np.split(np.arange(paths.num_paths), np.flatnonzero(np.diff(paths.link)) + 1):
        if len(of_link) > MIN_PATHS:
            order = of_link[np.argsort(-strength[of_link], kind="stable")]
            pool.append(np.sort(np.concatenate([order[:POOL], random.permutation(order[POOL:])[:POOL]])))
    return np.concatenate(pool) if pool else np.zeros(0, dtype=np.int64)


def _batches(
    links: NDArray[np.integer], size: NDArray[np.int64], candidates: int
) -> list[NDArray[np.integer]]:
    """Divide links into batches so small that the powers of each batch's paths in the pool fit into memory."""
    batch = np.cumsum(size[links]) * candidates // BATCH_POWERS
    return [part for part in np.split(links, np.flatnonzero(np.diff(batch)) + 1) if len(part)]


class _Powers:
    """Powers of paths at sets of candidates; the powers at a set are computed on first use."""

    def __init__(
        self, paths: Paths, parameters: Parameters, candidates: list[NDArray[np.float64]], intervals: int
    ) -> None:
        plan = layout(paths, np.float32, intervals, phases=False)
        self._program, self._position = plan.program, np.argsort(plan.order)
        self._tables = [parameters.constants_of(values, paths.materials) for values in candidates]
        self._powers: dict[int, NDArray[np.float64]] = {}

    def at(self, set_index: int, paths: slice) -> NDArray[np.float64]:
        """Powers [n, paths] of a slice of the paths at one set of candidates."""
        if set_index not in self._powers:
            tables = self._tables[set_index].astype(np.float32)
            powers = [np.asarray(path_powers(self._program, table)) for table in tables]
            self._powers[set_index] = np.stack(powers)
        return self._powers[set_index][:, self._position[paths]].astype(float)


def _fit_link(
    powers: _Powers, paths: slice, totals: list[NDArray[np.float64]], tolerance_db: float
) -> tuple[NDArray[np.float64], float] | None:
    """Weights of a link's paths in the pool, and largest error at new candidates; None if no fit is accurate enough.

    Candidates at which the link has no power (for example because no surface scatters) are omitted, because weights
    cannot change a power of zero.
    """
    # Largest relative error of a power, converted from decibels.
    bound = FIT_SHARE * tolerance_db * np.log(10) / 10
    shares, first = [], None
    for index, total in enumerate(totals):
        positive = total > 0
        share = powers.at(index, paths)[positive] / total[positive, None]
        if index:
            # The first set is used only for training; each later set checks the fit to all earlier sets.
            weight = sparse_weights(np.vstack(shares), bound, first)
            first = np.flatnonzero(weight)
            error = float(np.abs(10 * np.log10(share @ weight)).max(initial=0.0))
            if error <= CHECK_SHARE * tolerance_db:
                return weight, error
        # If the error is too large, the checked candidates join the training candidates.
        shares.append(share)
    return None


def sparse_weights(
    share: NDArray[np.float64], bound: float, first: NDArray[np.int64] | None = None
) -> NDArray[np.float64]:
    """Sparse weights w >= 0 [P] with sum_p w_p share_p = 1 in every row of `share` [n, P].

    The residual of every row is within `bound` if non-negative weights can achieve this. The search starts from the
    paths with the indices `first`.
    """
    norm = np.linalg.norm(share, axis=0)
    unit = share / np.where(norm > 0, norm, 1.0)
    chosen: NDArray[np.int64] = np.zeros(0, dtype=np.int64) if first is None else first
    one = np.ones(len(share))
    weight = np.zeros(len(chosen))
    for _ in range(share.shape[1]):
        if len(chosen):
            weight, _ = nnls(unit[:, chosen], one)
        chosen, weight = chosen[weight > 0], weight[weight > 0]
        residual = one - unit[:, chosen] @ weight
        gain = residual @ unit
        gain[chosen] = 0.0
        best = np.argmax(gain)
        if np.abs(residual).max(initial=0.0) <= bound or gain[best] <= 0:
            break
        chosen = np.append(chosen, best)
    weight = nnls(unit[:, chosen], one)[0] if len(weight) < len(chosen) else weight
    weights = np.zeros(share.shape[1])
    weights[chosen] = weight / norm[chosen]
    return weights
