"""The residual field: the correlated part of the calibration residuals, kriged to nearby links.

Clutter that the scene lacks affects neighbouring links in the same way, so the residual near a measured link is partly
known. The correlated part has an exponential covariance whose range and size maximize the restricted likelihood
(`uncertainty.residual_correlation.fit_correlation`). Far from all measured links, the field is zero and explains
nothing.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from calibray.result.held_out import ResidualField

MOST_EXACT: Final = 1000
"""Number of measured links up to which all of them are used at every new link; with more, only the nearest ones are
used."""

NEAREST: Final = 50
"""Number of nearest measured links used at each new link."""

TOGETHER: Final = 500
"""Number of new links whose neighbours are solved for together; each needs about 150 kB."""


def krige_residuals(
    field: ResidualField,
    measured: NDArray[np.float64],
    residuals: NDArray[np.float64],
    position: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Krige the residual field from measured links to new ones, whose ends have positions [m, 6] and [n, 6], [m].

    Residuals are measured minus modelled path loss [m], [dB]. The results are the correction of the modelled path loss
    [n], [dB], and the share of the field's variance that the measured links explain, which is 0 far from all of them
    and below 1 near one [n].
    """
    if len(measured) <= MOST_EXACT:
        return _krige(field, measured, residuals, position)
    correction, share = np.zeros(len(position)), np.zeros(len(position))
    neighbours = np.asarray(KDTree(measured).query(position, k=NEAREST)[1])
    variance = field.shared_db**2
    for first in range(0, len(position), TOGETHER):
        links = slice(first, first + TOGETHER)
        near = measured[neighbours[links]]
        between = np.linalg.norm(near[:, :, None] - near[:, None], axis=3)
        covariance = variance * np.exp(-between / field.range_m) + field.own_db**2 * np.eye(NEAREST)
        distance = np.linalg.norm(near - position[links, None], axis=2)
        cross = variance * np.exp(-distance / field.range_m)
        weights = np.linalg.solve(covariance, cross[..., None])[..., 0]
        correction[links] = np.einsum("nm,nm->n", weights, residuals[neighbours[links]])
        share[links] = np.einsum("nm,nm->n", weights, cross) / variance
    return correction, share


def _krige(
    field: ResidualField,
    measured: NDArray[np.float64],
    residuals: NDArray[np.float64],
    position: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simple kriging with an exponential covariance: c^T K^-1 r, and c^T K^-1 c over the field's variance."""
    variance = field.shared_db**2
    covariance = variance * np.exp(-cdist(measured, measured) / field.range_m)
    covariance = covariance + field.own_db**2 * np.eye(len(measured))
    factor = cho_factor(covariance, lower=True)
    cross = variance * np.exp(-cdist(position, measured) / field.range_m)
    correction = cross @ cho_solve(factor, residuals)
    return correction, np.einsum("nm,mn->n", cross, cho_solve(factor, cross.T)) / variance


def calibration_residuals(links: pd.DataFrame) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the calibration links with a path [m], and their measured minus predicted path loss [m], [dB]."""
    modelled = links["predicted_db"].to_numpy(float)
    counted = links["has_path"].to_numpy(bool) & ~links["held_out"].to_numpy(bool) & np.isfinite(modelled)
    if "faint" in links:
        counted &= ~links["faint"].to_numpy(bool)
    rows = np.flatnonzero(counted)
    return rows, links["measured_db"].to_numpy(float)[rows] - modelled[rows]
