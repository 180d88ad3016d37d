"""What every optimizer promises, whatever its algorithm."""

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.optimizers import GWO, METHODS, LeastSquares, Optimizer
from calibray.optimizers.evaluations import merged
from problem_families.landscapes import Landscape, rosenbrock

LANDSCAPE = rosenbrock()
CASES = sorted(METHODS.items())
# What they think between evaluations grows with the evaluations told: a promise is seen in thirty as well.
THOUGHTFUL = {METHODS[name] for name in ("vector-surrogate", "space-mapping", "gaussian-process")}


def make(method: type[Optimizer], landscape: Landscape = LANDSCAPE, **settings) -> Optimizer:
    if method in THOUGHTFUL:
        settings = {"budget": 30, **settings}
    return method(landscape.lower, landscape.upper, **settings)


def candidates(optimizer: Optimizer, limit: int = 40) -> np.ndarray:
    """Every candidate of the first `limit` batches."""
    batches = []
    while not optimizer.done and len(batches) < limit:
        batches.append(optimizer.ask())
        optimizer.tell(batches[-1], *LANDSCAPE.evaluate(batches[-1]))
    return np.concatenate(batches)


@pytest.mark.parametrize(("name", "method"), CASES)
def test_same_seed_same_run_and_other_seed_another(name, method):
    first, again, other = (candidates(make(method, seed=seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


@pytest.mark.parametrize(("name", "method"), CASES)
def test_candidates_stay_inside_and_the_best_is_the_best_told(name, method):
    optimizer, told = make(method, seed=1), []
    for _ in range(40):
        if optimizer.done:
            break
        x = optimizer.ask()
        assert x.ndim == 2
        assert ((x >= LANDSCAPE.lower) & (x <= LANDSCAPE.upper)).all()
        y, residuals, jacobian = LANDSCAPE.evaluate(x)
        optimizer.tell(x, y, residuals, jacobian)
        told.append((x, y))
        x, y = (np.concatenate(part) for part in zip(*told, strict=True))
        assert optimizer.best.y == y.min()
        assert np.array_equal(optimizer.best.x, x[y.argmin()])
        assert optimizer.evaluations == len(y)


@pytest.mark.parametrize(("name", "method"), CASES)
def test_takes_exactly_its_budget(name, method):
    optimizer = LANDSCAPE.run(make(method, seed=2), budget=20_000)
    assert optimizer.done
    assert optimizer.budget in (None, optimizer.evaluations)
    with pytest.raises(InputError, match=f"done after {optimizer.evaluations} evaluations"):
        optimizer.ask()


@pytest.mark.parametrize(("name", "method"), CASES)
def test_one_parameter_is_enough(name, method):
    def evaluate(x):
        return np.abs(x[:, 0] - 0.3), x - 0.3, np.ones((len(x), 1, 1))

    optimizer = method([0.0], [1.0], seed=1)
    while not optimizer.done and optimizer.evaluations < 1000:
        x = optimizer.ask()
        optimizer.tell(x, *evaluate(x))
    assert optimizer.best.y < 0.05


@pytest.mark.parametrize(("name", "method"), CASES)
def test_says_what_it_uses(name, method):
    assert method.uses <= {"value", "residuals", "jacobian"}
    assert "value" in method.uses
    optimizer = make(method)
    x = optimizer.ask()
    y, residuals, jacobian = LANDSCAPE.evaluate(x)
    if "residuals" in method.uses:
        with pytest.raises(InputError, match="residuals = None"):
            optimizer.tell(x, y, jacobian=jacobian)
    if "jacobian" in method.uses:
        with pytest.raises(InputError, match="jacobian = None"):
            optimizer.tell(x, y, residuals)
    assert optimizer.evaluations == 0


@pytest.mark.parametrize(("name", "method"), CASES)
def test_a_batch_is_asked_until_told_in_whatever_order_and_portions(name, method):
    whole, parts = make(method, seed=5), make(method, seed=5)
    for _ in range(2):
        if whole.done:
            break
        x = whole.ask()
        assert np.array_equal(x, whole.ask())
        assert np.array_equal(x, parts.ask())
        whole.tell(x, *LANDSCAPE.evaluate(x))
        backwards = x[::-1]
        half = len(x) // 2
        if half:
            parts.tell(backwards[:half], *LANDSCAPE.evaluate(backwards[:half]))
            assert np.array_equal(parts.ask(), x[: len(x) - half])
        parts.tell(backwards[half:], *LANDSCAPE.evaluate(backwards[half:]))
    assert whole.done == parts.done
    if not whole.done:
        assert np.array_equal(whole.ask(), parts.ask())


@pytest.mark.parametrize(("name", "method"), CASES)
def test_evaluations_that_were_not_asked_for_join_without_advancing(name, method):
    told, fresh = make(method, seed=6), make(method, seed=6)
    x = np.array([[1.0, 1.0], [0.0, 0.5]])
    told.tell(x, *LANDSCAPE.evaluate(x))
    assert told.evaluations == 2
    assert told.best.y == 0.0
    assert not told.done
    LANDSCAPE.run(told, budget=20_000)
    LANDSCAPE.run(fresh, budget=20_000)
    assert told.best.y == 0.0
    if fresh.budget is not None:
        assert told.evaluations == fresh.evaluations + 2


@pytest.mark.parametrize(("name", "method"), CASES)
def test_failed_evaluations_are_survived(name, method):
    optimizer = make(method, seed=7)
    for _ in range(40):
        if optimizer.done:
            break
        x = optimizer.ask()
        y, residuals, jacobian = LANDSCAPE.evaluate(x)
        failed = x[:, 0] < 0.0
        y[failed], residuals[failed], jacobian[failed] = np.inf, np.nan, np.nan
        optimizer.tell(x, y, residuals, jacobian)
    assert np.isfinite(optimizer.best.y)
    assert optimizer.best.x[0] >= 0.0


@pytest.mark.parametrize(("name", "method"), CASES)
def test_all_evaluations_failing_is_survived(name, method):
    optimizer = make(method, seed=8)
    for _ in range(30):
        if optimizer.done:
            break
        x = optimizer.ask()
        y, residuals, jacobian = LANDSCAPE.evaluate(x)
        optimizer.tell(x, np.full_like(y, np.inf), residuals, jacobian)
    assert optimizer.best.y == np.inf


def test_what_is_told_is_copied():
    optimizer = make(GWO)
    x = optimizer.ask()
    y = LANDSCAPE.value(x)
    best = (x[y.argmin()].copy(), y.min())
    optimizer.tell(x, y)
    x[:], y[:] = 0.0, -1.0
    assert np.array_equal(optimizer.best.x, best[0])
    assert optimizer.best.y == best[1]
    with pytest.raises(ValueError, match="read-only"):
        optimizer.best.x[0] = 0.0


NAN, INF = np.nan, np.inf
ONE = [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[1.0]], [1.0]), r"x has shape \(1, 1\); it must be \[n, 2\]"),
        (([1.0, 1.0], [1.0]), r"x has shape \(2,\)"),
        ((ONE, [[1.0]]), r"y has shape \(1, 1\); it must be \[n\]"),
        ((ONE, [1.0, 2.0]), "x has 1 rows, y 2"),
        ((np.empty((0, 2)), []), "x has 0 rows"),
        (([[NAN, 1.0]], [1.0]), r"x\[0, 0\] = nan"),
        (([[1.0, 2.5]], [1.0]), r"x\[0, 1\] = 2.5 lies outside its bounds \[-2, 2\]; leave .* or widen"),
        ((ONE, [NAN]), r"y\[0\] = nan; it must be a number, \+inf for a failed"),
        ((ONE, [-INF]), r"y\[0\] = -inf"),
        ((ONE, [1.0], [[NAN]]), r"residuals\[0, 0\] = nan; .* tell y = \+inf"),
        ((ONE, [1.0], [[1.0], [2.0]]), r"residuals has shape \(2, 1\); it must be \[1, m\]"),
        ((ONE, [1.0], [[]]), "residuals has 0 columns"),
        ((ONE, [2.0], [[1.0, 1.0]]), r"y\[0\] = 2, but sqrt\(mean\(residuals\[0\]\*\*2\)\) = 1"),
        ((ONE, [1.0], [[1.0]], [[[1.0]]]), r"jacobian has shape \(1, 1, 1\); it must be \[1, 1, 2\]"),
        ((ONE, [1.0], [[1.0]], [[[1.0, INF]]]), r"jacobian\[0, 0, 1\] = inf"),
    ],
)
def test_malformed_evaluations_are_refused_and_leave_nothing(arguments, message):
    optimizer = LeastSquares(LANDSCAPE.lower, LANDSCAPE.upper)
    filler = (ONE, [1.0], [[1.0]], [[[1.0, 1.0]]])
    optimizer.tell(*filler)
    with pytest.raises(InputError, match=message):
        optimizer.tell(*arguments, *filler[len(arguments) :])
    assert optimizer.evaluations == 1


def test_the_number_of_links_may_not_change():
    optimizer = LeastSquares(LANDSCAPE.lower, LANDSCAPE.upper)
    optimizer.tell(ONE, [1.0], [[1.0]], [[[1.0, 1.0]]])
    with pytest.raises(InputError, match="residuals have 2 columns, earlier ones 1"):
        optimizer.tell(ONE, [1.0], [[1.0, 1.0]], [[[1.0, 1.0], [1.0, 1.0]]])


def test_of_equal_evaluations_the_first_is_the_best():
    optimizer = make(GWO)
    optimizer.tell([[0.0, 1.0], [1.0, 0.0]], [2.0, 2.0])
    optimizer.tell([[1.0, 1.0]], [2.0])
    assert np.array_equal(optimizer.best.x, [0.0, 1.0])


def test_points_told_twice_are_merged_with_the_mean_of_their_values():
    x = np.array([[0.5, 0.1], [0.2, 0.2], [0.5, 0.1 + 1e-12]])
    points, values = merged(x, np.array([[1.0, 2.0], [5.0, 6.0], [3.0, 4.0]]))
    assert points == pytest.approx(np.array([[0.2, 0.2], [0.5, 0.1]]))
    assert values == pytest.approx(np.array([[5.0, 6.0], [2.0, 3.0]]))


def test_no_best_before_the_first_evaluation():
    with pytest.raises(InputError, match=r"0 evaluations told, at least 1 is needed; call tell\(\)"):
        _ = make(GWO).best


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ([0.0], [0.0], r"lower\[0\] = 0 and upper\[0\] = 0; .* leave a fixed parameter out"),
        ([0.0, 5.0], [1.0, 4.0], r"lower\[1\] = 5 and upper\[1\] = 4; .* swap them"),
        ([0.0], [INF], r"upper\[0\] = inf; the bounds must be finite"),
        ([NAN], [1.0], r"lower\[0\] = nan"),
        ([0.0], [1.0, 2.0], r"lower has shape \(1,\) and upper \(2,\)"),
        ([], [], r"d >= 1"),
        (0.0, 1.0, "both must be vectors"),
    ],
)
@pytest.mark.parametrize(("name", "method"), CASES)
def test_impossible_bounds_are_refused(name, method, lower, upper, message):
    with pytest.raises(InputError, match=message):
        method(lower, upper)


@pytest.mark.parametrize("seed", [-1, 1.5, True, None])
@pytest.mark.parametrize(("name", "method"), CASES)
def test_a_seed_is_a_whole_number(name, method, seed):
    with pytest.raises(InputError, match=r"seed = .* whole number >= 0"):
        make(method, seed=seed)
