"""A calibration as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.tables import Column, Table, numbers
from calibray.tables.text import decibels, rows_text

if TYPE_CHECKING:
    from calibray.result.record import Result
    from calibray.tracing.positions import EnclosedAntennas
    from calibray.uncertainty.intervals import Interval

SHOWN: Final = 3
"""Pieces of an interval that are shown one by one."""


def heading(result: Result) -> str:
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


def summary(result: Result) -> tuple[Table | str, ...]:
    """What a calibration found, and how far to trust it, in a few lines.

    Args:
        result: The calibration.

    Returns:
        Its heading with the RT calls spent, and its tables of parameters, offsets and accuracy.
    """
    every = (parameters(result), offsets(result), accuracy(result))
    return (f"{heading(result)}, {result.rt_calls:,} RT calls", *(table for table in every if table.rows))


def tables(result: Result) -> tuple[Table, ...]:
    """All tables of a calibration.

    Args:
        result: The calibration.

    Returns:
        Links, parameters and the reasons of their verdicts, nuisances if there are any, accuracy, remarks, diagnostics
        and cost.
    """
    from calibray.result.diagnostics import remarkable

    every = (
        links(result), parameters(result), reasons(result), offsets(result), accuracy(result), remarks(result),
        remarkable(result), costs(result),
    )  # fmt: skip
    return tuple(table for table in every if table.rows)


def links(result: Result) -> Table:
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
        *((what, str(number), "") for what, number in result.prepared.items()),
        ("calibrated on", str(count["calibrated_on"]), ""),
        ("held out", str(count["held_out"]), ""),
        *suspects(count["rows_without_path"], f", {verdict}", result.enclosed),
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


def parameters(result: Result) -> Table:
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
        before, interval = result.initial_parameters[name], result.intervals.get(name)
        ends = (ends_text(interval), interval.told) if interval else ("-", "not known")
        rows.append((label, f"{before:.4g}", f"{after:.4g}", *ends))
    columns = (Column(), numbers("before"), numbers("after"), numbers("95 % interval"), Column("verdict"))
    return Table("Parameters", columns, tuple(rows))


def ends_text(interval: Interval) -> str:
    """The ends of an interval, of each piece while they are few.

    Args:
        interval: The interval.

    Returns:
        The ends as words.
    """
    pieces = interval.pieces if 1 < len(interval.pieces) <= SHOWN else ((interval.lower, interval.upper),)
    return ", ".join(f"{low:.4g} to {high:.4g}" for low, high in pieces)


def reasons(result: Result) -> Table:
    """Why every verdict is what it is; no rows where none is known.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [(name, found.reason) for name, found in result.intervals.items() if found.reason]
    return Table("Why", (Column(), Column()), tuple(rows))


def remarks(result: Result) -> Table:
    """What is to be said aloud.

    Args:
        result: The calibration.

    Returns:
        A table of sentences.
    """
    return Table("To be noted", (Column(),), tuple((sentence,) for sentence in result.remarks))


def offsets(result: Result) -> Table:
    """The offset of every group and the coefficients of further nuisances; no rows where there are none.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [(name or "all links", f"{value:+.2f}") for name, value in result.offsets_db.items()]
    rows += [(name or "all links", "no link with a path") for name in result.groups_without_path]
    for name, values in result.nuisances.items():
        rows += [(f"{name}, {label}" if label else name, f"{value:+.3g}") for label, value in values.items()]
    return Table(
        "Offsets" if not result.nuisances else "Nuisances", (Column(), numbers(unit="dB")), tuple(rows)
    )


def accuracy(result: Result) -> Table:
    """RMSE before and after, with rivals beside.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [
        ("before", result.initial_rmse_db, result.initial_holdout_rmse_db),
        ("offset only", result.offset_only_rmse_db, result.offset_only_holdout_rmse_db),
        ("after", result.rmse_db, result.holdout_rmse_db),
        ("log-distance model", result.log_distance_rmse_db, result.log_distance_holdout_rmse_db),
    ]
    shown = tuple((name, decibels(fit), decibels(held)) for name, fit, held in rows if fit is not None)
    return Table("RMSE [dB]", (Column(), numbers("calibrated on"), numbers("held out")), shown)


def costs(result: Result) -> Table:
    """RT calls and time.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [("RT calls", f"{result.rt_calls:,}")]
    if result.ledger_hits:
        rows.append(("answered by the ledger", f"{result.ledger_hits:,}"))
    if result.cheap_calls:
        took = f"{result.cheap_calls:,} in {result.cheap_seconds:.1f} s"
        rows.append(("replays as cheap model", took))
    if result.retrace_gap_db is not None:
        rows.append(("change on tracing again", f"{result.retrace_gap_db:.2f} dB"))
    if result.profile_calls:
        took = f"{result.profile_calls:,} in {result.profile_seconds:.1f} s"
        rows.append(("replays for intervals", took))
    rows.append(("tracing", f"{result.trace_seconds:.1f} s"))
    rows.append(("calibrating", f"{result.seconds:.1f} s"))
    return Table("Cost", (Column(), numbers()), tuple(rows))
