"""`calibray demo`: the paper's experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, log


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write figures and result into.")
    ] = Path("out/demo"),
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="replay (trace once), or retrace: run the ray tracer for every candidate, as the paper does.",
        ),
    ] = "replay",
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the methods.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Run the paper's experiment in the embedded district, and space mapping and auto beside it: tables and figures."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.comparison.demo_files import FIGURES, write
        from calibray.comparison.experiment import run_demo
        from calibray.comparison.paper_tables import tables
        from calibray.support.output_files import check_outputs
        from calibray.tables.text import render

        check_outputs(out, ["result.json", *FIGURES], (), overwrite)
        finished = run_demo(engine, seed, progress)
        progress("writing", 0, None)
        write(finished, out)
    typer.echo(render(*tables(finished)) + "\n")
    typer.echo(f"Written to {out}: result.json, {', '.join(FIGURES)}, and a folder for each method", err=True)
