"""The experiment of the paper: the demo district calibrated by GWO, SGWO-IM, space mapping and `auto`.

Space mapping runs on the ray tracer itself, which traces again for every candidate, with a trace of fewer interactions
as its cheap model. This is how an engine without stored paths is calibrated. `auto` runs on stored paths.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Final

from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.comparison.experiment import AUTO, MAPPING, METHODS, Demo
from calibray.optimizers import label
from calibray.reporting import figures, page
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
from calibray.support import figure_style as style
from calibray.support.output_files import write_text
from calibray.support.progress import Progress, with_stage

RECORD: Final = "result.json"
FIGURES: Final = ("cumulative-cost.png", "convergence.png", "path-loss.png")
FILES: Final = (RECORD, *FIGURES, page.FILE)
"""Files of the experiment, in addition to a folder for each method."""

MAPPING_CALLS: Final = 8
"""RT calls of space mapping, each a trace."""

CHEAP_DEPTH: Final = 2
"""Largest number of interactions in its cheap model; the study has twice as many."""


def run_demo(engine: str = "replay", seed: int = 0, progress: Progress | None = None) -> Demo:
    """Run the experiment on "replay" (trace once) or "retrace" (trace for every RT call, as in the paper).

    `progress` is called with every stage, which begins with the name of the method.

    Raises:
        InputError: The engine or the seed is invalid.
    """
    study = Study.load(demo_study_path())
    started = time.perf_counter()
    setup = Setup.open(study)
    setup.replace(seed=seed, engine=engine)  # refuses an unknown engine or seed before anything is traced
    replay = engines.make(setup, "replay", progress)
    trace_seconds = time.perf_counter() - started
    paper_engine = replay if engine == "replay" else engines.make(setup, engine)
    results = {
        method: calibrate(
            setup, method, seed, engine=paper_engine, progress=with_stage(progress, label(method))
        )
        for method in METHODS
    }
    results[MAPPING] = _space_mapping(setup, seed, with_stage(progress, label(MAPPING)))
    results[AUTO] = calibrate(setup, AUTO, seed, engine=replay, progress=with_stage(progress, label(AUTO)))
    truth = json.loads(demo_study_path().with_name("truth.json").read_text(encoding="utf-8"))["materials"]
    return Demo(
        results=results,
        optimum_db=results[AUTO].rmse_db,
        truth={name: entry["relative_permittivity_mean"] for name, entry in truth.items()},
        engine=engine,
        trace_seconds=trace_seconds,
    )


def write_demo(demo: Demo, out: Path) -> Path:
    """Write the experiment: its record, figures, a folder for each method, and the report of `auto`.

    Returns the report, an HTML file.
    """
    out.mkdir(parents=True, exist_ok=True)
    black_box = {method: demo.results[method] for method in METHODS}
    drawings = (
        figures.cumulative_cost(black_box),
        figures.convergence(black_box, demo.optimum_db),
        figures.path_loss_by_receiver(demo.results),
    )
    for name, figure in zip(FIGURES, drawings, strict=True):
        style.write(figure, out / name)
    for method, result in demo.results.items():
        result.save(out / method)
    write_text(out / RECORD, json.dumps(demo.content(), indent=2) + "\n")
    return page.report(demo.results[AUTO], out / page.FILE, overwrite=True)


def _space_mapping(setup: Setup, seed: int, progress: Progress | None) -> Result:
    """Space mapping on the engine "retrace", with a replay of fewer interactions as its cheap model."""
    content = setup.study.content()
    method = {"name": MAPPING, "seed": seed, "options": {"budget": MAPPING_CALLS}}
    expensive, cheap = (
        Setup.open(Study.from_content(content | changes, setup.study.path), setup.factory)
        for changes in (
            {"method": method, "engine": {"name": "retrace"}},
            {"trace": content["trace"] | {"max_depth": CHEAP_DEPTH}},
        )
    )
    return calibrate(expensive, cheap_model=cheap, progress=progress)
