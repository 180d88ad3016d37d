"""Experiment design against closed forms: a linear model, separate minima, and errors that candidates share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from calibray.prediction.experiment_design import (
    Beliefs,
    Errors,
    choose_candidates,
    initial_range_probability,
)

DRAWS = 64


def beliefs(point: np.ndarray, piece: np.ndarray | None = None) -> Beliefs:
    """Draws in the unit cube without curvature."""
    count, dimension = point.shape
    piece = np.zeros((count, dimension), dtype=int) if piece is None else piece
    return Beliefs(point, np.zeros((count, dimension, dimension)), piece, np.zeros(count))


def gaussian(spread: float) -> np.ndarray:
    """Quantiles of a normal distribution as draws of one parameter."""
    return (0.5 + spread * norm.ppf((np.arange(DRAWS) + 0.5) / DRAWS))[:, None]


def linear(point: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Predictions that are linear in the parameters, and their derivatives; slopes [c, d]."""
    return point @ slope.T, np.tile(slope, (len(point), 1, 1))


def independent(own_db: float, count: int) -> Errors:
    return Errors(own_db, np.zeros((count, 0)), np.zeros((count, 3)))


def test_a_linear_model_narrows_by_bayes_rule():
    spread, own, slope = 0.1, 3.0, np.array([[20.0], [60.0]])
    point = gaussian(spread)
    outlooks = choose_candidates(beliefs(point), *linear(point, slope), independent(own, 2), 2)
    assert [outlook.index for outlook in outlooks] == [1, 0]
    variance = np.var(point)
    for outlook, square in zip(outlooks, (60.0**2, 60.0**2 + 20.0**2), strict=True):
        assert outlook.narrowed[0] == pytest.approx((1 + variance * square / own**2) ** -0.5, rel=0.03)


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_further_measurements_never_widen_what_is_expected(seed: int):
    """Of few draws some lie in a second range; whichever neighbours keep their weight, nothing is lost."""
    random = np.random.default_rng(seed)
    for _ in range(60):
        place, other = (
            random.standard_normal((DRAWS, 1)),
            random.uniform(size=(DRAWS, 1)) < random.uniform(0.05, 0.5),
        )
        point = np.hstack([0.5 + 0.1 * place, np.where(other, 0.8, 0.2)])
        predicted = place * random.uniform(0.3, 4.0, 3) + other * random.uniform(-1, 1, 3)
        predicted += 0.5 * random.standard_normal((DRAWS, 3))
        piece = np.zeros((DRAWS, 2), int)
        start = Beliefs(point, np.tile(1e6 * np.eye(2), (DRAWS, 1, 1)), piece, np.zeros(DRAWS))
        outlooks = choose_candidates(start, predicted, np.zeros((DRAWS, 3, 2)), independent(1.0, 3), 3)
        assert (np.diff([outlook.narrowed for outlook in outlooks], axis=0) <= 0).all()


def test_a_candidate_that_distinguishes_minima_precedes_one_that_narrows_each():
    random = np.random.default_rng(1)
    piece = np.repeat([0, 1], DRAWS // 2)[:, None]
    point = np.where(piece == 0, 0.2, 0.8) + 0.03 * random.standard_normal((DRAWS, 1))
    between = np.where(piece == 0, 90.0, 100.0)
    within = 100.0 * (point - np.where(piece == 0, 0.2, 0.8))
    predicted, slope = np.hstack([within, between]), np.zeros((DRAWS, 2, 1))
    slope[:, 0] = 100.0
    start = Beliefs(point, np.full((DRAWS, 1, 1), 0.03**-2.0), piece, np.zeros(DRAWS))
    assert initial_range_probability(piece) == pytest.approx(0.5)
    first, second = choose_candidates(start, predicted, slope, independent(2.0, 2), 2)
    assert (first.index, second.index) == (1, 0)
    assert first.range_probability[0] > 0.99
    assert first.narrowed[0] == pytest.approx(0.1, abs=0.03)


def test_an_unknown_offset_leaves_only_differences():
    """Two candidates of equal slope tell nothing about the parameter; two of different slope do."""
    point, slope = gaussian(0.1), np.array([[60.0], [59.0], [-40.0]])
    common = np.full((3, 1), 100.0)
    shared = Errors(1.0, common, np.zeros((3, 3)))
    outlooks = choose_candidates(beliefs(point), *linear(point, slope), shared, 2)
    assert {outlook.index for outlook in outlooks} == {0, 2}
    assert outlooks[0].narrowed[0] > 0.99
    assert outlooks[1].narrowed[0] == pytest.approx((1 + np.var(point) * 100.0**2 / 2.0) ** -0.5, rel=0.05)
    independent_errors = choose_candidates(beliefs(point), *linear(point, slope), independent(1.0, 3), 2)
    assert [outlook.index for outlook in independent_errors] == [0, 1]


@pytest.mark.parametrize(("shared_db", "second"), [(0.0, 1), (6.0, 2)])
def test_a_neighbour_of_a_chosen_point_is_worth_less_where_errors_are_shared(shared_db: float, second: int):
    point, slope = gaussian(0.1), np.array([[30.0], [29.0], [28.0]])
    position = np.array([[0.0, 0, 0], [1.0, 0, 0], [500.0, 0, 0]])
    errors = Errors(1.0, np.zeros((3, 0)), position, shared_db, 50.0)
    outlooks = choose_candidates(beliefs(point), *linear(point, slope), errors, 2)
    assert [outlook.index for outlook in outlooks] == [0, second]


def test_weights_after_all_candidates_follow_from_their_covariance():
    random = np.random.default_rng(3)
    point, slope = gaussian(0.1), 40 * random.standard_normal((4, 1))
    errors = Errors(2.0, random.standard_normal((4, 2)), random.uniform(0, 99, (4, 3)), 3.0, 60.0)
    predicted, slopes = linear(point, slope)
    matrix = np.stack([errors.covariance(k) for k in range(4)])
    assert np.diag(matrix) == pytest.approx(errors.variance)
    last = choose_candidates(beliefs(point), predicted, slopes, errors, 4)[-1]
    difference = predicted[:, None] - predicted[None]
    squares = np.einsum("tsc,cd,tsd->ts", difference, np.linalg.inv(matrix), difference)
    weight = np.exp(-0.5 * squares)
    weight /= weight.sum(axis=1, keepdims=True)
    spread = np.sqrt(weight @ point**2 - (weight @ point) ** 2).mean() / point.std()
    assert last.narrowed[0] == pytest.approx(spread, rel=1e-6)


def test_each_candidate_is_chosen_at_most_once():
    point = gaussian(0.1)
    outlooks = choose_candidates(beliefs(point), *linear(point, np.ones((3, 1))), independent(1.0, 3), 9)
    assert sorted(outlook.index for outlook in outlooks) == [0, 1, 2]


def test_where_draws_agree_the_steeper_candidate_comes_first():
    """For an uncertain parameter, curvature resolves what scatter over its whole range does not."""
    point = gaussian(0.1)
    predicted, slope = np.zeros((DRAWS, 2)), np.zeros((DRAWS, 2, 1))
    slope[:, 1] = 30.0
    outlooks = choose_candidates(beliefs(point), predicted, slope, independent(3.0, 2), 1)
    assert outlooks[0].index == 1


def test_a_range_without_draws_is_ruled_out_by_further_values():
    """All draws agree about the last two candidates; only one of these rules the other range out."""
    point = gaussian(0.01)
    excess = np.concatenate([np.zeros(DRAWS), [3.0]])
    predicted, slope = linear(point, np.array([[100.0], [0.0], [0.0]]))
    predicted = np.vstack([predicted, predicted.mean(axis=0) + np.array([0.0, 9.0, 2.0])])
    one = Beliefs(point, np.full((DRAWS, 1, 1), 1e4), np.zeros((DRAWS + 1, 1), dtype=int), excess)
    two = replace(one, piece=np.append(np.zeros(DRAWS, dtype=int), 1)[:, None])
    errors = independent(3.0, 3)
    assert [choose_candidates(start, predicted, slope, errors, 1)[0].index for start in (one, two)] == [0, 1]
