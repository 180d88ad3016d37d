"""The result of the paper's experiment, in tables next to the values that the paper reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from calibray.calibration.result import Result
from calibray.optimizers import label
from calibray.result.wording import interval_text
from calibray.tables import Column, Table, display, numbers

METHODS: Final = ("gwo", "sgwo-im")
"""The paper's methods."""

MAPPING: Final = "space-mapping"
AUTO: Final = "auto"

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
"""The paper's results at its own site (its tables III and IV, and section IV-B)."""


@dataclass(frozen=True, repr=False)
class Demo:
    """The finished experiment.

    Attributes:
        results: Results by method, `auto` last; space mapping runs on the engine "retrace".
        optimum_db: RMSE of the global optimum [dB], found by `auto` on stored paths.
        truth: Planted mean permittivities by material.
        engine: The engine of the paper's methods.
        trace_seconds: Time to load and trace the district, which replay needs once [s].
    """

    results: dict[str, Result]
    optimum_db: float
    truth: dict[str, float]
    engine: str
    trace_seconds: float

    def __repr__(self) -> str:
        return display.text(self._heading, permittivity(self), accuracy(self))

    def _repr_html_(self) -> str:
        return display.html(self._heading, permittivity(self), accuracy(self))

    @property
    def _heading(self) -> str:
        return f"The paper's experiment, engine {self.engine}"

    def content(self) -> dict[str, Any]:
        """The experiment as plain values, with the paper's results."""
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
        """Cost, permittivities, RMSE, and the intervals and verdicts of `auto`."""
        return cost(self), permittivity(self), accuracy(self), trust(self.results[AUTO])


def cost(demo: Demo) -> Table:
    """RT calls and time of every method, and those that the paper reports."""
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
    """Permittivities of every method, the planted ones, and those of the paper at its own site."""
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
    """RMSE before and after calibration, and its excess over the global optimum."""
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
    """Intervals and verdicts of the parameters of `auto`."""
    columns = (Column("parameter"), numbers("value"), numbers("95 % interval"), Column("verdict"))
    rows = tuple(
        (name, f"{result.parameters[name]:.2f}", interval_text(interval), interval.label)
        for name, interval in result.intervals.items()
    )
    return Table("Intervals and verdicts of auto", columns, rows)


def _paper(method: str, *keys: str) -> tuple[str, ...]:
    reported = PAPER.get(method, {})
    return tuple(f"{reported[key]:g}" if key in reported else "-" for key in keys)
