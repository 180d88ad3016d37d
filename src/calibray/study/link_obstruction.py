"""Columns of links that follow from scene and positions: obstruction of the line, clutter, and clusters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.scenes import Scene, read_triangles
from calibray.scenes.obstruction import COLUMNS as OBSTACLES
from calibray.scenes.obstruction import obstruction
from calibray.scenes.regions import Region

REGION: Final = "region_m"
"""Column of the length of the straight line inside regions of extra loss [m]."""

CLUTTER: Final = "clutter_db"
"""Column of the clutter loss of ITU-R P.2108 at one end [dB]."""

CLUSTER: Final = "cluster"
"""Column of labels of squares in which receivers form groups."""

COLUMNS: Final = (*OBSTACLES, REGION, CLUTTER)
"""All columns that follow from the scene."""


def with_obstruction(
    links: Measurements,
    scene: Scene,
    frequency: float,
    regions: Mapping[str, Region],
    *,
    clutter: bool = False,
    cluster_m: float | None = None,
) -> Measurements:
    """The links with the columns that follow from the scene; columns of these names in their table are kept.

    Args:
        links: The links.
        scene: The scene.
        frequency: Carrier [Hz] of the links that state none.
        regions: The regions of extra loss by name; if there are none, `REGION` is left out.
        clutter: Whether `CLUTTER` is wanted.
        cluster_m: Side of the squares of `CLUSTER`, a lattice through the scene's origin; left out if None.

    Raises:
        InputError: A carrier is outside the range of the clutter loss.
    """
    carrier = frequency if links.frequency is None else links.frequency
    added: dict[str, NDArray[np.float64] | NDArray[np.str_]] = {}
    if any(name not in links.frame for name in OBSTACLES):
        obstacles = obstruction(read_triangles(scene), links.tx, links.rx)
        added |= obstacles.columns(speed_of_light / np.asarray(carrier))
    if regions:
        added[REGION] = np.sum([item.length_inside(links.tx, links.rx) for item in regions.values()], axis=0)
    if clutter:
        added[CLUTTER] = clutter_loss_db(links.distance, carrier)
    if cluster_m is not None:
        squares = np.floor(links.rx[:, :2] / cluster_m).astype(int)
        added[CLUSTER] = np.array([f"{column} {row}" for column, row in squares])
    missing = {name: values for name, values in added.items() if name not in links.frame}
    return replace(links, table=links.table.assign(**missing)) if missing else links


SHORTEST: Final = 250.0
"""Shortest path that the recommendation covers, with one end in clutter [m]."""

CARRIERS: Final = (0.5e9, 67e9)
"""Carriers that it covers [Hz]."""


def clutter_loss_db(distance: ArrayLike, frequency: ArrayLike) -> NDArray[np.float64]:
    """Median clutter loss at one end, over locations in urban or suburban clutter [n], [dB].

    Args:
        distance: Length of the paths [n], [m].
        frequency: Carrier of all or of each [n], [Hz].

    Returns:
        The losses; 0 for paths shorter than `SHORTEST`, which the recommendation does not cover.

    Raises:
        InputError: A carrier is outside `CARRIERS`.

    Example:
        >>> clutter_loss_db([100.0, 1000.0, 5000.0], 3.5e9).round(2).tolist()
        [0.0, 30.11, 30.38]
    """
    carrier_ghz = np.asarray(frequency, dtype=float) / 1e9
    low, high = CARRIERS
    if not ((carrier_ghz * 1e9 >= low) & (carrier_ghz * 1e9 <= high)).all():
        wrong = carrier_ghz[(carrier_ghz * 1e9 < low) | (carrier_ghz * 1e9 > high)].reshape(-1)[0]
        raise InputError(
            f"clutter_db: ITU-R P.2108 section 3.2 covers {low / 1e9:g} to {high / 1e9:g} GHz, not {wrong:g} GHz; "
            "leave this nuisance out"
        )
    length_km = np.asarray(distance, dtype=float) / 1e3
    # Beyond 2 km the loss is that at 2 km (equation 6).
    capped_km = np.clip(length_km, SHORTEST / 1e3, 2.0)
    long_db = -2 * np.log10(10 ** (-5 * np.log10(carrier_ghz) - 12.5) + 10**-16.5)  # equation 4
    short_db = 32.98 + 23.9 * np.log10(capped_km) + 3 * np.log10(carrier_ghz)  # equation 5
    median_db = -5 * np.log10(
        10 ** (-0.2 * long_db) + 10 ** (-0.2 * short_db)
    )  # equation 3, for 50 % of locations
    return np.where(length_km < SHORTEST / 1e3, 0.0, median_db)
