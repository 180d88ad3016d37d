"""What is wrong with a fit, looked for in its errors: whether neighbours share them, and which links rule it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from calibray.errors import EngineError, InputError
from calibray.uncertainty.noise import Correlation, fit_correlation

FEWEST_LINKS: Final = 10
MOST_LINKS: Final = 500
"""Links that a correlation is looked for among: fewer show none, and of more some do."""

SHOWN: Final = 3.0
"""Gain in log likelihood from which a shared part is believed: two further constants at 95 %, about."""


def shared_errors(errors: NDArray[np.float64], position: NDArray[np.float64]) -> Correlation | None:
    """What errors of neighbouring links share.

    Args:
        errors: Errors at the best fit [m], [dB].
        position: Where the links stand [m, k], [m]: their receivers, or both ends.

    Returns:
        Their correlation; None where they do not show one.
    """
    if len(errors) < FEWEST_LINKS:
        return None
    chosen = np.linspace(0, len(errors) - 1, min(len(errors), MOST_LINKS)).round().astype(int)
    try:
        found = fit_correlation(errors[chosen], position[chosen])
    except (InputError, EngineError):
        # All at one place, or no errors at all.
        return None
    return found if found.log_likelihood - found.independent > SHOWN else None


def variogram(
    errors: NDArray[np.float64], position: NDArray[np.float64], bins: int = 8
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Half the mean square difference of errors over the distance between links.

    Where it rises from little to much, neighbours share their errors; where it is level, they do not.

    Args:
        errors: Errors [m], [dB].
        position: Where the links stand [m, k], [m]: their receivers, or both ends.
        bins: Classes of distance, of about equally many pairs each.

    Returns:
        Mean distance [k], [m], semivariance [k], [dB^2], and number of pairs of every class [k].
    """
    chosen = np.linspace(0, len(errors) - 1, min(len(errors), MOST_LINKS)).round().astype(int)
    apart, half = pdist(position[chosen]), 0.5 * pdist(errors[chosen, None], "sqeuclidean")
    # Pairs beyond half the extent are few and all at its ends.
    near = apart <= max(np.median(apart), apart.max() / 2) if len(apart) else np.zeros(0, dtype=bool)
    apart, half = apart[near], half[near]
    order = np.argsort(apart, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    return (
        np.array([apart[part].mean() for part in parts]),
        np.array([half[part].mean() for part in parts]),
        np.array([len(part) for part in parts], dtype=np.int64),
    )


def leverage(jacobian: NDArray[np.float64], design: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much each link's model follows its own measurement.

    Args:
        jacobian: Derivatives of the residuals by the parameters, nuisances eliminated [m, d].
        design: Columns of the nuisance at the same links, scaled as the residuals are [m, q].

    Returns:
        Diagonal of the projection onto both [m]: 0 where a link has no say, 1 where it alone decides something; their
        sum is the number of unknowns that the links determine.

    Example:
        >>> leverage(np.array([[1.0], [1.0], [0.0]]), np.zeros((3, 0))).round(2).tolist()
        [0.5, 0.5, 0.0]
    """
    found = np.zeros(len(jacobian))
    for columns in (jacobian, design):
        size = np.linalg.norm(columns, axis=0)
        used = columns[:, size > 0] / size[size > 0]
        left, values, _ = np.linalg.svd(used, full_matrices=False)
        found += np.sum(left[:, values > 1e-6] ** 2, axis=1)
    return np.minimum(found, 1.0)
