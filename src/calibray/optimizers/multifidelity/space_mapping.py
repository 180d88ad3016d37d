"""Space mapping minimizes an expensive model with the help of a cheap model, which is corrected after every call.

If you know the physics, you already have a cheap approximation of the expensive model, possibly with wrong constants.
The first call evaluates the engine at the minimum of this approximation. After every call, the cheap model is corrected
until it agrees with all answers (`correction.py`). Many local searches then find the minima of the corrected model in
all basins. There are two kinds of steps:

- *Exploitation*: among the corrected model's minima within a trust region, the minimum with the lowest expected mean
  square is evaluated. The expectation accounts for the uncertainty of the model. The trust region is a box around the
  best point. Its width is halved after an exploitation without an improvement, and doubled after one with an
  improvement.
- *Exploration*: the point with the largest expected improvement over the whole box is evaluated. The improvement is
  computed from draws of the discrepancy, as in `vector_surrogate.py`. Minima of the corrected model in other basins are
  among the candidates. An exploration follows an exploitation that brought almost no improvement, and replaces an
  exploitation if the trust region contains no new minimum.

Both kinds of steps account for the uncertainty of constants that a few answers cannot determine, and for the errors of
earlier predictions (`correction.py`). Without this, steps on synthetic districts jump across half the box to predicted
minima that do not exist.

The cheap model is used only as long as it helps. Each point is predicted from all other points, once by the corrected
model and once by the same process without a cheap model. `error_ratio` is the median over the links of the ratio of the
two squared errors. The first two checks, after three and four calls, fail if the ratio exceeds `HELPFUL`. Later checks
fail if the ratio exceeds `MISLED`. After two failed checks in a row, the vector surrogate continues with all
evaluations so far. If there is no cheap model, the vector surrogate runs from the first call. The median is used
because a few links dominate a sum over all links. Twelve synthetic problems were examined, eight with their own cheap
model and four with random sinusoids instead. After four calls, the ratio was at most 0.66 with the right model, and at
least 1.01 with sinusoids. In one problem with the right model, the ratio was 1.9 after three calls.

J. W. Bandler et al., "Space mapping: the state of the art", IEEE Trans. Microw. Theory Tech. 52 (2004) 337.
"""

from __future__ import annotations

from typing import ClassVar, Final, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.optimizers.arguments import Box, whole
from calibray.optimizers.descent import Residuals, descend_all, distinct
from calibray.optimizers.evaluations import Archive, Evaluations, Objective, merge_repeated, root_mean_square
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.correction import (
    Averaged,
    Corrected,
    ErrorRecord,
    UnitModel,
    average,
    correct,
)
from calibray.optimizers.protocol import CheapModel, Optimizer, Search, Session
from calibray.optimizers.regression import Inputs
from calibray.optimizers.sampling import design, distance_to_nearest, draw_around, not_evaluated
from calibray.optimizers.vector_surrogate import VectorSurrogate, improvement

CLOUD: Final = 64
"""Number of points at which the cheap model's response is computed."""

FIRST_SEARCHES: Final = 64
"""Number of local searches on the uncorrected cheap model."""

SEARCHES: Final = 16
"""Number of local searches on each corrected model that start from Sobol points."""

KEPT: Final = 8
"""Maximum number of local searches from each of three sets: earlier minima, best points, and random points in the trust
region.
"""

SEARCH_STEPS: Final = 30
"""Maximum number of steps of a local search on a model."""

CONVERGED: Final = 1e-6
"""Relative decrease in cost, or step in the unit cube, below which a local search has converged."""

CANDIDATES: Final = 300
"""Number of candidates drawn over the whole box, and also the number drawn around the best points."""

DRAWS: Final = 512
"""Number of draws of the discrepancy for the expected improvement, in total over all members."""

APART: Final = 0.003
"""Distance in the unit cube below which two minima are considered identical."""

MEMBERS: Final = 8
"""Maximum number of models with other constants whose predictions are averaged with those of the corrected model."""

AVERAGED: Final = 10
"""Number of calls up to which predictions are averaged over the corrected model and at most `MEMBERS` other models."""

SEPARATION: Final = 1e-3
"""Distance in the unit cube below which a point is considered already evaluated."""

REACHES: Final = (0.02, 1.0)
"""Minimum and maximum half-width of the trust region in the unit cube."""

GAINED: Final = 1e-3
"""An exploration follows an exploitation that decreases the root mean square by less than this fraction."""

JUDGED: Final = 3
"""Number of calls after which the first check of the cheap model takes place."""

HELPFUL: Final = 0.8
"""Error ratio above which one of the first `DOUBTS` checks fails."""

MISLED: Final = 2.0
"""Error ratio above which a later check fails; by then, points are so close that any process predicts them well."""

DOUBTS: Final = 2
"""Number of successive failed checks after which the cheap model is dropped; also the number of checks that use
`HELPFUL`."""


@final
class SpaceMapping(Optimizer):
    """Space mapping. The method uses residuals and takes 20 d evaluations by default.

    Args:
        budget: Number of evaluations; 20 d if None.
        cheap_model: The cheap model; if None, `VectorSurrogate` is used instead.
        batch: Number of candidates per batch, for engines that run in parallel.
        noisy: Whether the engine's answers are noisy.

    Raises:
        InputError: An argument is out of range.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"value", "residuals"})

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        budget: int | None = None,
        cheap_model: CheapModel | None = None,
        batch: int = 1,
        noisy: bool = False,
        objective: Objective = root_mean_square,
    ) -> None:
        self.box = Box.between(lower, upper)
        d = self.box.dimension
        self._budget = 20 * d if budget is None else whole("budget", budget, at_least=1)
        self.batch = whole("batch", batch, at_least=1)
        self.noisy = noisy
        self._cheap, self._objective = cheap_model, objective
        self._corrected: Corrected | None = None
        self._members = np.empty((0, 0))
        self._errors = ErrorRecord()
        self._predicted: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []
        self._minima = np.empty((0, d))
        self._reach, self._stalled = REACHES[1], False
        self._seed = whole("seed", seed, at_least=0)
        self._rng = np.random.default_rng(self._seed)
        self._session = Session(self.box, self.uses, self._search, objective)

    @property
    def corrected(self) -> Corrected | None:
        """The cheap model, corrected with all evaluations before the last step; None if no cheap model is used."""
        return self._corrected

    def _search(self, archive: Archive) -> Search:
        model, left, turn, verdicts, doubts = self._cheap, self._budget, 0, 0, 0
        if model is None:
            yield from self._without(archive, left)
            return
        cloud = design("sobol", CLOUD, self.box.dimension, self._rng)
        while left > 0:
            count = min(self.batch, left)
            answers = _successful(archive)
            if answers is None:
                chosen = self._first(model, count, turn)
            else:
                unit, residuals = merge_repeated(self.box.to_unit(answers.x), answers.errors)
                self._corrected = correct(
                    UnitModel(model, self.box), (unit, residuals), cloud, self._rng,
                    noisy=self.noisy, before=self._corrected,
                )  # fmt: skip
                if len(unit) >= JUDGED:
                    verdicts += 1
                    bound = HELPFUL if verdicts <= DOUBTS else MISLED
                    ratio = error_ratio(self._corrected, noisy=self.noisy)
                    doubts = doubts + 1 if ratio > bound else 0
                if doubts == DOUBTS:
                    self._corrected = None
                    yield from self._without(archive, left)
                    return
                self._compare(unit, residuals)
                chosen = self._choose(self._averaged(self._corrected), archive, count)
            before = archive.lowest
            yield self.box.from_unit(chosen)
            self._resize(archive.lowest, before)
            left, turn = left - count, turn + count

    def _without(self, archive: Archive, left: int) -> Search:
        """Continue with the vector surrogate, which starts from all evaluations so far."""
        surrogate = VectorSurrogate(
            self.box.lower, self.box.upper, seed=self._seed, budget=left, batch=self.batch, noisy=self.noisy,
            objective=self._objective,
        )  # fmt: skip
        if len(archive):
            earlier = archive.all()
            surrogate.tell(earlier.x, earlier.y, residuals=earlier.residuals)
        while not surrogate.done:
            answers = yield surrogate.ask()
            surrogate.tell(answers.x, answers.y, residuals=answers.residuals)

    def _first(self, model: CheapModel, count: int, turn: int) -> NDArray[np.float64]:
        """Points [count, d]: minima of the uncorrected cheap model, except the first `turn`, then random points."""
        d = self.box.dimension

        def evaluate(unit: NDArray[np.float64]) -> Residuals:
            return UnitModel(model, self.box).residuals_and_slope(unit, model.constants.centre)

        starts = design("sobol", FIRST_SEARCHES, d, self._rng)
        self._minima = distinct(descend_all(starts, evaluate, SEARCH_STEPS, CONVERGED), APART).unit
        return np.vstack([self._minima[turn:], self._rng.random((count, d))])[:count]

    def _averaged(self, corrected: Corrected) -> Averaged:
        """The corrected model and others that explain the answers; up to half of these start from earlier members."""
        prior = corrected.cheap.constants
        if len(corrected.residuals) > AVERAGED or not len(prior.centre):
            return Averaged((corrected,))
        draws = prior.draw(self._rng.standard_normal((MEMBERS, len(prior.centre))))
        starts = np.vstack([*self._members[: MEMBERS // 2], draws])
        model = average(corrected, starts[:MEMBERS], self._rng)
        self._members = np.array([member.constants for member in model.members])
        return model

    def _compare(self, unit: NDArray[np.float64], residuals: NDArray[np.float64]) -> None:
        """Record the errors of the predictions for the last batch."""
        for point, mean, variance in self._predicted:
            row = int(np.argmin(np.abs(unit - point).max(axis=1)))
            if np.abs(unit[row] - point).max() < 1e-9:  # otherwise the evaluation failed
                self._errors.add(mean, variance, residuals[row])

    def _choose(self, model: Averaged, archive: Archive, count: int) -> NDArray[np.float64]:
        """Choose the next batch of points [count, d]."""
        evaluated, d = archive.all(), self.box.dimension
        taken = self.box.to_unit(evaluated.x)[np.argsort(evaluated.y, kind="stable")]
        best = archive.lowest
        # `taken[0]` is the best point.
        near = np.clip(taken[0] + self._reach * self._rng.uniform(-1.0, 1.0, (KEPT, d)), 0.0, 1.0)
        starts = np.vstack([taken[:KEPT], near, self._minima[:KEPT], design("sobol", SEARCHES, d, self._rng)])
        ends = descend_all(starts, model.members[0].mean_and_slope, SEARCH_STEPS, CONVERGED)
        self._minima = distinct(ends, APART).unit
        self._predicted = []
        for index in range(count):
            fresh = self._minima[distance_to_nearest(self._minima, taken) > SEPARATION]
            within = fresh[np.abs(fresh - taken[0]).max(axis=1) <= self._reach]
            # Exploitations and explorations alternate in a batch. After a stall, the batch begins with an exploration.
            if (index % 2 == 1) == self._stalled and len(within):
                expected = model.predict(within)
                square = np.mean(expected.mean**2, axis=1) + self._errors.stretch * expected.variance
                point = within[np.argmin(square)]
            else:
                point = self._explore(model, taken, fresh, best)
            prediction = model.predict(point[None])
            self._predicted.append((point, prediction.mean[0], float(prediction.variance[0])))
            if index + 1 < count:
                model, taken = model.with_point(point), np.vstack([taken, point])
        return np.array([point for point, _, _ in self._predicted])

    def _explore(
        self, model: Averaged, taken: NDArray[np.float64], fresh: NDArray[np.float64], best: float
    ) -> NDArray[np.float64]:
        """The point [d] with the largest expected improvement; `taken` contains the evaluated points, best first."""
        d, stretch = self.box.dimension, self._errors.stretch
        around = draw_around(taken[:5], CANDIDATES, -2.5, self._rng)
        candidates = np.vstack([fresh, self._rng.random((CANDIDATES, d)), around])
        candidates = not_evaluated(candidates, taken, SEPARATION)
        prediction, gain = model.predict(candidates), np.zeros(len(candidates))
        draws = max(1, DRAWS // len(model.members))
        for member, (residuals, share) in zip(model.members, prediction.members, strict=True):
            # So far, squared errors exceeded predicted variances by `stretch`, so deviations grow by the square root of
            # `stretch`.
            mean = prediction.mean + np.sqrt(stretch) * (residuals - prediction.mean)
            normal = self._rng.standard_normal((draws, len(member.root)))
            gain += improvement(mean, stretch * share, normal @ member.root, best)
        return candidates[np.argmax(gain)]

    def _resize(self, best: float, before: float) -> None:
        """Resize the trust region after an exploitation, and explore in the next step if the gain was too small."""
        # There is nothing to resize: the last step was an exploration, or no evaluation before that step succeeded.
        if self._stalled or not np.isfinite(before):
            self._stalled = False
            return
        self._reach = float(np.clip(self._reach * (2.0 if best < before else 0.5), *REACHES))
        self._stalled = best > (1.0 - GAINED) * before


def error_ratio(corrected: Corrected, *, noisy: bool = False) -> float:
    """Median over the links of the ratio of the squared error with the cheap model to the squared error without it.

    Each of at least three points is predicted from all other points. The cheap model helps if the ratio is below 1.
    `noisy` states whether the answers are noisy; it affects only the process without the cheap model.
    """
    residuals = corrected.residuals
    scale = max(float(residuals.std(axis=0).max()), 1e-12)
    # Without the cheap model, the same kind of process is fitted to the answers themselves.
    alone = discrepancy.fit(Inputs.plain(corrected.unit), residuals, scale, noisy=noisy)
    with_it, without = (
        np.sum(process.left_out_errors() ** 2, axis=0) for process in (corrected.discrepancy, alone)
    )
    return float(np.median(with_it / np.maximum(without, 1e-300)))


def _successful(archive: Archive) -> Evaluations | None:
    """The evaluations that did not fail; None if there are none."""
    if not np.isfinite(archive.lowest):
        return None
    evaluated = archive.all()
    return evaluated.rows(np.flatnonzero(np.isfinite(evaluated.y)))
