"""Columns of links that follow from the scene: whether the straight line is blocked, by how much, and how."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.constants import speed_of_light

from calibray.measurements import Measurements
from calibray.scenes import Scene, read_triangles
from calibray.scenes.obstruction import COLUMNS, obstruction


def with_obstruction(links: Measurements, scene: Scene, frequency: float) -> Measurements:
    """The links with the columns `scenes.obstruction.COLUMNS`; columns of these names in their table are kept.

    Args:
        links: The links.
        scene: The scene.
        frequency: Carrier [Hz] of the links that state none.
    """
    missing = [name for name in COLUMNS if name not in links.frame]
    if not missing:
        return links
    carrier = frequency if links.frequency is None else links.frequency
    found = obstruction(read_triangles(scene), links.tx, links.rx)
    columns = found.columns(speed_of_light / np.asarray(carrier))
    return replace(links, table=links.table.assign(**{name: columns[name] for name in missing}))
