"""`calibray predict`: path loss at new links."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibray.cli.console import AllowChangedInputs, Overwrite, Scheduler, Workers, log
from calibray.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

PREDICTED: Final = ("path_loss_db", "lower_db", "upper_db")
"""The columns that `predict` adds, all but the first with --level alone; others tell what was measured."""

UNREACHED: Final = "no path leads to"
"""What is to be said of links without a path."""

SAID: Final = ("basis", "remark")
"""Columns of words, with --level."""


def predict(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder that `calibray run` wrote.", show_default=False)
    ],
    links_file: Annotated[
        Path,
        typer.Argument(
            metavar="LINKS",
            help="CSV or Parquet file with the columns that the study names for positions, or tx_x, tx_y, tx_z, rx_x, "
            "rx_y, rx_z [m], and its group column if its offset has one; its frequency column, if it has one, gives "
            "the carriers.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="CSV or Parquet file to write instead of CSV on stdout."
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Add the interval that a measurement would lie in with this probability, as 0.9: columns lower_db, "
            "upper_db and basis, and a remark on places where no antenna should be.",
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    allow_changed_inputs: AllowChangedInputs = False,
    overwrite: Overwrite = False,
) -> None:
    """Predict path loss at new links with the calibrated scene."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        import numpy as np
        import pandas as pd

        from calibray.calibration.result import Result
        from calibray.engines import open_workers
        from calibray.measurements import PiecedTable
        from calibray.prediction.batches import predict_batches
        from calibray.prediction.predict import as_links, as_measured
        from calibray.support.output_files import check_table, growing_table

        result = Result.load(folder, allow_changed_inputs=allow_changed_inputs)
        study, table = result.study, PiecedTable.open(links_file)
        first = as_links(result, next(table.pieces(1)))
        names = PREDICTED[: 1 if level is None else None]
        own = as_measured(study, first, pd.DataFrame(np.nan, index=[0], columns=list(names)))
        _refuse_columns(links_file, first.frame, (*names, *own, *(() if level is None else SAID)))
        if out is not None:
            check_table(out, [links_file, *study.files()], overwrite)
        odd: dict[str, array[int]] = {}
        with (
            open_workers(workers, scheduler) as pool,
            _printed() if out is None else growing_table(out) as append,
        ):
            for links, told in predict_batches(
                result, table, level, progress, pool, allow_changed_inputs=allow_changed_inputs
            ):
                own = as_measured(study, links, told)
                columns = {
                    name: told[name].to_numpy() for name in (*names, *(() if level is None else ("basis",)))
                }
                columns |= own | ({} if level is None else {"remark": told["remark"].to_numpy()})
                append(links.frame.assign(**columns))
                _note(odd, links.row, told)
    for what in sorted(odd, key=lambda each: (each != UNREACHED, each)):
        _warn(what if what == UNREACHED else f"{what}:", odd[what], table.rows)


@contextmanager
def _printed() -> Iterator[Callable[[pd.DataFrame], None]]:
    """What prints rows as CSV, the header before the first."""
    header = True

    def append(table: pd.DataFrame) -> None:
        nonlocal header
        typer.echo(table.to_csv(index=False, header=header), nl=False)
        header = False

    yield append


def _note(odd: dict[str, array[int]], row: NDArray[np.int64], told: pd.DataFrame) -> None:
    """Add the rows of which something is to be said, by what is to be said."""
    said: dict[str, list[int]] = {UNREACHED: row[~(told["path_loss_db"].to_numpy() < float("inf"))].tolist()}
    for number, remark in zip(row.tolist(), told["remark"].tolist(), strict=True):
        for part in filter(None, remark.split(", ")):
            said.setdefault(part, []).append(number)
    for what, rows in said.items():
        # Eight bytes a row, of a million rows as many megabytes.
        odd.setdefault(what, array("q")).extend(rows)


def _warn(what: str, rows: Sequence[int], count: int) -> None:
    """Say of which rows something is to be said, if of any."""
    from calibray.tables.text import rows_text

    if rows:
        typer.echo(f"Warning: {what} {len(rows)} of {count} links, {rows_text(rows)}", err=True)


def _refuse_columns(file: Path, frame: pd.DataFrame, columns: tuple[str, ...]) -> None:
    """Refuse a table that has a column of predictions already."""
    for name in columns:
        if name in frame:
            raise InputError(f"{file}: has a column {name!r} already; rename or remove it")
