"""`calibray cache`: traces and compiled programs that are kept between runs."""

from __future__ import annotations

from typing import Annotated

import typer

from calibray.cli.console import echo


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all cached files.")] = False,
) -> None:
    """Show where traces and compiled programs are kept between runs, or remove them.

    The environment variable CALIBRAY_CACHE sets the folder. If it is set but empty, nothing is kept.
    """
    from calibray.support.cache_folder import cache_folder, compiled_programs
    from calibray.tables import Column, Table, numbers
    from calibray.tables.text import render
    from calibray.tracing.cache import stored_traces

    folder, programs = cache_folder(), compiled_programs()
    kept = {
        "traces": stored_traces(),
        "compiled programs": [] if programs is None else programs.entries(),
    }
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
