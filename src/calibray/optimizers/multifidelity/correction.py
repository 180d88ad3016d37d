"""Correct a cheap model until it agrees with the engine: first the constants, then the remaining discrepancy.

*Input mapping*: the constants of the cheap model are set to the values that best explain the engine's answers. Errors
are whitened with the covariance of the discrepancy. For each link, the discrepancy is mostly an offset common to all
points, so whitening prevents this offset from distorting the constants. The prior of the constants is centred at their
assumed values. This method is known as implicit space mapping (J. W. Bandler, Q. S. Cheng, N. K. Nikolova, M. A.
Ismail, IEEE Trans. Microw. Theory Tech. 52 (2004) 378).
*Output mapping*: `discrepancy.py` models the offset, the slope and the remainder.

Slab resonances cause many minima. A kernel that was fitted with wrong constants attributes the resulting errors to the
discrepancy, and then favours these constants. An input mapping therefore proceeds in rounds. A round tries many sets of
constants, most of which differ from the current set in one or two constants. Sets are compared, each at its most
probable scale of the discrepancy. Successive rounds use the fitted kernel and the kernel at the mean of the prior in
turn. In each round, local searches start from the most likely sets, and the kernel is refitted for the best results. A
result is accepted only if it makes the answers more probable.

A few answers are not enough to determine the constants of a cheap model: several sets of constants explain the answers
equally well, but predict minima at different points. The lowest of these predictions would be too optimistic.
Predictions are therefore averaged over ensemble members drawn from the posterior of the constants. Each member is
corrected until it passes through all answers. The uncertainty is small where the members agree. Members are drawn by
randomized maximum likelihood: each member is fitted from a different starting point, to answers and a prior that are
both perturbed according to their uncertainties (D. S. Oliver, N. He, A. C. Reynolds, ECMOR V, 1996). The predicted
variance is scaled according to the errors of earlier predictions at points that were not yet used in a fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.arguments import Box
from calibray.optimizers.descent import Residuals, descend_all
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.protocol import CheapModel, Constants
from calibray.optimizers.regression import Inputs, Kernel, Process

ROUNDS: Final = 4
"""Maximum number of rounds of an input mapping."""

GAINED: Final = 1.0
"""Decrease in the negative log density below which a round counts as no improvement."""

TRIALS: Final = 300
"""Maximum number of sets of constants tried in a round."""

COMPARED: Final = 3000
"""Maximum product of the number of sets tried in a round and the number of answers."""

FOLLOWED: Final = 4
"""Number of best-fitting sets from which the searches of a round start, in addition to the current set."""

REFITTED: Final = 2
"""Number of results of a round for which the kernel is refitted."""

STEPS: Final = 12
"""Maximum number of steps of an input mapping from one starting point."""

CONVERGED: Final = 1e-4
"""Relative decrease in cost, or step in the unit cube, below which an input mapping has converged."""


@dataclass(frozen=True, eq=False)
class UnitModel:
    """A cheap model as a function of unit-cube coordinates."""

    model: CheapModel
    box: Box

    @property
    def constants(self) -> Constants:
        """See `CheapModel.constants`."""
        return self.model.constants

    def residuals(self, unit: NDArray[np.float64], constants: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals [k, m] at points of the unit cube [k, d], with constants [q]."""
        return self.model.residuals(self.box.from_unit(unit), np.tile(constants, (len(unit), 1)))

    def residuals_and_slope(
        self, unit: NDArray[np.float64], constants: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Residuals [k, m] at points of the unit cube [k, d], with constants [q], and their Jacobian [k, m, d]."""
        answer = self.model.answer(self.box.from_unit(unit), np.tile(constants, (len(unit), 1)))
        return answer.residuals, answer.by_point * self.box.width


@dataclass(frozen=True, eq=False)
class Response:
    """Variation of a cheap model's residuals over the box.

    Attributes:
        known: Mask [m] of the residuals that the model predicts.
        centre: Mean of the residuals over the box [m].
        scale: Root mean square of the deviations from this mean.
    """

    known: NDArray[np.bool_]
    centre: NDArray[np.float64]
    scale: float

    @staticmethod
    def of(residuals: NDArray[np.float64], known: NDArray[np.bool_]) -> Response:
        """The response, given residuals [k, m] at points across the box; `known` [m] marks the predicted residuals."""
        centre = residuals.mean(axis=0)
        scale = float(np.sqrt(np.mean((residuals - centre)[:, known] ** 2))) if known.any() else 0.0
        return Response(known, centre, max(scale, 1e-6 * max(float(np.abs(residuals).max()), 1e-6)))

    def inputs(self, unit: NDArray[np.float64], residuals: NDArray[np.float64]) -> Inputs:
        """Points [k, d] of the unit cube and their responses, from the cheap model's residuals [k, m]."""
        return Inputs(unit, self.scaled(residuals - self.centre))

    def scaled(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """The r predicted columns of `rows` [k, m, ...], scaled so that the mean squared norm of the responses is 1."""
        return rows[:, self.known] / (self.scale * np.sqrt(max(int(self.known.sum()), 1)))


@dataclass(frozen=True, eq=False)
class Corrected:
    """A cheap model with its discrepancy.

    Attributes:
        cheap: The cheap model over the search box.
        constants: Adjusted constants of the cheap model [q].
        response: Response of the cheap model over the box.
        residuals: Answers of the engine [n, m].
        discrepancy: Gaussian process of the discrepancy.
    """

    cheap: UnitModel
    constants: NDArray[np.float64]
    response: Response
    residuals: NDArray[np.float64]
    discrepancy: Process

    @property
    def unit(self) -> NDArray[np.float64]:
        """The evaluated points in the unit cube [n, d]."""
        return self.discrepancy.inputs.unit

    @property
    def root(self) -> NDArray[np.float64]:
        """Factor B of the covariance B^T B of the residuals, as in `Process.root`."""
        return self.discrepancy.root

    def predict(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted mean [k, m] at points [k, d], and predictive variance [k] relative to each residual's variance."""
        cheap, inputs = self.base(unit)
        mean, share = self.discrepancy.predict(inputs)
        return cheap + mean, share

    def mean_and_slope(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predicted residuals [k, m] and their Jacobian [k, m, d] at points of the unit cube [k, d]."""
        cheap, slope, inputs, response_slope = self.base_and_slope(unit)
        return cheap + self.discrepancy.mean(inputs), slope + self.discrepancy.slope(inputs, response_slope)

    def base(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Inputs]:
        """Residuals [k, m] of the cheap model at the adjusted constants, and the points with their responses."""
        cheap = self.cheap.residuals(unit, self.constants)
        return cheap, self.response.inputs(unit, cheap)

    def base_and_slope(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Inputs, NDArray[np.float64]]:
        """The results of `base`, and their derivatives with respect to the coordinates of the unit cube.

        Returns residuals [k, m], their derivatives [k, m, d], the points with their responses, and the derivatives of
        the responses [k, r, d].
        """
        cheap, slope = self.cheap.residuals_and_slope(unit, self.constants)
        return cheap, slope, self.response.inputs(unit, cheap), self.response.scaled(slope)

    def with_point(self, point: NDArray[np.float64], residuals: NDArray[np.float64]) -> Corrected:
        """Add a point [d] in the unit cube as if its evaluation had returned the given residuals [1, m]."""
        unit, answers = np.vstack([self.unit, point]), np.vstack([self.residuals, residuals])
        cheap, inputs = self.base(unit)
        process = discrepancy.solve(inputs, answers - cheap, self.discrepancy.kernel)
        return replace(self, residuals=answers, discrepancy=process)

    def with_constants(self, constants: NDArray[np.float64], kernel: Kernel | None = None) -> Corrected:
        """The model with other constants [q] and a discrepancy that fits the same answers; None keeps the kernel."""
        moved = replace(self, constants=constants)
        cheap, inputs = moved.base(self.unit)
        process = discrepancy.solve(inputs, self.residuals - cheap, kernel or self.discrepancy.kernel)
        return replace(moved, discrepancy=process)


def correct(
    cheap: UnitModel,
    answers: tuple[NDArray[np.float64], NDArray[np.float64]],
    cloud: NDArray[np.float64],
    random: np.random.Generator,
    *,
    noisy: bool = False,
    before: Corrected | None = None,
) -> Corrected:
    """Fit a corrected model to an engine's answers [n, m] at points [n, d] of the unit cube.

    The response of the cheap model is computed at the points in `cloud` [k, d]. The input mapping starts from the
    constants of `before`, a model that was fitted to fewer answers. `noisy` states whether the answers are noisy.
    """

    def corrected(constants: NDArray[np.float64], guess: Corrected | None) -> Corrected:
        return with_discrepancy(cheap, constants, answers, cloud, noisy=noisy, guess=guess)

    best = corrected(cheap.constants.centre if before is None else before.constants, before)
    idle = 0
    for turn in range(ROUNDS if len(best.constants) else 0):
        shaped = best
        if turn % 2:
            kernel = discrepancy.expected(len(answers[0][0]), best.response.scale, noisy)
            shaped = best.with_constants(best.constants, kernel)
        fitted = [corrected(constants, best) for constants in _likelier(shaped, random)]
        present, best = best, min([best, *fitted], key=_own_misfit)
        idle = idle + 1 if _own_misfit(present) - _own_misfit(best) < GAINED else 0
        # Two successive rounds, one with each kernel, brought no improvement.
        if idle == 2:
            break
    return best


def with_discrepancy(
    cheap: UnitModel,
    constants: NDArray[np.float64],
    answers: tuple[NDArray[np.float64], NDArray[np.float64]],
    cloud: NDArray[np.float64],
    *,
    noisy: bool = False,
    guess: Corrected | None = None,
) -> Corrected:
    """Fit only the discrepancy, with given constants [q]; see `correct`. `guess` provides a second initial kernel."""
    unit, residuals = answers
    response = Response.of(cheap.residuals(cloud, constants), cheap.model.known)
    base = cheap.residuals(unit, constants)
    kernel = None
    if guess is not None:
        # The kernel's variances are relative to the response, which depends on the constants.
        kernel = Kernel.of(guess.discrepancy.kernel.logarithms(guess.response.scale), response.scale)
    inputs = response.inputs(unit, base)
    process = discrepancy.fit(inputs, residuals - base, response.scale, noisy=noisy, guess=kernel)
    return Corrected(cheap, constants, response, residuals, process)


def _own_misfit(corrected: Corrected) -> float:
    """The misfit of a model's constants, given the model's own kernel."""
    return float(misfit(corrected, corrected.constants[None]).value[0])


def constants_fit(
    corrected: Corrected, centre: NDArray[np.float64] | None = None, noise: NDArray[np.float64] | None = None
) -> Callable[[NDArray[np.float64]], Residuals]:
    """The least-squares problem for the constants, given a fixed covariance of the discrepancy.

    The prior is centred at `centre` [q], or at the centre of the cheap model's constants if `centre` is None. `noise`
    [n m] perturbs the whitened answers. Returns a function that maps constants [s, q], scaled to the unit cube by their
    bounds, to whitened errors and their Jacobian. Half the sum of squared errors is the negative log density, up to an
    additive constant.
    """
    model, process, prior = corrected.cheap.model, corrected.discrepancy, corrected.cheap.constants
    points, width = corrected.cheap.box.from_unit(corrected.unit), prior.width
    (count, links), size = corrected.residuals.shape, len(prior.centre)
    # Errors are whitened over the points. The weights are the inverse standard deviations of the residuals.
    whiten = np.linalg.inv(process.lower)
    weight = np.sqrt(process.precision)
    prior_slope = np.diag(width / prior.spread)
    believed = prior.centre if centre is None else centre
    shift = np.zeros(count * links) if noise is None else noise

    def evaluate(unit: NDArray[np.float64]) -> Residuals:
        constants = prior.lower + unit * width
        answer = model.answer(np.tile(points, (len(unit), 1)), np.repeat(constants, count, axis=0))
        errors = corrected.residuals - answer.residuals.reshape(-1, count, links)
        rows = (whiten @ errors * weight).reshape(len(unit), -1) + shift
        slope = answer.by_constant.reshape(-1, count, links * size)
        slope = -(whiten @ slope).reshape(-1, count, links, size) * weight[:, None] * width
        rows = np.hstack([rows, (constants - believed) / prior.spread])
        prior_rows = np.broadcast_to(prior_slope, (len(unit), size, size))
        return rows, np.concatenate([slope.reshape(len(unit), -1, size), prior_rows], axis=1)

    return evaluate


class Misfit(NamedTuple):
    """Misfit of sets of constants to the answers.

    Attributes:
        value: Negative log density [s] of the answers and the model constants, up to an additive constant.
        scale: Factor [s] for the variances of the discrepancy at which the answers are most probable.
    """

    value: NDArray[np.float64]
    scale: NDArray[np.float64]


def misfit(corrected: Corrected, constants: NDArray[np.float64]) -> Misfit:
    """The misfit of constants [s, q], given the kernel of the discrepancy up to a scale factor.

    The variances of the links are integrated out. A link that the current constants do not explain therefore keeps its
    full weight when other constants are compared.
    """
    model, prior = corrected.cheap.model, corrected.cheap.constants
    points, (count, links) = corrected.cheap.box.from_unit(corrected.unit), corrected.residuals.shape
    cheap = model.residuals(np.tile(points, (len(constants), 1)), np.repeat(constants, count, axis=0))
    errors = corrected.residuals - cheap.reshape(-1, count, links)
    lower = corrected.discrepancy.lower
    value, scale = discrepancy.scaled_density(np.linalg.inv(lower) @ errors)
    away = (constants - prior.centre) / prior.spread
    return Misfit(value + links * np.log(np.diag(lower)).sum() + 0.5 * np.sum(away**2, axis=1), scale)


def _likelier(corrected: Corrected, random: np.random.Generator) -> NDArray[np.float64]:
    """Run one round with the kernel of `corrected`, and return the best constants [k, q]."""
    prior, present = corrected.cheap.constants, corrected.constants
    trials = np.vstack([present, _trials(corrected, random)])
    tried = misfit(corrected, trials)
    likeliest = [0, *(1 + np.argsort(tried.value[1:], kind="stable")[:FOLLOWED])]
    ends = []
    for trial, scale in zip(trials[likeliest], tried.scale[likeliest], strict=True):
        fit = constants_fit(
            corrected.with_constants(trial, corrected.discrepancy.kernel.scaled(float(scale)))
        )
        ends.append(descend_all((trial[None] - prior.lower) / prior.width, fit, STEPS, CONVERGED).unit[0])
    constants = prior.lower + np.array(ends) * prior.width
    return constants[np.argsort(misfit(corrected, constants).value, kind="stable")[:REFITTED]]


def _trials(corrected: Corrected, random: np.random.Generator) -> NDArray[np.float64]:
    """Draw sets of constants [s, q]; in each set, one, two or all current constants are redrawn from the prior."""
    size, count = len(corrected.constants), max(FOLLOWED, min(TRIALS, COMPARED // len(corrected.unit)))
    drawn = corrected.cheap.constants.draw(random.standard_normal((count, size)))
    one, another = np.eye(size, dtype=bool)[random.integers(0, size, (2, count))]
    # In successive sets, one, two or all constants are redrawn in turn.
    number = np.arange(count)[:, None] % 3
    return np.where(one | (another & (number > 0)) | (number > 1), drawn, corrected.constants)


UNLIKELY: Final = 30.0
"""Excess in negative log density, divided by the number of constants plus 3, above which an ensemble member is omitted.

The limit is high because this density assumes that links are independent. In fact, links share errors, so the true
posterior is wider.
"""

CAPPED: Final = 100.0
"""Maximum ratio of mean square error to predicted variance; larger ratios are reduced to this value."""


class Prediction(NamedTuple):
    """The prediction of an averaged model at given points.

    Attributes:
        mean: Residuals, averaged over the members [k, m].
        variance: Predictive variance of a residual, averaged over the residuals [k].
        members: For each member, the residuals [k, m] and the variance relative to `Corrected.root` [k].
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    members: list[tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class Averaged:
    """Corrected models that all explain the same answers.

    Attributes:
        members: The models; the most likely model comes first.
    """

    members: tuple[Corrected, ...]

    def predict(self, unit: NDArray[np.float64]) -> Prediction:
        """Predict the residuals at points of the unit cube [k, d]."""
        predictions = [member.predict(unit) for member in self.members]
        mean = np.mean([residuals for residuals, _ in predictions], axis=0)
        variance = np.zeros(len(unit))
        for (residuals, share), member in zip(predictions, self.members, strict=True):
            variance += np.mean((residuals - mean) ** 2, axis=1)
            variance += share * np.mean(np.sum(member.root**2, axis=0))
        return Prediction(mean, variance / len(predictions), predictions)

    def with_point(self, point: NDArray[np.float64]) -> Averaged:
        """Add a point [d] of the unit cube as if the prediction had been observed; all members then agree there."""
        residuals = self.predict(point[None]).mean
        return Averaged(tuple(member.with_point(point, residuals) for member in self.members))


@dataclass
class ErrorRecord:
    """Ratios of mean square errors to predicted variances for all steps so far.

    Attributes:
        ratios: Ratio of mean square error to predicted variance for every step, at most `CAPPED`.
    """

    ratios: list[float] = field(default_factory=list)

    @property
    def stretch(self) -> float:
        """Factor that scales predicted variances; the prior is equivalent to a single step with a ratio of 1."""
        return (1.0 + sum(self.ratios)) / (1.0 + len(self.ratios))

    def add(self, mean: NDArray[np.float64], variance: float, residuals: NDArray[np.float64]) -> None:
        """Add a step: predicted residuals [m], their mean variance before scaling, and observed residuals [m]."""
        ratio = float(np.mean((residuals - mean) ** 2)) / max(variance, 1e-12)
        self.ratios.append(min(ratio, CAPPED))


def average(corrected: Corrected, starts: NDArray[np.float64], random: np.random.Generator) -> Averaged:
    """Fit members from starting constants [s, q]; keep those that explain the answers nearly as well as `corrected`."""
    prior = corrected.cheap.constants
    size = len(prior.centre)
    if not size:
        return Averaged((corrected,))
    centres = prior.draw(random.standard_normal(starts.shape))
    noise = random.standard_normal((len(starts), corrected.residuals.size))
    ends = []
    for start, centre, shift in zip((starts - prior.lower) / prior.width, centres, noise, strict=True):
        fit = constants_fit(corrected, centre, shift)
        ends.append(descend_all(start[None], fit, STEPS, CONVERGED).unit[0])
    present = (corrected.constants - prior.lower) / prior.width
    rows, _ = constants_fit(corrected)(np.vstack([present, *ends]))
    cost = 0.5 * np.sum(rows**2, axis=1)
    likely = cost[1:] - cost[0] < UNLIKELY * (size + 3)
    constants = prior.lower + np.array(ends)[likely] * prior.width
    return Averaged((corrected, *(corrected.with_constants(member) for member in constants)))
