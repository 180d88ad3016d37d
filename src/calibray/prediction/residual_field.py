"""The residual field: what neighbouring links' errors share, carried over to links beside them.

Clutter that the scene lacks shades neighbours alike, so that beside a measured link the model's error there is known in
part. What is shared follows an exponential covariance whose range and size are those of the largest restricted
likelihood (`noise.fit_correlation`), and the errors of the links calibrated on are kriged. Far from all of them nothing
is added, and nothing is gained.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from calibray.result.prediction_model import ResidualField

EXACT: Final = 1000
"""Measured links up to which all of them count; of more, the nearest to each place."""

NEAREST: Final = 50
"""How many of these."""


def carried(
    field: ResidualField,
    known: NDArray[np.float64],
    errors: NDArray[np.float64],
    place: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What the errors of measured links say of those of others.

    Args:
        field: What errors share.
        known: Where the ends of the measured links stand [m, 6], [m].
        errors: Measured less modelled path loss there [m], [dB].
        place: Where those of the others stand [n, 6], [m].

    Returns:
        What is to be added to the modelled path loss [n], [dB], and the share of the shared variance that is known
        then, 0 far from all measured links and below 1 beside one [n].
    """
    if len(known) <= EXACT:
        return _kriged(field, known, errors, place)
    added, share = np.zeros(len(place)), np.zeros(len(place))
    near = np.asarray(KDTree(known).query(place, k=NEAREST)[1])
    for index, mine in enumerate(near):
        added[index : index + 1], share[index : index + 1] = _kriged(
            field, known[mine], errors[mine], place[index : index + 1]
        )
    return added, share


def _kriged(
    field: ResidualField,
    known: NDArray[np.float64],
    errors: NDArray[np.float64],
    place: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    shared = field.shared_db**2
    covariance = shared * np.exp(-cdist(known, known) / field.range_m) + field.own_db**2 * np.eye(len(known))
    factor = cho_factor(covariance, lower=True)
    cross = shared * np.exp(-cdist(place, known) / field.range_m)
    added = cross @ cho_solve(factor, errors)
    return added, np.einsum("nm,mn->n", cross, cho_solve(factor, cross.T)) / shared


def measured_errors(links: pd.DataFrame) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Errors of the model that predictions go by, at the links calibrated on.

    Args:
        links: A result's table of links.

    Returns:
        Places of the links that have one [m], and measured less modelled path loss there [m], [dB].
    """
    modelled = links["chosen_db" if "chosen_db" in links else "after_db"].to_numpy(float)
    counted = links["has_path"].to_numpy(bool) & ~links["held_out"].to_numpy(bool) & np.isfinite(modelled)
    if "faint" in links:
        counted &= ~links["faint"].to_numpy(bool)
    known = np.flatnonzero(counted)
    return known, links["measured_db"].to_numpy(float)[known] - modelled[known]
