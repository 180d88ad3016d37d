"""The fidelity loop: trace again with calibrated materials and positions, and calibrate again if path loss changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibray.engines.kinds.replay import ReplaySection, replay
from calibray.engines.protocol import Chunked
from calibray.fitting.methods import AUTO, choose
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, search
from calibray.study.displacement import displaces
from calibray.support.progress import Progress, with_stage


def retrace(
    problem: Problem, trail: Trail, progress: Progress | None = None
) -> tuple[Problem, Trail, NDArray[np.float64] | None]:
    """Trace with the calibrated materials, and calibrate again while the path loss changes by more than the tolerance.

    The tracer samples refraction and diffuse reflection by the materials, so the set of paths can depend on them; and
    path loss at displaced antennas is interpolated. A trace without all of these needs no check. Only the method `auto`
    calibrates again; other methods have a fixed budget of RT calls.

    Args:
        problem: The problem.
        trail: Its first search.
        progress: Called with the stage "checking" while tracing.

    Returns:
        The problem on the last trace that was calibrated on, its search, and the gap of every link: path loss on paths
        traced with the calibrated materials minus path loss on the paths of the calibration [L], [dB]; None if not
        checked.
    """
    study, parameters = problem.setup.study, problem.parameters
    section = study.engine
    sampled = study.trace.refraction or study.trace.diffuse_reflection
    if not isinstance(section, ReplaySection) or section.rays or study.fidelity.rounds == 0:
        return problem, trail, None
    if not (sampled or any(displaces(name) for name in parameters.names)):
        return problem, trail, None
    gap = None
    for turn in range(study.fidelity.rounds):
        setup = problem.setup.placed_at(parameters.named(trail.best), 0.5 ** (turn + 1))
        materials = parameters.materials(trail.best, problem.engine.materials)
        stage = with_stage(progress, "checking")
        if isinstance(problem.engine, Chunked):
            engine = problem.engine.traced_with(materials, stage)
        else:
            engine = replay(setup, setup.trace(materials, stage), section.compress_db)
        gap = path_loss_change(engine.path_loss(trail.best[None])[0], trail.best_modelled)
        objective = problem.objective
        settled = np.abs(gap[objective.weight > 0]).max() <= study.fidelity.tolerance_db
        if settled or study.method.name != AUTO or turn == study.fidelity.rounds - 1:
            break
        # Links without a path in the new trace are left out of the next calibration.
        if objective.ceiling_db is None:
            objective = replace(objective, weight=np.where(np.isfinite(gap), objective.weight, 0.0))
        problem = replace(problem, setup=setup, engine=engine, objective=objective)
        trail = search(problem, choose(problem), progress)
    return problem, trail, gap


def path_loss_change(after: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of path loss [L], [dB]; 0 for a link without a path in both, infinite for one without a path in one."""
    lost = np.isinf(after) & np.isinf(before)
    return np.where(lost, 0.0, after - np.where(lost, 0.0, before))


def traced_again(path_loss_db: NDArray[np.float64], gap: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss [L], [dB], on the paths of the new trace; unchanged at links that had no path before."""
    return np.where(np.isneginf(gap), path_loss_db, path_loss_db + np.where(np.isneginf(gap), 0.0, gap))


def largest_gap(gap: NDArray[np.float64] | None, counted: NDArray[np.bool_]) -> float | None:
    """Largest gap of the links with weight and a path on both traces [dB]; None if not checked."""
    if gap is None:
        return None
    return float(np.abs(gap[counted & np.isfinite(gap)]).max(initial=0.0))
