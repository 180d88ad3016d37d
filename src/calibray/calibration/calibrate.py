"""Calibrate a study: open it, search, trace again, and tell what was found."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from calibray import engines
from calibray.calibration.outcome import outcome
from calibray.engines.cluster.workers import Workers
from calibray.engines.ledger.ledger import LEDGER_FILE
from calibray.engines.protocol import Engine
from calibray.fitting.cheap_replay import aid
from calibray.fitting.fidelity_loop import settle
from calibray.fitting.methods import check_fit, check_method, choose
from calibray.fitting.noise_floor import heard
from calibray.fitting.noise_level import weighed
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.result import FILES, Result
from calibray.study import Setup, Study
from calibray.support.interruption import ensure_interruption, unwrap_interruption
from calibray.support.output_files import check_outputs
from calibray.support.progress import Progress
from calibray.tracing.default_tracer import SIONNA
from calibray.tracing.protocol import TracerFactory
from calibray.uncertainty.assessment import certainty
from calibray.validation.validate import check_engine, validated
from calibray.validation.validation import CALIBRATED
from calibray.validation.variants import NOTHING

FEW: Final = 2
"""Minima of a method that kept its best alone."""


# Cut short, an import leaves modules half-made, and what fails then knows nothing of Ctrl-C.
@ensure_interruption()
@unwrap_interruption()
def calibrate(
    study: Study | Setup,
    method: str | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    *,
    engine: Engine | None = None,
    executor: Workers | None = None,
    progress: Progress | None = None,
    tracer: TracerFactory = SIONNA,
    overwrite: bool = False,
    cheap: Study | Setup | None = None,
) -> Result:
    """Calibrate a scene's materials against measurements.

    Args:
        study: The study, opened or not.
        method: Method in place of the study's: "auto", "sgwo-im", "gwo", ...
        seed: Seed in place of the study's.
        out: Folder to save the result in; checked before anything is computed. The ledger of RT calls lies there,
            and a run that was killed repeats none of them when it is started again.
        engine: Engine to run on, over all links of the study; made from the study, with a ledger, if None.
        executor: Run the calls of a batch on the engine "command", or keep chunks of links on "replay"
            (`engines.open_workers`).
        progress: Called as the work goes on.
        overwrite: Replace files in `out` that Calibray did not write; the study's own are never replaced.
        tracer: What opens the scene in a ray tracer; a study that is open brings its own.
        cheap: A study of the same links and materials, whose replay is the cheap model of an engine that can only be
            called; the study itself if None.

    Returns:
        The result.

    Raises:
        InputError: Something in the study, the method or the folder cannot be used.
        EngineError: The engine failed.
    """
    given = study.replace(method=method, seed=seed)
    plan, setup = (given.study, given) if isinstance(given, Setup) else (given, None)
    check_method(plan.method.name)
    if out is not None:
        check_outputs(out, FILES, plan.files(), overwrite)
    in_turn = plan.holdout is not None and plan.holdout.where is None
    if in_turn:
        check_engine(plan)
    started = time.perf_counter()
    looked_for = setup is not None
    setup = setup or Setup.open(plan, tracer)
    if engine is None:
        check_fit(setup)
        ledger = None if out is None else Path(out) / LEDGER_FILE
        engine = engines.make(setup, None, progress, ledger, executor)
        looked_for = True
    problem = Problem.of(setup, engine)
    # Before anything is calibrated on them; a ready engine may stand where no ray tracer can be loaded.
    enclosed = setup.enclosed if looked_for else None
    traced = time.perf_counter()
    problem = weighed(heard(problem, progress), progress)
    paused = time.perf_counter()
    helper = aid(problem, progress, None if cheap is None else cheap.opened())
    traced += time.perf_counter() - paused
    trail = search(problem, choose(problem, helper.model), progress)
    problem, trail, gap = settle(problem, trail, progress)
    seconds = time.perf_counter() - traced
    told = certainty(problem, trail, progress, helper.model)
    known = {CALIBRATED: trail.minima} if len(trail.minima) > FEW else NOTHING
    judged = validated(problem, progress=progress, known=known) if in_turn else None
    result = outcome(problem, trail, gap, told, judged, enclosed, seconds, traced - started, helper)
    if out is not None:
        # Asked before the work: what was computed is not lost to a file that came in the meantime.
        result.save(out, overwrite=True)
    return result
