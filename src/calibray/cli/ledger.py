"""`calibray ledger`: list, export or clean up the RT calls of a ledger."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, echo

if TYPE_CHECKING:
    import pandas as pd

    from calibray.tables import Table


def ledger(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `calibray run` writes into.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="Write a CSV or Parquet file with every link's path loss."
        ),
    ] = None,
    forget_failed: Annotated[
        bool, typer.Option("--forget-failed", help="Remove failed calls, so that they run again.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """List or export the RT calls of a ledger, or remove failed ones."""
    from contextlib import closing

    from calibray.engines import open_ledger
    from calibray.support.output_tables import check_table, write_table
    from calibray.tables import render

    if out is not None:
        check_table(out, (), overwrite)
    with closing(open_ledger(folder)) as store:
        if forget_failed:
            echo(f"Removed {store.forget_failures()} failed calls", err=True)
        table = store.table(path_loss=out is not None)
    if out is not None:
        write_table(out, table)
        echo(f"Written to {out}: {len(table)} calls", err=True)
    else:
        echo(render(calls_table(table)))


def calls_table(frame: pd.DataFrame) -> Table:
    """The RT calls of a ledger, one row per call; the last column is the first line of its message."""
    from pandas.api.types import is_numeric_dtype

    from calibray.tables import Column, Table, numbers

    names = [name for name in frame.columns if name != "message"]
    numeric = [is_numeric_dtype(frame[name]) for name in names]
    columns = [numbers(name) if number else Column(name) for name, number in zip(names, numeric, strict=True)]
    rows = tuple(
        (
            *(f"{value:.6g}" if number else str(value) for value, number in zip(row, numeric, strict=True)),
            message.partition("\n")[0],
        )
        for row, message in zip(frame[names].itertuples(index=False), frame["message"], strict=True)
    )
    return Table("", (*columns, Column("message")), rows)
