"""`calibray open`: a window on a study's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibray.cli.console import echo
from calibray.errors import InputError


def open(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Folder of the study; it is created if it does not exist."),
    ] = Path(),
    port: Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Port; 0 for a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
) -> None:
    """Open a study's folder in the browser, from a map and measurements to predictions without a terminal.

    The page is served on this machine only, at an address with a token. Ctrl-C ends the server, but not commands in
    progress.

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
