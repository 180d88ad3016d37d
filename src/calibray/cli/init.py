"""`calibray init`, `schema` and `open`: draft a study, print the schema of studies, open a study's folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import echo, log, option, progress_bars, read_origin, warn, with_groups
from calibray.errors import InputError
from calibray.support.messages import command, counted


@dataclass(frozen=True)
class Known:
    """Options for values that are missing from the table of links."""

    transmitters: Annotated[Path | None, option("FILE", "Table of transmitter positions.")] = None
    track: Annotated[
        Path | None,
        option("FILE", "GPX track from which each row takes its position, according to the time in the row."),
    ] = None
    antennas: Annotated[
        Path | None, option("DIR", "Folder of MSI files that are named after the antennas.")
    ] = None
    tx: Annotated[str | None, option("X,Y,Z", "Transmitter position in the scene frame [m].")] = None
    frequency: Annotated[float | None, option("HZ", "Carrier frequency [Hz].")] = None
    origin: Annotated[
        str | None,
        option(
            "LON,LAT",
            "Origin of the scene frame [deg]; needed only if the scene file does not state the origin.",
        ),
    ] = None


@with_groups
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
        Path, option("FILE", "Study file to write; an existing file is never replaced.", "--out", "-o")
    ] = Path("study.toml"),
    *,
    known: Known,
    plot: Annotated[
        Path | None, option("FILE", "Draw the antennas on a plan of the scene (.png, .svg or .pdf).")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a plot that Calibray did not write.")
    ] = False,
) -> None:
    """Draft a study from a scene and a table of links, and list the assumptions made, with the reasons."""
    from calibray.support.output_files import check_file, write_text

    if out.exists() or out.is_symlink():
        raise InputError(f"{out}: already exists; choose another file with --out, or remove it")
    inputs = [links, *(file for file in (known.transmitters, known.track) if file)]
    check_file(out, inputs)
    with progress_bars(log()) as progress:
        from calibray.materials import check_frequency
        from calibray.reporting.link_map import save_positions
        from calibray.reporting.scene_tables import assumptions, warning_lines
        from calibray.study.draft import Given, schema_text
        from calibray.study.draft import draft as draft_study
        from calibray.study.link_checks import count_unknowns
        from calibray.study.toml_file import SCHEMA_FILE
        from calibray.tables import render

        progress("reading scene and links", 0, None)
        tx = None if known.tx is None else _position(known.tx)
        origin = None if known.origin is None else read_origin(known.origin)
        if known.frequency is not None:
            check_frequency(known.frequency, "--frequency")
        given = Given(known.transmitters, known.track, known.antennas, tx, known.frequency, origin)
        draft = draft_study(scene, links, out, given)
        measured = draft.study.measurements()
    echo(render(assumptions(draft)))
    counts = [f"{number} {cause}" for cause, number in measured.prepared.items()]
    echo("\n" + ", ".join([counted(len(measured), "link"), *counts]))
    with progress_bars(log()) as progress:
        progress("checking positions", 0, None)
        warn(draft.study, measured)
        if findings := count_unknowns(draft.study, measured):
            echo(warning_lines(findings), err=True)
        if plot is not None:
            save_positions(plot, draft.study.scene_source, measured.tx, measured.rx, inputs, overwrite)
    if plot is not None:
        echo(f"Written to {plot}", err=True)
    schema = out.parent / SCHEMA_FILE
    if not schema.exists():
        write_text(schema, schema_text())
    write_text(out, draft.text)
    echo(f"Written to {out}; next: {command('run', out, '--out', 'result')}", err=True)


def _position(text: str) -> list[float]:
    from calibray.scenes.meshes import LARGEST_COORDINATE

    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--tx {text}: must be x, y and z in metres, such as 0,0,2.5") from None
    if not all(abs(value) <= LARGEST_COORDINATE for value in (x, y, z)):
        raise InputError(
            f"--tx {text}: must be within {LARGEST_COORDINATE:g} m; give metres in the scene frame"
        )
    return [x, y, z]


def schema() -> None:
    """Print the JSON schema of study files; editors use the schema to complete and check them."""
    from calibray.study.draft import schema_text

    echo(schema_text(), nl=False)


def open(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of the study; it is created if it does not exist."),
    ] = Path(),
    port: Annotated[int, option("N", "Port; 0 for a free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
) -> None:
    """Work on a study in the browser instead of a terminal, from a map and measurements to predictions.

    The page is served only on this machine, at an address that contains a secret token. Ctrl-C ends the server, but not
    commands in progress.

    Raises:
        InputError: NiceGUI is not installed, or the folder or the port cannot be used.
    """
    import webbrowser
    from importlib.util import find_spec

    from calibray.support.output_files import check_folder

    if find_spec("nicegui") is None:
        raise InputError("nicegui is not installed; run pip install 'calibray[window]'")
    check_folder(folder).mkdir(parents=True, exist_ok=True)

    from calibray.window.server import serve

    def opened(address: str) -> None:
        echo(address)
        if not no_browser:
            webbrowser.open(address)

    serve(folder.resolve(), port, opened)
