"""`calibray predict`: path loss at links that were never measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibray.cli.console import Anyway, Overwrite, log
from calibray.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

PREDICTED: Final = ("path_loss_db", "lower_db", "upper_db", "basis")
"""The columns that `predict` adds, all but the first with --level alone."""


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
            "upper_db and basis.",
        ),
    ] = None,
    anyway: Anyway = False,
    overwrite: Overwrite = False,
) -> None:
    """Predict path loss at links that were never measured, with the calibrated scene."""
    import numpy as np

    from calibray.cli.progress import progress_bars
    from calibray.files import check_table, write_table
    from calibray.inference.prediction import as_links
    from calibray.result import Result
    from calibray.tables.text import rows_text

    result = Result.load(folder, anyway=anyway)
    study = result.study
    links = as_links(result, links_file)
    _refuse_columns(links_file, links.frame, PREDICTED[: 1 if level is None else None])
    if out is not None:
        check_table(out, [links_file, *study.files()], overwrite)
    with progress_bars(log) as progress:
        if level is None:
            table = links.frame.assign(**{PREDICTED[0]: result.predict(links, progress, anyway=anyway)})
        else:
            found = result.predict_interval(links, level, progress, anyway=anyway)
            table = links.frame.assign(**{name: found[name].to_numpy() for name in PREDICTED})
    if out is None:
        typer.echo(table.to_csv(index=False), nl=False)
    else:
        write_table(out, table)
    lost = links.row[np.isinf(table[PREDICTED[0]].to_numpy())].tolist()
    if lost:
        typer.echo(
            f"Warning: no path leads to {len(lost)} of {len(links)} links, {rows_text(lost)}",
            err=True,
        )


def _refuse_columns(file: Path, frame: pd.DataFrame, columns: tuple[str, ...]) -> None:
    """Refuse a table that has a column of predictions already."""
    for name in columns:
        if name in frame:
            raise InputError(f"{file}: has a column {name!r} already; rename or remove it")
