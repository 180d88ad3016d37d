"""Priors of parameters: log-normal around a value, such as that of ITU-R P.2040."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LogNormal:
    """Independent Gaussian priors of the logarithms of k parameters.

    Attributes:
        index: Numbers of the parameters that have a prior.
        centre: Medians, in the parameters' units.
        spread: Standard deviations of the logarithms: 0.3 is about 30 %.

    Example:
        >>> prior = LogNormal((0,), (4.0,), (0.3,))
        >>> prior.residuals(np.array([[4.0, 1.0], [8.0, 1.0]])).round(2).tolist()
        [[0.0], [2.31]]
    """

    index: tuple[int, ...] = ()
    centre: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """The priors as residuals of a least-squares problem: (log value - log centre) / spread [n, k].

        Candidates [n, d] are in the fields' units, greater than 0.
        """
        return (np.log(candidates[:, self._columns]) - np.log(self.centre)) / self.spread

    def jacobian(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of the residuals with respect to the parameters [n, k, d]; arguments as for `residuals`."""
        jacobian = np.zeros((len(candidates), len(self), candidates.shape[1]))
        jacobian[:, np.arange(len(self)), self._columns] = 1.0 / (candidates[:, self._columns] * self.spread)
        return jacobian

    @property
    def _columns(self) -> NDArray[np.int64]:
        return np.array(self.index, dtype=np.int64)


NO_PRIOR: Final = LogNormal()
