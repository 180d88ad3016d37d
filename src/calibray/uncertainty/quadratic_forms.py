"""Densities of measurements, each under a model of the noise of its own, of few links that are asked for many times.

Under Gaussian noise, whether links share errors or not, what is left of gaps once size and nuisances are integrated out
is a quadratic form of them (`marginal.py`), whose matrix is made once. Under heavy tails, gaps with an offset and
without go together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.uncertainty.noise_models import CORRELATED, GAUSSIAN, HEAVY, Marginal

LINKS: Final = 300
"""Links beyond which the matrices of all models would take up too much."""


@dataclass(frozen=True, eq=False)
class Forms:
    """What a marginal density takes for gaps each of which has one of its models.

    Attributes:
        marginal: The density.
        group: What is asked for together: each Gaussian model by its place, -1 for Student's tails, -2 for gross errors
            [models].
        square: Matrix [m, m], constant and power of each Gaussian model's form, None of others; nothing where links are
            too many, or where they need what only the density has.
    """

    marginal: Marginal
    group: NDArray[np.int64]
    square: tuple[tuple[NDArray[np.float64], float, float] | None, ...]

    @classmethod
    def of(cls, marginal: Marginal) -> Forms:
        """Make them.

        Args:
            marginal: The density.
        """
        models = marginal.models
        group = [(-2 if each.gross else -1) if each.kind == HEAVY else k for k, each in enumerate(models)]
        known = {model.kind for model in models} <= {GAUSSIAN, CORRELATED, HEAVY}
        if len(marginal.column) > LINKS or marginal.unheard.any() or not known:
            return cls(marginal, np.array(group), ())
        square = (None if model.kind == HEAVY else marginal.form(model) for model in models)
        return cls(marginal, np.array(group), tuple(square))

    def densities(self, gap: NDArray[np.float64], model: NDArray[np.int64]) -> NDArray[np.float64]:
        """Logarithm of the model's weight times the density of the measurements.

        Args:
            gap: Measured minus modelled path loss, without the nuisance, times the roots of the weights [n, m], [dB].
            model: The model of each, by its place [n].

        Returns:
            The logarithms [n]; -inf where a gap is not finite.
        """
        models, found = self.marginal.models, np.full(len(gap), -np.inf)
        if not self.square:
            for index in np.unique(model).tolist():
                mine = model == index
                found[mine] = replace(self.marginal, models=(models[index],)).densities(gap[mine])[:, 0]
            return found
        good = np.isfinite(gap).all(axis=1)
        group = self.group[model]
        for index in np.unique(group[good]).tolist():
            mine = good & (group == index)
            form = self.square[index] if index >= 0 else None
            if form is None:
                found[mine] = self.marginal.heavy(gap[mine], [models[k] for k in model[mine].tolist()])
            else:
                square, constant, half = form
                value = np.sum((gap[mine] @ square) * gap[mine], axis=1)
                found[mine] = constant - half * np.log(np.maximum(value, 1e-300))
        return found + np.log([each.weight for each in models])[model]
