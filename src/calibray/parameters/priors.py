"""What is known of parameters before they are calibrated: log-normal around a value, as that of ITU-R P.2040."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LogNormal:
    """Independent Gaussian priors of the logarithms of some parameters.

    Attributes:
        index: Places of the parameters that have one.
        centre: The values around which they lie, in the parameters' units.
        spread: Standard deviations of the logarithms: 0.3 stands for about 30 %.

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
        """Rows of residuals, in units of the noise, that stand for the priors.

        Args:
            candidates: Parameter values [n, d], in the fields' units, greater than 0.

        Returns:
            Standard deviations between the logarithms and their centres [n, k].
        """
        return (np.log(candidates[:, self._place]) - np.log(self.centre)) / self.spread

    def jacobian(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of the rows by the parameters.

        Args:
            candidates: Parameter values [n, d], in the fields' units, greater than 0.

        Returns:
            Derivatives [n, k, d].
        """
        found = np.zeros((len(candidates), len(self), candidates.shape[1]))
        found[:, np.arange(len(self)), self._place] = 1.0 / (candidates[:, self._place] * self.spread)
        return found

    @property
    def _place(self) -> NDArray[np.int64]:
        return np.array(self.index, dtype=np.int64)


NO_PRIOR: Final = LogNormal()
