"""Draws from the posterior by adaptive importance sampling.

Adaptive multiple importance sampling (J.-M. Cornuet, J.-M. Marin, A. Mira and C. P. Robert, Scandinavian Journal of
Statistics 39, 2012). The first points cover the whole box and the neighbourhood of every known minimum, with the
covariance from the curvature. Half of each further round is drawn from Student-t kernels around points of high density,
with the covariance of their neighbours. The other half draws each parameter independently from its smoothed histogram:
reflections inside walls give each of several permittivities many narrow modes, with more combinations than there are
kernels. All points count, weighted by the posterior over the mixture of all proposals, so no basin has to be reached
from another.
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
"""Effective draws that intervals need: a 95 % interval then has some 12 draws in each tail."""

LEAST: Final = 60.0
"""Effective points that kernels need; with fewer, the density is flattened."""

TOO_FEW: Final = 20.0
"""Effective draws below which the ends of a posterior are unknown: fewer than one is expected beyond a 95 % interval.
The density is then flattened until `LEAST` draws are effective."""

BLOCK: Final = 256
"""Points that kernels are evaluated at together; intermediate arrays then fit into a core's cache."""

BINS: Final = 1600
"""Bins of the histogram of one parameter."""

WIDTHS: Final = (1, 3, 8)
"""Half widths, in bins, of the triangles that smooth the histogram; the mean of all three keeps narrow peaks."""

UNIFORM: Final = 0.1
"""Share of the histogram's draws that is uniform over the whole range."""

Density = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Maps points [n, d] to the log posterior up to a constant [n]; -inf outside its support."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Weighted points.

    Attributes:
        point: The points [n, d].
        density: Log posterior at the points, up to a constant [n].
        weight: Their weights, with sum one [n].
        flattened: Whether the weights are those of a flatter, wider density because too few draws were effective.
    """

    point: NDArray[np.float64]
    density: NDArray[np.float64]
    weight: NDArray[np.float64]
    flattened: bool = False

    @property
    def effective(self) -> float:
        """Number of independent draws that would be as informative."""
        return float(1.0 / np.sum(self.weight**2))

    def resampled(self, count: int, seed: int = 0) -> NDArray[np.float64]:
        """Points of equal weight.

        Args:
            count: Their number.
            seed: Seed of the random numbers.

        Returns:
            Points drawn by their weights [count, d].
        """
        return self.point[self.indices(count, seed)]

    def indices(self, count: int, seed: int = 0) -> NDArray[np.intp]:
        """Indices of points of equal weight.

        Args:
            count: Number of points.
            seed: Seed of the random numbers.

        Returns:
            Indices drawn by weight, ascending [count].
        """
        return systematic_resampling(self.weight, count, np.random.default_rng(seed))

    def tempered(self, divisor: float) -> Draws:
        """The same points with the weights of a divided log density.

        Args:
            divisor: Divisor of the log density, 1 or more.

        Returns:
            Draws of a wider posterior; unchanged if the weights are already flattened.
        """
        if self.flattened or divisor == 1.0:
            return self
        positive = self.weight > 0
        wider = np.log(self.weight[positive]) + (1.0 / divisor - 1.0) * self.density[positive]
        weight = np.zeros_like(self.weight)
        weight[positive] = np.exp(wider - wider.max())
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
        density: The log posterior.
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        minima: Minima of all known basins [k, d].
        covariance: Covariance of the parameters at the minima by curvature [k, d, d].
        batch: Points per round.
        rounds: Rounds after the first, unless enough draws are effective earlier.
        more: Whether further rounds are allowed while fewer draws are effective than a round has points.
        enough: Effective draws that end the sampling.
        seed: Seed of the random numbers.

    Returns:
        Weighted points.

    Raises:
        ValueError: The density is finite nowhere.
    """
    random, width, dimension = np.random.default_rng(seed), upper - lower, len(lower)
    spread = covariance / np.outer(width, width) * 1.5**2 + 1e-12 * np.eye(dimension)
    basins = _Kernels.of((minima - lower) / width, spread)
    uniform = design("sobol", batch, dimension, random)
    unit = np.concatenate([uniform, _inside(basins.draw(batch, random))])
    log_posterior = density(lower + unit * width)
    proposals: list[_Kernels | _Proposal] = [basins]
    share = [float(batch), float(batch)]
    log_proposals = [basins.log_density(unit)]
    while True:
        # The uniform points have density 1. Points outside the box were dropped; they would have weight 0.
        parts = np.stack([np.zeros(len(unit)), *log_proposals])
        mixture = np.logaddexp.reduce(parts + np.log(np.array(share) / sum(share))[:, None], axis=0)
        log_weight = log_posterior - mixture
        if not np.isfinite(log_weight).any():
            raise ValueError("the density is finite nowhere")
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        draws, turn = Draws(lower + unit * width, log_posterior, weight), len(share) - 2
        if turn and draws.effective >= enough:
            return draws
        if turn >= rounds and (draws.effective >= batch or not more()):
            if draws.effective < TOO_FEW:
                return replace(draws, weight=_flattened(log_weight), flattened=True)
            return draws
        flattened = _flattened(log_weight)
        proposal = _Proposal(_kernels(unit, flattened, random), _Histograms.of(unit, flattened))
        new = _inside(proposal.draw(batch, random))
        log_proposals = [
            np.concatenate([values, earlier.log_density(new)])
            for values, earlier in zip(log_proposals, proposals, strict=True)
        ]
        unit = np.concatenate([unit, new])
        log_posterior = np.concatenate([log_posterior, density(lower + new * width)])
        proposals.append(proposal)
        log_proposals.append(proposal.log_density(unit))
        share.append(float(batch))


def pooled(parts: Sequence[Draws]) -> Draws:
    """Pool draws from several equally likely posteriors.

    Args:
        parts: Draws from each posterior.

    Returns:
        All draws.
    """
    return Draws(
        np.concatenate([part.point for part in parts]),
        np.concatenate([part.density for part in parts]),
        np.concatenate([part.weight for part in parts]) / len(parts),
        any(part.flattened for part in parts),
    )


def _inside(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points within the unit cube [k, d]."""
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
        kernel = random.permutation(np.arange(count) % len(self.centre))
        normal = random.standard_normal((count, self.centre.shape[1]))
        stretch = np.sqrt(TAILS / random.chisquare(TAILS, count))
        return self.centre[kernel] + stretch[:, None] * np.einsum("nij,nj->ni", self.root[kernel], normal)

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density at points [n]."""
        count, dimension = self.centre.shape
        # All kernels whiten a block of points with one matrix product.
        inverse = np.linalg.inv(self.root)
        across = inverse.transpose(2, 0, 1).reshape(dimension, -1)
        origin = np.einsum("kij,kj->ki", inverse, self.centre).ravel()
        constant = (
            gammaln((TAILS + dimension) / 2) - gammaln(TAILS / 2) - 0.5 * dimension * np.log(TAILS * np.pi)
        )
        size = constant - np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum(axis=1)
        total = np.empty(len(unit))
        for first in range(0, len(unit), BLOCK):
            white = (unit[first : first + BLOCK] @ across - origin).reshape(-1, count, dimension)
            square = np.einsum("nki,nki->nk", white, white)
            by_kernel = size - 0.5 * (TAILS + dimension) * np.log1p(square / TAILS)
            top = by_kernel.max(axis=1)
            total[first : first + BLOCK] = top + np.log(np.exp(by_kernel - top[:, None]).sum(axis=1))
        return total - np.log(count)


@dataclass(frozen=True, eq=False)
class _Histograms:
    """Independent parameters, each with a smoothed histogram as its density.

    Attributes:
        share: Probability of every bin, by parameter [d, BINS].
    """

    share: NDArray[np.float64]

    @classmethod
    def of(cls, unit: NDArray[np.float64], weight: NDArray[np.float64]) -> _Histograms:
        raw = np.stack([np.histogram(column, BINS, (0.0, 1.0), weights=weight)[0] for column in unit.T])
        share = np.zeros_like(raw)
        for width in WIDTHS:
            triangle = width + 1.0 - np.abs(np.arange(-width, width + 1))
            share += convolve1d(raw, triangle / triangle.sum(), mode="reflect")
        return cls((1.0 - UNIFORM) * share / share.sum(axis=1, keepdims=True) + UNIFORM / BINS)

    def draw(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points [count, d]."""
        bins = np.stack([random.choice(BINS, count, p=share) for share in self.share], axis=1)
        return (bins + random.random(bins.shape)) / BINS

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density at points [n]."""
        bins = np.minimum((unit * BINS).astype(np.int64), BINS - 1)
        return np.log(BINS * self.share[np.arange(len(self.share)), bins]).sum(axis=1)


@dataclass(frozen=True, eq=False)
class _Proposal:
    """The proposal of a round: half kernels, half histograms.

    Attributes:
        kernels: Kernels around points of high density.
        histograms: Independent parameters.
    """

    kernels: _Kernels
    histograms: _Histograms

    def draw(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points [count, d]."""
        half = count // 2
        return np.concatenate([self.kernels.draw(count - half, random), self.histograms.draw(half, random)])

    def log_density(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density at points [n]."""
        return np.logaddexp(self.kernels.log_density(unit), self.histograms.log_density(unit)) - np.log(2.0)


def _kernels(unit: NDArray[np.float64], weight: NDArray[np.float64], random: np.random.Generator) -> _Kernels:
    """Kernels around points of high density, with the covariance of their neighbours."""
    chosen = unit[systematic_resampling(weight, 4 * KERNELS, random)]
    centre = chosen[random.choice(len(chosen), KERNELS, replace=False)]
    dimension = unit.shape[1]
    size = np.sqrt(np.maximum(np.var(chosen, axis=0), 1e-16))
    near = max(4 * dimension, KERNELS // 2)
    distance = np.sum(((centre[:, None] - chosen[None]) / size) ** 2, axis=2)
    index = np.argsort(distance, axis=1)[:, :near]
    deviation = chosen[index] - chosen[index].mean(axis=1, keepdims=True)
    local = np.einsum("kni,knj->kij", deviation, deviation) / near
    floor = (0.02 * size) ** 2 + 1e-14
    return _Kernels.of(centre, 0.6 * local + np.diag(floor))


def _flattened(log_weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights to the largest power, at most one, that leaves `LEAST` points effective."""
    finite = np.isfinite(log_weight)
    power, target = 1.0, min(LEAST, 0.5 * finite.sum())
    relative = np.where(finite, log_weight, 0.0) - log_weight[finite].max()
    while True:
        weight = np.where(finite, np.exp(power * relative), 0.0)
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= target or power < 1e-4:
            return weight
        power *= 0.7


def systematic_resampling(
    weight: NDArray[np.float64], count: int, random: np.random.Generator
) -> NDArray[np.intp]:
    """Draw indices by weight with equally spaced quantiles and one random shift [count]."""
    quantile = (np.arange(count) + random.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), quantile), len(weight) - 1)
