"""Draws from the posterior: parameters that explain the data, as often as they should.

Importance sampling whose proposals learn (J.-M. Cornuet, J.-M. Marin, A. Mira and C. P. Robert, Adaptive multiple
importance sampling, Scandinavian Journal of Statistics 39, 2012). The first points are spread over the whole box and
around every minimum known, as wide as the curvature there says; each further round draws from Student-t kernels around
points that explain the data, as wide as their neighbours lie. All points count, weighed by the posterior over the
mixture of all proposals, so that none is lost and no basin has to be crossed from another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from calibray.optimizers.sampling import design

TAILS: Final = 5.0
"""Degrees of freedom of the kernels: heavier tails than those of most posteriors."""

KERNELS: Final = 120
"""Kernels of a round."""

ENOUGH: Final = 500.0
"""Effective draws that intervals are taken from."""

LEAST: Final = 60.0
"""Effective points that kernels are taken from; where there are fewer, the density is flattened."""

TOO_FEW: Final = 20.0
"""Effective draws below which they do not tell where a posterior ends; the density is flattened until `LEAST` are."""

BLOCK: Final = 256
"""Points that kernels are evaluated at together, so that what is between stays within a core's cache."""

Density = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Points [n, d] to the logarithm of the posterior, but for a constant [n]; -inf where it is none."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Weighted points.

    Attributes:
        point: The points [n, d].
        density: Logarithm of the posterior there, but for a constant [n].
        weight: Their weights; they add up to one [n].
        flattened: Whether so few draws were effective that the weights are those of a flatter, wider density.
    """

    point: NDArray[np.float64]
    density: NDArray[np.float64]
    weight: NDArray[np.float64]
    flattened: bool = False

    @property
    def effective(self) -> float:
        """Number of independent draws that would tell as much."""
        return float(1.0 / np.sum(self.weight**2))

    def resampled(self, count: int, seed: int = 0) -> NDArray[np.float64]:
        """Points of equal weight.

        Args:
            count: Their number.
            seed: Seed of the random numbers.

        Returns:
            Points drawn by their weights [count, d].
        """
        return self.point[_systematic(self.weight, count, np.random.default_rng(seed))]


def sample(
    density: Density,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    minima: NDArray[np.float64],
    covariance: NDArray[np.float64],
    *,
    batch: int = 512,
    rounds: int = 8,
    enough: float = ENOUGH,
    seed: int = 0,
) -> Draws:
    """Draw from a posterior within bounds.

    Args:
        density: Its logarithm.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        minima: Points that explain the data, from every basin known [k, d].
        covariance: Covariance of the parameters there by curvature [k, d, d].
        batch: Points of a round.
        rounds: Rounds at most, the first not counted.
        enough: Effective draws after which no further round is made.
        seed: Seed of the random numbers.

    Returns:
        Weighted points.

    Raises:
        ValueError: The density is nowhere finite.
    """
    random, width, dimension = np.random.default_rng(seed), upper - lower, len(lower)
    spread = covariance / np.outer(width, width) * 1.5**2 + 1e-12 * np.eye(dimension)
    basins = _Kernels.of((minima - lower) / width, spread)
    even = design("sobol", batch, dimension, random)
    unit = np.concatenate([even, inside(basins.draw(batch, random))])
    found = density(lower + unit * width)
    proposals, share = [basins], [float(batch), float(batch)]
    log_parts = [basins.log_density(unit)]
    while True:
        # Of the even points the density is 1; of those beyond the box, which were dropped, nothing is wanted.
        parts = np.stack([np.zeros(len(unit)), *log_parts])
        mixture = np.logaddexp.reduce(parts + np.log(np.array(share) / sum(share))[:, None], axis=0)
        raw = found - mixture
        if not np.isfinite(raw).any():
            raise ValueError("the density is finite nowhere")
        weight = np.exp(raw - raw.max())
        weight /= weight.sum()
        draws, turn = Draws(lower + unit * width, found, weight), len(share) - 2
        if turn == rounds and draws.effective < TOO_FEW:
            return replace(draws, weight=_flattened(raw), flattened=True)
        if turn == rounds or (turn and draws.effective >= enough):
            return draws
        kernels = _learned(unit, raw, random)
        new = inside(kernels.draw(batch, random))
        log_parts = [
            np.concatenate([part, each.log_density(new)])
            for part, each in zip(log_parts, proposals, strict=True)
        ]
        unit = np.concatenate([unit, new])
        found = np.concatenate([found, density(lower + new * width)])
        proposals.append(kernels)
        log_parts.append(kernels.log_density(unit))
        share.append(float(batch))


def pooled(parts: Sequence[Draws]) -> Draws:
    """Draws from several posteriors, each as likely as the others.

    Args:
        parts: Draws from each.

    Returns:
        All of them.
    """
    return Draws(
        np.concatenate([part.point for part in parts]),
        np.concatenate([part.density for part in parts]),
        np.concatenate([part.weight for part in parts]) / len(parts),
        any(part.flattened for part in parts),
    )


def inside(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of some points that lie in the unit cube [k, d]."""
    return unit[((unit >= 0) & (unit <= 1)).all(axis=1)]


@dataclass(frozen=True, eq=False)
class _Kernels:
    """A mixture of Student-t kernels of equal weight.

    Attributes:
        centre: Their centres [k, d].
        root: Cholesky factors of their scale matrices [k, d, d].
    """

    centre: NDArray[np.float64]
    root: NDArray[np.float64]

    @classmethod
    def of(cls, centre: NDArray[np.float64], scale: NDArray[np.float64]) -> _Kernels:
        return cls(centre, np.asarray(np.linalg.cholesky(scale), dtype=np.float64))

    def draw(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points [count, d]."""
        which = random.permutation(np.arange(count) % len(self.centre))
        normal = random.standard_normal((count, self.centre.shape[1]))
        stretch = np.sqrt(TAILS / random.chisquare(TAILS, count))
        return self.centre[which] + stretch[:, None] * np.einsum("nij,nj->ni", self.root[which], normal)

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the density at points [n]."""
        count, dimension = self.centre.shape
        inverse = np.linalg.inv(self.root)
        across = inverse.transpose(2, 0, 1).reshape(dimension, -1)
        origin = np.einsum("kij,kj->ki", inverse, self.centre).ravel()
        constant = (
            gammaln((TAILS + dimension) / 2) - gammaln(TAILS / 2) - 0.5 * dimension * np.log(TAILS * np.pi)
        )
        size = constant - np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum(axis=1)
        found = np.empty(len(unit))
        for first in range(0, len(unit), BLOCK):
            apart = (unit[first : first + BLOCK] @ across - origin).reshape(-1, count, dimension)
            square = np.einsum("nki,nki->nk", apart, apart)
            each = size - 0.5 * (TAILS + dimension) * np.log1p(square / TAILS)
            top = each.max(axis=1)
            found[first : first + BLOCK] = top + np.log(np.exp(each - top[:, None]).sum(axis=1))
        return found - np.log(count)


def _learned(unit: NDArray[np.float64], raw: NDArray[np.float64], random: np.random.Generator) -> _Kernels:
    """Kernels around points that explain the data, as wide as their neighbours lie."""
    weight = _flattened(raw)
    chosen = unit[_systematic(weight, 4 * KERNELS, random)]
    centre = chosen[random.choice(len(chosen), KERNELS, replace=False)]
    dimension = unit.shape[1]
    size = np.sqrt(np.maximum(np.var(chosen, axis=0), 1e-16))
    near = max(4 * dimension, KERNELS // 2)
    distance = np.sum(((centre[:, None] - chosen[None]) / size) ** 2, axis=2)
    index = np.argsort(distance, axis=1)[:, :near]
    apart = chosen[index] - chosen[index].mean(axis=1, keepdims=True)
    local = np.einsum("kni,knj->kij", apart, apart) / near
    floor = (0.02 * size) ** 2 + 1e-14
    return _Kernels.of(centre, 0.6 * local + np.diag(floor))


def _flattened(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights, the posterior raised to the largest power up to one that leaves enough of them effective."""
    good = np.isfinite(raw)
    power, most = 1.0, min(LEAST, 0.5 * good.sum())
    while True:
        weight = np.where(good, np.exp(power * (np.where(good, raw, 0.0) - raw[good].max())), 0.0)
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= most or power < 1e-4:
            return weight
        power *= 0.7


def _systematic(weight: NDArray[np.float64], count: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Indices by weight, as even as chance lets them be."""
    steps = (np.arange(count) + random.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), steps), len(weight) - 1)
