"""`calibray doctor`: check this machine, a scene, or the scene of a study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, echo, log
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.study import Study


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
        Path | None,
        typer.Option(metavar="FILE", help="Draw the study's antennas over its scene (.png, .svg or .pdf)."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Check whether tracing and replay work on this machine, or whether a scene can be used."""
    if subject is None:
        if plot is not None:
            raise InputError("--plot draws the antennas of a study: name the study file")
        _machine()
    else:
        _scene(subject, plot, overwrite)


def _machine() -> None:
    """Check the machine."""
    from calibray.cli.progress_bars import progress_bars
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
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.reporting import scene_tables
        from calibray.scenes.checks import check_scene
        from calibray.study import Study
        from calibray.tables import render

        study = Study.load(subject) if subject.lower().endswith(".toml") else None
        if plot is not None and study is None:
            raise InputError(f"--plot draws the antennas of a study: {subject} is a scene, name a study file")
        source = subject if study is None else study.scene_source
        check = check_scene(source, progress)
    echo(render(*scene_tables.findings(check), scene_tables.objects(check)))
    if plot is not None and study is not None:
        _draw(study, plot, overwrite)
    if any(finding.severity == "error" for finding in check.findings):
        raise typer.Exit(1)


def _draw(study: Study, plot: Path, overwrite: bool) -> None:
    """Draw a study's antennas over its scene."""
    from calibray.reporting.position_plot import save_positions

    links = study.measurements()
    save_positions(plot, study.scene_source, links.tx, links.rx, study.files(), overwrite)
    echo(f"Written to {plot}", err=True)


def cache(clear: Annotated[bool, typer.Option("--clear", help="Remove all cached files.")] = False) -> None:
    """Show where traces and compiled programs are kept between runs, or remove them.

    The environment variable CALIBRAY_CACHE sets the folder. If it is set but empty, Calibray caches nothing.
    """
    from calibray.support.cache_folder import cache_folder, compiled_programs
    from calibray.tables import Column, Table, numbers, render
    from calibray.tracing.cache import stored_traces

    folder, programs = cache_folder(), compiled_programs()
    kept = {"traces": stored_traces(), "compiled programs": [] if programs is None else programs.entries()}
    size = {name: sum(path.stat().st_size for path in paths) / 1e6 for name, paths in kept.items()}
    if clear:
        for path in (path for paths in kept.values() for path in paths):
            path.unlink(missing_ok=True)
        removed = ", ".join(f"{len(paths)} {name}" for name, paths in kept.items())
        echo(f"Removed {removed}, {sum(size.values()):.1f} MB", err=True)
        return
    rows = [
        ("folder", "none: CALIBRAY_CACHE is empty" if folder is None else str(folder)),
        *((name, f"{len(paths)}, {size[name]:.1f} MB") for name, paths in kept.items()),
    ]
    echo(render(Table("", (Column(), numbers()), tuple(rows))))
