"""Draws from the posterior: parameters that explain the data, as often as they should.

Importance sampling whose proposals learn (J.-M. Cornuet, J.-M. Marin, A. Mira and C. P. Robert, Adaptive multiple
importance sampling, Scandinavian Journal of Statistics 39, 2012). The first points are spread over the whole box and
around every minimum known, as wide as the curvature there says. Half of each further round is drawn from Student-t
kernels around points that explain the data, as wide as their neighbours lie; the other half takes each parameter by
itself from what explains the data: reflections inside walls make each of several permittivities fit at many narrow
places, and their combinations are more than any kernels could stand at. All points count, weighed by the posterior over
the mixture of all proposals, so that none is lost and no basin has to be crossed from another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
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

BINS: Final = 1600
"""Places of a parameter's range that are told apart where it is taken by itself."""

WIDTHS: Final = (1, 3, 8)
"""Places that what was learned is spread over, triangles of these half widths taken alike: what fits may be narrow."""

EVEN: Final = 0.1
"""Share of these draws that is spread over the whole range."""

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
        return self.point[self.chosen(count, seed)]

    def chosen(self, count: int, seed: int = 0) -> NDArray[np.intp]:
        """Their places among the draws.

        Args:
            count: Number of points.
            seed: Seed of the random numbers.

        Returns:
            Indices drawn by weight, ascending [count].
        """
        return systematic(self.weight, count, np.random.default_rng(seed))

    def tempered(self, divisor: float) -> Draws:
        """The same points, weighed by a density whose logarithm is divided.

        Args:
            divisor: By how much, 1 or more.

        Returns:
            Draws of a wider posterior; the same where weights are those of a flatter density already.
        """
        if self.flattened or divisor == 1.0:
            return self
        there = self.weight > 0
        wider = np.log(self.weight[there]) + (1.0 / divisor - 1.0) * self.density[there]
        weight = np.zeros_like(self.weight)
        weight[there] = np.exp(wider - wider.max())
        return replace(self, weight=weight / weight.sum())


def sample(
    density: Density,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    minima: NDArray[np.float64],
    covariance: NDArray[np.float64],
    *,
    batch: int = 512,
    rounds: int = 8,
    more: Callable[[], bool] = lambda: False,
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
        rounds: Rounds, the first not counted, that are made unless the draws are enough before.
        more: Whether there may be another round where fewer draws are effective than a round has points.
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
    proposals: list[_Kernels | _Learned] = [basins]
    share = [float(batch), float(batch)]
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
        if turn and draws.effective >= enough:
            return draws
        if turn >= rounds and (draws.effective >= batch or not more()):
            few = draws.effective < TOO_FEW
            return replace(draws, weight=_flattened(raw), flattened=True) if few else draws
        learned = _Learned(_kernels(unit, raw, random), _Apart.of(unit, _flattened(raw)))
        new = inside(learned.draw(batch, random))
        log_parts = [
            np.concatenate([part, each.log_density(new)])
            for part, each in zip(log_parts, proposals, strict=True)
        ]
        unit = np.concatenate([unit, new])
        found = np.concatenate([found, density(lower + new * width)])
        proposals.append(learned)
        log_parts.append(learned.log_density(unit))
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


@dataclass(frozen=True, eq=False)
class _Apart:
    """Every parameter by itself, evenly within each of many places of its range.

    Attributes:
        share: Probability of every place, by parameter [d, BINS].
    """

    share: NDArray[np.float64]

    @classmethod
    def of(cls, unit: NDArray[np.float64], weight: NDArray[np.float64]) -> _Apart:
        found = np.stack([np.histogram(each, BINS, (0.0, 1.0), weights=weight)[0] for each in unit.T])
        share = np.zeros_like(found)
        for width in WIDTHS:
            triangle = width + 1.0 - np.abs(np.arange(-width, width + 1))
            share += convolve1d(found, triangle / triangle.sum(), mode="reflect")
        return cls((1.0 - EVEN) * share / share.sum(axis=1, keepdims=True) + EVEN / BINS)

    def draw(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points [count, d]."""
        place = np.stack([random.choice(BINS, count, p=each) for each in self.share], axis=1)
        return (place + random.random(place.shape)) / BINS

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the density at points [n]."""
        place = np.minimum((unit * BINS).astype(np.int64), BINS - 1)
        return np.log(BINS * self.share[np.arange(len(self.share)), place]).sum(axis=1)


@dataclass(frozen=True, eq=False)
class _Learned:
    """What a round draws from, half from each.

    Attributes:
        kernels: Around points that explain the data.
        apart: Every parameter by itself.
    """

    kernels: _Kernels
    apart: _Apart

    def draw(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points [count, d]."""
        half = count // 2
        return np.concatenate([self.kernels.draw(count - half, random), self.apart.draw(half, random)])

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of the density at points [n]."""
        return np.logaddexp(self.kernels.log_density(unit), self.apart.log_density(unit)) - np.log(2.0)


def _kernels(unit: NDArray[np.float64], raw: NDArray[np.float64], random: np.random.Generator) -> _Kernels:
    """Kernels around points that explain the data, as wide as their neighbours lie."""
    weight = _flattened(raw)
    chosen = unit[systematic(weight, 4 * KERNELS, random)]
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


def systematic(weight: NDArray[np.float64], count: int, random: np.random.Generator) -> NDArray[np.intp]:
    """Indices by weight, as even as chance lets them be."""
    steps = (np.arange(count) + random.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), steps), len(weight) - 1)
