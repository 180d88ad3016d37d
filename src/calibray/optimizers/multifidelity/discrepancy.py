"""The discrepancy between an expensive model and a cheap one: a Gaussian process over the box for every residual.

The discrepancy consists of an offset, a change of response and a rest: v_0, v_1 and v_2 of `regression.py`. h(x) is the
deviation of the cheap model's residuals from their mean over the box. Links respond alike to the parameters, so paths
that the cheap model lacks respond as other links do. The v_1 term is therefore the slope of a link's output mapping,
and helps for links of which the cheap model knows nothing. Each residual has a variance, whose inverse gamma prior is
integrated out. So a few links that the cheap model predicts badly do not spoil the others.

M. C. Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63 (2001) 425, sec. 4.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.regression import (
    Inputs,
    Kernel,
    Likelihood,
    Prior,
    Process,
    condition,
    most_probable,
)

FREEDOM: Final = 4.0
"""Degrees of freedom of the prior of a residual's variance."""

VARIANCES: Final = (1.0, 0.1, 0.1)
"""Medians of the priors of v_0, v_1 and v_2, relative to the mean square of the cheap model's response."""

VARIANCE_SPREAD: Final = 2.0
"""Standard deviation of their logarithms."""

LOG_VARIANCE_BOUNDS: Final = (-14.0, 6.0)

LENGTH: Final = 0.5
"""Of the unit cube: median of the prior of a length scale."""

LENGTH_SPREAD: Final = 0.7
"""Standard deviation of its logarithm."""

LOG_RATE_BOUNDS: Final = (-2.0, 4.0)

NUGGET: Final = 1e-6
"""Smallest nugget, relative to the mean square of the response; it keeps the matrix regular."""

NOISE: Final = (float(np.log(1e-4)), 3.0)
"""Mean and standard deviation of the logarithm of the nugget where it is learned."""


def fit(
    inputs: Inputs,
    values: NDArray[np.float64],
    scale: float,
    *,
    noisy: bool = False,
    guess: Kernel | None = None,
) -> Process:
    """Fit the process to discrepancies [n, m], by the largest posterior density of its hyperparameters.

    The prior is relative to `scale`, the root mean square of the cheap model's response. `noisy` learns the nugget too.
    `guess` is a kernel to start from as well as the prior's.
    """
    d, low = inputs.unit.shape[1], float(np.log(NUGGET))
    three, rates = np.ones(3), np.ones(d)
    prior = Prior(
        mean=np.concatenate([np.log(VARIANCES), -np.log(LENGTH) * rates, [NOISE[0] if noisy else low]]),
        spread=np.concatenate([VARIANCE_SPREAD * three, LENGTH_SPREAD * rates, [NOISE[1]]]),
        lower=np.concatenate([LOG_VARIANCE_BOUNDS[0] * three, LOG_RATE_BOUNDS[0] * rates, [low]]),
        upper=np.concatenate(
            [LOG_VARIANCE_BOUNDS[1] * three, LOG_RATE_BOUNDS[1] * rates, [0.0 if noisy else low]]
        ),
    )
    likelihood = Likelihood(inputs, values, freedom=FREEDOM)
    return solve(inputs, values, most_probable(likelihood, prior, scale=scale, guess=guess))


def solve(inputs: Inputs, values: NDArray[np.float64], kernel: Kernel) -> Process:
    """The process with a known kernel, given discrepancies [n, m]."""
    return condition(inputs, values, kernel, freedom=FREEDOM)


def negative_log_density(whitened: NDArray[np.float64]) -> NDArray[np.float64]:
    """Negative log density [...] of discrepancies [..., n, m], a multivariate t, up to a constant.

    They are whitened by the inverse of the Cholesky factor of K.
    """
    count, square = whitened.shape[-2], np.sum(whitened**2, axis=-2)
    return 0.5 * (FREEDOM + count) * np.log1p(square / FREEDOM).sum(axis=-1)
