"""The paper's experiment: the embedded district calibrated by GWO and SGWO-IM, and beside them by what Calibray adds.

Space mapping runs on the ray tracer itself, anew for every candidate, with a trace of fewer interactions as its cheap
model: this is how an engine is calibrated that can only be called. `auto` runs on stored paths.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from calibray import engines
from calibray.calibration import calibrate
from calibray.comparison.paper_tables import summary
from calibray.optimizers.methods import label
from calibray.result import Result
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
from calibray.support.progress import Progress, with_stage
from calibray.tables import display as glance

METHODS: Final = ("gwo", "sgwo-im")
MAPPING: Final = "space-mapping"
AUTO: Final = "auto"

MAPPED: Final = 8
"""RT calls of space mapping, each a trace."""

CHEAP_DEPTH: Final = 2
"""Interactions of a path in its cheap model; the study has twice as many."""

PAPER: Final = {
    "gwo": {
        "rt_calls": 600,
        "seconds": 831.68,
        "rmse_db": 3.65,
        "concrete": 6.45,
        "glass": 4.12,
        "soil": 3.88,
    },
    "sgwo-im": {
        "rt_calls": 225,
        "seconds": 336.51,
        "rmse_db": 2.97,
        "concrete": 5.82,
        "glass": 4.65,
        "soil": 4.21,
    },
}
"""What the paper reports for its own site (its tables III and IV, and section IV-B)."""


@dataclass(frozen=True, repr=False)
class Demo:
    """The finished experiment.

    Attributes:
        results: Results by method, `auto` last; space mapping traces anew for every candidate.
        optimum_db: RMSE of the global optimum, [dB]: what `auto` found on stored paths.
        truth: Planted mean permittivities by material.
        engine: The engine that ran.
        trace_seconds: Time to load and trace the district, which replay pays once, [s].
    """

    results: dict[str, Result]
    optimum_db: float
    truth: dict[str, float]
    engine: str
    trace_seconds: float

    @property
    def paper(self) -> Mapping[str, Mapping[str, float]]:
        """What the paper reports for its own site, by method."""
        return PAPER

    def __repr__(self) -> str:
        return glance.text(*summary(self))

    def _repr_html_(self) -> str:
        return glance.html(*summary(self))

    def content(self) -> dict[str, Any]:
        """The experiment as plain values, the paper's figures beside."""
        return {
            "engine": self.engine,
            "optimum_db": self.optimum_db,
            "trace_seconds": self.trace_seconds,
            "planted_relative_permittivity": self.truth,
            "paper": PAPER,
            "methods": {
                method: {**result.content(), "excess_rmse_db": result.rmse_db - self.optimum_db}
                for method, result in self.results.items()
            },
        }


def run_demo(engine: str = "replay", seed: int = 0, progress: Progress | None = None) -> Demo:
    """Run the experiment.

    Args:
        engine: "replay" (trace once), or "retrace" to pay for every RT call as the paper does.
        seed: Seed of the methods.
        progress: Called as the work goes on, with the method's name in front.

    Returns:
        The experiment.

    Raises:
        InputError: The engine is unknown, or the seed is impossible.
    """
    study = Study.load(demo_study_path())
    started = time.perf_counter()
    setup = Setup.open(study)
    setup.replace(seed=seed, engine=engine)  # what cannot be used is refused before anything is traced
    replay = engines.make(setup, "replay", progress)
    trace_seconds = time.perf_counter() - started
    chosen = replay if engine == "replay" else engines.make(setup, engine)
    results = {
        method: calibrate(setup, method, seed, engine=chosen, progress=with_stage(progress, label(method)))
        for method in METHODS
    }
    results[MAPPING] = _mapped(setup, seed, with_stage(progress, label(MAPPING)))
    results[AUTO] = calibrate(setup, AUTO, seed, engine=replay, progress=with_stage(progress, label(AUTO)))
    truth = json.loads(demo_study_path().with_name("truth.json").read_text(encoding="utf-8"))["materials"]
    return Demo(
        results=results,
        optimum_db=results[AUTO].rmse_db,
        truth={name: entry["relative_permittivity_mean"] for name, entry in truth.items()},
        engine=engine,
        trace_seconds=trace_seconds,
    )


def _mapped(setup: Setup, seed: int, progress: Progress | None) -> Result:
    """Space mapping on the engine "retrace", by way of a replay of fewer interactions."""
    content = setup.study.content()
    method = {"name": MAPPING, "seed": seed, "options": {"budget": MAPPED}}
    dear, cheap = (
        Setup.open(Study.from_content(content | changed, setup.study.path), setup.factory)
        for changed in (
            {"method": method, "engine": {"name": "retrace"}},
            {"trace": content["trace"] | {"max_depth": CHEAP_DEPTH}},
        )
    )
    return calibrate(dear, cheap=cheap, progress=progress)
