"""Fast densities of many gaps with one noise model each, for a moderate number of links.

Under Gaussian noise, correlated or not, the density with noise level and nuisance integrated out is a power of a
quadratic form of the gaps (`noise_models.py`), whose matrix is computed once. Under heavy tails, gaps with and without
an offset are evaluated together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.noise_models import HEAVY, Marginal

MAX_LINKS: Final = 300
"""Number of links up to which the matrices are stored; those of 26 Gaussian models then need 19 MB."""


@dataclass(frozen=True, eq=False)
class QuadraticForms:
    """A marginal density prepared for gaps that have one noise model each.

    Attributes:
        marginal: The density.
        group: Models that are evaluated together: the index of each Gaussian model, -1 for Student's t, -2 for gross
            errors [models].
        square: Matrix [m, m], constant and exponent of each Gaussian model's form, None for other models. Empty if
            there are too many links, or censored ones.
    """

    marginal: Marginal
    group: NDArray[np.int64]
    square: tuple[tuple[NDArray[np.float64], float, float] | None, ...]

    @classmethod
    def of(cls, marginal: Marginal) -> QuadraticForms:
        """Compute the forms of a density."""
        models = marginal.models
        group = [(-2 if model.gross else -1) if model.kind == HEAVY else k for k, model in enumerate(models)]
        if len(marginal.column) > MAX_LINKS or marginal.censored.any():
            return cls(marginal, np.array(group), ())
        square = (None if model.kind == HEAVY else marginal.form(model) for model in models)
        return cls(marginal, np.array(group), tuple(square))

    def densities(self, gap: NDArray[np.float64], model: NDArray[np.int64]) -> NDArray[np.float64]:
        """As `Marginal.densities`, under the model with the given index for each gap [n]."""
        models, log_density = self.marginal.models, np.full(len(gap), -np.inf)
        if not self.square:
            for index in np.unique(model).tolist():
                rows = model == index
                log_density[rows] = replace(self.marginal, models=(models[index],)).densities(gap[rows])[:, 0]
            return log_density
        finite = np.isfinite(gap).all(axis=1)
        group = self.group[model]
        for index in np.unique(group[finite]).tolist():
            rows = finite & (group == index)
            form = self.square[index] if index >= 0 else None
            if form is None:
                log_density[rows] = self.marginal.heavy(gap[rows], [models[k] for k in model[rows].tolist()])
            else:
                square, constant, exponent = form
                value = np.sum((gap[rows] @ square) * gap[rows], axis=1)
                log_density[rows] = constant - exponent * np.log(np.maximum(value, 1e-300))
        return log_density + np.log([other.weight for other in models])[model]
