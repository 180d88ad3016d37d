"""Compressed programs: few weighted paths in place of tens of thousands, within a stated error of path loss.

The power of a link is a sum over its paths, P(x) = sum_p p_p(x), of functions of the candidate x. Within the bounds of
a few parameters these functions span a space of few dimensions, so that a few of them with weights w >= 0 suffice:
sum_p w_p p_p(x) is fitted to P(x) at training candidates by non-negative least squares. Paths are added greedily as
long as the fit is not good enough (C. Farhat, T. Chapman, P. Avery, Int. J. Numer. Methods Eng. 102 (2015) 1077).
Weights are non-negative and paths are physical ones, so a compressed link behaves as a link between the training
candidates too. That is not taken on trust: the error is measured at fresh candidates, many on the faces of the bounds,
and a link that misses half the tolerance is fitted again to more candidates, or keeps all its paths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import qmc

from calibray.errors import InputError
from calibray.fields import layout, path_losses, path_powers
from calibray.parameters import Parameters
from calibray.paths import Paths, take
from calibray.support.progress import Progress

TOLERANCE_DB: Final = 0.01
"""Largest error of a link's path loss [dB] unless told otherwise."""

FEW: Final = 64
"""Paths of a link that are not worth compressing."""

FITTED: Final = 0.1
"""Share of the tolerance that the fit itself may use up."""

TRAINING: Final = 16
"""Candidates per parameter, and as many more, beside the corners, on which the first fit rests."""

CORNERS: Final = 5
"""Parameters of which all corners are fitted to; further ones lie in the middle."""

CHECKED: Final = 48
"""Fresh candidates of every check."""

PASSED: Final = 0.5
"""Share of the tolerance that a check must stay within."""

ROUNDS: Final = 6
"""Fits of a link before it keeps all its paths."""

STRENGTH: Final = 16
"""Candidates by which the strongest paths are told."""

POOL: Final = 2000
"""Strongest paths of a link that are candidates to be kept, and as many others."""

BLOCK: Final = 400_000_000
"""Powers, paths times candidates, held at once."""

FIRST_INTERVALS: Final = 512
LAST_INTERVALS: Final = 65536
"""Intervals of a table of coefficients, at first and at most."""

TABLE_TOLERANCE: Final = 1e-4
"""Largest error of a tabulated coefficient."""


@dataclass(frozen=True)
class Compressed:
    """A compressed program.

    Attributes:
        paths: The program, over the same links. The weights are in the spreading of its paths, so that it is good for
            the sum of powers only, not for delays or sums of fields.
        error_db: Largest difference of path loss from the full program at the candidates checked [L], [dB].
        candidates: Candidates that every compressed link was checked at, none of which its weights were fitted to.
    """

    paths: Paths
    error_db: NDArray[np.float64]
    candidates: int


def compress(
    paths: Paths,
    parameters: Parameters,
    tolerance_db: float = TOLERANCE_DB,
    seed: int = 0,
    progress: Progress | None = None,
) -> Compressed:
    """Compress a program for some parameters within their bounds, for path loss by the sum of powers.

    Args:
        paths: The path program.
        parameters: What will vary, and between which bounds.
        tolerance_db: Largest error of a link's path loss [dB].
        seed: Seed of the candidates.
        progress: Called with "compressing", links done and links in all.

    Returns:
        The compressed program and its error.

    Raises:
        InputError: The tolerance is not a positive number, or a parameter's material is not in the paths.
    """
    if not (np.isfinite(tolerance_db) and tolerance_db > 0):
        raise InputError(f"tolerance_db = {tolerance_db}: must be a positive number of dB")
    candidates = _candidates(parameters, seed)
    intervals = FIRST_INTERVALS
    totals, strength, coarse = _whole(paths, parameters, candidates, intervals)
    while coarse > TABLE_TOLERANCE and intervals < LAST_INTERVALS:
        intervals *= 2
        totals, strength, coarse = _whole(paths, parameters, candidates, intervals)
    pool = _pool(paths, strength, seed)
    weight, error = np.ones(paths.num_paths), np.zeros(paths.num_links)
    links = np.unique(paths.link[pool])
    ends = np.searchsorted(paths.link[pool], np.arange(paths.num_links + 1))
    for block in _blocks(links, np.diff(ends), sum(len(some) for some in candidates)):
        start, stop = ends[block[0]], ends[block[-1] + 1]
        powers = _Powers(take(paths, pool[start:stop]), parameters, candidates, intervals)
        for link in block:
            where = slice(ends[link] - start, ends[link + 1] - start)
            fitted = _fit_link(powers, where, [total[:, link] for total in totals], tolerance_db)
            if fitted is not None:
                weight[slice(*np.searchsorted(paths.link, [link, link + 1]))] = 0.0
                weight[pool[ends[link] : ends[link + 1]]], error[link] = fitted
            if progress is not None:
                progress("compressing", int(link) + 1, paths.num_links)
    kept = np.flatnonzero(weight > 0)
    few = take(paths, kept)
    few = replace(
        few,
        spreading=few.spreading * np.sqrt(weight[kept]),
        settings={**few.settings, "compressed_db": tolerance_db},
    )
    return Compressed(few, error, CHECKED)


def _candidates(parameters: Parameters, seed: int) -> list[NDArray[np.float64]]:
    """Candidates to fit to, corners of the bounds among them, then those of every check [n, d], in the fields' units.

    What is fitted fails first where it extrapolates, so half of the candidates to check at lie on faces of the bounds.
    """
    d, random = len(parameters), np.random.default_rng(seed)
    corners = np.full((2 ** min(d, CORNERS), d), 0.5)
    corners[:, :CORNERS] = list(product([0.0, 1.0], repeat=min(d, CORNERS)))
    sets = [np.vstack([corners, qmc.LatinHypercube(d, rng=random).random(TRAINING * (d + 1))])]
    for _ in range(ROUNDS):
        unit = qmc.LatinHypercube(d, rng=random).random(CHECKED)
        on_face = random.random(unit.shape) < 0.5
        on_face[: CHECKED // 2] = False
        sets.append(np.where(on_face, unit.round(), unit))
    return [parameters.from_unit(unit) for unit in sets]


def _whole(
    paths: Paths, parameters: Parameters, candidates: list[NDArray[np.float64]], intervals: int
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64], float]:
    """What only the whole program tells.

    Returns:
        Power of every link at all candidates, by set [n, L]; every path's share of it, summed over the first ones [P];
        the largest error of a tabulated coefficient.
    """
    plan = layout(paths, np.float32, intervals, phases=False)
    totals, errors = [], []
    for some in candidates:
        tables = parameters.constants_of(some, paths.materials).astype(np.float32)
        loss, error = path_losses(plan.program, tables)
        totals.append(10 ** (-np.asarray(loss, dtype=float) / 10))
        errors.append(error)
    strength = np.zeros(paths.num_paths)
    for some, total in zip(candidates[0][:STRENGTH], totals[0], strict=False):
        table = parameters.constants_of(some[None], paths.materials)[0].astype(np.float32)
        power = np.asarray(path_powers(plan.program, table))
        strength[plan.order] += power / np.where(total > 0, total, np.inf)[paths.link[plan.order]]
    return totals, strength, max(errors)


def _pool(paths: Paths, strength: NDArray[np.float64], seed: int) -> NDArray[np.int64]:
    """Paths of links with many that may be kept, in their order: the strongest and as many others."""
    random, pool = np.random.default_rng(seed), []
    for some in np.split(np.arange(paths.num_paths), np.flatnonzero(np.diff(paths.link)) + 1):
        if len(some) > FEW:
            order = some[np.argsort(-strength[some], kind="stable")]
            pool.append(np.sort(np.concatenate([order[:POOL], random.permutation(order[POOL:])[:POOL]])))
    return np.concatenate(pool) if pool else np.zeros(0, dtype=np.int64)


def _blocks(
    links: NDArray[np.integer], size: NDArray[np.int64], candidates: int
) -> list[NDArray[np.integer]]:
    """Links whose pools' powers fit into memory together."""
    block = np.cumsum(size[links]) * candidates // BLOCK
    return [some for some in np.split(links, np.flatnonzero(np.diff(block)) + 1) if len(some)]


class _Powers:
    """Powers of some paths at sets of candidates, each computed when it is first asked for."""

    def __init__(
        self, paths: Paths, parameters: Parameters, candidates: list[NDArray[np.float64]], intervals: int
    ) -> None:
        plan = layout(paths, np.float32, intervals, phases=False)
        self._program, self._place = plan.program, np.argsort(plan.order)
        self._tables = [parameters.constants_of(some, paths.materials) for some in candidates]
        self._known: dict[int, NDArray[np.float64]] = {}

    def at(self, which: int, where: slice) -> NDArray[np.float64]:
        """Powers of some of the paths at one set of candidates [n, paths]."""
        if which not in self._known:
            tables = self._tables[which].astype(np.float32)
            self._known[which] = np.stack([np.asarray(path_powers(self._program, table)) for table in tables])
        return self._known[which][:, self._place[where]].astype(float)


def _fit_link(
    powers: _Powers, where: slice, totals: list[NDArray[np.float64]], tolerance_db: float
) -> tuple[NDArray[np.float64], float] | None:
    """Weights of the paths in a link's pool, and the largest error at fresh candidates; None if it is too large.

    Candidates that leave the link no power, as where nothing scatters, are left out: no weight can err there.
    """
    shares, begin = [], None
    for turn, total in enumerate(totals):
        lit = total > 0
        share = powers.at(turn, where)[lit] / total[lit, None]
        if turn:
            bound = FITTED * tolerance_db * np.log(10) / 10
            weight = sparse_weights(np.vstack(shares), bound, begin)
            begin = np.flatnonzero(weight)
            error = float(np.abs(10 * np.log10(share @ weight)).max(initial=0.0))
            if error <= PASSED * tolerance_db:
                return weight, error
        shares.append(share)
    return None


def sparse_weights(
    share: NDArray[np.float64], bound: float, first: NDArray[np.int64] | None = None
) -> NDArray[np.float64]:
    """Sparse weights w >= 0 with sum_p w_p share_p = 1 in every row, within a bound.

    Args:
        share: A path's share of the link's power at every candidate [n, P].
        bound: Largest residual of a row.
        first: Paths to begin with; none if None.

    Returns:
        The weights [P], most of them 0; the bound is missed where non-negative weights cannot meet it.
    """
    size = np.linalg.norm(share, axis=0)
    unit = share / np.where(size > 0, size, 1.0)
    chosen: NDArray[np.int64] = np.zeros(0, dtype=np.int64) if first is None else first
    one = np.ones(len(share))
    weight = np.zeros(len(chosen))
    for _ in range(share.shape[1]):
        if len(chosen):
            weight, _ = nnls(unit[:, chosen], one)
        chosen, weight = chosen[weight > 0], weight[weight > 0]
        rest = one - unit[:, chosen] @ weight
        gain = rest @ unit
        gain[chosen] = 0.0
        best = np.argmax(gain)
        if np.abs(rest).max() <= bound or gain[best] <= 0:
            break
        chosen = np.append(chosen, best)
    weight = nnls(unit[:, chosen], one)[0] if len(weight) < len(chosen) else weight
    found = np.zeros(share.shape[1])
    found[chosen] = weight / size[chosen]
    return found
