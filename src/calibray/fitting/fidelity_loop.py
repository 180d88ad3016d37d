"""The fidelity loop: trace again with calibrated materials and positions, and calibrate again if path loss changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calibray.engines.kinds.replay import ReplaySection, replay
from calibray.engines.protocol import Chunked
from calibray.fields import DisplacementLoss
from calibray.fitting.objective import Objective
from calibray.fitting.problem import Problem
from calibray.fitting.search import AUTO, Trail, choose, search
from calibray.study.displacement import displaces
from calibray.support.progress import Progress, with_stage

AROUND: Final = (0.0625, 0.125, 0.25, 0.5, 1.0)
"""Traced displacements on each side of a calibrated position, as fractions of the largest displacement. If the largest
displacement is 8 m, they are 0.5 to 8 m. The five inner positions are equally spaced, so that the interpolation error
can be estimated."""


def retrace(
    problem: Problem, trail: Trail, progress: Progress | None = None
) -> tuple[Problem, Trail, NDArray[np.float64] | None]:
    """Trace with the calibrated materials, and calibrate again as long as path loss changes by more than the tolerance.

    The tracer samples refraction and diffuse reflection according to the materials, so the set of paths can depend on
    the materials. Path loss at displaced antennas is interpolated. Without refraction, diffuse reflection or
    displacements, the paths are not traced again. Only the method `auto` calibrates again; other methods have a fixed
    budget of RT calls. The stage of `progress` is "checking".

    Returns:
        The problem of the last calibration, its search, and the gap [L], [dB]: each link's path loss on paths traced
        with the calibrated materials, minus that on the paths of the calibration. The gap is None if the paths were not
        traced again.
    """
    study, parameters = problem.setup.study, problem.parameters
    section = study.engine
    sampled = study.trace.refraction or study.trace.diffuse_reflection
    displaced = any(displaces(name) for name in parameters.names)
    rounds = study.fidelity.rounds
    if rounds is None:
        # A height that is wrong by 5 m is corrected in 2 traces, and five wrong positions are corrected in 2 to 4
        # traces.
        rounds = 4 if displaced else 3
    if not isinstance(section, ReplaySection) or section.rays or rounds == 0 or not (sampled or displaced):
        return problem, trail, None
    gap, stated, before = None, problem.objective, np.full(len(parameters), np.inf)
    near = [
        AROUND[0] * max(-item.lower, item.upper) if displaces(item.name) else np.inf for item in parameters
    ]
    for turn in range(rounds):
        best = trail.best
        setup = problem.setup.placed_at(parameters.named(best))
        materials = parameters.materials(best, problem.engine.materials)
        stage, paths = with_stage(progress, "checking"), None
        if isinstance(problem.engine, Chunked):
            engine = problem.engine.traced_with(materials, stage)
        else:
            paths = setup.trace(materials, stage)
            engine = replay(setup, paths, section.compress_db)
        gap = path_loss_change(engine.path_loss(best[None])[0], trail.best_modelled)
        objective = problem.objective
        settled = np.abs(gap[objective.weight > 0]).max() <= study.fidelity.tolerance_db
        # If no position moved by more than the smallest traced displacement, a further trace gains nothing.
        settled |= displaced and bool((np.abs(best - before) <= near).all())
        if settled or study.method.name != AUTO or turn == rounds - 1:
            break
        # Links without a path in the new trace are left out of the next calibration.
        if objective.ceiling_db is None:
            objective = objective.reweighted(np.where(np.isfinite(gap), objective.weight, 0.0))
        if displaced and paths is not None:
            setup = setup.placed_at(parameters.named(best), AROUND)
            engine, before = replay(setup, paths), best
            # Start from the stated weights, because interpolation errors at earlier positions no longer apply.
            weight, error_db = np.where(objective.weight > 0, stated.weight, 0.0), gap
            for effect in getattr(engine, "effects", ()):
                if isinstance(effect, DisplacementLoss):
                    error_db = np.hypot(error_db, effect.error_db)
            objective = with_interpolation_error(stated.reweighted(weight), trail.best_modelled, error_db)
        problem = replace(problem, setup=setup, engine=engine, objective=objective)
        trail = search(problem, choose(problem), progress)
    return problem, trail, gap


def with_interpolation_error(
    objective: Objective, modelled: NDArray[np.float64], error_db: NDArray[np.float64]
) -> Objective:
    """The objective with weights that account for interpolation errors in the links' path loss.

    Interpolation errors are largest where paths appear or vanish between the traced positions. `error_db` [L] is the
    standard deviation of each link's interpolation error [dB], which adds to its other errors; infinite values leave
    links out. The other errors are estimated from the residuals for the modelled path loss [L], [dB].
    """
    counted = (objective.weight > 0) & np.isfinite(error_db)
    residual = (objective.model(modelled[None])[0] - objective.measured)[counted]
    # Weights are relative to their mean. The median is robust against links with large interpolation errors.
    relative = objective.weight[counted] / objective.weight[counted].mean()
    variance = np.median(residual**2 * relative) / chdtri(1, 0.5) / relative
    weight = objective.weight.copy()
    weight[counted] *= variance / (variance + error_db[counted] ** 2)
    # The mean weight has changed, so the standard deviation at the mean weight changes as well.
    noise_db = objective.noise_db * np.sqrt(objective.weight[counted].mean() / weight[counted].mean())
    return replace(objective, weight=weight, noise_db=float(noise_db))


def path_loss_change(after: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change in path loss [L], [dB]; 0 if neither trace has a path for the link, infinite if only one trace has."""
    lost = np.isinf(after) & np.isinf(before)
    return np.where(lost, 0.0, after - np.where(lost, 0.0, before))


def traced_again(path_loss_db: NDArray[np.float64], gap: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss [L], [dB], on the paths of the new trace; unchanged for links without a path in the earlier trace."""
    return np.where(np.isneginf(gap), path_loss_db, path_loss_db + np.where(np.isneginf(gap), 0.0, gap))


def largest_gap(gap: NDArray[np.float64] | None, counted: NDArray[np.bool_]) -> float | None:
    """Largest gap [dB] among links with nonzero weight and a path in both traces; None if `gap` is None."""
    if gap is None:
        return None
    return float(np.abs(gap[counted & np.isfinite(gap)]).max(initial=0.0))
