"""`calibray doctor`, `cache` and `ledger`: check this machine or a scene, and manage the files kept between runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, echo, log, option, progress_bars
from calibray.errors import InputError
from calibray.support.messages import counted

if TYPE_CHECKING:
    import pandas as pd

    from calibray.study import Study
    from calibray.tables import Table


def doctor(
    subject: Annotated[
        str | None,
        typer.Argument(
            metavar="SUBJECT",
            help="A scene (FILE.xml or sionna:NAME) or a study file; by default, the command checks this machine.",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None, option("FILE", "Draw the study's antennas on a plan of its scene (.png, .svg or .pdf).")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Check whether tracing and replay work on this machine, or whether a scene can be used."""
    if subject is None:
        if plot is not None:
            raise InputError("--plot draws the antennas of a study; name the study file")
        _machine()
    else:
        _scene(subject, plot, overwrite)


def _machine() -> None:
    """Check the machine."""
    from calibray.doctor import examine
    from calibray.tables import render

    with progress_bars(log()) as progress:
        progress("checking Dr.Jit, Sionna RT and JAX", 0, None)
        diagnosis = examine()
    echo(render(diagnosis.table()))
    if not diagnosis.usable:
        raise typer.Exit(1)


def _scene(subject: str, plot: Path | None, overwrite: bool) -> None:
    """Check a scene, or the scene of a study."""
    with progress_bars(log()) as progress:
        from calibray.reporting import scene_tables
        from calibray.scenes.checks import check_scene
        from calibray.study import Study
        from calibray.tables import render

        study = Study.load(subject) if subject.lower().endswith(".toml") else None
        if plot is not None and study is None:
            raise InputError(
                f"--plot draws the antennas of a study, but {subject} is a scene; name a study file"
            )
        source = subject if study is None else study.scene_source
        check = check_scene(source, progress)
    echo(render(*scene_tables.findings(check), scene_tables.objects(check)))
    if plot is not None and study is not None:
        _draw(study, plot, overwrite)
    if any(finding.severity == "error" for finding in check.findings):
        raise typer.Exit(1)


def _draw(study: Study, plot: Path, overwrite: bool) -> None:
    """Draw a study's antennas on a plan of its scene."""
    from calibray.reporting.link_map import save_positions

    links = study.measurements()
    save_positions(plot, study.scene_source, links.tx, links.rx, study.files(), overwrite)
    echo(f"Written to {plot}", err=True)


def cache(clear: Annotated[bool, typer.Option("--clear", help="Remove all cached files.")] = False) -> None:
    """Show the folder in which traces and compiled programs are kept between runs, or remove these files.

    The environment variable CALIBRAY_CACHE sets the cache folder. If this variable is set but empty, Calibray caches
    nothing.
    """
    from calibray.support.cache_folder import cache_folder, compiled_programs
    from calibray.tables import Column, Table, numbers, render
    from calibray.tracing.cache import stored_traces

    folder, programs = cache_folder(), compiled_programs()
    kept = {"trace": stored_traces(), "compiled program": [] if programs is None else programs.entries()}
    size = {name: sum(path.stat().st_size for path in paths) / 1e6 for name, paths in kept.items()}
    if clear:
        for path in (path for paths in kept.values() for path in paths):
            path.unlink(missing_ok=True)
        removed = ", ".join(counted(len(paths), name) for name, paths in kept.items())
        echo(f"Removed {removed}, {sum(size.values()):.1f} MB", err=True)
        return
    rows = [
        ("folder", "none: CALIBRAY_CACHE is empty" if folder is None else str(folder)),
        *((f"{name}s", f"{len(paths)}, {size[name]:.1f} MB") for name, paths in kept.items()),
    ]
    echo(render(Table("", (Column(), numbers()), tuple(rows))))


def ledger(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `calibray run` writes into.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        option("FILE", "Write a CSV or Parquet file with the path loss of every link.", "--out", "-o"),
    ] = None,
    forget_failed: Annotated[
        bool, typer.Option("--forget-failed", help="Remove failed calls, so that the next run repeats them.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """List or export the RT calls of a ledger, or remove failed calls."""
    from contextlib import closing

    from calibray.engines import open_ledger
    from calibray.support.output_files import check_table, write_table
    from calibray.tables import render

    if out is not None:
        check_table(out, (), overwrite)
    with closing(open_ledger(folder)) as store:
        if forget_failed:
            echo(f"Removed {counted(store.forget_failures(), 'failed call')}", err=True)
        table = store.table(path_loss=out is not None)
    if out is not None:
        write_table(out, table)
        echo(f"Written to {out}: {counted(len(table), 'call')}", err=True)
    else:
        echo(render(calls_table(table)))


def calls_table(frame: pd.DataFrame) -> Table:
    """Tabulate the RT calls of a ledger, one row per call; the last column is the first line of the call's message."""
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
