"""Warnings about a study's links, before anything is traced."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.measurements import Measurements
    from calibray.study import Study


def warn(study: Study, links: Measurements) -> None:
    """Print what is suspicious about links to stderr.

    Args:
        study: The study.
        links: Its links.

    Raises:
        InputError: The links have nothing to do with the scene, or the scene cannot be read.
    """
    from importlib.util import find_spec

    from calibray.reporting.scene_tables import warned
    from calibray.study.link_checks import examine

    if missing := [name for name in ("shapely", "trimesh") if find_spec(name) is None]:
        typer.echo(
            f"Positions were not checked against the scene: {missing[0]} is missing, pip install 'calibray[scenes]'",
            err=True,
        )
        return
    try:
        found = examine(study, links)
    except InputError:
        # An external program may read the scene's file in its own way.
        if study.engine.external:
            return
        raise
    if found:
        typer.echo(warned(found), err=True)
