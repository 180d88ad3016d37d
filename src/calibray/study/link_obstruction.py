"""Columns of links that follow from the scene: what is on the straight line, and the clutter that the scene lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.measurements import Measurements
from calibray.scenes import Scene, read_triangles
from calibray.scenes.clutter import clutter_loss_db
from calibray.scenes.obstruction import COLUMNS as OBSTACLES
from calibray.scenes.obstruction import obstruction
from calibray.scenes.regions import Region

REGION: Final = "region_m"
"""Column of the length of the straight line inside regions of extra loss [m]."""

CLUTTER: Final = "clutter_db"
"""Column of the clutter loss of ITU-R P.2108 at one end [dB]."""

COLUMNS: Final = (*OBSTACLES, REGION, CLUTTER)
"""All columns that follow from the scene."""


def with_obstruction(
    links: Measurements, scene: Scene, frequency: float, regions: Mapping[str, Region], clutter: bool
) -> Measurements:
    """The links with the columns that the scene gives; columns of these names in their table are kept.

    Args:
        links: The links.
        scene: The scene.
        frequency: Carrier [Hz] of the links that state none.
        regions: The regions of extra loss by name; without any, `REGION` is left out.
        clutter: Whether `CLUTTER` is wanted.

    Raises:
        InputError: A carrier is outside the range of the clutter loss.
    """
    carrier = frequency if links.frequency is None else links.frequency
    added: dict[str, NDArray[np.float64]] = {}
    if any(name not in links.frame for name in OBSTACLES):
        found = obstruction(read_triangles(scene), links.tx, links.rx)
        added |= found.columns(speed_of_light / np.asarray(carrier))
    if regions:
        added[REGION] = np.sum([item.length_inside(links.tx, links.rx) for item in regions.values()], axis=0)
    if clutter:
        added[CLUTTER] = clutter_loss_db(links.distance, carrier)
    missing = {name: values for name, values in added.items() if name not in links.frame}
    return replace(links, table=links.table.assign(**missing)) if missing else links
