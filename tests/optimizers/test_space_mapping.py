"""Space mapping: it needs few calls with a useful cheap model, and loses little with a useless one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from calibray.optimizers import SpaceMapping, VectorSurrogate
from calibray.optimizers.arguments import Box
from calibray.optimizers.multifidelity.correction import (
    CAPPED,
    UNLIKELY,
    Corrected,
    ErrorRecord,
    UnitModel,
    average,
    constants_fit,
    correct,
    misfit,
)
from calibray.optimizers.multifidelity.discrepancy import FREEDOM, VARIANCE_SPREAD, expected, scaled_density
from calibray.optimizers.multifidelity.space_mapping import HELPFUL, MISLED, error_ratio
from calibray.optimizers.protocol import CheapAnswer, Constants
from calibray.optimizers.sampling import design

LOWER, UPPER = np.array([1.5, 1.5]), np.array([12.0, 9.0])
BOX = Box.between(LOWER, UPPER)
RNG = np.random.default_rng(5)
PHASE, WEIGHT = RNG.uniform(0.0, 6.0, 25), RNG.uniform(0.3, 1.0, (2, 25))
TRUTH = np.array([6.1, 4.2])
NOISE = RNG.standard_normal(25)
CLOUD = design("sobol", 64, 2, np.random.default_rng(2))


def street_loss(x: np.ndarray, thickness: np.ndarray, absorption: float = 0.0) -> np.ndarray:
    """Path losses of a made-up street: a trend in two permittivities, and ripples set by a thickness."""
    trend = 6.0 * WEIGHT[0] * np.log(x[:, :1]) - 4.0 * WEIGHT[1] * np.log(x[:, 1:])
    ripple = 1.5 * np.cos(2.0 * thickness * np.sqrt(x[:, :1]) + PHASE)
    return trend + ripple - absorption * np.log1p(np.exp(0.5 * trend))


MEASURED = street_loss(TRUTH[None], np.full((1, 1), 1.1), 1.0)[0] + NOISE


def engine(x: np.ndarray) -> np.ndarray:
    """Residuals of the expensive engine [n, 25]; the thickness is 1.1, and it models absorption."""
    return street_loss(x, np.full((len(x), 1), 1.1), 1.0) - MEASURED


def value(residuals: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(residuals**2, axis=1))


def minimum() -> float:
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(LOWER, UPPER, strict=True))), -1)
    return float(value(engine(grid.reshape(-1, 2))).min())


MINIMUM = minimum()


def excess(optimizer) -> np.ndarray:
    """Excess over the minimum after every call."""
    best = []
    while not optimizer.done:
        x = optimizer.ask()
        residuals = engine(x)
        optimizer.tell(x, value(residuals), residuals=residuals)
        best += value(residuals).tolist()
    return np.minimum.accumulate(best) - MINIMUM


@dataclass(frozen=True, eq=False)
class FunctionModel:
    """A cheap model given as a function of points [n, 2] and constants [n, q]; derivatives are central differences."""

    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    constants: Constants = field(default_factory=Constants.none)
    known: np.ndarray = field(default_factory=lambda: np.ones(25, bool))

    def residuals(self, points, constants):
        return self.function(points, constants)

    def answer(self, points, constants):
        arguments = np.hstack([points, constants])
        step = 1e-5 * np.concatenate([BOX.width, self.constants.width])
        moves = np.concatenate([np.diag(step), -np.diag(step)])
        moved = (arguments + moves[:, None]).reshape(-1, arguments.shape[1])
        values = self.function(moved[:, :2], moved[:, 2:]).reshape(2, len(step), len(points), -1)
        slopes = np.moveaxis((values[0] - values[1]) / (2.0 * step[:, None, None]), 0, -1)
        return CheapAnswer(self.function(points, constants), slopes[:, :, :2], slopes[:, :, 2:])


def cheap(thickness: float) -> FunctionModel:
    """The street without absorption, with a believed thickness."""
    centre = np.log([thickness])
    constants = Constants(centre, np.full(1, 0.5), centre - 1.5, centre + 1.5)
    return FunctionModel(lambda x, c: street_loss(x, np.exp(c)) - MEASURED, constants)


def useless() -> FunctionModel:
    """A model that explains nothing: random tones."""
    rng = np.random.default_rng(1)
    frequency, amplitude = rng.standard_normal((2, 30)), rng.standard_normal((30, 25))
    phase = rng.uniform(0, 6, 30)

    def tones(x, _):
        return 3.0 * np.cos(6.0 * BOX.to_unit(x) @ frequency + phase) @ amplitude / 5.0

    return FunctionModel(tones)


@pytest.mark.parametrize("thickness", [1.1, 1.8])
def test_eight_calls_find_the_minimum_even_with_wrong_constants(thickness):
    mapped = excess(SpaceMapping(LOWER, UPPER, cheap_model=cheap(thickness), budget=8))
    assert mapped[0] > 0.02  # the cheap model's minimum is elsewhere
    assert mapped[-1] < 2e-3
    without = excess(VectorSurrogate(LOWER, UPPER, budget=8))
    assert mapped[-1] < 0.1 * without[-1]


def corrected_by(count: int):
    """The cheap model with thickness 1.8 instead of 1.1, corrected by some answers; and starts of its members."""
    unit = design("sobol", count, 2, np.random.default_rng(0))
    random = np.random.default_rng(1)
    starts = np.log(1.8) + 0.5 * random.standard_normal((16, 1))
    return correct(UnitModel(cheap(1.8), BOX), (unit, engine(BOX.from_unit(unit))), CLOUD, random), starts


def test_the_constants_are_those_that_explain_the_answers():
    corrected, _ = corrected_by(8)
    assert np.exp(corrected.constants) == pytest.approx([1.1], rel=0.05)
    mean, share = corrected.predict(corrected.unit)
    assert mean == pytest.approx(corrected.residuals, abs=0.02)
    assert share.max() < 1e-3 * corrected.predict(CLOUD)[1].max()


def thick_walls(x: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Path losses of two walls so thick that their ripples repeat many times within the prior of the thickness."""
    ripple = np.cos(12.0 * thickness[:, :, None] * np.sqrt(x)[:, :, None] + np.stack([PHASE, PHASE[::-1]]))
    return 6.0 * WEIGHT[0] * np.log(x[:, :1]) + 3.0 * ripple.sum(axis=1)


THICK = np.array([1.1, 2.3])
"""True thicknesses of both walls."""


def thick_cheap() -> FunctionModel:
    """The thick walls with other believed thicknesses; hundreds of minima explain some answers badly."""
    centre = np.log([1.8, 1.6])
    constants = Constants(centre, np.full(2, 0.5), centre - 1.5, centre + 1.5)
    return FunctionModel(lambda x, c: thick_walls(x, np.exp(c)), constants)


def thick_answers(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unit cube, and the residuals there with the true thicknesses."""
    unit = design("sobol", count, 2, np.random.default_rng(0))
    return unit, thick_walls(BOX.from_unit(unit), np.tile(THICK, (count, 1)))


def test_an_input_mapping_finds_one_of_hundreds_of_minima(monkeypatch):
    model, answers = thick_cheap(), thick_answers(6)
    centre = model.constants.centre

    def mapped() -> Corrected:
        return correct(UnitModel(model, BOX), answers, CLOUD, np.random.default_rng(1))

    corrected = mapped()
    assert np.exp(corrected.constants) == pytest.approx(THICK, rel=1e-3)
    believed, fitted = misfit(corrected, np.stack([centre, corrected.constants])).value
    assert fitted < believed - 50.0
    monkeypatch.setattr("calibray.optimizers.multifidelity.correction.TRIALS", 4)
    assert np.abs(np.exp(mapped().constants) - THICK).max() > 0.1


def test_rounds_that_gain_nothing_end_after_one_with_each_kernel(monkeypatch):
    kernels = []

    def nothing_likelier(corrected: Corrected, random: np.random.Generator) -> np.ndarray:
        kernels.append(corrected.discrepancy.kernel)
        return np.empty((0, 1))

    monkeypatch.setattr("calibray.optimizers.multifidelity.correction._likelier", nothing_likelier)
    corrected, _ = corrected_by(6)
    prior = expected(2, corrected.response.scale, noisy=False)
    assert [kernel.rates.tolist() for kernel in kernels] == [
        corrected.discrepancy.kernel.rates.tolist(), prior.rates.tolist(),
    ]  # fmt: skip
    assert kernels[0].rates != pytest.approx(prior.rates)
    assert corrected.constants == corrected.cheap.constants.centre


def test_the_scale_of_a_discrepancy_is_the_most_probable_one():
    """Errors of a hundredth of the expected size are probable, because the expected size may be wrong too."""
    errors = np.random.default_rng(4).standard_normal((3, 6, 9)) * np.array([0.01, 1.0, 5.0])[:, None, None]

    def density(logarithm: float, rows: np.ndarray) -> float:
        square = np.sum(rows**2, axis=0) / np.exp(logarithm)
        links = 0.5 * (FREEDOM + 6) * np.log1p(square / FREEDOM).sum() + 0.5 * rows.size * logarithm
        return float(links + 0.5 * (logarithm / VARIANCE_SPREAD) ** 2)

    value, scale = scaled_density(errors)
    for rows, found, factor in zip(errors, value, scale, strict=True):
        lowest = min(density(logarithm, rows) for logarithm in np.linspace(-14.0, 6.0, 2001))
        assert found == pytest.approx(lowest, rel=1e-2)
        assert found == pytest.approx(density(np.log(factor), rows))


def test_a_search_with_earlier_evaluations_fits_the_constants_from_the_likeliest_draws():
    unit, residuals = thick_answers(16)
    search = SpaceMapping(LOWER, UPPER, cheap_model=thick_cheap(), budget=4)
    search.tell(BOX.from_unit(unit), value(residuals), residuals=residuals)
    for _ in range(4):
        x = search.ask()
        residuals = thick_walls(x, np.tile(THICK, (len(x), 1)))
        search.tell(x, value(residuals), residuals=residuals)
    assert search.corrected is not None
    assert np.exp(search.corrected.constants) == pytest.approx(THICK, rel=1e-3)


def test_slopes_of_a_corrected_model_equal_finite_differences():
    unit = design("sobol", 6, 2, np.random.default_rng(3))
    corrected = correct(
        UnitModel(cheap(1.4), BOX), (unit, engine(BOX.from_unit(unit))), unit, np.random.default_rng(0)
    )
    point = np.array([[0.4, 0.7]])
    _, slope = corrected.mean_and_slope(point)
    for axis, move in enumerate(1e-5 * np.eye(2)):
        central = (corrected.predict(point + move)[0] - corrected.predict(point - move)[0]) / 2e-5
        assert slope[0, :, axis] == pytest.approx(central[0], rel=1e-4, abs=1e-4)


def test_members_pass_through_the_answers_and_agree_better_with_more_of_them():
    spread = []
    for count in (1, 8):
        corrected, starts = corrected_by(count)
        model = average(corrected, starts, np.random.default_rng(3))
        assert model.members[0] is corrected
        assert len(model.members) > 4
        spread.append(np.std([np.exp(member.constants) for member in model.members[1:]]))
        for member in model.members:
            assert member.predict(corrected.unit)[0] == pytest.approx(corrected.residuals, abs=0.02)
    assert spread[1] < 0.2 * spread[0]


def test_members_that_explain_the_answers_badly_are_left_out(monkeypatch):
    corrected, starts = corrected_by(3)
    monkeypatch.setattr(
        "calibray.optimizers.multifidelity.correction.STEPS", 0
    )  # members stay at their start
    kept = average(corrected, starts, np.random.default_rng(3)).members[1:]
    fit, prior = constants_fit(corrected), corrected.cheap.constants

    def cost(constants):
        return 0.5 * np.sum(fit((constants[None] - prior.lower) / prior.width)[0] ** 2)

    costs = np.array([cost(start) for start in starts])
    assert 0 < len(kept) < len(starts)
    assert len(kept) == np.sum(costs - cost(corrected.constants) < UNLIKELY * 4)


def test_disagreement_of_members_is_uncertainty_until_the_point_is_evaluated():
    corrected, starts = corrected_by(1)
    model, far = average(corrected, starts, np.random.default_rng(3)), np.array([0.9, 0.2])
    before = model.predict(far[None])
    disagreement = np.var([residuals[0] for residuals, _ in before.members], axis=0).mean()
    assert before.variance[0] > disagreement > 1e-3
    after = model.with_point(far).predict(far[None])
    assert after.mean == pytest.approx(before.mean, abs=0.01)
    assert after.variance[0] < 0.01 * before.variance[0]


def test_errors_larger_than_predicted_stretch_later_predictions():
    record = ErrorRecord()
    assert record.stretch == 1.0
    record.add(np.zeros(4), 2.0, np.full(4, 4.0))
    assert record.stretch == pytest.approx(0.5 * (1.0 + 8.0))
    record.add(np.zeros(4), 1e-30, np.full(4, 4.0))
    assert record.stretch == pytest.approx((1.0 + 8.0 + CAPPED) / 3.0)


def test_a_cheap_model_is_judged_by_the_median_link():
    unit = design("sobol", 4, 2, np.random.default_rng(0))
    residuals = engine(BOX.from_unit(unit))
    wild = residuals.copy()
    wild[:, :5] = 30.0 * np.random.default_rng(7).standard_normal(
        (4, 5)
    )  # no model predicts these five links

    def ratio(model: FunctionModel, answers: np.ndarray) -> float:
        return error_ratio(correct(UnitModel(model, BOX), (unit, answers), CLOUD, np.random.default_rng(0)))

    assert ratio(cheap(1.1), residuals) < HELPFUL
    assert ratio(useless(), residuals) > HELPFUL
    assert ratio(cheap(1.1), wild) < HELPFUL


def test_a_useless_cheap_model_is_recognised_on_a_noisy_engine():
    """Both processes smooth: one that interpolates noise would make the cheap model look better."""
    unit = design("sobol", 16, 2, np.random.default_rng(16))
    answers = engine(BOX.from_unit(unit)) + 0.5 * np.random.default_rng(116).standard_normal((16, 25))
    corrected = correct(
        UnitModel(useless(), BOX), (unit, answers), CLOUD, np.random.default_rng(1), noisy=True
    )
    assert error_ratio(corrected) < MISLED < 3.0 < error_ratio(corrected, noisy=True)


def test_a_useless_cheap_model_costs_three_calls_at_most():
    optimizer = SpaceMapping(LOWER, UPPER, cheap_model=useless(), budget=21)
    mapped = excess(optimizer)
    assert optimizer.corrected is None  # the vector surrogate has taken over
    assert mapped[-1] <= excess(VectorSurrogate(LOWER, UPPER, budget=18))[-1] + 1e-3


def test_without_a_cheap_model_it_is_the_vector_surrogate():
    mapped = SpaceMapping(LOWER, UPPER, budget=9, seed=2)
    assert np.array_equal(excess(mapped), excess(VectorSurrogate(LOWER, UPPER, budget=9, seed=2)))


def test_batches_hold_different_candidates_and_keep_to_the_budget():
    optimizer = SpaceMapping(LOWER, UPPER, cheap_model=cheap(1.8), budget=10, batch=4)
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        sizes.append(len(x))
        assert len(np.unique(x.round(9), axis=0)) == len(x)
        residuals = engine(x)
        optimizer.tell(x, value(residuals), residuals=residuals)
    assert sizes == [4, 4, 2]
    assert optimizer.best.y - MINIMUM < 5e-3


def test_a_constant_in_the_value_does_not_change_the_search():
    """A negative log likelihood may be negative; steps that gain nothing lead to an exploration all the same."""
    shift, rng = 10.0, np.random.default_rng(8)

    def searching(objective):
        return SpaceMapping(LOWER, UPPER, cheap_model=cheap(1.1), budget=8, noisy=True, objective=objective)

    plain, shifted = searching(value), searching(lambda residuals: value(residuals) - shift)
    while not plain.done:
        x = plain.ask()
        assert np.array_equal(shifted.ask(), x)
        residuals = engine(x) + 0.05 * rng.standard_normal((1, 25))
        plain.tell(x, value(residuals), residuals=residuals)
        shifted.tell(x, value(residuals) - shift, residuals=residuals)


def test_a_box_without_a_point_far_from_all_evaluated_ones_is_searched_on(monkeypatch):
    monkeypatch.setattr("calibray.optimizers.multifidelity.space_mapping.SEPARATION", 0.5)
    assert len(excess(SpaceMapping(LOWER, UPPER, cheap_model=cheap(1.1), budget=16))) == 16


def test_failed_calls_are_ignored():
    optimizer = SpaceMapping(LOWER, UPPER, cheap_model=cheap(1.4), budget=9)
    for call in range(9):
        x = optimizer.ask()
        residuals, y = engine(x), value(engine(x))
        if call in (0, 1, 4):
            residuals, y = np.full_like(residuals, np.inf), np.full(1, np.inf)
        optimizer.tell(x, y, residuals=residuals)
    assert optimizer.done
    assert optimizer.best.y - MINIMUM < 0.01


def test_a_noisy_engine_is_smoothed():
    rng = np.random.default_rng(8)
    optimizer = SpaceMapping(LOWER, UPPER, cheap_model=cheap(1.1), budget=12, noisy=True)
    while not optimizer.done:
        x = optimizer.ask()
        residuals = engine(x) + 0.05 * rng.standard_normal((1, 25))
        optimizer.tell(x, value(residuals), residuals=residuals)
    assert value(engine(optimizer.best.x[None]))[0] - MINIMUM < 0.01
