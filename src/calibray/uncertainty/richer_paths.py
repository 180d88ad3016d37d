"""Uncertainty for measurements that favour paths which the study's trace leaves out.

If a digital twin lacks paths, such as paths through buildings, its intervals are centred on wrong values, because the
constants compensate for the missing power. The links are therefore traced once more with refraction and diffraction.
The choice between the two twins is based on the evidence for each twin, which is estimated from its draws.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import Final

import numpy as np

from calibray.engines.kinds.replay import replay
from calibray.engines.replay import Replay, ReplayCarriers
from calibray.errors import EngineError, InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, STARTS, Trail, search
from calibray.measurements import FEW
from calibray.optimizers import LeastSquares
from calibray.result.verdict import Remark, RemarkKind
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.study.displacement import displaces
from calibray.support.progress import Progress, start_stage, with_stage
from calibray.uncertainty.assessment import EXACT_DB, Certainty, certainty
from calibray.uncertainty.remarks import LIKELY
from calibray.uncertainty.verdicts import consistent

_LOG: Final = logging.getLogger(__name__)

LONGEST_TRACE: Final = 60.0
"""Estimated duration of a trace above which no richer paths are traced [s]."""

LIKELY_LOG_ODDS: Final = float(np.log(LIKELY / (1.0 - LIKELY)))
"""The uncertainty with richer paths is used if the log odds in favour of these paths are at least this large."""

OF_THE_FIT: Final = (RemarkKind.MISSED_OPTIMUM, RemarkKind.OUTSIDE_INTERVAL)
"""Remarks that compare draws with the calibrated values."""


def assess_richer_paths(
    problem: Problem, trail: Trail, assessed: Certainty, progress: Progress | None = None
) -> Certainty:
    """The uncertainty with richer paths, and a remark, if the measurements favour them; otherwise `assessed`.

    Nothing is traced if `lacking` returns no settings, for example because the study states the noise, its
    `fidelity.rounds` is 0, or no link is out of sight. The stages of `progress` are "tracing more paths", "fitting more
    paths" and "drawing with more paths".

    Args:
        problem: The problem.
        trail: The finished search.
        assessed: The uncertainty without richer paths.
        progress: Called with the stage, the work done and the total work.
    """
    changes = lacking(problem)
    if assessed.posterior is None or not changes:
        return assessed
    setup = problem.setup.with_trace(replace(problem.setup.study.trace, **changes))
    if setup.tracer.plan(setup.links).seconds > LONGEST_TRACE:
        return assessed
    started = time.perf_counter()
    materials = problem.parameters.materials(trail.best, problem.engine.materials)
    try:
        paths = setup.trace(materials, with_stage(progress, "tracing more paths"))
    except (InputError, EngineError) as error:  # for example too many paths; the calibration is finished
        _LOG.warning(
            "the trace with %s failed, so richer paths are not considered: %s", " and ".join(changes), error
        )
        return assessed
    start_stage(progress, "fitting more paths")
    richer = replace(problem, setup=setup, engine=replay(setup, paths))
    counted = problem.objective.weight > 0
    if not np.isfinite(richer.engine.path_loss(trail.best[None])[0][counted]).all():
        return assessed
    method = LeastSquares(*problem.parameters.search_bounds, starts=STARTS[0], x0=trail.minima[:BASINS])
    fitted = search(richer, method, with_stage(progress, "fitting more paths"))
    calls = assessed.calls + fitted.rt_calls
    # First test the likelihood ratio for Gaussian errors of unknown level, because drawing takes much longer.
    if (
        counted.sum() * (np.log(trail.best_value) - np.log(max(fitted.best_value, EXACT_DB)))
        < LIKELY_LOG_ODDS
    ):
        return replace(assessed, calls=calls, seconds=assessed.seconds + time.perf_counter() - started)
    other = certainty(richer, fitted, with_stage(progress, "drawing with more paths"))
    calls, seconds = calls + other.calls, assessed.seconds + time.perf_counter() - started
    # No draws are needed if the richer paths explain the measurements exactly.
    log_odds = np.inf
    if other.posterior is not None:
        log_odds = other.posterior.log_evidence - assessed.posterior.log_evidence
    if log_odds < LIKELY_LOG_ODDS:
        return replace(assessed, calls=calls, seconds=seconds)
    best = problem.parameters.named(trail.best)
    intervals = {name: consistent(each, best[name]) for name, each in other.record.intervals.items()}
    remark = Remark(
        RemarkKind.RICHER_PATHS,
        {
            "probability": float(1.0 / (1.0 + np.exp(-log_odds))),
            "settings": [f"{name} = {str(value).lower()}" for name, value in changes.items()],
            "rmse_db": fitted.best_rmse_db,
            "rmse_without_db": trail.best_rmse_db,
            "outside": [name for name, each in intervals.items() if not each.contains(best[name])],
        },
    )
    remarks = (remark, *(each for each in other.record.remarks if each.kind not in OF_THE_FIT))
    record = replace(other.record, intervals=intervals, remarks=remarks)
    return Certainty(record, other.posterior, calls, seconds)


def lacking(problem: Problem) -> dict[str, bool]:
    """Tracer settings that find more paths than the study's settings; empty if no other settings can be tried."""
    study, counted = problem.setup.study, problem.objective.weight > 0
    traced = isinstance(problem.engine, Replay | ReplayCarriers) and study.rays_path is None
    displaced = any(displaces(name) for name in problem.parameters.names)
    stated = study.noise.kind != "auto" or study.fidelity.rounds == 0
    if not traced or displaced or stated or counted.sum() < FEW:
        return {}
    links = problem.setup.with_obstruction().links
    if not (links.table.numbers(OUT_OF_SIGHT)[counted] > 0).any():
        return {}
    return {name: True for name in ("refraction", "diffraction") if not getattr(study.trace, name)}
