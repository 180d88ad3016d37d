"""Features of links that determine errors of a wrong scene or of missing propagation effects.

If the twin lacks diffraction, scattering or buildings, its error depends on the obstruction of a link and on how its
paths bypass it, rather than on the position of the link.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.replay import Replay
from calibray.fitting.problem import Problem
from calibray.paths import Paths

OBSTRUCTION: Final = ("out_of_sight", "walls_crossed", "obstruction_m", "knife_edge_db")
"""Columns of the links' table that follow from a scene; lengths and numbers enter by their logarithms."""


def link_features(problem: Problem) -> NDArray[np.float64]:
    """Standardized features of the links with weight, limited to features that differ between links [L, k].

    The features are the logarithm of the distance, the obstruction, and the number of interactions and mean cosine of
    incidence of the path with the fewest interactions. Their mean square over all links and features is one over the
    number of features, so that the distance of two links is about the square root of two.
    """
    setup = problem.setup.with_obstruction()
    table, links = setup.links.table, setup.links
    columns = [np.log(np.maximum(links.distance, 1e-3))]
    columns += [np.log1p(np.maximum(table.numbers(name), 0.0)) for name in OBSTRUCTION]
    if isinstance(problem.engine, Replay) and problem.engine.paths.num_paths:
        columns += _simplest_paths(problem.engine.paths)
    features = np.column_stack(columns)
    used = features[problem.objective.weight > 0]
    spread = used.std(axis=0)
    differing = spread > 1e-9
    return np.asarray(
        ((features - used.mean(axis=0)) / np.where(differing, spread, 1.0))[:, differing]
        / np.sqrt(max(np.count_nonzero(differing), 1))
    )


def _simplest_paths(paths: Paths) -> list[NDArray[np.float64]]:
    """Interactions and mean cosine of incidence of every link's path with the fewest interactions [L] each."""
    count = np.diff(paths.first)
    total = np.concatenate([[0.0], np.cumsum(paths.cos_incidence)])
    cosine = np.where(count > 0, np.diff(total[paths.first]) / np.maximum(count, 1), 1.0)
    order = np.lexsort((-paths.delay, -count, paths.link))
    found = []
    for values, none in ((count, count.max(initial=0) + 1.0), (cosine, 0.0)):
        column = np.full(paths.num_links, none)
        # The last of a link's paths in this order has the fewest interactions, and of these the least delay.
        column[paths.link[order]] = values[order]
        found.append(column)
    return found
