"""Bayesian optimization: a Gaussian process models the value, and the expected improvement selects candidates.

This method models the value alone, whereas `VectorSurrogate` models every residual; both use `regression.py`. A run
begins with a maximin Latin hypercube. Every further candidate maximizes the logarithm of the expected improvement (D.
R. Jones, M. Schonlau, W. J. Welch, J. Global Optim. 13 (1998) 455, eq. 15; for the logarithm, see S. Ament et al.,
NeurIPS 2023, arXiv:2310.20708). In the model, a failed evaluation is assigned the worst successful value.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfcx, ndtr

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.evaluations import Archive, merge_repeated
from calibray.optimizers.protocol import Optimizer, Search, Session
from calibray.optimizers.regression import Kriging, fit, solve
from calibray.optimizers.sampling import SEPARATION, distance_to_nearest, draw_around, maximin_design

CANDIDATES = 300
"""Number of candidates drawn over the whole box, and also the number drawn around the best points."""


@final
class GaussianProcess(Optimizer):
    """Bayesian optimization. The method uses only objective values and takes 20 d evaluations by default.

    Args:
        budget: Number of evaluations; 20 d if None.
        initial: Size of the initial design; 2 (d + 1) if None. Points already passed to `tell` count towards this size.

    Raises:
        InputError: An argument is out of range.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int | None = None,
        initial: int | None = None,
    ) -> None:
        self.box = Box.between(lower, upper)
        d = self.box.dimension
        self._budget = 20 * d if budget is None else whole("budget", budget, at_least=1)
        self.initial = 2 * (d + 1) if initial is None else whole("initial", initial, at_least=d + 2)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    def _search(self, archive: Archive) -> Search:
        d, left = self.box.dimension, self._budget
        model: Kriging | None = None
        missing = min(left, max(self.initial - len(archive), 0))
        if missing:
            yield self.box.from_unit(maximin_design(missing, d, self._rng))
            left -= missing
        for turn in range(left):
            evaluated = archive.imputed(archive.all())
            unit = self.box.to_unit(evaluated.x)
            points, values = merge_repeated(unit, evaluated.y[:, None])
            spanned = np.linalg.matrix_rank(points - points.mean(axis=0)) == d
            if not spanned or len(points) < d + 2 or np.ptp(values) == 0.0:  # too little data for a model
                x = self._rng.random(d)
            else:
                kernel = None if model is None else model.process.kernel
                # The kernel is fitted at every step until there are 40 points, and at every tenth step afterwards.
                if kernel is None or len(points) <= 40 or turn % 10 == 0:
                    model = fit(points, values, guess=kernel)
                else:
                    model = solve(points, values, kernel)
                x = self._promising(model, unit[np.argsort(evaluated.y, kind="stable")])
            yield self.box.from_unit(x[None])

    def _promising(self, model: Kriging, taken: NDArray[np.float64]) -> NDArray[np.float64]:
        """The point [d] with the largest expected improvement; `taken` contains the evaluated points, best first."""
        d, best = self.box.dimension, float(model.residuals.min())
        around = draw_around(taken[:5], CANDIDATES, -3.0, self._rng)
        candidates = np.vstack([self._rng.random((CANDIDATES, d)), around])
        promise = log_improvement(model, candidates, best)
        # Draw candidates at ever shorter distances from the best candidate so far.
        for reach in (0.1, 0.01, 0.001):
            closer = reach * self._rng.standard_normal((CANDIDATES // 3, d))
            closer = np.clip(candidates[np.argmax(promise)] + closer, 0.0, 1.0)
            candidates = np.vstack([candidates, closer])
            promise = np.append(promise, log_improvement(model, closer, best))
        fresh = distance_to_nearest(candidates, taken) > SEPARATION
        return candidates[np.argmax(np.where(fresh, promise, -np.inf))]


def log_improvement(model: Kriging, x: NDArray[np.float64], best: float) -> NDArray[np.float64]:
    """Logarithm [k] of the expected improvement over the best value at the points x [k, d]."""
    mean, share = model.predict(x)
    spread = np.sqrt(np.maximum(share * model.variance[0], 1e-300))
    z = (best - mean[:, 0]) / spread
    return np.log(spread) + log_shape(z)


def log_shape(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The logarithm of phi(z) + z Phi(z), accurate even if this sum is tiny; z [k] is in standard deviations.

    Example:
        >>> import numpy as np
        >>> log_shape(np.array([0.0, -1e6])).round(3).tolist()
        [-0.919, -500000000028.55]
    """
    high, low = np.maximum(z, -1.0), np.minimum(z, -1.0)
    # phi(z) + z Phi(z) = phi(z) (1 + z Phi(z) / phi(z)); the second factor tends to 1 / z^2.
    ratio = 1.0 + low * np.sqrt(np.pi / 2.0) * erfcx(-low / np.sqrt(2.0))
    rest = np.where(low < -1e4, -2.0 * np.log(-low), np.log(np.maximum(ratio, 1e-300)))
    tail = -0.5 * low**2 - 0.5 * np.log(2.0 * np.pi) + rest
    density = np.exp(-0.5 * high**2) / np.sqrt(2.0 * np.pi)
    return np.where(z > -1.0, np.log(density + high * ndtr(high)), tail)
