"""The search on an engine that answers with rays: ray mapping, and the replay that replaces the engine afterwards."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.export import Export, Exporting
from calibray.fitting.methods import AUTO, local_searches
from calibray.fitting.problem import Problem
from calibray.fitting.ray_mapping import MOST_CALLS, RayMap, map_rays, with_engine
from calibray.fitting.search import Trail, least_squares
from calibray.result.verdict import Remark, RemarkKind
from calibray.study import Setup
from calibray.support.progress import Progress


def maps_rays(setup: Setup) -> bool:
    """Whether a study is calibrated by ray mapping: the method `auto` on a program that answers with rays."""
    return setup.study.engine.exports_rays and setup.study.method.name == AUTO


def search_rays(
    problem: Problem, engine: Exporting, progress: Progress | None = None
) -> tuple[Problem, Trail, Remark]:
    """Search by ray mapping.

    Args:
        problem: The problem on an engine that answers with rays.
        engine: That engine.
        progress: Called with the stage "calibrating" after every RT call.

    Returns:
        The problem on the replay that replaces the engine, the search, and how well the engine's assumptions are
        identified.

    Raises:
        EngineError: A call failed.
    """
    started, trail = time.perf_counter(), Trail()

    def ask(candidate: NDArray[np.float64]) -> Export:
        export = engine.export(candidate)
        evaluation = problem.evaluate(problem.parameters.to_search(candidate[None]))
        number = len(trail.candidates) + 1
        trail.add(candidate[None], evaluation, number, time.perf_counter() - started)
        if progress is not None:
            progress(f"calibrating: best RMSE {trail.best_rmse_db:.2f} dB", number, MOST_CALLS)
        return export

    mapped = map_rays(problem, ask, seed=problem.setup.study.method.seed)
    problem = with_engine(problem, mapped.engine)
    best = problem.parameters.to_search(trail.best)[None]
    trail.minima = least_squares(problem, local_searches(mapped.engine.interactions), best).minima
    trail.rt_calls, trail.ledger_hits = len(mapped.calls), engine.hits
    return problem, trail, _remark(mapped)


def _remark(mapped: RayMap) -> Remark:
    understanding = mapped.understanding
    constants = dict(understanding.model.described(understanding.values))
    slabs = any(field == "thickness" for _, field in understanding.model.assumed)
    return Remark(
        RemarkKind.RAY_MAPPING,
        {
            "understood": mapped.understood,
            "misfit_db": understanding.misfit_db,
            "gap_db": mapped.gap_db,
            "calls": len(mapped.calls),
            "changed": mapped.changed,
            "changed_db": mapped.changed_db,
            "half_space": slabs and not any(name.endswith(".thickness") for name in constants),
            "names": list(constants),
            "values": list(constants.values()),
        },
    )
