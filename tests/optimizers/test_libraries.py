"""Optimizers of other libraries, and Bayesian optimization of the value."""

import sys
import threading

import numpy as np
import pytest
from scipy.stats import norm

from calibray.errors import InputError
from calibray.optimizers import CMAES, DFOLS, DifferentialEvolution, GaussianProcess, RandomSearch
from calibray.optimizers.evaluations import Evaluations
from calibray.optimizers.gaussian_process import log_shape
from calibray.optimizers.libraries import inverted
from problem_families.landscapes import rosenbrock, street, tones, within

LARGE = 2.0**31
LIBRARIES = [CMAES, DFOLS, DifferentialEvolution]
BUDGETED = [*LIBRARIES, GaussianProcess]


def run(method, landscape, **settings):
    return landscape.run(method(landscape.lower, landscape.upper, **settings))


@pytest.mark.parametrize(
    ("method", "budget", "excess"),
    [(CMAES, 400, 0.1), (DFOLS, 40, 1e-6), (DifferentialEvolution, 400, 0.1), (GaussianProcess, 40, 0.2)],
)
def test_they_descend_the_curved_valley(method, budget, excess):
    best = run(method, rosenbrock(), budget=budget, seed=1).best
    assert best.y < excess
    assert run(RandomSearch, rosenbrock(), budget=budget, seed=1).best.y > best.y


def test_dfo_ls_starts_again_until_it_leaves_a_local_minimum():
    few, many = (run(DFOLS, tones(), budget=budget, seed=3).best.y for budget in (100, 200))
    assert few > tones().minimum + 0.05
    assert many < tones().minimum + 1e-3


def test_the_gaussian_process_needs_fewer_evaluations_than_random_search():
    land = street()
    modelled = [run(GaussianProcess, land, budget=40, seed=seed).best.y for seed in range(3)]
    drawn = [run(RandomSearch, land, budget=40, seed=seed).best.y for seed in range(3)]
    assert max(modelled) < min(drawn)


@pytest.mark.parametrize("method", LIBRARIES)
def test_they_start_at_the_best_earlier_point(method):
    land = rosenbrock()
    optimizer = method(land.lower, land.upper, budget=20, seed=2)
    earlier = np.array([[-1.5, 1.0], [0.8, 0.6]])
    optimizer.tell(earlier, *land.evaluate(earlier))
    first = optimizer.ask()
    if method is CMAES:  # draws around it
        far, near = np.linalg.norm(np.median(first, axis=0) - earlier, axis=1)
        assert near < far
    else:
        assert np.abs(first - earlier[1]).max(axis=1).min() < 1e-12


def test_differential_evolution_starts_on_a_face_of_the_box():
    rng = np.random.default_rng(0)
    for _ in range(50):
        lower = rng.uniform(-10.0, 10.0, 2)
        upper = lower + rng.uniform(0.1, 10.0, 2)
        optimizer = DifferentialEvolution(lower, upper)
        optimizer.tell([upper], [1.0])
        assert np.array_equal(optimizer.ask().max(axis=0), upper)


def test_a_first_region_of_dfo_ls_that_is_the_last_one_is_refused():
    with pytest.raises(InputError, match=r"tolerance = 0.01; it must be a finite number from 1e-12 to 0.005"):
        DFOLS([0.0], [1.0], radius=0.01, tolerance=0.01)


def test_earlier_points_replace_the_design_of_the_gaussian_process():
    land = rosenbrock()
    optimizer = GaussianProcess(land.lower, land.upper, seed=2)
    earlier = land.lower + np.random.default_rng(0).random((6, 2)) * 4.0
    optimizer.tell(earlier, *land.evaluate(earlier))
    assert len(optimizer.ask()) == 1


@pytest.mark.parametrize("method", BUDGETED)
@pytest.mark.parametrize("budget", [1, 3, 10])
def test_a_small_budget_is_kept(method, budget):
    assert run(method, rosenbrock(), budget=budget).evaluations == budget


@pytest.mark.parametrize("method", BUDGETED)
def test_the_scale_of_the_parameters_does_not_matter(method):
    near, far = rosenbrock(), within(rosenbrock(), [-LARGE] * 2, [LARGE] * 2)
    near, far = (method(land.lower, land.upper, budget=24, seed=3) for land in (near, far))
    while not near.done:
        x = near.ask()
        evaluation = rosenbrock().evaluate(x)
        near.tell(x, *evaluation)
        far.tell(far.ask(), *evaluation)
        assert np.array_equal(far.best.x, 0.5 * LARGE * near.best.x)


@pytest.mark.parametrize("method", BUDGETED)
def test_numpys_global_generator_is_not_used(method):
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    run(method, rosenbrock(), budget=30)
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize("method", [DFOLS, DifferentialEvolution])
def test_the_thread_of_a_dropped_run_ends(method):
    before = threading.active_count()
    optimizer = method([0.0, 0.0], [1.0, 1.0])
    optimizer.ask()
    assert threading.active_count() == before + 1
    del optimizer
    assert threading.active_count() == before


def test_an_error_of_a_library_reaches_the_caller():
    def minimize(evaluate):
        evaluate(np.zeros((1, 1)))
        raise ZeroDivisionError("in the library")

    search = inverted(minimize)
    next(search)
    with pytest.raises(ZeroDivisionError, match="in the library"):
        search.send(Evaluations(np.zeros((1, 1)), np.zeros(1)))


def test_the_thread_ends_even_if_the_library_swallows_every_exception():
    def minimize(evaluate):
        for _ in range(3):
            try:
                evaluate(np.zeros((1, 1)))
            except BaseException:
                continue

    before = threading.active_count()
    search = inverted(minimize)
    next(search)
    search.close()
    assert threading.active_count() == before


@pytest.mark.parametrize(("method", "module"), [(CMAES, "cma"), (DFOLS, "dfols")])
def test_a_missing_library_is_named_with_the_command_that_installs_it(method, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        InputError, match=rf"{module} is not installed .*pip install 'calibray\[optimizers\]'"
    ):
        method([0.0], [1.0])


def test_the_logarithm_of_the_expected_improvement_is_accurate_in_the_tail():
    z = np.array([-12.0, -6.0, -1.5, -1.0, 0.3, 4.0])
    t = np.linspace(0.0, 1.0, 200_001)[1:-1]
    for value in z:  # the integral of (z - u)+ phi(u), by quadrature over u = z - t / (1 - t)
        gain = t / (1.0 - t)
        integral = np.trapezoid(gain * norm.pdf(value - gain) / (1.0 - t) ** 2, t)
        assert log_shape(np.array([value]))[0] == pytest.approx(np.log(integral), abs=1e-6)
