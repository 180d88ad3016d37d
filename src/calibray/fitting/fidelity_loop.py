"""The fidelity loop: trace again with the materials found, and calibrate again while that changes too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import ReplaySection, replay
from calibray.engines.protocol import Chunked
from calibray.fitting.methods import AUTO, choose
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, search
from calibray.support.progress import Progress, with_stage


def settle(
    problem: Problem, trail: Trail, progress: Progress | None = None
) -> tuple[Problem, Trail, NDArray[np.float64] | None]:
    """Trace again with the materials found, and calibrate again while that changes the path loss too much.

    Refraction and diffuse reflection are sampled by the materials of the trace, so the set of paths can change with
    them. Where a trace follows neither, there is nothing to check. Only `auto` calibrates again: the other methods
    have a budget of RT calls to keep to.

    Args:
        problem: The problem.
        trail: Its first search.
        progress: Called as the work goes on, with the stage "checking" while tracing.

    Returns:
        The problem on the last trace calibrated on, its search, and the gap of every link, path loss on paths traced
        with the materials found minus path loss on those calibrated on [L], [dB]; None where nothing was checked.
    """
    setup, section = problem.setup, problem.setup.study.engine
    study, parameters = setup.study, problem.parameters
    sampled = study.trace.refraction or study.trace.diffuse_reflection
    if not sampled or not study.fidelity.rounds or not isinstance(section, ReplaySection):
        return problem, trail, None
    gap = None
    for turn in range(study.fidelity.rounds):
        materials = parameters.materials(trail.best, problem.engine.materials)
        told = with_stage(progress, "checking")
        if isinstance(problem.engine, Chunked):
            again = problem.engine.traced_with(materials, told)
        else:
            again = replay(setup, setup.trace(materials, told), section.compress_db)
        gap = difference(again.path_loss(trail.best[None])[0], trail.best_modelled)
        objective = problem.objective
        settled = np.abs(gap[objective.weight > 0]).max() <= study.fidelity.tolerance_db
        if settled or study.method.name != AUTO or turn == study.fidelity.rounds - 1:
            break
        # A link that the new trace does not reach is left out from here on.
        if objective.ceiling_db is None:
            objective = replace(objective, weight=np.where(np.isfinite(gap), objective.weight, 0.0))
        problem = replace(problem, engine=again, objective=objective)
        trail = search(problem, choose(problem), progress)
    return problem, trail, gap


def difference(after: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Difference of path losses [L], [dB]; 0 where neither has a path, infinite where one has none."""
    lost = np.isinf(after) & np.isinf(before)
    return np.where(lost, 0.0, after - np.where(lost, 0.0, before))


def largest(gap: NDArray[np.float64] | None, counted: NDArray[np.bool_]) -> float | None:
    """Largest gap [dB] of the links that count and have a path on both traces; None where nothing was checked."""
    if gap is None:
        return None
    return float(np.abs(gap[counted & np.isfinite(gap)]).max(initial=0.0))
