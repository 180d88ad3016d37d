"""Draws from the posterior: parameters that explain the data about as well as the best, as often as they should.

An affine-invariant ensemble of walkers (J. Goodman and J. Weare, Communications in Applied Mathematics and
Computational Science 5, 2010): each moves along the line to a walker of the other half, so that no step length has to
be tuned, and one batch of replays moves half of them. It starts from points of the profiles, which know every basin
that fits. The size of the noise is integrated out: the density falls with the residuals' sum of squares to the power of
half the degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

STRETCH: Final = 2.0
"""Longest stretch of the line between two walkers; the published choice."""

Square = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Points [n, d] to the mean square of their residuals [n]; +inf where an evaluation failed."""


def draws(
    square: Square,
    starts: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    freedom: float,
    *,
    count: int = 64,
    steps: int = 60,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Draw from the posterior within bounds, on which it is flat but for the data and what the residuals hold.

    Args:
        square: What the density falls with.
        starts: Points that explain the data [s, d], from every basin.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        freedom: Number of links less that of eliminated nuisances.
        count: Number of walkers; more where there are many parameters.
        steps: Steps of each.
        seed: Seed of the random numbers.

    Returns:
        Where the walkers ended [n, d].
    """
    random, dimension = np.random.default_rng(seed), starts.shape[1]
    half = max(count // 2, 2 * dimension)

    def logarithm(points: NDArray[np.float64]) -> NDArray[np.float64]:
        with np.errstate(divide="ignore"):
            return -0.5 * freedom * np.log(square(points))

    density = logarithm(starts)
    known = np.isfinite(density) | (density == np.inf)
    starts, density = starts[known], density[known]
    weight = np.exp(np.clip(density - density.max(), -700.0, 0.0)) if len(density) else density
    weight = np.where(np.isfinite(weight), weight, 1.0)
    chosen = random.choice(len(starts), 2 * half, p=weight / weight.sum())
    # Walkers at one place would span no line between them.
    jitter = 1e-4 * (upper - lower) * random.standard_normal((2 * half, dimension))
    walkers = np.clip(starts[chosen] + jitter, lower, upper)
    density = logarithm(walkers)
    for step in range(2 * steps):
        mine, others = (
            (slice(0, half), slice(half, None)) if step % 2 else (slice(half, None), slice(0, half))
        )
        partner = walkers[others][random.integers(half, size=half)]
        # Goodman and Weare, eq. 10: density of the stretch z proportional to its inverse root.
        stretch = ((STRETCH - 1.0) * random.random(half) + 1.0) ** 2 / STRETCH
        trial = partner + stretch[:, None] * (walkers[mine] - partner)
        inside = ((trial >= lower) & (trial <= upper)).all(axis=1)
        value = np.full(half, -np.inf)
        if inside.any():
            value[inside] = logarithm(trial[inside])
        gain = (dimension - 1.0) * np.log(stretch) + value - density[mine]
        accepted = inside & (np.log(random.random(half)) < gain)
        walkers[mine] = np.where(accepted[:, None], trial, walkers[mine])
        density[mine] = np.where(accepted, value, density[mine])
    return walkers
