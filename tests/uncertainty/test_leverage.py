"""Diagnostics against closed forms and planted errors."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.uncertainty.residual_correlation import leverage, shared_errors, variogram

COUNT = 60


@pytest.fixture(scope="module")
def position() -> np.ndarray:
    return np.column_stack([np.random.default_rng(2).uniform(0, 400, (COUNT, 2)), np.zeros(COUNT)])


def alike(position: np.ndarray, seed: int, range_m: float = 80.0) -> np.ndarray:
    """Errors of 3 dB that neighbours share."""
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart / range_m) + 1e-9 * np.eye(len(position)))
    return 3.0 * root @ np.random.default_rng(seed).standard_normal(len(position))


def test_leverage_of_a_mean_is_shared_and_of_a_lone_link_is_whole():
    offset = np.zeros((5, 2))
    offset[:4, 0] = offset[4, 1] = 1.0
    assert leverage(np.zeros((5, 1)), offset) == pytest.approx([0.25] * 4 + [1.0])


def test_leverage_is_the_projection_and_adds_up_to_the_unknowns():
    random = np.random.default_rng(0)
    design = np.ones((30, 1))
    jacobian = random.standard_normal((30, 3))
    jacobian -= jacobian.mean(axis=0)  # as it is with the offset eliminated
    columns = np.hstack([jacobian, design])
    hat = columns @ np.linalg.solve(columns.T @ columns, columns.T)
    found = leverage(jacobian, design)
    assert found == pytest.approx(np.diag(hat))
    assert found.sum() == pytest.approx(4.0)


def test_columns_that_make_up_each_other_count_once():
    column = np.arange(1.0, 7.0)[:, None]
    assert leverage(np.hstack([column, 2 * column]), np.zeros((6, 0))).sum() == pytest.approx(1.0)


def test_a_variogram_rises_where_neighbours_share_errors_and_is_level_where_not(position):
    for shared, ratio in ((True, 0.6), (False, None)):
        rise = []
        for seed in range(20):
            white = 3.0 * np.random.default_rng([1, seed]).standard_normal(COUNT)
            errors = alike(position, seed) if shared else white
            distance, half, pairs = variogram(errors, position)
            assert (np.diff(distance) > 0).all()
            assert pairs.sum() <= COUNT * (COUNT - 1) / 2
            rise.append(half[0] / half[-3:].mean())
        if ratio is not None:
            assert np.median(rise) < ratio
        else:
            assert np.median(rise) == pytest.approx(1.0, abs=0.15)


def test_shared_errors_are_found_and_none_in_white_ones(position):
    found = [shared_errors(alike(position, seed), position) is not None for seed in range(8)]
    white = [
        shared_errors(3.0 * np.random.default_rng([3, seed]).standard_normal(COUNT), position) is not None
        for seed in range(8)
    ]
    assert sum(found) >= 7
    assert sum(white) <= 1


def test_few_links_and_one_place_show_nothing():
    errors = np.random.default_rng(0).standard_normal(12)
    assert shared_errors(errors[:9], np.arange(27.0).reshape(9, 3)) is None
    assert shared_errors(errors, np.zeros((12, 3))) is None
