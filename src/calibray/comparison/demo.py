"""The paper's experiment, which calibrates the demo district with GWO, SGWO-IM, space mapping and `auto`.

Space mapping runs on the engine "retrace", which traces the scene again for every candidate and so represents engines
without stored paths. The cheap model of space mapping replays a trace with fewer interactions per path. `auto` runs on
stored paths.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.optimizers import label
from calibray.reporting import figures, page
from calibray.result.wording import interval_text
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
from calibray.support import figure_style as style
from calibray.support.output_files import write_text
from calibray.support.progress import Progress, with_prefix
from calibray.tables import Column, Table, numbers, short_html, short_text

RECORD: Final = "result.json"
FIGURES: Final = ("cumulative-cost.png", "convergence.png", "path-loss.png")
FILES: Final = (RECORD, *FIGURES, page.FILE)
"""Files of the experiment, in addition to a folder for each method."""

MAPPING_CALLS: Final = 8
"""Number of RT calls of space mapping; each RT call traces the scene."""


def run_demo(engine: str = "replay", seed: int = 0, progress: Progress | None = None) -> Demo:
    """Run the experiment, with the paper's methods on "replay" (one trace) or "retrace" (one trace per RT call).

    `progress` is called for every stage, with the method's label before the stage's name.

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
            setup, method, seed, engine=paper_engine, progress=with_prefix(progress, label(method))
        )
        for method in METHODS
    }
    results[MAPPING] = _space_mapping(setup, seed, with_prefix(progress, label(MAPPING)))
    results[AUTO] = calibrate(setup, AUTO, seed, engine=replay, progress=with_prefix(progress, label(AUTO)))
    truth = json.loads(demo_study_path().with_name("truth.json").read_text(encoding="utf-8"))["materials"]
    return Demo(
        results=results,
        optimum_db=results[AUTO].rmse_db,
        truth={name: entry["relative_permittivity_mean"] for name, entry in truth.items()},
        engine=engine,
        trace_seconds=trace_seconds,
    )


def write_demo(demo: Demo, out: Path) -> Path:
    """Write the experiment's record and figures, a folder for each method, and the report of `auto`.

    Returns the path of the report, an HTML file.
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
    """Run space mapping on the engine "retrace"; the cheap model replays a trace with fewer interactions per path."""
    content = setup.study.content()
    method = {"name": MAPPING, "seed": seed, "options": {"budget": MAPPING_CALLS}}
    expensive, cheap = (
        Setup.open(Study.from_content(content | changes, setup.study.path), setup.factory)
        for changes in (
            {"method": method, "engine": {"name": "retrace"}},
            # The study allows twice as many interactions per path.
            {"trace": content["trace"] | {"max_depth": 2}},
        )
    )
    return calibrate(expensive, cheap_model=cheap, progress=progress)


METHODS: Final = ("gwo", "sgwo-im")
"""The paper's methods."""

MAPPING: Final = "space-mapping"
AUTO: Final = "auto"

PAPER: Final = {
    "gwo": {
        "rt_calls": 600, "seconds": 831.68, "rmse_db": 3.65, "concrete": 6.45, "glass": 4.12, "soil": 3.88,
    },
    "sgwo-im": {
        "rt_calls": 225, "seconds": 336.51, "rmse_db": 2.97, "concrete": 5.82, "glass": 4.65, "soil": 4.21,
    },
}  # fmt: skip
"""The paper's results for its own site (tables III and IV and section IV-B of the paper)."""


@dataclass(frozen=True, repr=False)
class Demo:
    """The finished experiment.

    Attributes:
        results: Results by method, with `auto` last; space mapping runs on the engine "retrace".
        optimum_db: RMSE of the global optimum [dB], found by `auto` on stored paths.
        truth: True mean permittivities by material.
        engine: Engine used by the paper's methods.
        trace_seconds: Time to load and trace the district [s]; replay requires this only once.
    """

    results: dict[str, Result]
    optimum_db: float
    truth: dict[str, float]
    engine: str
    trace_seconds: float

    def __repr__(self) -> str:
        return short_text(self._heading, permittivity(self), accuracy(self))

    def _repr_html_(self) -> str:
        return short_html(self._heading, permittivity(self), accuracy(self))

    @property
    def _heading(self) -> str:
        return f"The paper's experiment, engine {self.engine}"

    def content(self) -> dict[str, Any]:
        """The experiment as a dictionary, including the results of the paper."""
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

    def tables(self) -> tuple[Table, ...]:
        """Tables of cost, permittivities and RMSE, and of the intervals and verdicts from `auto`."""
        return cost(self), permittivity(self), accuracy(self), trust(self.results[AUTO])


def cost(demo: Demo) -> Table:
    """RT calls and time of every method, and the corresponding values from the paper."""
    columns = (
        Column("method"), numbers("RT calls"), numbers("time", "s"),
        numbers("paper: calls"), numbers("paper: time", "s"),
    )  # fmt: skip
    rows = tuple(
        (
            label(method),
            str(result.rt_calls),
            f"{result.cost.seconds:.2f}",
            *_paper(method, "rt_calls", "seconds"),
        )
        for method, result in demo.results.items()
    )
    return Table("Cost", columns, rows)


def permittivity(demo: Demo) -> Table:
    """Permittivities found by every method, the true values, and the paper's values for its own site."""
    columns = (
        Column("material"),
        Column("before"),
        *(Column(label(method)) for method in demo.results),
        Column("planted mean"),
        *(Column(f"paper: {label(method)}") for method in PAPER),
    )
    first = next(iter(demo.results.values()))
    rows = []
    for parameter, before in first.fit.initial_parameters.items():
        material = parameter.split(".")[0]
        calibrated = (result.parameters[parameter] for result in demo.results.values())
        reported = (figures[material] for figures in PAPER.values())
        values = (before, *calibrated, demo.truth[material], *reported)
        rows.append((material, *(f"{value:.2f}" for value in values)))
    return Table("Relative permittivity", columns, tuple(rows))


def accuracy(demo: Demo) -> Table:
    """RMSE before and after calibration, and the excess over the global optimum."""
    columns = (
        Column("method"), numbers("before"), numbers("after"), numbers("excess"), numbers("paper: after")
    )  # fmt: skip
    rows = tuple(
        (
            label(method),
            f"{result.initial_rmse_db:.2f}",
            f"{result.rmse_db:.3f}",
            f"{result.rmse_db - demo.optimum_db:.4f}",
            *_paper(method, "rmse_db"),
        )
        for method, result in demo.results.items()
    )
    return Table("RMSE [dB]", columns, rows)


def trust(result: Result) -> Table:
    """Intervals and verdicts of the parameters, from `auto`."""
    columns = (Column("parameter"), numbers("value"), numbers("95 % interval"), Column("verdict"))
    rows = tuple(
        (name, f"{result.parameters[name]:.2f}", interval_text(interval), interval.label)
        for name, interval in result.intervals.items()
    )
    return Table("Intervals and verdicts of auto", columns, rows)


def _paper(method: str, *keys: str) -> tuple[str, ...]:
    reported = PAPER.get(method, {})
    return tuple(f"{reported[key]:g}" if key in reported else "-" for key in keys)
