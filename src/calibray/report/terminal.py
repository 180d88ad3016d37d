"""What the command line shows: tables of a calibration as plain text, and progress bars."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from typing import Any, Final

import numpy as np
import pandas as pd
from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.paths import Paths
from calibray.progress import Progress as Report
from calibray.result import Result
from calibray.tracing.convergence import Convergence
from calibray.tracing.enclosed import Enclosed
from calibray.tracing.launches import Plan

LONG: Final = 20_000_000  # rays x interactions x receivers that take some seconds
LISTED: Final = 12  # rows named one by one before the rest is only counted


def summary(result: Result, enclosed: Enclosed) -> dict[str, Any]:
    """The links of a calibration in numbers, with the rows that need a look.

    Args:
        result: The calibration.
        enclosed: Its antennas inside closed bodies.

    Returns:
        How many links were calibrated on and held out, and the rows without a path or with an enclosed antenna.
    """
    links = result.links
    has_path, held_out = links["has_path"].to_numpy(bool), links["held_out"].to_numpy(bool)
    counted = ~held_out & (has_path | (result.study.objective.no_path == "censor"))
    return {
        "calibrated_on": int(counted.sum()),
        "held_out": int(held_out.sum()),
        "rows_without_path": links["row"][~has_path].tolist(),
        "rows_with_enclosed_tx": list(enclosed.tx),
        "rows_with_enclosed_rx": list(enclosed.rx),
    }


def render_result(result: Result, enclosed: Enclosed) -> str:
    """A calibration as tables of plain text.

    Args:
        result: The calibration.
        enclosed: Its antennas inside closed bodies.

    Returns:
        Lines of text, without a line break at the end.
    """
    sections = [
        _heading(result),
        _links(result, enclosed),
        _parameters(result),
        _offsets(result),
        _accuracy(result),
        _costs(result),
    ]
    return "\n\n".join(section for section in sections if section)


def render_plan(plan: Plan, links: int) -> str:
    """What a long trace will take, in a line; the time that is left is told by the progress bar.

    Args:
        plan: The launches.
        links: Number of links.

    Returns:
        The line; empty if one small launch does it all.
    """
    if len(plan.launches) <= 1 and plan.lanes <= LONG:
        return ""
    return (
        f"Tracing {links:,} links in {len(plan.launches):,} launches of up to {plan.lanes:,} rays x interactions x "
        f"receivers; about {plan.memory / 2**30:.1f} GiB of memory, besides that of the scene and the paths found"
    )


def render_paths(paths: Paths, row: np.ndarray, enclosed: Enclosed) -> str:
    """A trace as a table of plain text.

    Args:
        paths: What was traced.
        row: Line of every link in the source file [L].
        enclosed: Antennas inside closed bodies.

    Returns:
        Lines of text, without a line break at the end.
    """
    reached = np.bincount(paths.link, minlength=paths.num_links) > 0
    rows = [
        ("links", f"{paths.num_links:,}", ""),
        ("paths", f"{paths.num_paths:,}", ""),
        ("interactions", f"{paths.num_interactions:,}", ""),
        *_suspects(row[~reached].tolist(), "", enclosed),
    ]
    return render_table(("Trace", ">", ""), rows)


def render_convergence(found: Convergence, row: np.ndarray, tolerance_db: float) -> str:
    """What tracing again with more samples changed, as tables of plain text and a verdict.

    Args:
        found: The changes.
        row: Line of every link in the source file [L].
        tolerance_db: Change of a link's path loss that is let stand [dB].

    Returns:
        Lines of text, without a line break at the end.
    """
    after = 2 * found.samples
    overview = [
        ("median", f"{found.quantile(0.5):.2f} dB", ""),
        ("95 % of the links", f"{found.quantile(0.95):.2f} dB", ""),
        ("largest", f"{found.quantile(1.0):.2f} dB", ""),
        ("links that gained paths", str(len(found.gained)), rows_text(row[found.gained].tolist())),
        ("links that lost paths", str(len(found.lost)), rows_text(row[found.lost].tolist())),
    ]
    tables = [render_table((f"Change from {found.samples:,} to {after:,} samples", ">", ""), overview)]
    changed = [
        link for link in found.largest[:LISTED] if abs(found.change_db[link]) >= 0.005
    ]  # shown to 0.01 dB
    if changed:
        rows = [
            (str(row[link]), f"{found.change_db[link]:+.2f}",
             f"{found.paths_before[link]:,}", f"{found.paths_after[link]:,}")
            for link in changed
        ]  # fmt: skip
        tables.append(render_table((">Row", ">change [dB]", ">paths before", ">after"), rows))
    above = int((np.abs(found.change_db) > tolerance_db).sum())
    tables.append(
        f"Converged: no link changed by more than {tolerance_db:g} dB (fidelity.tolerance_db)."
        if found.converged(tolerance_db)
        else f"Not converged: {above} of {len(row)} links changed by more than {tolerance_db:g} dB "
        f"(fidelity.tolerance_db); raise trace.samples to {after} or more and check again."
    )
    return "\n\n".join(tables)


def rows_text(rows: Sequence[int]) -> str:
    """Rows of a file, named one by one while they are few.

    Args:
        rows: Lines of the file.

    Returns:
        Them as words, empty if there is none.

    Example:
        >>> rows_text([3, 4, 9])
        'rows 3, 4, 9'
        >>> rows_text(range(2, 40))
        'rows 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13 and 26 more'
    """
    if not rows:
        return ""
    named = ", ".join(map(str, rows[:LISTED]))
    more = f" and {len(rows) - LISTED} more" if len(rows) > LISTED else ""
    return f"row{'s' if len(rows) > 1 else ''} {named}{more}"


@contextmanager
def progress_bars(console: Console) -> Iterator[Report]:
    """Progress bars, one for each stage of the work; none where nobody watches.

    Args:
        console: Where to draw them; must be a terminal, else nothing is drawn.

    Yields:
        What to call with the stage's name, how much is done, and out of how much.
    """
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns,
        console=console,
        disable=not console.is_terminal,
        transient=True,
        speed_estimate_period=3600.0,  # [s]; a launch of rays may take longer than Rich looks back by itself
    ) as bars:
        tasks = {"tracing": bars.add_task("tracing", total=None)}

        def report(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


def _heading(result: Result) -> str:
    study = result.study
    return (
        f"{study.path.name}: method {study.method.name}, engine {study.engine.name}, seed {study.method.seed}"
    )


def _links(result: Result, enclosed: Enclosed) -> str:
    count = summary(result, enclosed)
    censored = result.study.objective.no_path == "censor"
    verdict = f"counted as lost at {result.study.objective.ceiling_db:g} dB" if censored else "left out"
    rows = [
        ("calibrated on", str(count["calibrated_on"]), ""),
        ("held out", str(count["held_out"]), ""),
        *_suspects(count["rows_without_path"], f", {verdict}", enclosed),
    ]
    return render_table(("Links", ">", ""), rows)


def _suspects(
    without_path: Sequence[int], verdict: str, enclosed: Enclosed
) -> Iterator[tuple[str, str, str]]:
    lost = rows_text(without_path)
    yield "without a path", str(len(without_path)), lost + verdict if lost else ""
    for end, rows in (("transmitter", enclosed.tx), ("receiver", enclosed.rx)):
        if enclosed.indoors:
            remedy = "as most are: taken for an indoor scene"
        else:
            remedy = f"{rows_text(rows)}: check the positions" if rows else ""
        yield f"{end} inside a building", str(len(rows)), remedy if rows else ""


def _parameters(result: Result) -> str:
    rows = []
    for name, after in result.parameters.items():
        unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
        label = name if unit == "1" else f"{name} [{unit}]"
        before, interval = result.initial_parameters[name], result.intervals.get(name)
        ends = (
            (f"{interval.lower:.4g} to {interval.upper:.4g}", interval.verdict)
            if interval
            else ("-", "not known")
        )
        rows.append((label, f"{before:.4g}", f"{after:.4g}", *ends))
    return render_table(("Parameters", ">before", ">after", ">95 % interval", "verdict"), rows)


def _offsets(result: Result) -> str:
    rows = [(name or "all links", f"{value:+.2f}") for name, value in result.offsets_db.items()]
    return render_table(("Offsets", ">[dB]"), rows) if rows else ""


def _accuracy(result: Result) -> str:
    rows = [
        ("before", result.initial_rmse_db, result.initial_holdout_rmse_db),
        ("offset only", result.offset_only_rmse_db, result.offset_only_holdout_rmse_db),
        ("after", result.rmse_db, result.holdout_rmse_db),
        ("log-distance model", result.log_distance_rmse_db, result.log_distance_holdout_rmse_db),
    ]
    shown = [(name, _decibels(fit), _decibels(held)) for name, fit, held in rows if fit is not None]
    return render_table(("RMSE [dB]", ">calibrated on", ">held out"), shown)


def _costs(result: Result) -> str:
    rows = [
        ("RT calls", f"{result.rt_calls:,}"),
        *([("answered by the ledger", f"{result.ledger_hits:,}")] if result.ledger_hits else []),
        *(
            []
            if result.retrace_gap_db is None
            else [("change on tracing again", f"{result.retrace_gap_db:.2f} dB")]
        ),
        ("tracing", f"{result.trace_seconds:.1f} s"),
        ("calibrating", f"{result.seconds:.1f} s"),
    ]
    return render_table(("Cost", ">"), rows)


def _decibels(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def calls_table(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """RT calls for `render_table`.

    Args:
        table: A ledger's table, without the columns of links.

    Returns:
        The headings and the rows; of a message only the first line.
    """
    message = table.message.str.split("\n").str[0]
    columns = [name for name in table.columns if name != "message"]
    numbers = [name for name in columns if pd.api.types.is_numeric_dtype(table[name])]
    rows = [
        [f"{value:.6g}" if name in numbers else str(value) for name, value in zip(columns, row, strict=True)]
        for row in table[columns].itertuples(index=False)
    ]
    headings = [f">{name}" if name in numbers else name for name in columns]
    return [*headings, "message"], [[*row, text] for row, text in zip(rows, message, strict=True)]


def render_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as plain text.

    Args:
        header: Headings; one that begins with ">" stands over a column aligned to the right.
        rows: Cells of every row.

    Returns:
        Lines of text, without a line break at the end.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for heading in header:
        table.add_column(
            heading.removeprefix(">"), justify="right" if heading.startswith(">") else "left", no_wrap=True
        )
    for row in rows:
        table.add_row(*row)
    # As wide as it needs to be: output is for files and pipes as much as for a screen.
    text = Console(file=StringIO(), width=1000, markup=False, highlight=False, color_system=None)
    text.print(table)
    return "\n".join(line.rstrip() for line in text.file.getvalue().splitlines())
