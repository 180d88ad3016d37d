"""A calibration as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from calibray.fitting.nuisance import OFFSET
from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.result import wording
from calibray.result.record import Record
from calibray.result.wording import interval_text, reason_text
from calibray.tables import Column, Table, numbers
from calibray.tables.text import decibels, rows_text
from calibray.tracing.positions import EnclosedAntennas
from calibray.validation.validation import Validation


def heading(result: Record) -> str:
    """Which study was calibrated, and with what.

    Args:
        result: The calibration.

    Returns:
        A line.
    """
    study = result.study
    return (
        f"{study.path.name}: method {study.method.name}, engine {study.engine.name}, seed {study.method.seed}"
    )


def summary(result: Record) -> tuple[Table | str, ...]:
    """What a calibration found, and how far to trust it, in a few lines.

    Args:
        result: The calibration.

    Returns:
        Its heading with the RT calls spent, and its tables of parameters, offsets and accuracy.
    """
    every = (parameters(result), offsets(result), accuracy(result))
    return (f"{heading(result)}, {result.rt_calls:,} RT calls", *(table for table in every if table.rows))


def tables(result: Record) -> tuple[Table, ...]:
    """All tables of a calibration.

    Args:
        result: The calibration.

    Returns:
        Links, parameters and the reasons of their verdicts, nuisances if there are any, accuracy, remarks, diagnostics
        and cost.
    """
    from calibray.reporting.diagnostics import remarkable

    every = (
        links(result), parameters(result), reasons(result), offsets(result), accuracy(result), remarks(result),
        remarkable(result), costs(result),
    )  # fmt: skip
    return tuple(table for table in every if table.rows)


def links(result: Record) -> Table:
    """How many links were used, and which need a look.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    count = result.counts
    censored = result.study.objective.no_path == "censor"
    verdict = f"counted as lost at {result.study.objective.ceiling_db:g} dB" if censored else "left out"
    rows = [
        *((what, str(number), "") for what, number in result.provenance.rows.items()),
        ("calibrated on", str(count["calibrated_on"]), ""),
        ("held out", str(count["held_out"]), ""),
        *suspects(count["rows_without_path"], f", {verdict}", result.provenance.enclosed),
    ]
    return Table("Links", (Column(), numbers(), Column()), tuple(rows))


def suspects(
    without_path: Sequence[int], verdict: str, enclosed: EnclosedAntennas | None
) -> Iterator[tuple[str, str, str]]:
    """Rows of a table of links: those that need a look.

    Args:
        without_path: Lines of the links without a path.
        verdict: What becomes of these.
        enclosed: Antennas inside closed bodies; None where nothing was looked for.

    Yields:
        What is counted, how many there are, and which with what to do.
    """
    lost = rows_text(without_path)
    yield "without a path", str(len(without_path)), lost + verdict if lost else ""
    if enclosed is None:
        return
    for end, rows in (("transmitter", enclosed.tx), ("receiver", enclosed.rx)):
        if enclosed.indoors:
            remedy = "as most are: taken for an indoor scene"
        else:
            remedy = f"{rows_text(rows)}: check the positions"
        yield f"{end} inside a building", str(len(rows)), remedy if rows else ""


def parameters(result: Record) -> Table:
    """What every parameter was and became, and how far to trust it.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = []
    for name, after in result.parameters.items():
        unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
        label = Column(name, "" if unit == "1" else unit).heading
        before, interval = result.fit.initial_parameters[name], result.intervals.get(name)
        ends = (interval_text(interval), interval.label) if interval else ("-", "not known")
        rows.append((label, f"{before:.4g}", f"{after:.4g}", *ends))
    columns = (Column(), numbers("before"), numbers("after"), numbers("95 % interval"), Column("verdict"))
    return Table("Parameters", columns, tuple(rows))


def reasons(result: Record) -> Table:
    """Why every verdict is what it is; no rows where none is known.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [
        (name, reason_text(interval.reason)) for name, interval in result.intervals.items() if interval.reason
    ]
    return Table("Why", (Column(), Column()), tuple(rows))


def remarks(result: Record) -> Table:
    """Warnings and advice.

    Args:
        result: The calibration.

    Returns:
        A table of sentences.
    """
    choice = "" if result.held_out is None else Validation.of(result.held_out).choice
    sentences = wording.remarks(result, choice)
    return Table("Remarks", (Column(),), tuple((sentence,) for sentence in sentences))


def offsets(result: Record) -> Table:
    """The offset of every group and the coefficients of further nuisances; no rows where there are none.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    nuisance = result.nuisance
    further = {name: values for name, values in nuisance.coefficients.items() if name != OFFSET}
    rows = [(group or "all links", f"{value:+.2f}") for group, value in nuisance.offsets_db.items()]
    rows += [(group or "all links", "no link with a path") for group in nuisance.groups_without_path]
    for name, values in further.items():
        rows += [(f"{name}, {group}" if group else name, f"{value:+.3g}") for group, value in values.items()]
    return Table("Nuisances" if further else "Offsets", (Column(), numbers(unit="dB")), tuple(rows))


def accuracy(result: Record) -> Table:
    """RMSE before and after, with rivals beside.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [
        ("before", result.initial_rmse_db, result.accuracy.initial_holdout_rmse_db),
        ("offset only", result.fit.nuisance_only_rmse_db, result.accuracy.nuisance_only_holdout_rmse_db),
        ("after", result.rmse_db, result.holdout_rmse_db),
        ("log-distance model", result.fit.log_distance_rmse_db, result.accuracy.log_distance_holdout_rmse_db),
    ]
    shown = tuple((name, decibels(fit), decibels(held)) for name, fit, held in rows if fit is not None)
    return Table("RMSE [dB]", (Column(), numbers("calibrated on"), numbers("held out")), shown)


def costs(result: Record) -> Table:
    """RT calls and time.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [("RT calls", f"{result.rt_calls:,}")]
    if result.cost.ledger_hits:
        rows.append(("answered by the ledger", f"{result.cost.ledger_hits:,}"))
    if result.cost.cheap_replays:
        took = f"{result.cost.cheap_replays:,} in {result.cost.cheap_seconds:.1f} s"
        rows.append(("replays as cheap model", took))
    if result.fit.retrace_gap_db is not None:
        rows.append(("change on tracing again", f"{result.fit.retrace_gap_db:.2f} dB"))
    if result.cost.uncertainty_replays:
        took = f"{result.cost.uncertainty_replays:,} in {result.cost.uncertainty_seconds:.1f} s"
        rows.append(("replays for intervals", took))
    rows.append(("tracing", f"{result.cost.trace_seconds:.1f} s"))
    rows.append(("calibrating", f"{result.cost.seconds:.1f} s"))
    return Table("Cost", (Column(), numbers()), tuple(rows))
