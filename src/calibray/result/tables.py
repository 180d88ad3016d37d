"""A calibration as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.tables import Column, Table, numbers
from calibray.tables.text import decibels, rows_text

if TYPE_CHECKING:
    from calibray.result.record import Result
    from calibray.tracing.enclosed import Enclosed


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
        Links, parameters, offsets if there are any, accuracy and cost.
    """
    every = (links(result), parameters(result), offsets(result), accuracy(result), costs(result))
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
    without_path: Sequence[int], verdict: str, enclosed: Enclosed | None
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
        ends = (
            (f"{interval.lower:.4g} to {interval.upper:.4g}", interval.verdict)
            if interval
            else ("-", "not known")
        )
        rows.append((label, f"{before:.4g}", f"{after:.4g}", *ends))
    columns = (Column(), numbers("before"), numbers("after"), numbers("95 % interval"), Column("verdict"))
    return Table("Parameters", columns, tuple(rows))


def offsets(result: Result) -> Table:
    """The offset of every group; no rows without `[offset]`.

    Args:
        result: The calibration.

    Returns:
        The table.
    """
    rows = [(name or "all links", f"{value:+.2f}") for name, value in result.offsets_db.items()]
    rows += [(name or "all links", "no link with a path") for name in result.groups_without_path]
    return Table("Offsets", (Column(), numbers(unit="dB")), tuple(rows))


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
    if result.retrace_gap_db is not None:
        rows.append(("change on tracing again", f"{result.retrace_gap_db:.2f} dB"))
    rows.append(("tracing", f"{result.trace_seconds:.1f} s"))
    rows.append(("calibrating", f"{result.seconds:.1f} s"))
    return Table("Cost", (Column(), numbers()), tuple(rows))
