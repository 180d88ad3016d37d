"""Correlation of residuals: planted ranges and sizes, restricted likelihood, variogram."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

from calibray.errors import EngineError, InputError
from calibray.uncertainty.residual_correlation import Correlation, fit_correlation, shared_errors, variogram


@pytest.fixture(autouse=True)
def _one_thread():
    """Small matrices are slower on several BLAS threads."""
    with threadpool_limits(1, user_api="blas"):
        yield


def street(count: int, seed: int = 0) -> np.ndarray:
    """Receivers along two streets [m]."""
    rng = np.random.default_rng(seed)
    along, across = rng.uniform(0, 1500, count), rng.choice([0.0, 400.0], count)
    return np.stack([along, across, np.full(count, 1.5)], axis=1)


def drawn(position: np.ndarray, range_m: float, shared: float, own: float, rng) -> np.ndarray:
    """Spatially correlated errors."""
    matrix = Correlation(range_m, shared, own, 0.0, 0.0).covariance(position)
    return np.linalg.cholesky(matrix) @ rng.normal(size=len(position))


def test_range_and_size_of_the_correlated_part_are_recovered():
    position, rng = street(250), np.random.default_rng(3)
    found = [fit_correlation(drawn(position, 60.0, 4.0, 2.0, rng), position) for _ in range(10)]
    assert np.median([each.range_m for each in found]) == pytest.approx(60.0, rel=0.25)
    assert np.median([each.shared_db for each in found]) == pytest.approx(4.0, rel=0.12)
    assert np.median([each.own_db for each in found]) == pytest.approx(2.0, rel=0.12)
    assert all(each.log_likelihood > each.independent + 5 for each in found)


def test_independent_errors_show_no_correlation():
    position, rng = street(120), np.random.default_rng(4)
    gain = [
        (each := fit_correlation(rng.normal(0, 3, 120), position)).log_likelihood - each.independent
        for _ in range(12)
    ]
    assert np.median(gain) < 1.0
    assert max(gain) < 5.0


def test_the_restricted_likelihood_is_the_density_of_the_residual_components():
    rng = np.random.default_rng(5)
    position = street(40)
    columns = np.column_stack([np.ones(40), position[:, 0] / 1000])
    errors = drawn(position, 80.0, 3.0, 1.0, rng)
    found = fit_correlation(errors, position, design=columns)
    # Written out: the density of the errors' components at right angles to the columns, as Patterson and Thompson
    # define it, but for the columns' own determinant.
    null = np.linalg.svd(columns.T)[2][2:].T
    matrix = null.T @ found.covariance(position) @ null
    density = stats.multivariate_normal(np.zeros(38), matrix).logpdf(null.T @ errors)
    inner = np.linalg.slogdet(columns.T @ columns)[1]
    assert found.log_likelihood + 0.5 * inner == pytest.approx(density, abs=1e-6)
    # What the columns explain does not matter.
    shifted = fit_correlation(errors + columns @ [7.0, -3.0], position, design=columns)
    assert shifted.log_likelihood == pytest.approx(found.log_likelihood, abs=1e-6)


def test_fitted_columns_do_not_bias_the_noise():
    rng, position, own = np.random.default_rng(6), street(60), []
    columns = rng.normal(size=(60, 20))
    for _ in range(30):
        errors = rng.normal(0, 3, 60)
        errors -= columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
        parts = [fit_correlation(errors, position, design=each) for each in (columns, None)]
        own.append([np.hypot(part.own_db, part.shared_db) for part in parts])
    restricted, plain = np.mean(own, axis=0)
    assert restricted == pytest.approx(3.0, rel=0.06)
    assert plain < 2.7


def test_uninformative_errors_are_refused():
    position = street(5)
    with pytest.raises(
        InputError, match=r"number of links \(5\) must exceed the number of fitted columns \(3\)"
    ):
        fit_correlation(np.ones(5), position, design=np.ones((5, 3)))
    with pytest.raises(InputError, match="all receivers have the same position"):
        fit_correlation(np.ones(5), np.zeros((5, 3)))
    with pytest.raises(EngineError, match="all errors are zero"):
        fit_correlation(np.zeros(5), position)


COUNT = 60


@pytest.fixture(scope="module")
def position() -> np.ndarray:
    return np.column_stack([np.random.default_rng(2).uniform(0, 400, (COUNT, 2)), np.zeros(COUNT)])


def alike(position: np.ndarray, seed: int, range_m: float = 80.0) -> np.ndarray:
    """Correlated errors of 3 dB."""
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart / range_m) + 1e-9 * np.eye(len(position)))
    return 3.0 * root @ np.random.default_rng(seed).standard_normal(len(position))


def test_a_variogram_rises_for_correlated_errors_and_is_level_otherwise(position):
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


def test_correlated_errors_are_detected_and_white_ones_are_not(position):
    found = [shared_errors(alike(position, seed), position) is not None for seed in range(8)]
    white = [
        shared_errors(3.0 * np.random.default_rng([3, seed]).standard_normal(COUNT), position) is not None
        for seed in range(8)
    ]
    assert sum(found) >= 7
    assert sum(white) <= 1


def test_few_links_and_one_position_show_no_correlation():
    errors = np.random.default_rng(0).standard_normal(12)
    assert shared_errors(errors[:9], np.arange(27.0).reshape(9, 3)) is None
    assert shared_errors(errors, np.zeros((12, 3))) is None
