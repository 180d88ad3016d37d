"""Paths in a few lines, for a screen and for a notebook."""

from __future__ import annotations

from dataclasses import fields
from html import escape
from textwrap import shorten
from typing import TYPE_CHECKING, Final

import numpy as np

from calibray.paths.interactions import Kind

if TYPE_CHECKING:
    from calibray.paths.program import Paths

WIDTH: Final = 80
"""Longest line, in characters."""


def summary(paths: Paths) -> dict[str, str]:
    """What matters of traced paths, in words.

    Args:
        paths: The path program.

    Returns:
        Texts by heading.
    """
    lost = len(paths.links_without_path)
    found = np.bincount(paths.kind, minlength=max(Kind) + 1)
    kinds = [f"{found[kind]:,} {kind.name.lower()}" for kind in Kind if found[kind]]
    sizes = [
        value.nbytes
        for record in (paths, paths.diffuse, paths.diffraction)
        for entry in fields(record)
        if isinstance(value := getattr(record, entry.name), np.ndarray)
    ]
    return {
        "links": f"{paths.num_links:,}" + (f", {lost:,} of them without a path" if lost else ""),
        "paths": f"{paths.num_paths:,}",
        "interactions": f"{paths.num_interactions:,}" + (f": {', '.join(kinds)}" if kinds else ""),
        "materials": f"{len(paths.materials)}: {', '.join(paths.materials)}",
        "frequency": f"{paths.frequency / 1e9:g} GHz",
        "memory": _size(sum(sizes)),
    }


def as_text(paths: Paths) -> str:
    """Paths as a few lines of text.

    Args:
        paths: The path program.

    Returns:
        A line for each heading of `summary`, cut to 80 characters.
    """
    rows = (f"  {name:<13}{shorten(text, WIDTH - 15)}" for name, text in summary(paths).items())
    return "\n".join(["Paths", *rows])


def as_html(paths: Paths) -> str:
    """Paths as a table for a notebook.

    Args:
        paths: The path program.

    Returns:
        HTML.
    """
    rows = (
        f"<tr><th style='text-align:left'>{name}</th><td style='text-align:left'>{escape(text)}</td></tr>"
        for name, text in summary(paths).items()
    )
    return f"<table><caption>Paths</caption>{''.join(rows)}</table>"


def _size(count: int) -> str:
    """A number of bytes in the unit that suits it.

    Example:
        >>> _size(512), _size(3_500_000)
        ('512 B', '3.3 MiB')
    """
    if count < 1024:
        return f"{count} B"
    power = min(int(np.log2(count) // 10), 4)
    return f"{count / 1024**power:.1f} {('KiB', 'MiB', 'GiB', 'TiB')[power - 1]}"
