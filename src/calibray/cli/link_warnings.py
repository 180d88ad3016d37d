"""Warnings about a study's links, before anything is traced."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibray.cli.console import echo
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.measurements import Measurements
    from calibray.study import Study


def warn(study: Study, links: Measurements) -> None:
    """Print warnings about suspicious links to stderr.

    Raises:
        InputError: The links are far from the scene, or the scene cannot be read.
    """
    from importlib.util import find_spec

    from calibray.reporting.scene_tables import warning_lines
    from calibray.study.link_checks import examine

    if missing := [name for name in ("shapely", "trimesh") if find_spec(name) is None]:
        echo(
            f"Positions were not checked against the scene: {missing[0]} is not installed; "
            "run pip install 'calibray[scenes]'",
            err=True,
        )
        return
    try:
        findings = examine(study, links)
    except InputError:
        # An external program may read scene files that Calibray cannot.
        if study.engine.external:
            return
        raise
    if findings:
        echo(warning_lines(findings), err=True)
