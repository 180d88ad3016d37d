"""Tables that describe a calibration, and the calibrated values as shown in the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import inf, log
from statistics import stdev
from typing import Final

from calibray.parameters.parameter import PARAMETER_BOUNDS
from calibray.reporting.wording import diagnostics_table, engine_text, group_text, usable_link_text
from calibray.result import wording
from calibray.result.record import Record
from calibray.result.verdict import Verdict
from calibray.result.wording import explanation_text, interval_text
from calibray.study.calibration_sections import OFFSET
from calibray.tables import Column, Table, decibels, numbers, rows_text
from calibray.tracing.protocol import EnclosedAntennas
from calibray.validation.validation import Validation, observables_table

MARKS: Final[dict[str, str]] = {
    Verdict.IDENTIFIED: "●",
    Verdict.WEAKLY_IDENTIFIED: "◕",
    Verdict.AMBIGUOUS: "◑",
    Verdict.AT_BOUND: "◐",
    Verdict.NOT_IDENTIFIABLE: "○",
}


def heading(result: Record) -> str:
    """State which study, method, engine and seed a calibration used."""
    study = result.study
    return f"{study.path.name}: method {study.method.name}, engine {engine_text(result)}, seed {study.method.seed}"


def summary(result: Record) -> tuple[Table | str, ...]:
    """A short form for Python and notebooks: a heading, and tables of parameters, nuisances and accuracy."""
    parts = (parameters(result), nuisances(result), accuracy(result), observables(result))
    parts = (*parts, observables_table(result.accuracy.observables))
    return (f"{heading(result)}, {result.rt_calls:,} RT calls", *(table for table in parts if table.rows))


def tables(result: Record) -> tuple[Table, ...]:
    """All tables of a calibration."""
    parts = (
        links(result), parameters(result), reasons(result), nuisances(result), accuracy(result), observables(result),
        observables_table(result.accuracy.observables), remarks(result), diagnostics_table(result), costs(result),
    )  # fmt: skip
    return tuple(table for table in parts if table.rows)


def links(result: Record) -> Table:
    """Numbers of links, and the rows of links that should be checked."""
    count = result.counts
    censored = result.study.objective.no_path == "censor"
    treatment = (
        f"counted with a path loss of {result.study.objective.ceiling_db:g} dB" if censored else "left out"
    )
    if result.prediction.fallback is not None:
        treatment += ", predicted by the log-distance model"
    rows = [
        *((cause, str(number), "") for cause, number in result.provenance.rows.items()),
        ("calibration links", str(count["calibrated_on"]), ""),
        ("held out", *_held_out(result)),
        *suspicious_rows(count["rows_without_path"], f", {treatment}", result.provenance.enclosed),
    ]
    return Table("Links", (Column(), numbers(), Column()), tuple(rows))


def _held_out(result: Record) -> tuple[str, str]:
    """Number of held-out links and, if blocks were held out in turn, number of blocks."""
    if result.held_out is None:
        return str(result.counts["held_out"]), ""
    return str((result.held_out.block >= 0).sum()), f"in turn, in {len(result.held_out.labels)} blocks"


def suspicious_rows(
    without_path: Sequence[int], treatment: str, enclosed: EnclosedAntennas | None
) -> Iterator[tuple[str, str, str]]:
    """Lines about links to check; each line contains a label, the number of links, their rows, and a remedy.

    `treatment` is appended to the list of rows without a path. If `enclosed` is None, the antennas were not checked.
    """
    text = rows_text(without_path)
    yield "without a path", str(len(without_path)), text + treatment if text else ""
    if enclosed is None:
        return
    for end, rows, below in enclosed.ends:
        if enclosed.indoors:
            remedy = "like most receivers: the scene is assumed to be indoors"
        else:
            remedy = f"{rows_text(rows)}: check the positions"
        yield f"{end} inside a building", str(len(rows)), remedy if rows else ""
        if below:
            yield f"{end} below the ground", str(len(below)), f"{rows_text(below)}: check the heights"


def parameters(result: Record) -> Table:
    """Values before and after calibration, with intervals and verdicts."""
    predicted = result.prediction.model.parameters
    differs = predicted is not None and predicted != result.parameters
    rows = []
    for name, after in result.parameters.items():
        heading = Column(name, _unit(name)).heading
        before, interval = result.fit.initial_parameters[name], result.intervals.get(name)
        certainty = (interval_text(interval), interval.label) if interval else ("-", "unknown")
        used = (f"{predicted[name]:.4g}",) if predicted is not None and differs else ()
        rows.append((heading, f"{before:.4g}", f"{after:.4g}", *used, *certainty))
    columns = (
        Column(), numbers("before"), numbers("after"), *([numbers("in predictions")] if differs else []),
        numbers("95 % interval"), Column("verdict"),
    )  # fmt: skip
    return Table("Parameters", columns, tuple(rows))


def reasons(result: Record) -> Table:
    """The reasons for the verdicts."""
    rows = [
        (name, explanation_text(interval)) for name, interval in result.intervals.items() if interval.reason
    ]
    return Table("Reasons", (Column(), Column()), tuple(rows))


def observables(result: Record) -> Table:
    """The fit of further observables, each in its own unit; no rows if the study has no further observables."""
    rows = []
    for name, fit in result.fit.observables.items():
        biases = ", ".join(
            f"{label or 'all'} {value:+.3g} ± {fit.bias_errors.get(label, 0.0):.2g}"
            for label, value in fit.biases.items()
        )
        figures = (fit.initial_rmse, fit.rmse, fit.mean_rmse, fit.error)
        rows.append(
            (f"{name} [{fit.unit}]", str(fit.links), *(f"{figure:.3g}" for figure in figures), biases)
        )
    columns = (
        Column(), numbers("links"), numbers("RMSE before"), numbers("RMSE after"), numbers("RMSE of the mean"),
        numbers("error"), Column("bias"),
    )  # fmt: skip
    return Table("Observables", columns, tuple(rows))


def remarks(result: Record) -> Table:
    """Warnings and advice."""
    choice = "" if result.held_out is None else Validation.of(result.held_out).choice
    sentences = wording.remarks(result, choice)
    return Table("Remarks", (Column(),), tuple((sentence,) for sentence in sentences))


def nuisances(result: Record) -> Table:
    """Offsets, and coefficients of further nuisances, by group; no rows if the study declares no nuisance.

    If the posterior draws contain these coefficients, a further column shows their standard deviations.
    """
    nuisance, others = result.nuisance, _nuisances_besides_offset(result)

    def spread(name: str, group: str) -> str:
        drawn = result.uncertainty.draws.get(f"{name}[{group}]" if group else name, ())
        return f"{stdev(drawn):.2g}" if len(drawn) > 1 else ""

    rows = [
        (group_text(result, group) if group else "all links", f"{value:+z.2f}", spread(OFFSET, group))
        for group, value in nuisance.offsets_db.items()
    ]
    rows += [
        (group_text(result, group), f"no link with {usable_link_text(result)}", "")
        for group in nuisance.groups_without_path
    ]
    for name, values in others.items():
        rows += [
            (f"{name}, {group}" if group else name, f"{value:+.3g}", spread(name, group))
            for group, value in values.items()
        ]
    # The column of an offset is 1; the column of a further nuisance can be a length or a number of walls.
    title, unit = ("Nuisances", "dB per unit") if others else ("Offsets", "dB")
    columns = (Column(), numbers(unit=unit), numbers("standard deviation", unit))
    shown = columns if any(row[2] for row in rows) else columns[:2]
    return Table(title, shown, tuple(row[: len(shown)] for row in rows))


def accuracy(result: Record) -> Table:
    """RMSE before and after calibration, and RMSE of the baselines."""
    fit, held_out = result.fit, result.accuracy
    rows = (
        ("before", fit.initial_rmse_db, held_out.initial_holdout_rmse_db),
        (nuisances_only(result), fit.nuisance_only_rmse_db, held_out.nuisance_only_holdout_rmse_db),
        ("after", fit.rmse_db, held_out.holdout_rmse_db),
        ("log-distance model", fit.log_distance_rmse_db, held_out.log_distance_holdout_rmse_db),
    )
    cells = tuple(
        (name, decibels(fitted), decibels(held)) for name, fitted, held in rows if fitted is not None
    )
    return Table("RMSE [dB]", (Column(), numbers("calibration links"), numbers("held out")), cells)


def costs(result: Record) -> Table:
    """Numbers of RT calls and replays, and computing times."""
    cost = result.cost
    rows = [("RT calls", f"{cost.rt_calls:,}")]
    if cost.ledger_hits:
        rows.append(("found in the ledger", f"{cost.ledger_hits:,}"))
    if result.study.engine.expensive and (failed := int((result.history.rmse_db == inf).sum())):
        rows.append(("failed, or a link lost its path", f"{failed:,}"))
    if cost.cheap_replays:
        rows.append(("replays of the cheap model", f"{cost.cheap_replays:,} in {cost.cheap_seconds:.1f} s"))
    if (gap_db := result.fit.retrace_gap_db) is not None:
        rows.append(("largest change when traced again", f"{gap_db:.2f} dB"))
    if cost.uncertainty_replays:
        replays = f"{cost.uncertainty_replays:,} in {cost.uncertainty_seconds:.1f} s"
        rows.append(("replays for intervals", replays))
    rows.append(("tracing", f"{cost.trace_seconds:.1f} s"))
    rows.append(("calibrating", f"{cost.seconds:.1f} s"))
    if cost.total_seconds:
        rows.append(("in total", f"{cost.total_seconds:.1f} s"))
    return Table("Cost", (Column(), numbers()), tuple(rows))


@dataclass(frozen=True)
class Value:
    """A parameter as shown in the report: its texts, and positions on a bar that spans the parameter's bounds.

    Attributes:
        name: Name of the parameter.
        unit: Unit; empty for a dimensionless parameter.
        before: Value before calibration.
        after: Calibrated value.
        interval: 95 % interval; empty if unknown.
        verdict: The verdict on the parameter.
        bounds: Lower and upper bound.
        scale: "linear" or "log".
        positions: Positions of the values "before" and "after" on the bar, from 0 to 1.
        pieces: Ends of every separate range of the interval on the bar, from 0 to 1.
        reason: The reason for the verdict; empty if unknown.
        approximate: Whether the interval was computed with an emulator of the engine.
        predicted: The value that predictions use; empty if predictions use the calibrated value or use no scene.
    """

    name: str
    unit: str
    before: str
    after: str
    interval: str
    verdict: str
    bounds: tuple[str, str]
    scale: str
    positions: dict[str, float]
    pieces: tuple[tuple[float, float], ...] = ()
    reason: str = ""
    approximate: bool = False
    predicted: str = ""

    @property
    def mark(self) -> str:
        """A symbol for the verdict."""
        return MARKS.get(self.verdict, "")


def values(result: Record) -> list[Value]:
    """The parameters of a calibration as shown in the report."""
    entries, predicted = [], result.prediction.model.parameters
    for name, after in result.parameters.items():
        section, interval = result.study.parameters[name], result.intervals.get(name)
        before, position = result.fit.initial_parameters[name], _bar(*section.bounds, section.scale)
        pieces = () if interval is None else interval.pieces or ((interval.lower, interval.upper),)
        entries.append(
            Value(
                name,
                _unit(name),
                f"{before:.4g}",
                f"{after:.4g}",
                "" if interval is None else interval_text(interval),
                "unknown" if interval is None else interval.verdict,
                (f"{section.bounds[0]:.4g}", f"{section.bounds[1]:.4g}"),
                section.scale,
                {"before": position(before), "after": position(after)},
                tuple((position(low), position(high)) for low, high in pieces),
                "" if interval is None else explanation_text(interval),
                interval is not None and interval.approximate,
                "" if predicted is None or predicted[name] == after else f"{predicted[name]:.4g}",
            )
        )
    return entries


def nuisances_only(result: Record) -> str:
    """The short name of the model with the initial materials and fitted nuisances."""
    return "nuisances only" if _nuisances_besides_offset(result) else "offset only"


def _nuisances_besides_offset(result: Record) -> dict[str, dict[str, float]]:
    return {name: values for name, values in result.nuisance.coefficients.items() if name != OFFSET}


def _unit(name: str) -> str:
    unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
    return "" if unit == "1" else unit


def _bar(lower: float, upper: float, scale: str) -> Callable[[float], float]:
    """Make a function that converts a value to its position between the bounds, from 0 to 1."""

    def position(value: float) -> float:
        value = min(max(value, lower), upper)
        if scale == "log":
            return log(value / lower) / log(upper / lower)
        return (value - lower) / (upper - lower)

    return position
