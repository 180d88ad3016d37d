"""A cheap model, corrected until it answers as the dear one does: its constants adjusted, and what remains modelled.

*Input mapping*: the constants that the cheap model takes for granted are those that explain the dear model's answers
best. Errors are weighed by the covariance of what remains, which is common to an offset and little else, so that an
offset of a link is no reason to bend a constant; and the constants have a prior around what they are believed to be.
Walls resonate, so that there are many minima: the search starts from the likeliest of many draws from that prior.
This is implicit space mapping (J. W. Bandler, Q. S. Cheng, N. K. Nikolova, M. A. Ismail, IEEE Trans. Microw. Theory
Tech. 52 (2004) 378). *Output mapping*: offset, slope and rest by `discrepancy.py`. The two are fitted in turns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.optimizers.box import Box
from calibray.optimizers.descent import Residuals, Starts, descend
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.cheap_model import CheapModel
from calibray.optimizers.multifidelity.discrepancy import Discrepancy, Seen

TURNS: Final = 2
"""Rounds of output and input mapping."""

STEPS: Final = 12
"""Steps of an input mapping from one start."""

FOLLOWED: Final = 8
"""Trials, those that explain the answers best, that an input mapping starts from."""


@dataclass(frozen=True, eq=False)
class Response:
    """What a cheap model does over the box.

    Attributes:
        centre: Mean of its residuals [m].
        scale: Root mean square of what they do around it.
    """

    centre: NDArray[np.float64]
    scale: float

    @staticmethod
    def of(residuals: NDArray[np.float64], known: NDArray[np.bool_]) -> Response:
        """Measure it.

        Args:
            residuals: Residuals at points spread over the box [k, m].
            known: Rows that the model says something about [m].

        Returns:
            The response.
        """
        centre = residuals.mean(axis=0)
        scale = float(np.sqrt(np.mean((residuals - centre)[:, known] ** 2))) if known.any() else 0.0
        return Response(centre, max(scale, 1e-6 * max(float(np.abs(residuals).max()), 1e-6)))


@dataclass(frozen=True, eq=False)
class Corrected:
    """A cheap model with what it leaves unexplained.

    Attributes:
        model: The cheap model.
        box: The box searched.
        constants: Its constants as adjusted [q].
        response: What it does over the box.
        residuals: What the dear model answered [n, m].
        rest: What remains.
    """

    model: CheapModel
    box: Box
    constants: NDArray[np.float64]
    response: Response
    residuals: NDArray[np.float64]
    rest: Discrepancy

    @property
    def root(self) -> NDArray[np.float64]:
        """Factor of the covariance of the residuals, as in `Discrepancy.root`."""
        return self.rest.root

    def predict(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict residuals.

        Args:
            unit: Points of the unit cube [k, d].

        Returns:
            Mean [k, m], and the variance by that of each residual [k].
        """
        cheap, seen = self.seen(unit)
        mean, share = self.rest.predict(seen)
        return cheap + mean, share

    def mean_and_slope(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Predict residuals and their derivatives.

        Args:
            unit: Points of the unit cube [k, d].

        Returns:
            Mean [k, m] and Jacobian by the coordinates of the unit cube [k, m, d].
        """
        cheap, slope, seen, change = self.sloped(unit)
        mean, _ = self.rest.predict(seen)
        return cheap + mean, slope + self.rest.slope(seen, change)

    def seen(self, unit: NDArray[np.float64]) -> tuple[NDArray[np.float64], Seen]:
        """What the cheap model says, its constants adjusted.

        Args:
            unit: Points of the unit cube [k, d].

        Returns:
            Residuals [k, m], and the points as the rest sees them.
        """
        cheap = _cheap(self.model, self.box, unit, self.constants)
        return cheap, _seen(self.model, self.response, unit, cheap)

    def sloped(
        self, unit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Seen, NDArray[np.float64]]:
        """The same with derivatives by the coordinates of the unit cube.

        Args:
            unit: Points of the unit cube [k, d].

        Returns:
            Residuals [k, m], their derivatives [k, m, d], the points as the rest sees them, and the derivatives of
            what it sees [k, r, d].
        """
        cheap, slope = cheap_and_slope(self.model, self.box, unit, self.constants)
        seen = _seen(self.model, self.response, unit, cheap)
        return cheap, slope, seen, _known(self.model, self.response, slope)

    def with_point(self, point: NDArray[np.float64], told: NDArray[np.float64]) -> Corrected:
        """Pretend that a point had been evaluated.

        Args:
            point: The point of the unit cube [d].
            told: Its residuals [1, m].

        Returns:
            A model certain at that point too.
        """
        unit = np.vstack([self.rest.seen.unit, point])
        residuals = np.vstack([self.residuals, told])
        cheap, seen = self.seen(unit)
        rest = discrepancy.solve(seen, residuals - cheap, self.rest.hyper, self.rest.scale)
        return replace(self, residuals=residuals, rest=rest)


def correct(
    model: CheapModel,
    box: Box,
    unit: NDArray[np.float64],
    residuals: NDArray[np.float64],
    cloud: NDArray[np.float64],
    trials: NDArray[np.float64],
    *,
    noisy: bool = False,
    before: Corrected | None = None,
) -> Corrected:
    """Fit a corrected model to what a dear one answered.

    Args:
        model: The cheap model.
        box: The box searched.
        unit: The points evaluated, in the unit cube [n, d].
        residuals: The answers [n, m].
        cloud: Points spread over the unit cube, at which the cheap model's response is measured [k, d].
        trials: Constants, the likeliest of which the input mapping starts from, beside those before [s, q].
        noisy: Whether the answers scatter.
        before: The model of fewer points, to go on from.

    Returns:
        The model.
    """
    constants = model.constants.centre if before is None else before.constants
    hyper = None if before is None else before.rest.hyper

    def around(constants: NDArray[np.float64], hyper: NDArray[np.float64] | None) -> Corrected:
        response = Response.of(_cheap(model, box, cloud, constants), model.known)
        cheap = _cheap(model, box, unit, constants)
        seen = _seen(model, response, unit, cheap)
        rest = discrepancy.fit(seen, residuals - cheap, response.scale, noisy=noisy, guess=hyper)
        return Corrected(model, box, constants, response, residuals, rest)

    corrected = around(constants, hyper)
    for _ in range(TURNS if len(constants) else 0):
        constants = _adjusted(corrected, trials)
        moved = np.abs(constants - corrected.constants).max() > 1e-3 * model.constants.spread.max()
        corrected, trials = around(constants, corrected.rest.hyper), trials[:0]
        if not moved:
            break
    return corrected


def cheap_and_slope(
    model: CheapModel, box: Box, unit: NDArray[np.float64], constants: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A cheap model's residuals, and their derivatives by the coordinates of the unit cube.

    Args:
        model: The cheap model.
        box: The box searched.
        unit: Points of the unit cube [k, d].
        constants: The model's constants [q].

    Returns:
        Residuals [k, m] and Jacobian [k, m, d].
    """
    told = model.answer(box.from_unit(unit), np.tile(constants, (len(unit), 1)))
    return told.residuals, told.by_point * box.width


def descended(
    unit: NDArray[np.float64],
    evaluate: Callable[[NDArray[np.float64]], Residuals],
    steps: int,
    tolerance: float,
) -> Starts:
    """Descend from many points of the unit cube.

    Args:
        unit: The points [s, d].
        evaluate: Residuals and their Jacobian.
        steps: Largest number of steps.
        tolerance: Relative decrease of the cost at which a search has converged.

    Returns:
        Where the searches ended.
    """
    descent = descend(unit, steps, tolerance)
    point = next(descent)
    while True:
        try:
            point = descent.send(evaluate(point))
        except StopIteration as end:
            return end.value


def constants_fit(
    corrected: Corrected,
    centre: NDArray[np.float64] | None = None,
    noise: NDArray[np.float64] | None = None,
) -> Callable[[NDArray[np.float64]], Residuals]:
    """The least squares problem of the constants, the covariance of what remains kept.

    Args:
        corrected: The model whose constants are fitted.
        centre: Centre of their prior [q]; that of the cheap model if None.
        noise: What the answers are disturbed by, in their standard deviations [n m]; nothing if None.

    Returns:
        Constants, in the unit cube between their bounds [s, q], to rows and their Jacobian; half the sum of squares of
        the rows is their negative log density.
    """
    model, rest, given = corrected.model, corrected.rest, corrected.model.constants
    points, width = corrected.box.from_unit(rest.seen.unit), given.upper - given.lower
    (count, links), size = corrected.residuals.shape, len(given.centre)
    whiten = np.linalg.inv(rest.lower)
    weight = np.sqrt(rest.precision)
    prior_slope = np.diag(width / given.spread)
    believed = given.centre if centre is None else centre
    shift = np.zeros(count * links) if noise is None else noise

    def evaluate(unit: NDArray[np.float64]) -> Residuals:
        constants = given.lower + unit * width
        told = model.answer(np.tile(points, (len(unit), 1)), np.repeat(constants, count, axis=0))
        remains = corrected.residuals - told.residuals.reshape(-1, count, links)
        rows = (whiten @ remains * weight).reshape(len(unit), -1) + shift
        slope = told.by_constant.reshape(-1, count, links * size)
        slope = -(whiten @ slope).reshape(-1, count, links, size) * weight[:, None] * width
        rows = np.hstack([rows, (constants - believed) / given.spread])
        prior = np.broadcast_to(prior_slope, (len(unit), size, size))
        return rows, np.concatenate([slope.reshape(len(unit), -1, size), prior], axis=1)

    return evaluate


def misfit(corrected: Corrected, constants: NDArray[np.float64]) -> NDArray[np.float64]:
    """How badly constants explain the answers, the covariance of what remains kept.

    Args:
        corrected: The model whose constants are judged.
        constants: Constants [s, q].

    Returns:
        Their negative log density, but for a term that all have [s]. Variances of links are integrated out, so that
        links which other constants did not explain count again.
    """
    model, rest, given = corrected.model, corrected.rest, corrected.model.constants
    points, (count, links) = corrected.box.from_unit(rest.seen.unit), corrected.residuals.shape
    told = model.residuals(np.tile(points, (len(constants), 1)), np.repeat(constants, count, axis=0))
    rows = np.linalg.inv(rest.lower) @ (corrected.residuals - told.reshape(-1, count, links))
    return discrepancy.negative_log_density(rows) + 0.5 * np.sum(
        ((constants - given.centre) / given.spread) ** 2, axis=1
    )


def _adjusted(corrected: Corrected, trials: NDArray[np.float64]) -> NDArray[np.float64]:
    """The constants [q] that explain the answers best, the covariance of what remains kept."""
    given, own = corrected.model.constants, corrected.constants[None]
    width = given.upper - given.lower
    likely = (
        trials[np.argsort(misfit(corrected, trials), kind="stable")[:FOLLOWED]] if len(trials) else trials
    )
    starts = (np.vstack([own, likely]) - given.lower) / width
    ended = descended(starts, constants_fit(corrected), STEPS, 1e-4)
    found = np.vstack([own, given.lower + ended.unit * width])
    return found[np.argmin(misfit(corrected, found))]


def _cheap(
    model: CheapModel, box: Box, unit: NDArray[np.float64], constants: NDArray[np.float64]
) -> NDArray[np.float64]:
    return model.residuals(box.from_unit(unit), np.tile(constants, (len(unit), 1)))


def _seen(
    model: CheapModel, response: Response, unit: NDArray[np.float64], cheap: NDArray[np.float64]
) -> Seen:
    return Seen(unit, _known(model, response, (cheap - response.centre)[:, :, None])[:, :, 0])


def _known(model: CheapModel, response: Response, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows [k, m, ...] of which the cheap model knows something, scaled to a mean square of 1 together."""
    return rows[:, model.known] / (response.scale * np.sqrt(max(int(model.known.sum()), 1)))
