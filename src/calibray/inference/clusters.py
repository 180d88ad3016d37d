"""What estimates owe to single buildings, whose walls differ from the material's mean.

Links that lean on one building share what its walls have of their own, so that many links do not average it out: an
estimate from m links of which each leans on one of b buildings is uncertain as from b of them, not from m. What is
shared can hardly be seen in residuals, for the estimate follows it. With derivatives G_b of path loss by the logarithms
of building b's own constants, J their sum over all that has constants, in units of the noise, and priors P, the
estimate follows building b by

    A_b = (J'J + P)^-1 J'G_b,

which add up to one where the data tell all. Buildings that differ by factors exp(spread z) give it the covariance
spread^2 sum_b A_b A_b' beside that of the noise, as the covariance that is robust to clusters has it (K.-Y. Liang and
S. L. Zeger, Biometrika 73, 1986), but for a spread in place of the clusters' residuals: buildings are too few for
those. Both products are means over the posterior, for at a single point reflections inside walls may cancel a
derivative.

Whether buildings differ is no alternative to errors that neighbours share or that have heavy tails: draws of every kind
of noise are moved. How likely each spread is, is told by those two kinds of noise that differ in nothing else, as far
as these explain the data; as far as others do, it is as before: that buildings differ is as likely as that they do not,
and the rarer the more they do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibray.inference.marginal import DIFFERING, GAUSSIAN, NoiseModel


def shared_covariance(
    slope: NDArray[np.float64],
    owner: NDArray[np.int64],
    building: NDArray[np.int64],
    design: NDArray[np.float64],
    precision: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Covariance that estimates have from buildings of spread one.

    Args:
        slope: Derivatives of path loss by the logarithms of all buildings' constants at some draws, rows in units of
            the noise [n, m, c].
        owner: Parameter that each of these constants stands in for [c].
        building: Its building; -1 for what is no building [c].
        design: Columns of the nuisance, rows in units of the noise [m, q].
        precision: Inverse variances of the priors of the parameters' logarithms, and of the nuisance's coefficients
            [d + q].

    Returns:
        Covariance of the parameters' logarithms [d, d].

    Example:
        >>> one_each = np.eye(4)[None]  # four links, each on a building of its own
        >>> shared_covariance(
        ...     one_each, np.zeros(4, int), np.arange(4), np.zeros((4, 0)), np.zeros(1)
        ... ).round(3).tolist()
        [[0.25]]
    """
    width = len(precision) - design.shape[1]
    whole = np.zeros((*slope.shape[:2], len(precision)))
    for index in range(width):
        whole[:, :, index] = slope[:, :, owner == index].sum(axis=2)
    whole[:, :, width:] = design
    rows = whole.reshape(-1, len(precision))
    own = slope[:, :, building >= 0].reshape(len(rows), -1)
    normal = rows.T @ rows / len(slope) + np.diag(precision)
    moved = np.linalg.solve(normal, rows.T @ own / len(slope))[:width]
    return np.asarray(moved @ moved.T, dtype=np.float64)


def spreads(
    models: Sequence[NoiseModel], share: NDArray[np.float64], tried: Sequence[NoiseModel], seed: int = 0
) -> NDArray[np.float64]:
    """Draw a spread between buildings for every draw of the parameters.

    Args:
        models: The models of noise that were not negligible.
        share: Their weights at every draw [n, models].
        tried: All models that were tried, with the weights that they had before.
        seed: Seed of the random numbers.

    Returns:
        The spreads, 0 where buildings do not differ [n].
    """
    random = np.random.default_rng(seed)
    known = sorted({model.spread for model in tried if model.kind == DIFFERING})
    if not known:
        return np.zeros(len(share))
    choices, told = np.array([0.0, *known]), share.mean(axis=0)
    # A spread of 0 is that of independent errors; the others differ from these in nothing else.
    before, after = (
        np.array([sum(weight for model, weight in pairs if _is(model, spread)) for spread in choices])
        for pairs in (
            [(model, model.weight) for model in tried],
            list(zip(models, told.tolist(), strict=True)),
        )
    )
    evidence = np.maximum(after, 1e-6) / np.where(before > 0, before, 1.0)
    rare = np.array([1.0 / spread for spread in known])
    prior = np.concatenate([[float(before[0] > 0)], rare / rare.sum()])
    odds = prior * evidence ** min(1.0, float(after.sum()))
    place = (random.random((len(share), 1)) > np.cumsum(share, axis=1)[:, :-1]).sum(axis=1)
    other = random.choice(choices, len(share), p=odds / odds.sum())
    own = np.array([model.spread for model in models])[place]
    return np.where(np.array([model.kind == DIFFERING for model in models])[place], own, other)


def moved(
    value: NDArray[np.float64],
    spread: NDArray[np.float64],
    covariance: NDArray[np.float64],
    seed: int = 0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values as far from where they were as buildings that differ may have moved them.

    Args:
        value: Values of the parameters, greater than 0 [n, d].
        spread: Spread between the buildings [n].
        covariance: What `shared_covariance` gave [d, d].
        seed: Seed of the random numbers.

    Returns:
        The values [n, d], and half the square of how far each was moved, in standard deviations [n].
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    normal = np.where(spread[:, None] > 0, np.random.default_rng(seed).standard_normal(value.shape), 0.0)
    return value * np.exp(spread[:, None] * normal @ root.T), 0.5 * np.sum(normal**2, axis=1)


def _is(model: NoiseModel, spread: float) -> bool:
    """Whether a model is that of independent errors and buildings of a spread, 0 for none."""
    return model.kind == (DIFFERING if spread else GAUSSIAN) and model.spread == spread
