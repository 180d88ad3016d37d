"""How far a measurement may lie from a prediction, by the errors of links that nothing was fitted to.

Among n + 1 errors that could have come in any order, a further one is as likely to be of any rank: so that the share p
of them lies within the (n + 1) p-th smallest of the n that are known, whatever their distribution (V. Vovk,
A. Gammerman, G. Shafer, Algorithmic Learning in a Random World, 2005; R. J. Barber et al., Ann. Statist. 49, 2021, for
links left out in turn). Errors of links have heavier tails than a Gaussian's, which makes an interval from their root
mean square too wide at nine tenths. Of few errors the largest ones say little: Student's t takes their place.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

FEW: Final = 40
"""Errors below which a distribution is assumed."""


def reach(sizes: NDArray[np.float64], level: float) -> float:
    """Half the width of an interval that a further error lies in.

    Args:
        sizes: Sizes of errors, ascending [n], [dB].
        level: With which probability.

    Returns:
        Half the width [dB].

    Example:
        >>> errors = np.sort(np.abs(np.random.default_rng(0).standard_normal(999)))
        >>> round(reach(errors, 0.9), 2), round(reach(errors[::100], 0.9), 2)
        (1.56, 1.48)
    """
    count, rank = len(sizes), (len(sizes) + 1) * level
    size = float(np.sqrt(np.mean(np.square(sizes))))
    normal = float(stdtrit(count, (1 + level) / 2)) * size
    if count < FEW:
        return normal
    if rank > count:
        return max(normal, float(sizes[-1]))
    return float(np.interp(rank, np.arange(1, count + 1), sizes))
