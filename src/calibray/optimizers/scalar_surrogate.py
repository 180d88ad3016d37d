"""The scalar surrogate that screens the candidates of SGWO-IM: radial basis functions of the objective.

SciPy's `RBFInterpolator` on inputs scaled to the unit cube, with smoothing 1e-6. The default kernel is
cubic with a linear tail. The Gaussian one is the classical RBF network with a constant tail; its width
follows the rule of the largest spacing, sigma = d_max / sqrt(2 M) for M centres (S. Haykin, Neural
Networks, 2nd ed., sec. 5.13). Points told more than once are merged with the mean of their objectives. A
failed evaluation counts as the worst successful one, so that the model steers away from it without being
distorted by infinity.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import pdist

from calibray.optimizers.box import Box
from calibray.optimizers.evaluations import Archive, merged

KERNELS = ("cubic", "gaussian")
SMOOTHING = 1e-6


def predict(archive: Archive, candidates: NDArray[np.float64], kernel: str = "cubic") -> NDArray[np.float64]:
    """Predict the objective of candidates from all real evaluations.

    Args:
        archive: The evaluations, with more than d distinct points that span the box.
        candidates: Points [n, d].
        kernel: "cubic" or "gaussian".

    Returns:
        Predicted objective [n]; all zero while every evaluation has failed.
    """
    if not np.isfinite(archive.best.y):
        return np.zeros(len(candidates))
    told = archive.imputed(archive.all())
    return interpolated(archive.box, told.x, told.y, candidates, kernel)


def interpolated(
    box: Box,
    points: NDArray[np.float64],
    values: NDArray[np.float64],
    candidates: NDArray[np.float64],
    kernel: str = "cubic",
) -> NDArray[np.float64]:
    """Radial basis functions of values at points.

    Args:
        box: The box.
        points: More than d distinct points that span it [k, d].
        values: Values there [k].
        candidates: Points [n, d].
        kernel: "cubic" or "gaussian".

    Returns:
        Values at the candidates [n].
    """
    x, y = merged(box.to_unit(points), values)
    if kernel == "gaussian":
        # phi(r) = exp(-(epsilon r)^2) with epsilon = 1 / (sqrt(2) sigma)
        settings = {"kernel": "gaussian", "epsilon": sqrt(len(x)) / pdist(x).max(), "degree": 0}
    else:
        settings = {"kernel": "cubic", "degree": 1}
    return RBFInterpolator(x, y, smoothing=SMOOTHING, **settings)(box.to_unit(candidates))
