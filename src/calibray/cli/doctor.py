"""`calibray doctor`: whether this machine can trace and replay, and whether a scene or a study is sound."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibray.cli.console import Overwrite, log
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.study import Study


def doctor(
    subject: Annotated[
        str | None,
        typer.Argument(
            metavar="SUBJECT",
            help="A scene, as FILE.xml or sionna:NAME, or a study file; without it this machine is examined.",
            show_default=False,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the study's antennas over its scene: .png, .svg or .pdf."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Tell whether tracing and replay work on this machine; or what is wrong with a scene, or with a study's links."""
    if subject is None:
        if plot is not None:
            raise InputError("--plot: needs a study whose antennas are drawn; name its file")
        _machine()
    else:
        _scene(subject, plot, overwrite)


def _machine() -> None:
    """Examine the machine."""
    from calibray.cli.progress_bars import progress_bars
    from calibray.doctor import examine
    from calibray.reporting.doctor_table import table
    from calibray.tables.text import render

    with progress_bars(log()) as progress:
        progress("trying Dr.Jit, Sionna RT and JAX", 0, None)
        diagnosis = examine()
    typer.echo(render(table(diagnosis)))
    if not diagnosis.usable:
        raise typer.Exit(1)


def _scene(subject: str, plot: Path | None, overwrite: bool) -> None:
    """Examine a scene, or a study's scene with its antennas."""
    from calibray.cli.progress_bars import progress_bars

    with progress_bars(log()) as progress:
        from calibray.reporting import scene_tables as report
        from calibray.scenes.checks import check_scene
        from calibray.study import Study
        from calibray.tables.text import render

        study = Study.load(subject) if subject.lower().endswith(".toml") else None
        if plot is not None and study is None:
            raise InputError(f"--plot: {subject} is a scene, whose antennas are not known; name a study file")
        source = subject if study is None else study.scene_source
        found = check_scene(source, progress)
    typer.echo(render(*report.diagnosed(found), report.objects(found)))
    if plot is not None and study is not None:
        _draw(study, plot, overwrite)
    if any(finding.severity == "error" for finding in found.findings):
        raise typer.Exit(1)


def _draw(study: Study, plot: Path, overwrite: bool) -> None:
    """Draw a study's antennas over its scene."""
    from calibray.reporting.scene_tables import save_positions

    links = study.measurements()
    save_positions(plot, study.scene_source, links.tx, links.rx, study.files(), overwrite)
    typer.echo(f"Written to {plot}", err=True)
