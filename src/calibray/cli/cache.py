"""`calibray cache`: what is kept between runs."""

from __future__ import annotations

from typing import Annotated

import typer


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all that is kept.")] = False,
) -> None:
    """Say where traces and compiled programs are kept between runs, or remove them.

    The folder is named by CALIBRAY_CACHE; where that is empty, none are kept.
    """
    from calibray.support import cache_folder as caching
    from calibray.support.cache_folder import compiled_programs
    from calibray.tables import Column, Table, numbers
    from calibray.tables.text import render
    from calibray.tracing import cache as traces

    folder, programs = caching.cache_folder(), compiled_programs()
    kept = {
        "traces": traces.stored_traces(),
        "compiled programs": [] if programs is None else programs.entries(),
    }
    size = {name: sum(path.stat().st_size for path in paths) / 1e6 for name, paths in kept.items()}
    if clear:
        for path in (path for paths in kept.values() for path in paths):
            path.unlink(missing_ok=True)
        told = ", ".join(f"{len(paths)} {name}" for name, paths in kept.items())
        typer.echo(f"Removed {told}, {sum(size.values()):.1f} MB", err=True)
        return
    rows = [
        ("folder", "none: CALIBRAY_CACHE is empty" if folder is None else str(folder)),
        *((name, f"{len(paths)}, {size[name]:.1f} MB") for name, paths in kept.items()),
    ]
    typer.echo(render(Table("", (Column(), numbers()), tuple(rows))))
