"""`calibray predict`: path loss at links that were never measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibray.cli.console import Anyway, Overwrite, Scheduler, Workers, log
from calibray.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

PREDICTED: Final = ("path_loss_db", "lower_db", "upper_db")
"""The columns that `predict` adds, all but the first with --level alone; others tell what was measured."""

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
            help="CSV or Parquet file with the columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m], and the study's "
            "group column if its offset has one; its frequency column, if it has one, gives the carriers.",
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
    anyway: Anyway = False,
    overwrite: Overwrite = False,
) -> None:
    """Predict path loss at links that were never measured, with the calibrated scene."""
    from calibray.cli.progress import progress_bars

    with progress_bars(log()) as progress:
        import numpy as np
        import pandas as pd

        from calibray.engines import open_crew
        from calibray.files import check_table, write_table
        from calibray.inference.prediction import as_links, opened
        from calibray.inference.quantity import as_measured
        from calibray.inference.shared_out import predicted
        from calibray.result import Result

        result = Result.load(folder, anyway=anyway)
        study = result.study
        links = as_links(result, links_file)
        names = PREDICTED[: 1 if level is None else None]
        own = as_measured(study, links, pd.DataFrame(np.nan, index=links.frame.index, columns=list(names)))
        _refuse_columns(links_file, links.frame, (*names, *own, *(() if level is None else SAID)))
        if out is not None:
            check_table(out, [links_file, *study.files()], overwrite)
        setup = opened(result, links, anyway=anyway)
        with open_crew(workers, scheduler) as crew:
            told = predicted(result, setup, level, progress, crew, remarked=True)
        odd = told.remark.to_numpy()
    columns = {name: told[name].to_numpy() for name in (*names, *(() if level is None else ("basis",)))}
    columns |= as_measured(study, links, told) | ({} if level is None else {"remark": odd})
    table = links.frame.assign(**columns)
    if out is None:
        typer.echo(table.to_csv(index=False), nl=False)
    else:
        write_table(out, table)
    _warn("no path leads to", links.row[np.isinf(told["path_loss_db"].to_numpy())].tolist(), len(links))
    parts = [set(filter(None, each.split(", "))) for each in odd.tolist()]
    for part in sorted(set().union(*parts)):
        rows = [row for row, each in zip(links.row.tolist(), parts, strict=True) if part in each]
        _warn(f"{part}:", rows, len(links))


def _warn(what: str, rows: list[int], count: int) -> None:
    """Say of which rows something is to be said, if of any."""
    from calibray.tables.text import rows_text

    if rows:
        typer.echo(f"Warning: {what} {len(rows)} of {count} links, {rows_text(rows)}", err=True)


def _refuse_columns(file: Path, frame: pd.DataFrame, columns: tuple[str, ...]) -> None:
    """Refuse a table that has a column of predictions already."""
    for name in columns:
        if name in frame:
            raise InputError(f"{file}: has a column {name!r} already; rename or remove it")
