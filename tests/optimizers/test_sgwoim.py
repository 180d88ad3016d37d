"""SGWO-IM against the paper: Algorithm 1, eqs. 2 to 4 and Table II."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from calibray.errors import InputError
from calibray.optimizers import GWO, SGWOIM, RandomSearch
from calibray.optimizers.grey_wolf import cosine_decay, memory_weight
from problem_families.landscapes import hall, tones, within

LOWER, UPPER = np.array([-1.0, 2.0]), np.array([4.0, 9.0])


def objective(x: np.ndarray) -> np.ndarray:
    return np.sum((x - np.array([1.2, 8.3])) ** 2, axis=1)


def test_convergence_factor_eq_2():
    assert cosine_decay(10, 20) == pytest.approx(2.0 * np.sqrt(0.5), abs=1e-12)
    assert cosine_decay(20, 20) == pytest.approx(0.0, abs=1e-12)


def test_memory_weight_eq_4():
    assert memory_weight(10, 20, 0.1, 0.3) == pytest.approx(0.15, abs=1e-12)
    assert memory_weight(20, 20, 0.1, 0.3) == pytest.approx(0.3, abs=1e-12)


def test_a_whole_run_equals_algorithm_1():
    """An independent transcription: explicit loops, SciPy's interpolator, real values only."""
    population, iterations, full, elites, seed = 6, 9, 3, 2, 11
    optimizer = SGWOIM(
        LOWER,
        UPPER,
        seed=seed,
        population=population,
        iterations=iterations,
        full_iterations=full,
        elites=elites,
    )
    draws = np.random.default_rng(seed)
    wolves = LOWER + draws.random((population, 2)) * (UPPER - LOWER)
    memory, score = wolves.copy(), [np.inf] * population
    points, values = [], []
    clipped = 0
    for t in range(1, iterations + 1):
        if t > full:
            model = RBFInterpolator(
                (np.array(points) - LOWER) / (UPPER - LOWER), values, kernel="cubic", degree=1, smoothing=1e-6
            )
            chosen = sorted(range(population), key=model((wolves - LOWER) / (UPPER - LOWER)).__getitem__)[
                :elites
            ]
        else:
            chosen = list(range(population))
        asked = optimizer.ask()
        assert asked == pytest.approx(wolves[chosen], abs=1e-12)
        optimizer.tell(asked, objective(asked))
        for wolf in chosen:
            y = float(objective(wolves[wolf][None])[0])
            points.append(wolves[wolf])
            values.append(y)
            if y < score[wolf]:
                memory[wolf], score[wolf] = wolves[wolf], y
        leaders = [points[i] for i in np.argsort(values)[:3]]
        a = 2.0 * np.cos(np.pi / 2.0 * t / iterations)
        w = 0.1 + 0.2 * (t / iterations) ** 2
        r = draws.random((2, population, 3, 2))
        moved = np.empty_like(wolves)
        for i in range(population):
            for j in range(2):
                guided = []
                for k in range(3):
                    big_a, big_c = 2.0 * a * r[0, i, k, j] - a, 2.0 * r[1, i, k, j]
                    guided.append(leaders[k][j] - big_a * abs(big_c * leaders[k][j] - wolves[i, j]))
                moved[i, j] = (1.0 - w) * sum(guided) / 3.0 + w * memory[i, j]
        wolves = np.minimum(np.maximum(moved, LOWER), UPPER)
        clipped += int((wolves != moved).sum())
    assert optimizer.done
    assert clipped > 0
    assert optimizer.memory.x == pytest.approx(memory, abs=1e-12)
    assert optimizer.memory.y == pytest.approx(np.array(score), abs=1e-12)


def test_without_its_three_additions_it_is_gwo_bit_for_bit():
    bare = SGWOIM(LOWER, UPPER, seed=5, w_min=0.0, w_max=0.0, convergence="linear", surrogate=False)
    parent = GWO(LOWER, UPPER, seed=5)
    while not parent.done:
        x = parent.ask()
        assert np.array_equal(x, bare.ask())
        parent.tell(x, objective(x))
        bare.tell(x, objective(x))
    assert bare.done
    assert bare.budget == parent.budget == 600


@pytest.mark.parametrize(
    "change",
    [{"w_max": 0.3}, {"convergence": "cosine"}, {"surrogate": True}],
    ids=lambda change: next(iter(change)),
)
def test_each_addition_changes_the_run(change):
    settings = {"w_min": 0.0, "w_max": 0.0, "convergence": "linear", "surrogate": False, **change}
    runs = []
    for optimizer in (SGWOIM(LOWER, UPPER, seed=5, **settings), GWO(LOWER, UPPER, seed=5)):
        runs.append([])
        while not optimizer.done:
            x = optimizer.ask()
            optimizer.tell(x, objective(x))
            runs[-1].append(x)
    assert not all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))


def test_takes_225_evaluations_at_the_papers_settings():
    optimizer = SGWOIM(LOWER, UPPER)
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        sizes.append(len(x))
        optimizer.tell(x, objective(x))
    assert sizes == [30] * 5 + [5] * 15
    assert optimizer.evaluations == optimizer.budget == 225


def test_predictions_enter_neither_leaders_nor_memory_nor_best():
    """Every value that the optimizer holds was told to it."""
    landscape = tones()
    optimizer = SGWOIM(landscape.lower, landscape.upper, seed=2)
    values = {}
    while not optimizer.done:
        x = optimizer.ask()
        y = landscape.value(x)
        optimizer.tell(x, y)
        values |= {tuple(point): value for point, value in zip(x, y, strict=True)}
        assert values[tuple(optimizer.best.x)] == optimizer.best.y == min(values.values())
        assert [values[tuple(x)] for x in optimizer.leaders] == sorted(values.values())[:3]
    assert [values[tuple(x)] for x in optimizer.memory.x] == list(optimizer.memory.y)


def test_screened_wolves_move_but_keep_their_memory():
    optimizer = SGWOIM(LOWER, UPPER, seed=1, population=8, iterations=3, full_iterations=1, elites=2)
    x = optimizer.ask()
    optimizer.tell(x, objective(x))
    before = optimizer.ask()  # completes the first iteration
    first = optimizer.memory
    optimizer.tell(before, np.full(2, -1.0))
    assert not optimizer.done
    changed = np.flatnonzero(optimizer.memory.y != first.y)
    assert len(changed) == 2
    assert {tuple(point) for point in optimizer.memory.x[changed]} == {tuple(point) for point in before}


def test_earlier_evaluations_become_leaders_but_no_memory():
    optimizer = SGWOIM(LOWER, UPPER, seed=1)
    optimizer.tell([[1.2, 8.3]], [0.0])
    x = optimizer.ask()
    assert np.array_equal(x, SGWOIM(LOWER, UPPER, seed=1).ask())
    optimizer.tell(x, objective(x))
    optimizer.ask()
    assert np.array_equal(optimizer.leaders[0], [1.2, 8.3])
    assert optimizer.memory.y.min() > 0.0


@pytest.mark.parametrize(("name", "landscape"), [("tones", tones()), ("hall", hall())])
def test_beats_random_search_at_the_same_budget(name, landscape):
    if name == "tones":
        landscape = within(landscape, [3.0, 1.0, -np.pi], [8.0, 4.0, np.pi])
    floor = landscape.minimum
    scores = {SGWOIM: [], RandomSearch: []}
    for seed in range(7):
        for method in scores:
            scores[method].append(landscape.run(method(landscape.lower, landscape.upper, seed=seed)).best.y)
    excess = {method: np.median(values) - floor for method, values in scores.items()}
    assert excess[SGWOIM] < 0.5 * excess[RandomSearch]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"elites": 31}, r"elites = 31; it must be a whole number from 1 to 30"),
        ({"full_iterations": 0}, r"full_iterations = 0"),
        ({"w_max": 1.5}, r"w_max = 1.5; it must be a finite number from 0 to 1"),
        ({"w_min": float("nan")}, r"w_min = nan"),
        ({"w_min": "0.1"}, r"w_min = '0.1'"),
        ({"convergence": "cosin"}, r"convergence = 'cosin'; choose one of cosine, linear"),
        (
            {"population": 3, "full_iterations": 1, "elites": 1, "dimension": 3},
            r"= 3 samples; .* at least 4: raise",
        ),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    dimension = settings.pop("dimension", 2)
    with pytest.raises(InputError, match=message):
        SGWOIM([0.0] * dimension, [1.0] * dimension, **settings)


def test_memory_before_the_first_evaluation_is_refused():
    with pytest.raises(InputError, match="no memory before the first evaluation"):
        _ = SGWOIM(LOWER, UPPER).memory
