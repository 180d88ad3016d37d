"""What estimates owe to single buildings, whose walls differ from the material's mean.

Links that lean on one building share what its walls have of their own, so that many links do not average it out: an
estimate from m links of which each leans on one of b buildings is uncertain as from b of them, not from m. What is
shared can hardly be seen in residuals, for the estimate follows it. Worse, an estimate may follow all of them to one
side: thick walls reflect in waves, which buildings that differ smear, so that walls look lossier than they are.

So it is asked backwards, which mean over all buildings would have given an estimate (indirect inference: C. Gourieroux,
A. Monfort and E. Renault, J. Applied Econometrics 8, 1993). Let g(t) be path loss where all buildings are alike and
f(x, z) that of buildings whose constants are the mean x times exp(spread z), each z drawn. Least squares with g to
what f(x, z) gives, columns Z of the nuisance beside, ends in t where

    J'(g(t) - f(x, z)) + P (t - x) = 0,

J being the derivatives of g at t beside Z, and P a prior that keeps what links do not tell. For each draw t of the
posterior, and buildings drawn for it, this is solved for x, followed from x = t on while the buildings' own, z, grow
from nothing: where waves are steep there are many solutions, and another one has nothing to do with these buildings.
Where path loss follows constants in straight lines, x scatters about t as the covariance that is robust to clusters
says (K.-Y. Liang and S. L. Zeger, Biometrika 73, 1986); so it is taken to do where it cannot be followed to the end.

Waves make many places fit, and what single buildings have of their own makes another one fit best than would on the
mean: a density that takes them as alike is too sure which. Two places are told apart by their difference e in path
loss, of length one in units of the noise, whose variance is then one. With what buildings change, r, it is
1 + (e'r)^2, of both what estimates cannot follow; the logarithm of the density is divided by this before draws are
moved, as that of composite likelihoods is (F. Pauli, W. Racugno and L. Ventura, Statistica Sinica 21, 2011).

Whether buildings differ is no alternative to errors that neighbours share or that have heavy tails: draws of every kind
of noise are moved. How likely each spread is, is told by those two kinds of noise that differ in nothing else, as far
as these explain the data; as far as others do, it is as before: that buildings differ weighs as every departure does,
and the rarer the more they do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.noise_models import DEPARTURE, DIFFERING, GAUSSIAN, NoiseModel

PORTIONS: Final = 8
"""Portions of what buildings have of their own, in which means are followed: onward, and a step back to the way."""

TRIED: Final = 2 * PORTIONS
"""Places that are tried for every estimate."""

LONGEST: Final = 0.2
"""Longest step, in the unit cube."""

CLOSE: Final = 0.02
"""Length of the step that is left, in the unit cube, beyond which a mean is followed no further."""


@dataclass(frozen=True, eq=False)
class Leaning:
    """What links tell at some estimates, as if all buildings were alike. Rows are in units of the noise.

    Attributes:
        estimate: The estimates, in the unit cube [n, d].
        slope: Derivatives of path loss by these there [n, m, d].
        design: Columns of the nuisance [m, q].
        precision: Inverse variances of the priors of the parameters, and of the nuisance's coefficients [n, d + q].
    """

    estimate: NDArray[np.float64]
    slope: NDArray[np.float64]
    design: NDArray[np.float64]
    precision: NDArray[np.float64]

    @cached_property
    def _columns(self) -> NDArray[np.float64]:
        there = np.broadcast_to(self.design, (*self.slope.shape[:2], self.design.shape[1]))
        return np.concatenate([self.slope, there], axis=2)

    @cached_property
    def _normal(self) -> NDArray[np.float64]:
        square = self._columns.transpose(0, 2, 1) @ self._columns
        return square + self.precision[:, None, :] * np.eye(square.shape[1])

    def step(self, gap: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far least squares moves an estimate whose links have less path loss than was thought.

        Args:
            gap: How much less [n, m].
            place: Where priors are centred, in the unit cube [n, d].

        Returns:
            The step from the estimates, less that of the priors, in the unit cube [n, d].
        """
        width = self.estimate.shape[1]
        side = np.einsum("nmi,nm->ni", self._columns, gap)
        side[:, :width] += self.precision[:, :width] * (self.estimate - place)
        return np.linalg.solve(self._normal, side[..., None])[:, :width, 0]

    def left(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """What estimates and nuisance cannot follow.

        Args:
            gap: Changes of path loss at every estimate [n, k, m].

        Returns:
            What is left of them [n, k, m].
        """
        followed = np.linalg.solve(self._normal, self._columns.transpose(0, 2, 1) @ gap.transpose(0, 2, 1))
        return gap - (self._columns @ followed).transpose(0, 2, 1)


def overstated(leaning: Leaning, own: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """How many times too sure a density is, which of several places explains the links, that takes buildings as alike.

    Args:
        leaning: What links tell at some of these places.
        own: What buildings of their own change there, but for what the places explain, rows in units of the noise
            [n, m].
        others: What path loss other places have instead, likewise [n, k, m].

    Returns:
        Variance between a place and others, of the noise and of buildings, over that of the noise, at the middling
        place; 1 where all are neighbours.

    Example:
        >>> alike = Leaning(np.array([[0.5]]), np.ones((1, 4, 1)), np.zeros((4, 0)), np.zeros((1, 1)))
        >>> other = np.array([[[2.0, 2.0, -2.0, -2.0]]])
        >>> overstated(alike, np.array([[1.0, 1.0, -1.0, -1.0]]), other)  # as if it were the other place
        5.0
        >>> overstated(alike, np.array([[1.0, 1.0, 1.0, 1.0]]), other)  # which an estimate follows
        1.0
    """
    apart, left = leaning.left(others), leaning.left(own[:, None, :])[:, 0]
    square = np.sum(apart**2, axis=2)
    far = square > 1.0
    along = np.einsum("nkm,nm->nk", apart, left) ** 2 / np.where(far, square, 1.0)
    mean = np.sum(along * far, axis=1) / np.maximum(far.sum(axis=1), 1)
    return 1.0 + float(np.median(mean))


def following(
    slope: NDArray[np.float64],
    owner: NDArray[np.int64],
    design: NDArray[np.float64],
    precision: NDArray[np.float64],
) -> NDArray[np.float64]:
    """How estimates follow single buildings, where path loss follows constants in straight lines.

    Args:
        slope: Derivatives of path loss by the logarithms of all buildings' constants at some draws, rows in units of
            the noise [n, m, c].
        owner: Parameter that each of these constants stands in for [c].
        design: Columns of the nuisance, rows in units of the noise [m, q].
        precision: Inverse variances of the priors of the parameters' logarithms, and of the nuisance's coefficients
            [d + q].

    Returns:
        Change of the logarithm of each parameter with that of each constant, on the mean over the draws, for at a
        single one reflections inside walls may cancel a derivative [d, c].

    Example:
        >>> one_each = np.eye(4)[None]  # four links, each on a building of its own
        >>> following(one_each, np.zeros(4, int), np.zeros((4, 0)), np.zeros(1)).tolist()
        [[0.25, 0.25, 0.25, 0.25]]
    """
    width = len(precision) - design.shape[1]
    whole = np.zeros((*slope.shape[:2], len(precision)))
    for index in range(width):
        whole[:, :, index] = slope[:, :, owner == index].sum(axis=2)
    whole[:, :, width:] = design
    rows = whole.reshape(-1, len(precision))
    normal = rows.T @ rows / len(slope) + np.diag(precision)
    side = rows.T @ slope.reshape(len(rows), -1) / len(slope)
    return np.asarray(np.linalg.solve(normal, side)[:width], dtype=np.float64)


def means_behind(
    leaning: Leaning,
    change: Callable[[NDArray[np.float64], float], NDArray[np.float64]],
    straight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Means over all buildings that would have given estimates.

    Args:
        leaning: What links tell at the estimates.
        change: Means [n, d], and a portion of what buildings have of their own, to how much their path loss exceeds
            that at the estimates, rows in units of the noise [n, m].
        straight: The means where path loss follows constants in straight lines, in the unit cube [n, d].

    Returns:
        The means, in the unit cube [n, d]; the straight ones where they cannot be followed.

    Example:
        >>> alike = Leaning(np.array([[0.5]]), np.ones((1, 4, 1)), np.zeros((4, 0)), np.zeros((1, 1)))
        >>> own = np.array([0.1, 0.0, 0.0, -0.02])  # of four links, each on a building of its own
        >>> means_behind(alike, lambda x, portion: x - 0.5 + portion * own, np.zeros((1, 1))).round(3).tolist()
        [[0.48]]
    """
    estimate = leaning.estimate

    def missing(place: NDArray[np.float64], portion: float) -> NDArray[np.float64]:
        return leaning.step(-change(place, portion), place)

    followed, before, place = np.ones(len(estimate), dtype=bool), estimate, estimate
    for portion in np.linspace(0.0, 1.0, PORTIONS + 1)[1:].tolist():
        found = np.clip(2.0 * place - before, 0.0, 1.0)
        left = missing(found, portion)
        step = left * np.minimum(1.0, LONGEST / np.maximum(np.linalg.norm(left, axis=1), 1e-12))[:, None]
        there = np.clip(found + step, 0.0, 1.0)
        told = missing(there, portion)
        shorter = (np.linalg.norm(told, axis=1) < np.linalg.norm(left, axis=1))[:, None]
        found, left = np.where(shorter, there, found), np.where(shorter, told, left)
        followed &= np.linalg.norm(left, axis=1) <= CLOSE
        before, place = place, np.where(followed[:, None], found, place)
    return np.where(followed[:, None], place, np.clip(straight, 0.0, 1.0))


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
    prior = np.concatenate([[float(before[0] > 0)], DEPARTURE * rare / rare.sum()])
    odds = prior * evidence ** min(1.0, float(after.sum()))
    place = (random.random((len(share), 1)) > np.cumsum(share, axis=1)[:, :-1]).sum(axis=1)
    other = random.choice(choices, len(share), p=odds / odds.sum())
    own = np.array([model.spread for model in models])[place]
    return np.where(np.array([model.kind == DIFFERING for model in models])[place], own, other)


def _is(model: NoiseModel, spread: float) -> bool:
    """Whether a model is that of independent errors and buildings of a spread, 0 for none."""
    return model.kind == (DIFFERING if spread else GAUSSIAN) and model.spread == spread
