"""`calibray ledger`: the RT calls that were paid for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite


def ledger(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `calibray run` writes into.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="CSV or Parquet file to write, with every link's path loss."
        ),
    ] = None,
    forget_failed: Annotated[
        bool, typer.Option("--forget-failed", help="Take out failed calls, so that they are run again.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """List or export the RT calls that were paid for."""
    from contextlib import closing

    from calibray.engines import open_ledger
    from calibray.reporting.ledger_table import calls
    from calibray.support.output_files import check_table, write_table
    from calibray.tables.text import render

    if out is not None:
        check_table(out, (), overwrite)
    with closing(open_ledger(folder)) as store:
        if forget_failed:
            typer.echo(f"Taken out: {store.forget_failures()} failed calls", err=True)
        table = store.table(path_loss=out is not None)
    if out is not None:
        write_table(out, table)
        typer.echo(f"Written to {out}: {len(table)} calls", err=True)
    else:
        typer.echo(render(calls(table)))
