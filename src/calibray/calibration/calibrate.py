"""Calibrate a study: open the study, search, trace again, assess the uncertainty, validate, and make the result."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

from calibray import engines
from calibray.calibration.link_diagnostics import (
    directions_remark,
    groups_remark,
    region_remark,
    unreached_remark,
)
from calibray.calibration.make_result import Run, Timing, given_engine_remark, make_result
from calibray.calibration.result import Result
from calibray.engines.cluster.workers import Workers, check_workers
from calibray.engines.ledger.ledger import LEDGER_FILE
from calibray.engines.protocol import Answering, Engine
from calibray.engines.rays.export import Exporting
from calibray.errors import InputError
from calibray.fitting.cheap_replay import CheapReplay, make_cheap_replay
from calibray.fitting.fidelity_loop import retrace
from calibray.fitting.preliminary_fits import with_preliminary_fits
from calibray.fitting.problem import Problem
from calibray.fitting.ray_mapping import maps_rays, search_rays
from calibray.fitting.search import check_fit, check_method, choose, search
from calibray.result.files import FILES
from calibray.result.held_out import Model
from calibray.study import Setup, Study
from calibray.study.link_checks import suspicions
from calibray.support.interruption import ensure_interruption, unwrap_interruption
from calibray.support.output_files import check_outputs
from calibray.support.progress import Progress, start_stage
from calibray.tracing import SIONNA
from calibray.tracing.protocol import TracerFactory
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.richer_paths import assess_richer_paths
from calibray.validation.models import NO_MINIMA
from calibray.validation.validate import check_engine, validate_problem

_LOG: Final = logging.getLogger(__name__)


# Ctrl-C during an import leaves modules half initialized, and errors raised by these modules would hide the
# interruption.
@ensure_interruption()
@unwrap_interruption()
def calibrate(
    study: Study | Setup,
    method: str | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    *,
    engine: Engine | None = None,
    workers: Workers | None = None,
    progress: Progress | None = None,
    tracer: TracerFactory = SIONNA,
    overwrite: bool = False,
    cheap_model: Study | Setup | None = None,
) -> Result:
    """Calibrate a scene's materials against measurements.

    Suspicious positions and values of the links are logged as warnings. If the study is already open, its links are not
    checked.

    Args:
        study: The study, which may already be open.
        method: Method to use instead of that of the study: "auto", "sgwo-im", "gwo", ...
        seed: Seed to use instead of that of the study.
        out: Folder in which the result is saved; it is checked before any computation. The ledger of RT calls is also
            written to this folder, so that a restarted run does not repeat completed calls. If `engine` is given, its
            calls are not stored.
        engine: Engine for all links of the study; if None, the engine that the study specifies. Predictions use the
            study's engine.
        workers: Workers from `engines.open_workers`, which run the calls of a batch (engine "command") or replay chunks
            of links (engine "replay"). If None, everything runs in this process.
        progress: Called with the name of each stage, the completed work and the total.
        tracer: Function that opens the scene in a ray tracer; not used for an opened study.
        overwrite: Replace files in `out` even if Calibray did not write them; input files are never replaced.
        cheap_model: A study with the same links and materials, whose replay is used as the cheap model of an expensive
            engine. If None, the study itself is replayed.

    Raises:
        InputError: The study, the method or the folder cannot be used.
        EngineError: The engine failed.

    Example:
        >>> from calibray.scenarios import demo_study_path
        >>> result = calibrate(Study.load(demo_study_path()))  # doctest: +SKIP
        >>> result.rmse_db < result.initial_rmse_db  # doctest: +SKIP
        True
    """
    if not isinstance(study, Study | Setup):
        raise InputError(
            f"study: is a {type(study).__name__}; it must be a Study; read a file first: "
            "calibrate(Study.load(file))"
        )
    if not isinstance(engine, Engine | None):
        raise InputError(
            f"engine: is {engine!r}; it must be an engine for all links; to choose an engine by name, use "
            "study.replace(engine=NAME)"
        )
    check_workers(workers)
    if not isinstance(cheap_model, Study | Setup | None):
        raise InputError(f"cheap_model: is {cheap_model!r}; it must be a Study, such as Study.load(file)")
    replaced = study.replace(method=method, seed=seed)
    plan, setup = (replaced.study, replaced) if isinstance(replaced, Setup) else (replaced, None)
    check_method(plan.method.name)
    if out is not None:
        check_outputs(out, FILES, plan.files(), overwrite)
    if plan.holds_out_blocks:
        check_engine(plan)
    started = time.perf_counter()
    can_trace = setup is not None
    if setup is None:
        setup = Setup.open(plan, tracer)
        for finding in suspicions(plan, setup.links):
            _LOG.warning("%s: %s; %s", finding.subject, finding.problem, finding.remedy)
    given = engine
    if engine is None:
        check_fit(setup)
        ledger = None if out is None else Path(out) / LEDGER_FILE
        engine = engines.make(setup, None, progress, ledger, workers)
        can_trace = True
    exporting = None
    if maps_rays(setup) and isinstance(engine, Answering):
        engine = exporting = Exporting(engine, setup)
    start_stage(progress, "evaluating initial values")
    problem = Problem.of(setup, engine)
    if problem.objective.num_counted < 2:
        raise InputError(
            f"{setup.links.source}: only 1 calibration link has a path; at least 2 are needed: measure more links, "
            "or change [holdout]"
        )
    # If an engine is given, this machine may have no ray tracer, which the check for enclosed antennas needs.
    enclosed = setup.enclosed if can_trace else None
    traced = time.perf_counter()
    problem = with_preliminary_fits(problem, progress)
    # The time taken to make the cheap model does not count as search time.
    paused = time.perf_counter()
    cheap, of_rays = CheapReplay(), ()
    if exporting is None:
        cheap = make_cheap_replay(problem, progress, None if cheap_model is None else cheap_model.opened())
    traced += time.perf_counter() - paused
    if exporting is None:
        trail = search(problem, choose(problem, cheap.model), progress)
        problem, trail, gap_db = retrace(problem, trail, progress)
    else:
        problem, trail, *of_rays = search_rays(problem, exporting, progress)
        gap_db = None
    timing = Timing(time.perf_counter() - traced, traced - started, started)
    assessment = certainty(problem, trail, progress, cheap.model)
    if can_trace and exporting is None:
        assessment = assess_richer_paths(problem, trail, assessment, progress)
    if plan.holdout is not None:
        problem = replace(problem, setup=problem.setup.with_obstruction())
    validation = None
    if plan.holds_out_blocks:
        # A method without multiple starts returns at most two minima, which are too few starting points for a
        # validation.
        many = len(trail.minima) > 2
        starts = {Model.CALIBRATED: trail.minima} if many else NO_MINIMA
        validation = validate_problem(problem, progress=progress, known_minima=starts)
    start_stage(progress, "examining residuals")
    on_links = unreached_remark(problem, progress) if can_trace and exporting is None else ()
    # A wrong antenna direction looks like a loss on one side of the transmitter, so regions are tested only if no
    # direction is found to be wrong.
    on_links += directions_remark(problem, trail.best) or region_remark(problem, trail)
    on_links += groups_remark(problem, trail)
    remarks = (*given_engine_remark(setup, given), *of_rays, *on_links)
    run = Run(problem, trail, gap_db, cheap, enclosed, remarks, timing)
    result = make_result(run, assessment, validation)
    if out is not None:
        # The folder was checked before the search; a file that has appeared since then must not prevent saving.
        result.save(out, overwrite=True)
    return result
