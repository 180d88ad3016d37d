"""Clutter that a scene lacks: the statistical loss at an end of a terrestrial path, ITU-R P.2108-1 section 3.2."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError

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
        The losses; 0 for paths shorter than `SHORTEST`, for which the recommendation has none.

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
