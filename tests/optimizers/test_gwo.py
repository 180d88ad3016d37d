"""The canonical Grey Wolf Optimizer against explicit arithmetic."""

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.optimizers import GWO, RandomSearch
from calibray.optimizers.grey_wolf import encircle, linear_decay
from problem_families.landscapes import tones, within

LOWER, UPPER = np.array([-1.0, 2.0]), np.array([4.0, 9.0])


def objective(x: np.ndarray) -> np.ndarray:
    return np.sum((x - np.array([1.2, 8.3])) ** 2, axis=1)


def test_one_move_worked_by_hand():
    # a = 1.2; one wolf at 2; leaders at 1, 4 and -3.
    r1, r2 = np.array([[[0.25], [0.5], [1.0]]]), np.array([[[0.5], [0.75], [0.1]]])
    # alpha: A = -0.6, C = 1.0: D = |1.0 * 1 - 2| = 1, X1 = 1 + 0.6 = 1.6
    # beta:  A =  0.0, C = 1.5: X2 = 4
    # delta: A =  1.2, C = 0.2: D = |0.2 * -3 - 2| = 2.6, X3 = -3 - 1.2 * 2.6 = -6.12
    moved = encircle(np.array([[2.0]]), np.array([[1.0], [4.0], [-3.0]]), 1.2, r1, r2)
    assert moved == pytest.approx(np.array([[(1.6 + 4.0 - 6.12) / 3.0]]), abs=1e-12)


def test_convergence_factor_runs_from_two_to_zero():
    assert [linear_decay(t, 4) for t in (1, 2, 3, 4)] == [1.5, 1.0, 0.5, 0.0]


def test_a_whole_run_equals_the_textbook_loop():
    population, iterations, seed = 5, 6, 42
    optimizer = GWO(LOWER, UPPER, seed=seed, population=population, iterations=iterations)
    draws = np.random.default_rng(seed)
    wolves = LOWER + draws.random((population, 2)) * (UPPER - LOWER)
    evaluated: list[tuple[float, np.ndarray]] = []
    clipped = 0
    for t in range(1, iterations + 1):
        asked = optimizer.ask()
        assert asked == pytest.approx(wolves, abs=1e-12)
        optimizer.tell(asked, objective(asked))
        evaluated += [(float(y), x) for x, y in zip(wolves, objective(wolves), strict=True)]
        leaders = [x for _, x in sorted(evaluated, key=lambda pair: pair[0])[:3]]
        a = 2.0 - 2.0 * t / iterations
        r = draws.random((2, population, 3, 2))
        moved = np.empty_like(wolves)
        for i in range(population):
            for j in range(2):
                guided = []
                for k in range(3):
                    big_a, big_c = 2.0 * a * r[0, i, k, j] - a, 2.0 * r[1, i, k, j]
                    guided.append(leaders[k][j] - big_a * abs(big_c * leaders[k][j] - wolves[i, j]))
                moved[i, j] = sum(guided) / 3.0
        wolves = np.minimum(np.maximum(moved, LOWER), UPPER)
        clipped += int((wolves != moved).sum())
    assert clipped > 0  # otherwise the run would not test clipping
    assert optimizer.done


def test_leaders_are_the_best_distinct_points_of_the_whole_run():
    optimizer = GWO(LOWER, UPPER, population=4, iterations=2)
    x = optimizer.ask()
    optimizer.tell(x, [3.0, 1.0, 2.0, 1.0])
    assert np.array_equal(optimizer.leaders, x[[1, 3, 2]])
    optimizer.tell(x[1:2], [0.5])  # the same point again is no second leader
    assert np.array_equal(optimizer.leaders, x[[1, 3, 2]])
    worse = optimizer.ask()
    optimizer.tell(worse, [9.0, 9.0, 9.0, 9.0])
    assert np.array_equal(optimizer.leaders, x[[1, 3, 2]])


def test_takes_600_evaluations_at_the_papers_settings():
    optimizer = GWO(LOWER, UPPER)
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        sizes.append(len(x))
        optimizer.tell(x, objective(x))
    assert sizes == [30] * 20
    assert optimizer.evaluations == optimizer.budget == 600


@pytest.mark.parametrize("name", ["sphere", "tones"])
def test_beats_random_search(name):
    if name == "sphere":
        lower, upper, value = LOWER, UPPER, objective
    else:
        landscape = within(tones(), [3.0, 1.0, -np.pi], [8.0, 4.0, np.pi])
        lower, upper, value = landscape.lower, landscape.upper, landscape.value
    scores = {GWO: [], RandomSearch: []}
    for seed in range(7):
        for optimizer in (GWO(lower, upper, seed=seed), RandomSearch(lower, upper, seed=seed, budget=600)):
            while not optimizer.done:
                x = optimizer.ask()
                optimizer.tell(x, value(x))
            scores[type(optimizer)].append(optimizer.best.y)
    floor = 0.0 if name == "sphere" else landscape.minimum
    excess = {method: np.median(values) - floor for method, values in scores.items()}
    assert excess[GWO] < 0.1 * excess[RandomSearch]


def test_the_steps_depend_on_the_origin_of_the_coordinates():
    shift = np.array([100.0, -40.0])
    original = GWO(LOWER, UPPER, seed=3, iterations=4)
    shifted = GWO(LOWER + shift, UPPER + shift, seed=3, iterations=4)
    for _ in range(3):
        x, moved = original.ask(), shifted.ask()
        original.tell(x, objective(x))
        shifted.tell(moved, objective(x))
    assert not np.allclose(original.ask() + shift, shifted.ask(), atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"population": 2}, r"population = 2; it must be a whole number >= 3"),
        ({"population": 30.0}, r"population = 30.0"),
        ({"iterations": 0}, r"iterations = 0; it must be a whole number >= 1"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        GWO(LOWER, UPPER, **settings)
