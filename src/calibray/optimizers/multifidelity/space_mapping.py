"""Space mapping: a dear model searched by way of a cheap one that is corrected after every call.

Who knows the physics has a model of the dear model already: simpler, perhaps told wrong constants, and free. Its
minimum is the first call. After every call the cheap model is corrected until it answers as the dear one did
(`corrected.py`), and searched for its minima by many local searches, in all basins at once. Steps are of two kinds:

- *exploitation*: of the minima of the corrected model within a trust region, a box around the best point that is
  halved by a step that does not improve and doubled by one that does, the one that is lowest when what is not known of
  the model is counted in;
- *exploration*: the point of the largest expected improvement over the whole box, by draws of what remains, as in
  `vector_surrogate.py`. Minima of the corrected model in other basins are among the candidates. It follows an
  exploitation that gained next to nothing, and takes the place of one that would repeat a point.

Both count in that few answers leave the constants of the cheap model open, and how far off predictions have been so
far (`averaged.py`). Without that, on planted districts, steps go half way across the box to minima lower than any that
there is, call after call.

The cheap model is trusted only while it helps. Each point is predicted from all the others, once by the corrected model
and once by the same process without a cheap model. Where half of the links have more than `HELPFUL` times the sum of
squared errors with it, after three and after four calls, the cheap model says nothing; where they have more than
`MISLED` times as much twice in a row later on, it misleads. Then the vector surrogate goes on with all that was told,
on a design of its own in which points that are clumped count as one. So it does from the first call where there is no
cheap model. A single verdict says little, and the sum over all links as little, which a few links rule: on planted
problems (eight with their own cheap model, four with tones at random) the ratio of a middling link was at most 0.55
after three calls and 0.66 after four with their own, but once 1.9, and at least 1.01 with tones; that of the sums was
up to 1.5 with their own after three calls, and down to 0.95 with tones.

J. W. Bandler et al., "Space mapping: the state of the art", IEEE Trans. Microw. Theory Tech. 52 (2004) 337.
"""

from __future__ import annotations

from typing import ClassVar, Final, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from calibray.optimizers.arguments import whole
from calibray.optimizers.box import Box
from calibray.optimizers.descent import Residuals, distinct
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, merged, root_mean_square
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.averaging import Averaged, Track, averaged
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.optimizers.multifidelity.correction import Corrected, cheap_and_slope, correct, descended
from calibray.optimizers.multifidelity.discrepancy import Seen
from calibray.optimizers.multifidelity.vector_surrogate import VectorSurrogate, improvement
from calibray.optimizers.protocol import Optimizer
from calibray.optimizers.sampling import design
from calibray.optimizers.schedule import AS_GIVEN, Schedule
from calibray.optimizers.session import Search, Session

CLOUD: Final = 64
"""Points at which the cheap model's response is measured."""

FIRST_SEARCHES: Final = 64
"""Local searches on the cheap model."""

SEARCHES: Final = 16
"""New ones on each corrected model, beside those from the minima before and the best points."""

KEPT: Final = 8
"""Minima, and best points, that these go on from."""

TRIALS: Final = 200
"""Constants drawn from their prior for each of the first input mappings, which start from the likeliest ones."""

TRIED: Final = 10
"""Calls after which input mappings go on from the one before alone."""

CANDIDATES: Final = 300
"""Drawn over the box, and as many around the best points."""

DRAWS: Final = 512
"""Of what remains, for the expected improvement, of all members together."""

APART: Final = 0.003
"""Distance in the unit cube below which two minima are taken for one."""

MEMBERS: Final = 8
"""Models with other constants that the first steps are averaged over."""

AVERAGED: Final = 10
"""Calls up to which they are."""

SEPARATION: Final = 1e-3
"""Distance in the unit cube below which a point is taken for one already evaluated."""

REACHES: Final = (0.02, 1.0)
"""Smallest and largest half width of the trust region."""

GAINED: Final = 1e-3
"""Share of the objective that a step has to gain for another of its kind."""

JUDGED: Final = 3
"""Calls from which on the cheap model is judged."""

HELPFUL: Final = 0.8
"""Ratio of a middling link's squared errors beyond which the first verdicts doubt it."""

MISLED: Final = 2.0
"""Ratio beyond which later ones do, when points stand so close together that any process predicts them."""

DOUBTS: Final = 2
"""Doubts in a row after which it is given up, and number of the first verdicts."""


@final
class SpaceMapping(Optimizer):
    """Space mapping. Uses residuals; 20 d evaluations unless told otherwise.

    Args:
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        seed: Seed of the one random generator.
        budget: Number of evaluations, 20 d if None.
        model: The cheap model; without one the vector surrogate searches.
        batch: Candidates asked for at once, for engines that run in parallel.
        noisy: Whether the engine's answers scatter.
        objective: The value that belongs to residuals [n, m], [n]; their root mean square unless told otherwise. It
            must rise with their mean square, which is what is minimised; both are checked.

    Raises:
        InputError: An argument is out of range.

    Example:
        >>> import numpy as np
        >>> from calibray.optimizers.multifidelity.cheap_model import Differenced
        >>> width, known = np.full(2, 9.0), np.ones(2, dtype=bool)
        >>> cheap = Differenced(lambda x, _: np.sin(x) - 0.4 * x[:, ::-1], width, known)
        >>> opt = SpaceMapping([0.0, 0.0], [9.0, 9.0], model=cheap, budget=6)
        >>> while not opt.done:
        ...     x = opt.ask()
        ...     r = np.sin(x) - 0.5 * x[:, ::-1] - 0.1
        ...     opt.tell(x, np.sqrt(np.mean(r**2, axis=1)), residuals=r)
        >>> opt.evaluations, bool(opt.best.y < 1e-2)
        (6, True)
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})
    schedule: ClassVar[Schedule | None] = AS_GIVEN
    takes_starts: ClassVar[bool] = False

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int | None = None,
        model: CheapModel | None = None,
        batch: int = 1,
        noisy: bool = False,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        d = self.box.dimension
        self._budget = 20 * d if budget is None else whole("budget", budget, at_least=1)
        self.batch = whole("batch", batch, at_least=1)
        self.noisy = noisy
        self._model, self._objective = model, objective
        self._corrected: Corrected | None = None
        self._members = np.empty((0, 0))
        self._track, self._expected = Track(), np.empty((0, d))
        self._foretold: list[tuple[NDArray[np.float64], float]] = []
        self._minima = np.empty((0, d))
        self._reach, self._stalled = REACHES[1], False
        self._seed = whole("seed", seed, at_least=0)
        self._rng = np.random.default_rng(self._seed)
        self._session = Session(self.box, self.uses, self._search, objective)

    @property
    def budget(self) -> int:
        """Largest number of evaluations it will ask for."""
        return self._budget

    @property
    def corrected(self) -> Corrected | None:
        """The cheap model as corrected by all that was told before the last step; None where it is not trusted."""
        return self._corrected

    def _search(self, archive: Archive) -> Search:
        model, left, turn, verdicts, doubts = self._model, self._budget, 0, 0, 0
        if model is None:
            yield from self._without(archive, left)
            return
        cloud = design("sobol", CLOUD, self.box.dimension, self._rng)
        while left > 0:
            count = min(self.batch, left)
            told = _answered(archive)
            if told is None:
                chosen = self._first(model, count, turn)
            else:
                unit, residuals = merged(self.box.to_unit(told.x), told.errors)
                self._corrected = correct(
                    model, self.box, unit, residuals, cloud, self._trials(model, len(unit)),
                    noisy=self.noisy, before=self._corrected,
                )  # fmt: skip
                if len(unit) >= JUDGED:
                    verdicts += 1
                    bound = HELPFUL if verdicts <= DOUBTS else MISLED
                    doubts = doubts + 1 if misleading(self._corrected) > bound else 0
                if doubts == DOUBTS:
                    self._corrected = None
                    yield from self._without(archive, left)
                    return
                self._look_back(unit, residuals)
                chosen = self._choose(self._averaged(self._corrected), archive, count)
            before = archive.best.y if len(archive) else np.inf
            yield self.box.from_unit(chosen)
            self._take_stock(archive.best.y, before)
            left, turn = left - count, turn + count

    def _without(self, archive: Archive, left: int) -> Search:
        """The vector surrogate, told all that is known."""
        rest = VectorSurrogate(
            self.box.lower, self.box.upper, seed=self._seed, budget=left, batch=self.batch, noisy=self.noisy,
            objective=self._objective,
        )  # fmt: skip
        if len(archive):
            told = archive.all()
            rest.tell(told.x, told.y, residuals=told.residuals)
        while not rest.done:
            told = yield rest.ask()
            rest.tell(told.x, told.y, residuals=told.residuals)

    def _trials(self, model: CheapModel, count: int) -> NDArray[np.float64]:
        """Constants to try for an input mapping [s, q]."""
        given = model.constants
        draws = self._rng.standard_normal((TRIALS if count <= TRIED else 0, len(given.centre)))
        return np.vstack(
            [given.centre, np.clip(given.centre + given.spread * draws, given.lower, given.upper)]
        )

    def _first(self, model: CheapModel, count: int, turn: int) -> NDArray[np.float64]:
        """The lowest minima of the cheap model as it is believed to be, after the first `turn` ones [count, d]."""
        d = self.box.dimension

        def evaluate(unit: NDArray[np.float64]) -> Residuals:
            return cheap_and_slope(model, self.box, unit, model.constants.centre)

        ended = descended(design("sobol", FIRST_SEARCHES, d, self._rng), evaluate, 30, 1e-6)
        self._minima = distinct(ended, APART).unit
        return np.vstack([self._minima[turn:], self._rng.random((count, d))])[:count]

    def _averaged(self, corrected: Corrected) -> Averaged:
        """The corrected model and others that explain the answers; half of them go on from those before."""
        given = corrected.model.constants
        if len(corrected.residuals) > AVERAGED or not len(given.centre):
            return Averaged((corrected,))
        draws = given.centre + given.spread * self._rng.standard_normal((MEMBERS, len(given.centre)))
        starts = np.vstack([*self._members[: MEMBERS // 2], np.clip(draws, given.lower, given.upper)])
        found = averaged(corrected, starts[:MEMBERS], self._rng)
        self._members = np.array([member.constants for member in found.members])
        return found

    def _look_back(self, unit: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        """Compare what was answered to the last batch with what was expected."""
        for point, (mean, variance) in zip(self._expected, self._foretold, strict=True):
            row = int(np.argmin(np.abs(unit - point).max(axis=1)))
            if np.abs(unit[row] - point).max() < 1e-9:  # else it failed
                self._track.note(mean, variance, residuals[row])

    def _choose(self, model: Averaged, archive: Archive, count: int) -> NDArray[np.float64]:
        """The next batch [count, d]."""
        told, d = archive.all(), self.box.dimension
        taken = self.box.to_unit(told.x)[np.argsort(told.y, kind="stable")]
        best = float(root_mean_square(archive.leading.errors)[0])
        near = np.clip(taken[0] + self._reach * self._rng.uniform(-1.0, 1.0, (KEPT, d)), 0.0, 1.0)
        starts = np.vstack([taken[:KEPT], near, self._minima[:KEPT], design("sobol", SEARCHES, d, self._rng)])
        ended = descended(starts, model.members[0].mean_and_slope, 30, 1e-6)
        self._minima = distinct(ended, APART).unit
        chosen: list[NDArray[np.float64]] = []
        self._foretold = []
        for place in range(count):
            fresh = self._minima[_separation(self._minima, taken) > SEPARATION]
            within = fresh[np.abs(fresh - taken[0]).max(axis=1) <= self._reach]
            if (place % 2 == 1) == self._stalled and len(within):
                point = within[np.argmin(self._expected_square(model, within))]
            else:
                point = self._explored(model, taken, fresh, best)
            chosen.append(point)
            outlook = model.predict(point[None])
            self._foretold.append((outlook.mean[0], float(outlook.variance[0])))
            if len(chosen) < count:
                model, taken = model.with_point(point), np.vstack([taken, point])
        self._expected = np.array(chosen)
        return self._expected

    def _expected_square(self, model: Averaged, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean square of the residuals to be expected at points [k]."""
        outlook = model.predict(unit)
        return np.mean(outlook.mean**2, axis=1) + self._track.stretch * outlook.variance

    def _explored(
        self,
        model: Averaged,
        taken: NDArray[np.float64],
        fresh: NDArray[np.float64],
        best: float,
    ) -> NDArray[np.float64]:
        """The point of the largest expected improvement [d]; `taken` are the points told, best first."""
        d, stretch = self.box.dimension, self._track.stretch
        near = taken[self._rng.integers(0, min(5, len(taken)), CANDIDATES)]
        reach = 10.0 ** self._rng.uniform(-2.5, -0.5, (CANDIDATES, 1))
        around = np.clip(near + reach * self._rng.standard_normal((CANDIDATES, d)), 0.0, 1.0)
        candidates = np.vstack([fresh, self._rng.random((CANDIDATES, d)), around])
        candidates = candidates[_separation(candidates, taken) > SEPARATION]
        outlook, gain = model.predict(candidates), np.zeros(len(candidates))
        draws = max(1, DRAWS // len(model.members))
        for member, (own, share) in zip(model.members, outlook.parts, strict=True):
            mean = outlook.mean + np.sqrt(stretch) * (own - outlook.mean)
            normal = self._rng.standard_normal((draws, len(member.root)))
            gain += improvement(mean, stretch * share, normal @ member.root, best)
        return candidates[np.argmax(gain)]

    def _take_stock(self, best: float, before: float) -> None:
        """Resize the trust region after an exploitation, and explore once where it gained too little."""
        if self._stalled or not np.isfinite(before):
            self._stalled = False
            return
        self._reach = float(np.clip(self._reach * (2.0 if best < before else 0.5), *REACHES))
        self._stalled = best > (1.0 - GAINED) * before


def misleading(corrected: Corrected) -> float:
    """How much a cheap model misleads.

    Args:
        corrected: The cheap model, corrected by three points or more.

    Returns:
        Squared errors of points predicted from all the others with it, by those without: the median of the links. Below
        1 it helps.
    """
    unit, residuals = corrected.rest.seen.unit, corrected.residuals
    scale = max(float(residuals.std(axis=0).max()), 1e-12)
    alone = discrepancy.fit(Seen(unit, np.zeros((len(unit), 0))), residuals, scale)
    with_it, without = (np.sum(rest.left_out() ** 2, axis=0) for rest in (corrected.rest, alone))
    return float(np.median(with_it / np.maximum(without, 1e-300)))


def _answered(archive: Archive) -> Evaluations | None:
    """The evaluations that did not fail; None where there are none."""
    if not len(archive) or not np.isfinite(archive.leading.y[0]):
        return None
    told = archive.all()
    return told.rows(np.flatnonzero(np.isfinite(told.y)))


def _separation(x: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each point to the nearest one taken."""
    return cdist(x, taken).min(axis=1)
