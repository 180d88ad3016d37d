"""`calibray cache`: the traces kept between runs."""

from __future__ import annotations

from typing import Annotated

import typer


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all traces that are kept.")] = False,
) -> None:
    """Tell where traces are kept between runs and how large they are, or remove them.

    The folder is named by CALIBRAY_CACHE; where that is empty, none are kept.
    """
    from calibray.tables import Column, Table, numbers
    from calibray.tables.text import render
    from calibray.tracing import cache as traces

    folder, kept = traces.folder(), traces.kept()
    size = sum(path.stat().st_size for path in kept)
    if clear:
        for path in kept:
            path.unlink(missing_ok=True)
        typer.echo(f"Removed {len(kept)} traces, {size / 1e6:.1f} MB", err=True)
        return
    rows = [
        ("folder", "none: CALIBRAY_CACHE is empty" if folder is None else str(folder)),
        ("traces", str(len(kept))),
        ("size", f"{size / 1e6:.1f} MB"),
    ]
    typer.echo(render(Table("", (Column(), numbers()), tuple(rows))))
