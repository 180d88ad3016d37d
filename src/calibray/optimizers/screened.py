"""SGWO-IM screened by a model that is handed in: the smallest change of the paper's method that profits from physics.

The paper screens wolves by radial basis functions of the objective, which know nothing before five full packs have
been paid for. Who has a cheap model of the engine, such as a simpler trace of the same scene, can screen from the
first: the pack is the best of ten times as many places, and of every pack the K wolves that the cheap model finds best
are evaluated. At 225 evaluations these are 45 packs, in place of the paper's 20.

A cheap model is wrong somewhere, and a screen that believed it would search the wrong basin for good. So the paper's
radial basis functions of what it missed, the engine's objective less the cheap model's, are added to it, as soon as
there are points enough for them. Without a cheap model the first pack is evaluated whole, and these are functions of
the objective itself: the paper's screen, from the second pack on.

Moves, memory, leaders and all else are those of `sgwoim.py`; predictions enter nothing but the screening.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.arguments import real, whole
from calibray.optimizers.box import Box
from calibray.optimizers.evaluations import Archive, Evaluations
from calibray.optimizers.gwo import LEADERS, WOLVES, encircle
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.scalar_surrogate import interpolated
from calibray.optimizers.schedule import AS_GIVEN, Schedule
from calibray.optimizers.session import Search, Session
from calibray.optimizers.sgwoim import ELITES, cosine_decay, memory_weight, remember

Screen = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""A cheap model: points of the box [n, d] to its objective there [n]."""


DRAWN = 10
"""Places drawn for each wolf of the first pack, where a cheap model can choose among them."""


@final
class ScreenedSGWOIM(Optimizer):
    """SGWO-IM with a cheap model for a screen. Uses the value alone; 225 evaluations unless told otherwise.

    Args:
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed of the one random generator.
        screen: The cheap model; None for none.
        budget: Number of evaluations; the last pack has fewer elites where it does not hold whole ones.
        population: N, number of wolves; without a cheap model no more than half of the budget.
        elites: K, wolves evaluated in each screened iteration, at most N.
        w_min: Memory weight at the start.
        w_max: Memory weight at the end.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> opt = ScreenedSGWOIM([-5.0, -5.0], [5.0, 5.0], screen=lambda x: np.sum((x - 1.9) ** 2, axis=1))
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     opt.tell(x, np.sum((x - 2.0) ** 2, axis=1))
        >>> opt.evaluations, bool(opt.best.y < 0.001)
        (225, True)
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        screen: Screen | None = None,
        budget: int = 225,
        population: int = WOLVES,
        elites: int = ELITES,
        w_min: float = 0.1,
        w_max: float = 0.3,
    ) -> None:
        self.box = Box.between(lower, upper)
        self._budget = whole("budget", budget, at_least=1)
        wolves = whole("population", population, at_least=LEADERS)
        self.population = wolves if screen is not None else max(LEADERS, min(wolves, self._budget // 2))
        self.elites = min(whole("elites", elites, at_least=1), self.population)
        self.w_min = real("w_min", w_min, at_least=0.0, at_most=1.0)
        self.w_max = real("w_max", w_max, at_least=0.0, at_most=1.0)
        self._screen, self._screened = screen, np.zeros(0)
        self._rng = np.random.default_rng(whole("seed", seed, at_least=0))
        self._session = Session(self.box, self.uses, self._search)

    @property
    def budget(self) -> int:
        """Number of evaluations it will ask for."""
        return self._budget

    def _search(self, archive: Archive) -> Search:
        count, left = self.population, self._budget
        positions = self.box.from_unit(self._rng.random((count, self.box.dimension)))
        if self._screen is not None:
            more = self._rng.random(((DRAWN - 1) * count, self.box.dimension))
            positions = np.concatenate([positions, self.box.from_unit(more)])
            positions = positions[np.argsort(self._screen(positions), kind="stable")[:count]]
        memory = Evaluations(positions, np.full(count, np.inf))
        first = count if self._screen is None else min(self.elites, count)
        total = 1 + max(0, -(-(left - first) // self.elites))
        for iteration in range(1, total + 1):
            elites = min(first if iteration == 1 else self.elites, left)
            wolves = np.argsort(self._predicted(archive, positions), kind="stable")[:elites]
            told = yield positions[wolves]
            left -= elites
            memory = remember(memory, wolves, told)
            a = cosine_decay(iteration, total)  # eq. 2
            w = memory_weight(iteration, total, self.w_min, self.w_max)  # eq. 4
            r1, r2 = self._rng.random((2, self.population, LEADERS, self.box.dimension))
            guided = encircle(positions, archive.leaders(LEADERS), a, r1, r2)
            positions = self.box.clip((1.0 - w) * guided + w * memory.x)  # eq. 3

    def _predicted(self, archive: Archive, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The cheap model's objective at places [n], corrected by what it missed where the engine answered."""
        screen = self._screen or (lambda x: np.zeros(len(x)))
        if not len(archive) or not np.isfinite(archive.best.y):
            return screen(positions)
        told = archive.imputed(archive.all())
        self._screened = np.append(self._screened, screen(told.x[len(self._screened) :]))
        spanned = np.linalg.matrix_rank(told.x - told.x.mean(axis=0)) == self.box.dimension
        missed = interpolated(self.box, told.x, told.y - self._screened, positions) if spanned else 0.0
        return screen(positions) + missed
