"""`calibray run`: calibrate a study."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, StudyFile, log

if TYPE_CHECKING:
    from calibray.calibration.result import Result


def run(
    study_file: StudyFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write the result into.")],
    method: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Method in place of the study's: auto, sgwo-im, gwo, ..."),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed in place of the study's.")] = None,
    engine: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Engine in place of the study's: replay, retrace or command."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Processes here that blocks of links are shared out to, or programs of the engine 'command' at once.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler whose workers take blocks of links, or run the engine 'command'.",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON instead of tables.")
    ] = False,
    overwrite: Overwrite = False,
    figures: Annotated[
        bool, typer.Option("--figures", help="Write the report's figures as well, as SVG and PNG.")
    ] = False,
) -> None:
    """Calibrate a study's materials, print the result, and write it with the calibrated scene and a report."""
    from calibray.cli.progress_bars import progress_bars

    try:
        # Loading libraries, tables and the scene takes seconds too.
        with progress_bars(log()) as progress:
            from calibray.calibration.calibrate import calibrate
            from calibray.cli.link_warnings import warn
            from calibray.engines import open_workers
            from calibray.fitting.methods import check_method
            from calibray.reporting import result_tables as tables
            from calibray.result import FILES
            from calibray.study import Study
            from calibray.support.output_files import check_outputs
            from calibray.tables.text import render

            study = Study.load(study_file).replace(method, seed, engine)
            check_method(study.method.name)
            check_outputs(out, FILES, study.files(), overwrite)
            setup = study.opened()
            warn(study, setup.links)
            with open_workers(workers, scheduler) as pool:
                result = calibrate(setup, out=out, workers=pool, progress=progress, overwrite=overwrite)
    except KeyboardInterrupt:
        typer.echo(_kept(out), err=True)
        raise
    if as_json:
        typer.echo(json.dumps(result.content(), indent=2))
    else:
        typer.echo(render(tables.heading(result), *tables.tables(result)))
    written = [*FILES, *_reported(result, out, figures, overwrite)]
    typer.echo(f"Written to {out}: {', '.join(written)}", err=True)


def _kept(out: Path) -> str:
    """What an interrupted run left, and how to go on."""
    from contextlib import closing

    from calibray.engines import open_ledger
    from calibray.engines.ledger.ledger import LEDGER_FILE
    from calibray.support import cache_folder as caching
    from calibray.tracing import cache

    parts = []
    if (out / LEDGER_FILE).is_file():
        with closing(open_ledger(out)) as ledger:
            parts.append(f"{len(ledger.table())} RT calls in {out / LEDGER_FILE}")
    if cache.stored_traces():
        parts.append(f"finished traces in {caching.cache_folder()}")
    kept = f"Kept: {' and '.join(parts)}." if parts else "Nothing was finished that could be kept."
    return f"{kept} Start the same command again to go on; what is kept is not computed twice."


def _reported(result: Result, out: Path, figures: bool, overwrite: bool) -> list[str]:
    """Write the report beside a result that is safe by now: what goes wrong here is told, and loses nothing."""
    from calibray.cli.progress_bars import progress_bars

    try:
        from calibray.reporting import page

        folder = out / page.FIGURES if figures else None
        with progress_bars(log()) as progress:
            page.report(result, out / page.FILE, figures=folder, overwrite=overwrite, progress=progress)
    except Exception as error:
        typer.echo(f"Warning: no report ({error}); try again with: calibray report {out}", err=True)
        return []
    return [page.FILE, *([f"{page.FIGURES}/"] if figures else [])]
