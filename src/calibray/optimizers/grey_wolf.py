"""Grey wolf optimizers: the canonical GWO, which is the baseline of the SGWO-IM paper, and SGWO-IM itself.

GWO: S. Mirjalili, S. M. Mirjalili, A. Lewis, "Grey Wolf Optimizer", Advances in Engineering Software 69, 2014. Where
descriptions and common implementations differ, the following choices apply:

- Iteration t = 1..T evaluates the whole population, and then moves the population with a(t) = 2 (1 - t/T). The move
  after the last evaluation is omitted, so a run takes exactly N T evaluations.
- alpha, beta and delta are the three best *distinct* points of the whole run (not of the last generation), with ties in
  the order of evaluation. Wolves at the same point count as one leader.
- Wolves always move, even if the new position is worse.
- Positions outside the bounds are clipped to the bounds before evaluation.
- A failed evaluation (+inf) ranks last and has no other effect.
- C multiplies a position, so steps are short near the origin of the coordinates and long far from the origin. The pack
  is therefore biased towards the origin, as in the published method.

SGWO-IM, the Surrogate-assisted Grey Wolf Optimizer with Individual Memory: X. Zou, P. Tang, P. Liu, C. Tai, "Efficient
and Accurate Surrogate-Assisted Electromagnetic Parameter Calibration for 6G Digital Twin Channels", Algorithm 1 and
eqs. 2 to 4. The defaults are those of Table II in the paper: N = 30, T = 20, cosine convergence, memory weight 0.1 to
0.3, 5 full iterations, and K = 5 real evaluations in each later iteration. A run therefore takes 5 * 30 + 15 * 5 = 225
evaluations.

Where the paper is silent, the following choices apply, in addition to those for GWO:

- "RBF model is available" means t > `full_iterations`. In every iteration, the model is refitted to all real
  evaluations of the run, including those that were not requested.
- Wolves that the surrogate does not select still move. Only real evaluations change the memory of a wolf.
- Each memory starts at the initial position with a score of infinity, and is replaced only by an evaluation with a
  strictly lower score.
- The K elites are evaluated in ascending order of their predicted values; ties keep the order of the pack.
- Memory fusion (eq. 3) uses X_GWO before clipping; the fused position is then clipped.
- Predictions determine only which wolves are evaluated. Leaders, memories and the best point come from the archive of
  real evaluations.

With `w_min = w_max = 0`, linear convergence and no surrogate, SGWO-IM gives the same results as GWO, bit for bit.

The surrogate is SciPy's `RBFInterpolator` with a cubic kernel, a linear tail, inputs scaled to the unit cube and
smoothing 1e-6. Repeated points are merged, and their objectives are averaged. A failed evaluation is assigned the worst
successful value, so that the model avoids the failed point and is fitted to finite values only.
"""

from __future__ import annotations

from math import cos, pi
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RBFInterpolator

from calibray.errors import InputError
from calibray.optimizers.arguments import Box, choice, real, whole
from calibray.optimizers.evaluations import Archive, Evaluations, merge_repeated, read_only
from calibray.optimizers.protocol import Optimizer, Schedule, Search, Session
from calibray.support.messages import counted

LEADERS = 3
"""Number of leaders: alpha, beta and delta."""

WOLVES = 30
"""Number of wolves, N in the paper (Table II)."""

LEAST_BUDGET = 24
"""Smallest budget of both methods. With this budget, SGWO-IM has three wolves, one for each leader, and uses the whole
budget."""

FULL_ITERATIONS = 5
"""Number of iterations that evaluate all wolves (Table II)."""

ELITES = 5
"""Number of wolves evaluated in each later iteration, K in the paper (Table II)."""

SMOOTHING = 1e-6


def linear_decay(iteration: int, iterations: int) -> float:
    """The standard convergence factor a(t) = 2 (1 - t / T) in iteration t = 1..T."""
    return 2.0 * (1.0 - iteration / iterations)


def encircle(
    positions: NDArray[np.float64],
    leaders: NDArray[np.float64],
    a: float,
    r1: NDArray[np.float64],
    r2: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Move a pack under the guidance of its leaders (Mirjalili et al. 2014, eqs. 3.1 to 3.7).

    `r1` and `r2` [n, 3, d] are independent uniform random numbers, and `leaders` contains alpha, beta and delta [3, d].
    Returns X_GWO, the mean of the three guided positions [n, d], before clipping.
    """
    a_coefficient = 2.0 * a * r1 - a  # A, eq. 3.3
    c_coefficient = 2.0 * r2  # C, eq. 3.4
    distance = np.abs(c_coefficient * leaders - positions[:, None, :])  # D, eq. 3.5
    return (leaders - a_coefficient * distance).mean(axis=1)  # eqs. 3.6, 3.7


def whole_iterations(budget: int) -> dict[str, int]:
    """The settings of GWO for a given budget: 30 wolves, and as many complete iterations as the budget allows.

    If the budget does not allow two iterations of 30 wolves, there are fewer wolves.

    Example:
        >>> whole_iterations(600), whole_iterations(45)
        ({'population': 30, 'iterations': 20}, {'population': 22, 'iterations': 2})
    """
    wolves = min(WOLVES, budget // 2)
    return {"population": wolves, "iterations": budget // wolves}


@final
class GWO(Optimizer):
    """Grey Wolf Optimizer. The method uses only objective values and takes 600 evaluations by default.

    Args:
        population: Number of wolves, N.
        iterations: Number of iterations, T.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> opt = GWO([-5.0, -5.0], [5.0, 5.0], seed=1)
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     opt.tell(x, np.sum((x - 2.0) ** 2, axis=1))
        >>> opt.evaluations, bool(opt.best.y < 0.01)
        (600, True)
    """

    schedule: ClassVar[Schedule | None] = Schedule(whole_iterations, LEAST_BUDGET)

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        population: int = WOLVES,
        iterations: int = 20,
    ) -> None:
        self.box = Box.between(lower, upper)
        self.population = whole("population", population, at_least=LEADERS)
        self.iterations = whole("iterations", iterations, at_least=1)
        self._budget = self.population * self.iterations
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    @property
    def leaders(self) -> NDArray[np.float64]:
        """Positions of alpha, beta and delta [3, d]."""
        return self._session.archive.leaders(LEADERS)

    def _search(self, archive: Archive) -> Search:
        positions = self.box.from_unit(self._rng.random((self.population, self.box.dimension)))
        for iteration in range(1, self.iterations + 1):
            yield positions
            r1, r2 = self._rng.random((2, self.population, LEADERS, self.box.dimension))
            a = linear_decay(iteration, self.iterations)
            positions = self.box.clip(encircle(positions, archive.leaders(LEADERS), a, r1, r2))


def cosine_decay(iteration: int, iterations: int) -> float:
    """The paper's convergence factor a(t) = 2 cos(pi t / (2 T)) in iteration t = 1..T (eq. 2)."""
    return 2.0 * cos(0.5 * pi * iteration / iterations)


def memory_weight(iteration: int, iterations: int, w_min: float, w_max: float) -> float:
    """The weight of a wolf's memory in iteration t, w(t) = w_min + (w_max - w_min) (t / T)^2 (paper eq. 4)."""
    return w_min + (w_max - w_min) * (iteration / iterations) ** 2


CONVERGENCE = {"cosine": cosine_decay, "linear": linear_decay}


def screened_iterations(budget: int) -> dict[str, int]:
    """The settings of SGWO-IM for a given budget: the paper's schedule (225 evaluations), scaled if the budget differs.

    At most two thirds of the budget are spent on 5 full iterations of at most 30 wolves. The rest is spent on
    iterations of at most 5 elites.

    Example:
        >>> screened_iterations(225)
        {'population': 30, 'elites': 5, 'iterations': 20}
    """
    wolves = min(WOLVES, 2 * budget // (3 * FULL_ITERATIONS))
    elites = min(ELITES, wolves)
    rest = budget - FULL_ITERATIONS * wolves
    return {"population": wolves, "elites": elites, "iterations": FULL_ITERATIONS + rest // elites}


@final
class SGWOIM(Optimizer):
    """The paper's optimizer. The method uses only objective values and takes 225 evaluations by default.

    Args:
        population: Number of wolves, N.
        iterations: Number of iterations, T.
        full_iterations: Number of iterations that evaluate the whole population before the surrogate selects wolves.
        elites: Number of wolves evaluated in each later iteration, K.
        w_min: Memory weight at the start of the run.
        w_max: Memory weight at the end of the run.
        convergence: "cosine" (the paper's eq. 2) or "linear" (standard GWO).
        surrogate: Whether the surrogate selects the wolves to evaluate; if not, every iteration evaluates the whole
            population.

    Raises:
        InputError: An argument is out of range.
    """

    schedule: ClassVar[Schedule | None] = Schedule(screened_iterations, LEAST_BUDGET)

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        population: int = WOLVES,
        iterations: int = 20,
        full_iterations: int = FULL_ITERATIONS,
        elites: int = ELITES,
        w_min: float = 0.1,
        w_max: float = 0.3,
        convergence: str = "cosine",
        surrogate: bool = True,
    ) -> None:
        self.box = Box.between(lower, upper)
        self.population = whole("population", population, at_least=LEADERS)
        self.iterations = whole("iterations", iterations, at_least=1)
        self.full_iterations = whole("full_iterations", full_iterations, at_least=1)
        self.elites = whole("elites", elites, at_least=1, at_most=self.population)
        self.w_min = real("w_min", w_min, at_least=0.0, at_most=1.0)
        self.w_max = real("w_max", w_max, at_least=0.0, at_most=1.0)
        self.convergence = choice("convergence", convergence, CONVERGENCE)
        self.surrogate = surrogate
        samples, d = self.population * self.full_iterations, self.box.dimension
        if surrogate and samples <= d:
            raise InputError(
                f"population * full_iterations = {samples} samples; a surrogate of {counted(d, 'parameter')} needs at "
                f"least {d + 1}: raise the budget, population or full_iterations"
            )
        full = min(self.full_iterations, self.iterations) if surrogate else self.iterations
        self._budget = self.population * full + self.elites * (self.iterations - full)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._memory: Evaluations | None = None
        self._session = Session(self.box, self.uses, self._search)

    @property
    def leaders(self) -> NDArray[np.float64]:
        """Positions of alpha, beta and delta [3, d]."""
        return self._session.archive.leaders(LEADERS)

    @property
    def memory(self) -> Evaluations:
        """The best evaluation of each wolf; before the first evaluation, the initial position and the value +inf.

        Raises:
            InputError: `ask` has not been called yet.
        """
        if self._memory is None:
            raise InputError(
                "the pack has no memory before the first evaluation: call ask() and tell() first"
            )
        return self._memory

    def _search(self, archive: Archive) -> Search:
        total, shape = self.iterations, (self.population, self.box.dimension)
        positions = self.box.from_unit(self._rng.random(shape))
        memory = Evaluations(positions, np.full(self.population, np.inf))
        for iteration in range(1, total + 1):
            wolves = self._screen(archive, positions, iteration)
            answers = yield positions[wolves]
            self._memory = memory = remember(memory, wolves, answers)
            a = CONVERGENCE[self.convergence](iteration, total)  # eq. 2
            w = memory_weight(iteration, total, self.w_min, self.w_max)  # eq. 4
            r1, r2 = self._rng.random((2, self.population, LEADERS, self.box.dimension))
            guided = encircle(positions, archive.leaders(LEADERS), a, r1, r2)
            positions = self.box.clip((1.0 - w) * guided + w * memory.x)  # eq. 3

    def _screen(self, archive: Archive, positions: NDArray[np.float64], iteration: int) -> NDArray[np.intp]:
        """The wolves to evaluate: all wolves in full iterations, then the K wolves that the surrogate ranks best."""
        if not self.surrogate or iteration <= self.full_iterations:
            return np.arange(self.population)
        predicted = predict(archive, positions)
        return np.argsort(predicted, kind="stable")[: self.elites]


def remember(memory: Evaluations, wolves: NDArray[np.intp], answers: Evaluations) -> Evaluations:
    """Update the memory of each evaluated wolf whose new score is strictly lower than the remembered score."""
    x, y = memory.x.copy(), memory.y.copy()
    better = answers.y < y[wolves]
    x[wolves[better]], y[wolves[better]] = answers.x[better], answers.y[better]
    return Evaluations(read_only(x), read_only(y))


def predict(archive: Archive, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Predict the objective at candidates [n, d] from all real evaluations; zero if all evaluations failed.

    The archive must contain at least d + 1 distinct points that span the box.
    """
    if not np.isfinite(archive.best.y):
        return np.zeros(len(candidates))
    evaluated = archive.imputed(archive.all())
    x, y = merge_repeated(archive.box.to_unit(evaluated.x), evaluated.y)
    model = RBFInterpolator(x, y, smoothing=SMOOTHING, kernel="cubic", degree=1)
    return model(archive.box.to_unit(candidates))
