"""`calibray init`: a study drafted from a scene and a table of links."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import log
from calibray.errors import InputError


def init(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Mitsuba XML file, or sionna:NAME.", show_default=False)
    ],
    links: Annotated[
        Path,
        typer.Argument(
            metavar="LINKS", help="Table of measured links: CSV, Parquet or Excel.", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Study file to write; never replaced.")
    ] = Path("study.toml"),
    transmitters: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table of the transmitters' positions.")
    ] = None,
    track: Annotated[
        Path | None, typer.Option(metavar="FILE", help="GPX track that tells where each row was measured.")
    ] = None,
    tx: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Transmitter position in the scene's frame [m].")
    ] = None,
    frequency: Annotated[float | None, typer.Option(metavar="HZ", help="Carrier frequency [Hz].")] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the antennas over the scene: .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Look at a scene and a table of links, tell what is assumed and why, and write a study that runs."""
    from calibray.cli.link_warnings import warn
    from calibray.cli.progress_bars import progress_bars
    from calibray.support.output_files import check_file, write_text

    if out.exists() or out.is_symlink():
        raise InputError(f"{out}: is there already; name another file with --out, or remove it")
    inputs = [links, *(file for file in (transmitters, track) if file)]
    check_file(out, inputs)
    with progress_bars(log()) as progress:
        from calibray.reporting.scene_tables import assumed, save_positions
        from calibray.study.draft import draft
        from calibray.study.draft_text import SCHEMA_FILE
        from calibray.study.schema import schema_text
        from calibray.tables.text import render

        progress("looking at scene and links", 0, None)
        found = draft(
            scene, links, out, transmitters, frequency, None if tx is None else _position(tx), track
        )
        measured = found.study.measurements()
    typer.echo(render(assumed(found)))
    counts = [f"{number} {what}" for what, number in measured.prepared.items()]
    typer.echo("\n" + ", ".join([f"{len(measured)} links", *counts]))
    with progress_bars(log()) as progress:
        progress("checking positions", 0, None)
        warn(found.study, measured)
        if plot is not None:
            save_positions(plot, found.study.scene_source, measured.tx, measured.rx, inputs)
    if plot is not None:
        typer.echo(f"Written to {plot}", err=True)
    schema = out.parent / SCHEMA_FILE
    if not schema.exists():
        write_text(schema, schema_text())
    write_text(out, found.text)
    typer.echo(f"Written to {out}; next: calibray run {out} --out result", err=True)


def _position(text: str) -> list[float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--tx {text}: must be x, y and z in metres, 0,0,2.5") from None
    return [x, y, z]
