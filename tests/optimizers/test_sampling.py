"""The designs that serve as negative controls."""

import numpy as np
import pytest
from scipy.stats import kstest, qmc

from calibray.errors import InputError
from calibray.optimizers import LatinHypercube, RandomSearch, Sobol
from calibray.optimizers.sampling import maximin_design

LOWER, UPPER = np.array([-1.0, 2.0, 0.0]), np.array([4.0, 9.0, 1e-3])


def unit(optimizer) -> np.ndarray:
    return (optimizer.ask() - LOWER) / (UPPER - LOWER)


@pytest.mark.parametrize("method", [RandomSearch, LatinHypercube, Sobol])
@pytest.mark.parametrize("budget", [1, 2, 100])
def test_asks_once_for_its_whole_budget(method, budget):
    optimizer = method(LOWER, UPPER, budget=budget)
    x = optimizer.ask()
    assert x.shape == (budget, 3)
    optimizer.tell(x, np.ones(budget))
    assert optimizer.done


def test_random_points_are_uniform():
    points = unit(RandomSearch(LOWER, UPPER, budget=2000, seed=1))
    assert min(kstest(column, "uniform").pvalue for column in points.T) > 0.01
    assert kstest(points[:, 0] ** 1.2, "uniform").pvalue < 0.01  # negative control


def test_latin_hypercube_has_one_point_in_each_slice():
    points = unit(LatinHypercube(LOWER, UPPER, budget=50, seed=1))
    assert (np.sort(np.floor(points * 50), axis=0) == np.arange(50)[:, None]).all()


def test_sobol_fills_space_more_evenly_than_random_points():
    def discrepancy(method):
        return np.median([qmc.discrepancy(unit(method(LOWER, UPPER, budget=100, seed=s))) for s in range(5)])

    assert discrepancy(Sobol) < 0.3 * discrepancy(RandomSearch)


def test_maximin_design_spreads_points():
    rng = np.random.default_rng(0)

    def spacing(points):
        return min(np.linalg.norm(a - b) for i, a in enumerate(points) for b in points[:i])

    spread = np.median([spacing(maximin_design(8, 3, rng)) for _ in range(9)])
    plain = np.median([spacing(maximin_design(8, 3, rng, tries=1)) for _ in range(9)])
    assert spread > 1.3 * plain


def test_a_budget_is_needed():
    with pytest.raises(InputError, match="budget = 0; it must be a whole number >= 1"):
        Sobol(LOWER, UPPER, budget=0)
