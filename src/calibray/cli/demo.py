"""`calibray demo`: run the experiment of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import Overwrite, echo, log


def demo(
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Folder for tables, figures, results and the report."
        ),
    ] = Path("out/demo"),
    engine: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="replay (trace once) or retrace (run the ray tracer for every candidate, as in the paper).",
        ),
    ] = "replay",
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the methods.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Run the experiment of the paper in the demo district: tables, figures and a report."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.comparison.demo import FILES, run_demo, write_demo
        from calibray.support.output_files import check_outputs
        from calibray.tables.text import render

        check_outputs(out, FILES, (), overwrite)
        finished = run_demo(engine, seed, progress)
        progress("writing", 0, None)
        page = write_demo(finished, out)
    echo(render(*finished.tables()) + "\n")
    echo(f"Written to {out}: {', '.join(FILES)}, and a folder for each method", err=True)
    echo(f"Report: {page}")
