"""What only the finished calibration itself can tell of its links: leverage, depth, and what their power passes by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.replay import Replay
from calibray.fields import path_gains
from calibray.fitting.problem import Problem
from calibray.materials import Material
from calibray.paths import Kind, Paths
from calibray.uncertainty.residuals import leverage

DENSE: Final = 20_000_000
"""Entries of a nuisance's design up to which links' leverage is worked out."""

DIRECT: Final = "line of sight"
"""What a path meets that meets nothing."""


@dataclass(frozen=True)
class Examined:
    """What was found.

    Attributes:
        columns: Columns of the table of links: `leverage`, NaN where a link does not count; `depth`, interactions of
            the strongest path, NaN where none leads.
        power_shares: Share of the links' power that is carried by paths with an interaction, by material and its kind:
            the mean over links; what a path meets counts in full, so that shares add up to more than 1.
    """

    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    power_shares: dict[str, dict[str, float]] = field(default_factory=dict)


def examined(problem: Problem, best: NDArray[np.float64], paths: Paths | None) -> Examined:
    """Look at a finished calibration.

    Args:
        problem: The problem.
        best: The calibrated values [d].
        paths: The paths calibrated on, at the study's carrier; None where they are not at hand.

    Returns:
        What was found; columns that cannot be known are left out.
    """
    columns: dict[str, NDArray[np.float64]] = {}
    if problem.differentiable:
        columns["leverage"] = _leverage(problem, best)
    if paths is None or not isinstance(problem.engine, Replay) or not paths.num_paths:
        return Examined(columns)
    materials = problem.parameters.materials(best, problem.engine.materials)
    depth, shares = _passed(paths, materials)
    return Examined({**columns, "depth": depth}, shares)


def _leverage(problem: Problem, best: NDArray[np.float64]) -> NDArray[np.float64]:
    objective, count = problem.objective, problem.objective.num_counted
    told = problem.evaluate(problem.parameters.to_search(best)[None], derivatives=True)
    counted = np.flatnonzero(objective.weight > 0)
    root = np.sqrt(objective.weight[counted] * count / objective.weight.sum())
    columns = len(objective.nuisance.columns)
    found = np.full(len(objective.weight), np.nan)
    if count * columns <= DENSE:
        design = (
            objective.nuisance.design[counted].toarray() * root[:, None] if columns else np.zeros((count, 0))
        )
        found[counted] = leverage(told.slopes[0, :count], design)
    return found


def _passed(
    paths: Paths, materials: dict[str, Material]
) -> tuple[NDArray[np.float64], dict[str, dict[str, float]]]:
    """Interactions of every link's strongest path [L], and shares of power by material and kind of interaction."""
    gain = path_gains(paths, materials).reshape(paths.num_paths, -1)
    power = np.sum(np.abs(gain) ** 2, axis=1)
    count, order = np.diff(paths.first), np.lexsort((power, paths.link))
    depth = np.full(paths.num_links, np.nan)
    # The last of a link's paths in this order is its strongest.
    depth[paths.link[order]] = count[order]
    total = np.bincount(paths.link, power, paths.num_links)
    part = power / np.where(total > 0, total, np.inf)[paths.link]
    reached = max(int(np.count_nonzero(total)), 1)
    owner = np.repeat(np.arange(paths.num_paths), count)
    what = paths.material.astype(np.int64) * (max(Kind) + 1) + paths.kind
    once = np.unique(np.stack([owner, what]), axis=1)
    shares: dict[str, dict[str, float]] = {}
    names = list(paths.materials)
    for code in np.unique(once[1]):
        share = float(part[once[0, once[1] == code]].sum()) / reached
        name = names[int(code) // (max(Kind) + 1)]
        shares.setdefault(name, {})[Kind(int(code) % (max(Kind) + 1)).name.lower()] = share
    direct = float(part[count == 0].sum()) / reached
    return depth, {**shares, **({DIRECT: {"": direct}} if direct else {})}
