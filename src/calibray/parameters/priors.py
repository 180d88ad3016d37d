"""Priors of parameters: log-normal around a value or another parameter, or Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, ndtri

from calibray.parameters.parameter import SCATTERING_SPREAD
from calibray.parameters.space import Parameters


@dataclass(frozen=True)
class LogNormal:
    """Gaussian priors on the logarithms of k parameters or, for parameters in `linear`, on the values.

    Attributes:
        index: Indices of the parameters that have a prior.
        centre: Medians, in the units of the parameters. For parameters in `like`, medians are ratios to the other
            parameter.
        spread: Standard deviations of the logarithms (0.3 corresponds to about 30 %), or of the values of parameters in
            `linear`.
        linear: Indices of the parameters with a Gaussian prior on the value, because the value can be negative.
        like: Pairs of indices: a parameter, and the parameter on which its prior is centred. In this way, members of a
            population scatter around a common value.

    Example:
        >>> prior = LogNormal((0,), (4.0,), (0.3,))
        >>> prior.residuals(np.array([[4.0, 1.0], [8.0, 1.0]])).round(2).tolist()
        [[0.0], [2.31]]
    """

    index: tuple[int, ...] = ()
    centre: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()
    linear: tuple[int, ...] = ()
    like: tuple[tuple[int, int], ...] = ()

    def __len__(self) -> int:
        return len(self.index)

    def extended(self, index: Sequence[int], centre: Sequence[float], spread: float) -> LogNormal:
        """These priors and, for further parameters, independent log-normal priors with a common spread.

        A prior centred on 0, which only scattering coefficients can have, has the standard deviation
        `SCATTERING_SPREAD`.
        """
        return replace(
            self,
            index=(*self.index, *index),
            centre=(*self.centre, *centre),
            spread=(*self.spread, *(spread if value > 0 else SCATTERING_SPREAD for value in centre)),
            linear=(
                *self.linear,
                *(number for number, value in zip(index, centre, strict=True) if value == 0),
            ),
        )

    def residuals(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Least-squares residuals [n, k] of the priors: (log value - log centre) / spread.

        The candidates [n, d] are in the units of the fields. Their values are positive, except for parameters in
        `linear`.
        """
        values, centre, linear = candidates[:, self._columns], np.array(self.centre), self._linear
        logarithm = np.log(np.where(linear, 1.0, values)) - np.log(np.where(linear, 1.0, centre))
        for row, reference in self._pairs:
            # The centre is a multiple of the common value of the population.
            logarithm[:, row] -= np.log(candidates[:, reference])
        return np.where(linear, values - centre, logarithm) / self.spread

    def jacobian(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives [n, k, d] of the residuals with respect to the parameters.

        The arguments are those of `residuals`.
        """
        jacobian = np.zeros((len(candidates), len(self), candidates.shape[1]))
        slope = np.where(self._linear, 1.0, candidates[:, self._columns])
        jacobian[:, np.arange(len(self)), self._columns] = 1.0 / (slope * self.spread)
        for row, reference in self._pairs:
            jacobian[:, row, reference] = -1.0 / (candidates[:, reference] * self.spread[row])
        return jacobian

    def log_normalization(
        self, candidates: NDArray[np.float64], parameters: Parameters
    ) -> NDArray[np.float64]:
        """Logarithm [n] of the integral of exp(-residual^2 / 2) between the bounds of the parameters in `like`.

        The integral depends on the parameters on which these priors are centred. The variables of integration are the
        search coordinates.
        """
        total = np.zeros(len(candidates))
        for row, reference in self._pairs:
            middle, low, high, tilt = self._interval(row, candidates[:, reference], parameters)
            # Integral over x of exp(-(log x - m)^2 / 2 s^2): exp(m + s^2 / 2) times a probability of N(m + s^2, s^2).
            total += tilt * (middle - tilt * self.spread[row] ** 2 / 2)
            # The normal distribution is symmetric, and differences of probabilities lose no precision below the mean.
            below, above = np.where(low > 0, [-high, -low], [low, high])
            total += log_ndtr(above) + np.log1p(-np.exp(log_ndtr(below) - log_ndtr(above)))
        return total

    def draw_like(
        self, candidates: NDArray[np.float64], parameters: Parameters, random: np.random.Generator
    ) -> NDArray[np.float64]:
        """Candidates [n, d] in which each parameter in `like` is drawn around the one on which its prior is centred."""
        drawn = candidates.copy()
        for row, reference in self._pairs:
            middle, low, high, _ = self._interval(row, candidates[:, reference], parameters)
            # This is inverse transform sampling between the bounds, below the mean as in `log_normalization`.
            side = np.where(low > 0, -1.0, 1.0)
            level = ndtr(side * low) + random.random(len(drawn)) * (ndtr(side * high) - ndtr(side * low))
            logarithm = middle + self.spread[row] * side * ndtri(np.clip(level, 1e-300, 1 - 1e-16))
            item = parameters.items[self.index[row]]
            drawn[:, self.index[row]] = np.clip(np.exp(logarithm), item.lower, item.upper)
        return drawn

    def _interval(
        self, row: int, reference: NDArray[np.float64], parameters: Parameters
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
        """Mean of the logarithm [n], and distance [n] of each bound from this mean, in standard deviations.

        The last result is 1 if the search coordinate is the value itself, which shifts the mean, and 0 if it is the
        logarithm.
        """
        item, spread = parameters.items[self.index[row]], self.spread[row]
        tilt = 0.0 if item.scale == "log" else 1.0
        middle = np.log(reference) + np.log(self.centre[row]) + tilt * spread**2
        low, high = ((np.log(bound) - middle) / spread for bound in (item.lower, item.upper))
        return middle, low, high, tilt

    @property
    def _pairs(self) -> tuple[tuple[int, int], ...]:
        """For each pair in `like`: index of the prior, and index of the parameter on which the prior is centred."""
        return tuple((self.index.index(parameter), reference) for parameter, reference in self.like)

    @property
    def _linear(self) -> NDArray[np.bool_]:
        return np.isin(self._columns, self.linear)

    @property
    def _columns(self) -> NDArray[np.int64]:
        return np.array(self.index, dtype=np.int64)


NO_PRIOR: Final = LogNormal()
