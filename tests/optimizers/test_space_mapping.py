"""Space mapping: how far a cheap model carries, and that one that explains nothing costs next to nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import multivariate_t

from calibray.optimizers import SpaceMapping, VectorSurrogate
from calibray.optimizers.box import Box
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.averaging import CAPPED, UNLIKELY, Track, averaged
from calibray.optimizers.multifidelity.cheap_model import Constants, Differenced
from calibray.optimizers.multifidelity.correction import FOLLOWED, constants_fit, correct, misfit
from calibray.optimizers.multifidelity.discrepancy import Seen
from calibray.optimizers.multifidelity.space_mapping import HELPFUL, misleading
from calibray.optimizers.sampling import design

LOWER, UPPER = np.array([1.5, 1.5]), np.array([12.0, 9.0])
RNG = np.random.default_rng(5)
PHASE, SIDE = RNG.uniform(0.0, 6.0, 25), RNG.uniform(0.3, 1.0, (2, 25))
TRUTH = np.array([6.1, 4.2])
NOISE = RNG.standard_normal(25)


def rows(x: np.ndarray, thickness: np.ndarray, lost: float = 0.0) -> np.ndarray:
    """Path losses of a made-up street: a trend in two constants, and ripples that a thickness sets."""
    first = 6.0 * SIDE[0] * np.log(x[:, :1]) - 4.0 * SIDE[1] * np.log(x[:, 1:])
    ripple = 1.5 * np.cos(2.0 * thickness * np.sqrt(x[:, :1]) + PHASE)
    return first + ripple - lost * np.log1p(np.exp(0.5 * first))


MEASURED = rows(TRUTH[None], np.full((1, 1), 1.1), 1.0)[0] + NOISE


@dataclass
class Dear:
    """The dear model, its calls counted."""

    calls: int = 0

    def run(self, optimizer, calls: int) -> np.ndarray:
        """Excess over the minimum after every call."""
        best = []
        while not optimizer.done and len(best) < calls:
            x = optimizer.ask()
            residuals = answered(x)
            optimizer.tell(x, np.sqrt(np.mean(residuals**2, axis=1)), residuals=residuals)
            best += np.sqrt(np.mean(residuals**2, axis=1)).tolist()
        return np.minimum.accumulate(best)[:calls] - minimum()


def answered(x: np.ndarray) -> np.ndarray:
    return rows(x, np.full((len(x), 1), 1.1), 1.0) - MEASURED


def minimum() -> float:
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 301) for a, b in zip(LOWER, UPPER, strict=True))), -1)
    return float(np.sqrt(np.mean(answered(grid.reshape(-1, 2)) ** 2, axis=1)).min())


def cheap(believed: float) -> Differenced:
    """The street without what it loses, told a thickness."""
    centre = np.log([believed])
    constants = Constants(centre, np.full(1, 0.5), centre - 1.5, centre + 1.5)
    return Differenced(
        lambda x, c: rows(x, np.exp(c)) - MEASURED, UPPER - LOWER, np.ones(25, bool), constants
    )


def noise() -> Differenced:
    """A model that knows nothing: tones at random."""
    rng = np.random.default_rng(1)
    tones, size, phase = rng.standard_normal((2, 30)), rng.standard_normal((30, 25)), rng.uniform(0, 6, 30)

    def tell(x, _):
        return 3.0 * np.cos(6.0 * ((x - LOWER) / (UPPER - LOWER)) @ tones + phase) @ size / 5.0

    return Differenced(tell, UPPER - LOWER, np.ones(25, bool))


@pytest.mark.parametrize("believed", [1.1, 1.8])
def test_a_cheap_model_told_wrong_constants_finds_the_minimum_in_eight_calls(believed):
    excess = Dear().run(SpaceMapping(LOWER, UPPER, model=cheap(believed), budget=8), 8)
    assert excess[0] > 0.02  # the cheap model's own minimum is another
    assert excess[-1] < 2e-3
    without = Dear().run(VectorSurrogate(LOWER, UPPER, budget=8), 8)
    assert excess[-1] < 0.1 * without[-1]


def test_the_constants_are_those_that_explain_the_answers():
    box, model = Box.between(LOWER, UPPER), cheap(1.8)
    unit = design("sobol", 8, 2, np.random.default_rng(0))
    trials = np.log(1.8) + 0.5 * np.random.default_rng(1).standard_normal((8, 1))
    cloud = design("sobol", 64, 2, np.random.default_rng(2))
    residuals = answered(box.from_unit(unit))
    corrected = correct(model, box, unit, residuals, cloud, trials)
    assert np.exp(corrected.constants) == pytest.approx([1.1], rel=0.05)
    mean, share = corrected.predict(unit)
    assert mean == pytest.approx(residuals, abs=0.02)  # at evaluated points it is what was answered
    assert share.max() < 1e-3 * corrected.predict(cloud)[1].max()


def thick(x: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Path losses of walls, two of them, so thick that their ripples repeat many times within what is believed."""
    ripple = np.cos(12.0 * thickness[:, :, None] * np.sqrt(x)[:, :, None] + np.stack([PHASE, PHASE[::-1]]))
    return 6.0 * SIDE[0] * np.log(x[:, :1]) + 3.0 * ripple.sum(axis=1)


def test_input_mappings_start_from_the_likeliest_of_many_trials():
    """Of hundreds of minima one explains the answers, and the first trials lie in others."""
    box, true = Box.between(LOWER, UPPER), np.array([1.1, 2.3])
    centre = np.log([1.8, 1.6])
    constants = Constants(centre, np.full(2, 0.5), centre - 1.5, centre + 1.5)
    model = Differenced(lambda x, c: thick(x, np.exp(c)), UPPER - LOWER, np.ones(25, bool), constants)
    unit = design("sobol", 3, 2, np.random.default_rng(0))
    residuals = thick(box.from_unit(unit), np.tile(true, (3, 1)))
    cloud = design("sobol", 64, 2, np.random.default_rng(2))
    trials = centre + 0.5 * np.random.default_rng(1).standard_normal((600, 2))
    few = correct(model, box, unit, residuals, cloud, trials[:FOLLOWED])
    assert np.abs(np.exp(few.constants) - true).max() > 0.1
    many = correct(model, box, unit, residuals, cloud, trials)
    assert np.exp(many.constants) == pytest.approx(true, rel=1e-3)
    believed, found = misfit(many, np.stack([centre, many.constants]))
    assert found < believed - 50.0


def test_slopes_of_a_corrected_model_are_those_of_its_predictions():
    box, unit = Box.between(LOWER, UPPER), design("sobol", 6, 2, np.random.default_rng(3))
    corrected = correct(cheap(1.4), box, unit, answered(box.from_unit(unit)), unit, np.zeros((0, 1)))
    point, step = np.array([[0.4, 0.7]]), 1e-5
    _, slope = corrected.mean_and_slope(point)
    for axis in range(2):
        move = step * np.eye(2)[axis]
        central = (corrected.predict(point + move)[0] - corrected.predict(point - move)[0]) / (2.0 * step)
        assert slope[0, :, axis] == pytest.approx(central[0], rel=1e-4, abs=1e-4)


def corrected_by(count: int):
    """The cheap model, told 1.8 where 1.1 is true, corrected by some answers, and constants to start members from."""
    box, model = Box.between(LOWER, UPPER), cheap(1.8)
    unit = design("sobol", count, 2, np.random.default_rng(0))
    cloud = design("sobol", 64, 2, np.random.default_rng(2))
    starts = np.log(1.8) + 0.5 * np.random.default_rng(1).standard_normal((16, 1))
    return correct(model, box, unit, answered(box.from_unit(unit)), cloud, starts), starts


def test_members_pass_through_the_answers_and_come_together_with_their_number():
    spread = []
    for count in (1, 8):
        corrected, starts = corrected_by(count)
        drawn = averaged(corrected, starts, np.random.default_rng(3))
        assert drawn.members[0] is corrected
        assert len(drawn.members) > 4
        spread.append(np.std([np.exp(member.constants) for member in drawn.members[1:]]))
        for member in drawn.members:
            assert member.predict(corrected.rest.seen.unit)[0] == pytest.approx(corrected.residuals, abs=0.02)
    assert spread[1] < 0.2 * spread[0]


def test_members_that_explain_the_answers_worse_are_left_out(monkeypatch):
    corrected, starts = corrected_by(3)
    monkeypatch.setattr("calibray.optimizers.multifidelity.averaging.STEPS", 0)  # each stays where it starts
    kept = averaged(corrected, starts, np.random.default_rng(3)).members[1:]
    fit = constants_fit(corrected)
    given = corrected.model.constants
    cost = [
        0.5 * np.sum(fit((start[None] - given.lower) / (given.upper - given.lower))[0] ** 2)
        for start in starts
    ]
    least = 0.5 * np.sum(fit((corrected.constants[None] - given.lower) / (given.upper - given.lower))[0] ** 2)
    assert 0 < len(kept) < len(starts)
    assert len(kept) == np.sum(np.array(cost) - least < UNLIKELY * 4)


def test_what_members_disagree_about_is_in_doubt_until_it_is_told():
    corrected, starts = corrected_by(1)
    model, far = averaged(corrected, starts, np.random.default_rng(3)), np.array([0.9, 0.2])
    told = model.predict(far[None])
    apart = np.var([part[0] for part in told.parts], axis=0).mean()
    assert told.variance[0] > apart > 1e-3
    after = model.with_point(far).predict(far[None])
    assert after.mean == pytest.approx(told.mean, abs=0.01)
    assert after.variance[0] < 0.01 * told.variance[0]


def test_errors_beyond_what_was_expected_stretch_what_is_expected_next():
    track = Track()
    assert track.stretch == 1.0
    track.note(np.zeros(4), 2.0, np.full(4, 4.0))
    assert track.stretch == pytest.approx(0.5 * (1.0 + 8.0))
    track.note(np.zeros(4), 1e-30, np.full(4, 4.0))
    assert track.stretch == pytest.approx((1.0 + 8.0 + CAPPED) / 3.0)


def test_a_cheap_model_is_judged_by_its_middling_link():
    box, cloud = Box.between(LOWER, UPPER), design("sobol", 64, 2, np.random.default_rng(2))
    unit = design("sobol", 4, 2, np.random.default_rng(0))
    residuals = answered(box.from_unit(unit))
    helps = correct(cheap(1.1), box, unit, residuals, cloud, np.zeros((0, 1)))
    assert misleading(helps) < HELPFUL
    assert misleading(correct(noise(), box, unit, residuals, cloud, np.zeros((1, 0)))) > HELPFUL
    wild = residuals.copy()
    wild[:, :5] = 30.0 * np.random.default_rng(7).standard_normal((4, 5))  # five links that nothing foretells
    assert misleading(correct(cheap(1.1), box, unit, wild, cloud, np.zeros((0, 1)))) < HELPFUL


def test_a_cheap_model_of_pure_noise_costs_three_calls_at_most():
    budget = 30
    with_noise = Dear().run(SpaceMapping(LOWER, UPPER, model=noise(), budget=budget), budget)
    without = Dear().run(VectorSurrogate(LOWER, UPPER, budget=budget), budget)
    optimizer = SpaceMapping(LOWER, UPPER, model=noise(), budget=8)
    Dear().run(optimizer, 8)
    assert optimizer.corrected is None  # the vector surrogate has taken over
    assert with_noise[budget - 1] <= without[budget - 4] + 1e-3


def test_without_a_cheap_model_it_is_the_vector_surrogate():
    first, second = (
        SpaceMapping(LOWER, UPPER, budget=9, seed=2),
        VectorSurrogate(LOWER, UPPER, budget=9, seed=2),
    )
    assert np.array_equal(Dear().run(first, 9), Dear().run(second, 9))


def test_batches_hold_candidates_that_differ_and_keep_to_the_budget():
    optimizer = SpaceMapping(LOWER, UPPER, model=cheap(1.8), budget=10, batch=4)
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        sizes.append(len(x))
        assert len(np.unique(x.round(9), axis=0)) == len(x)
        residuals = answered(x)
        optimizer.tell(x, np.sqrt(np.mean(residuals**2, axis=1)), residuals=residuals)
    assert sizes == [4, 4, 2]
    assert optimizer.best.y - minimum() < 5e-3


def test_failed_calls_are_not_learned_from():
    optimizer = SpaceMapping(LOWER, UPPER, model=cheap(1.4), budget=9)
    for call in range(9):
        x = optimizer.ask()
        residuals = answered(x)
        failed = call in (0, 1, 4)
        y = np.full(1, np.inf) if failed else np.sqrt(np.mean(residuals**2, axis=1))
        optimizer.tell(x, y, residuals=np.full_like(residuals, np.inf) if failed else residuals)
    assert optimizer.done
    assert optimizer.best.y - minimum() < 0.01


def test_an_engine_whose_answers_scatter_is_smoothed():
    rng = np.random.default_rng(8)
    optimizer = SpaceMapping(LOWER, UPPER, model=cheap(1.1), budget=12, noisy=True)
    while not optimizer.done:
        x = optimizer.ask()
        residuals = answered(x) + 0.05 * rng.standard_normal((1, 25))
        optimizer.tell(x, np.sqrt(np.mean(residuals**2, axis=1)), residuals=residuals)
    assert np.sqrt(np.mean(answered(optimizer.best.x[None]) ** 2)) - minimum() < 0.01


def test_the_process_is_a_multivariate_t_by_its_formula():
    """The likelihood's slope is that of its value, and left-out errors are those of leaving out."""
    rng = np.random.default_rng(4)
    seen, remains = Seen(rng.random((6, 2)), rng.standard_normal((6, 3))), rng.standard_normal((6, 5))
    likelihood = discrepancy._likelihood(seen, remains, 0.7)
    hyper = np.array([0.3, -1.0, -0.5, 0.4, 0.9, -3.0])
    value, slope = likelihood(hyper)
    for k in range(6):
        move = 1e-6 * np.eye(6)[k]
        assert slope[k] == pytest.approx(
            (likelihood(hyper + move)[0] - likelihood(hyper - move)[0]) / 2e-6, rel=1e-4
        )
    process = discrepancy.solve(seen, remains, hyper, 0.7)
    others = np.arange(6) != 2
    fewer = discrepancy.solve(Seen(seen.unit[others], seen.response[others]), remains[others], hyper, 0.7)
    worse = np.stack([process.whitened, 2.0 * process.whitened])
    student = multivariate_t(np.zeros(6), np.eye(6), df=discrepancy.FREEDOM)
    density = np.array([student.logpdf(each.T).sum() for each in worse])
    assert np.diff(discrepancy.negative_log_density(worse)) == pytest.approx(-np.diff(density))
    left = remains[2] - fewer.predict(Seen(seen.unit[2:3], seen.response[2:3]))[0][0]
    assert process.left_out()[2] == pytest.approx(left)
    assert np.isfinite(value)
