"""The contract that every optimizer keeps."""

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.optimizers import GWO, METHODS, LeastSquares, Optimizer
from calibray.optimizers.evaluations import merge_repeated
from problem_families.landscapes import rosenbrock

LANDSCAPE = rosenbrock()
every_method = pytest.mark.parametrize("method", list(METHODS.values()), ids=list(METHODS))
# The cost of a step on a surrogate grows with the number of evaluations, so these get small budgets.
SURROGATES = {METHODS[name] for name in ("vector-surrogate", "space-mapping", "gaussian-process")}


def make(method: type[Optimizer], **settings) -> Optimizer:
    if method in SURROGATES:
        settings = {"budget": 14, **settings}
    return method(LANDSCAPE.lower, LANDSCAPE.upper, **settings)


def candidates(optimizer: Optimizer, limit: int = 40) -> np.ndarray:
    """Every candidate of the first `limit` batches."""
    batches = []
    while not optimizer.done and len(batches) < limit:
        batches.append(optimizer.ask())
        optimizer.tell(batches[-1], *LANDSCAPE.evaluate(batches[-1]))
    return np.concatenate(batches)


@every_method
def test_the_seed_determines_the_run(method):
    first, again, other = (candidates(make(method, seed=seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


@every_method
def test_candidates_are_inside_the_box_and_the_best_is_the_lowest_value(method):
    optimizer, points, values = make(method, seed=1), [], []
    for _ in range(40):
        if optimizer.done:
            break
        x = optimizer.ask()
        assert x.ndim == 2
        assert ((x >= LANDSCAPE.lower) & (x <= LANDSCAPE.upper)).all()
        y, residuals, jacobian = LANDSCAPE.evaluate(x)
        optimizer.tell(x, y, residuals, jacobian)
        points += x.tolist()
        values += y.tolist()
        assert optimizer.best.y == min(values)
        assert np.array_equal(optimizer.best.x, points[int(np.argmin(values))])
        assert optimizer.evaluations == len(values)


@every_method
def test_the_budget_is_used_exactly(method):
    optimizer = LANDSCAPE.run(make(method, seed=2), budget=20_000)
    assert optimizer.done
    assert optimizer.budget in (None, optimizer.evaluations)
    with pytest.raises(InputError, match=f"done after {optimizer.evaluations} evaluations"):
        optimizer.ask()


@every_method
def test_one_parameter_is_enough(method):
    def evaluate(x):
        return np.abs(x[:, 0] - 0.3), x - 0.3, np.ones((len(x), 1, 1))

    optimizer = method([0.0], [1.0], seed=1)
    while not optimizer.done and optimizer.evaluations < 1000:
        x = optimizer.ask()
        optimizer.tell(x, *evaluate(x))
    assert optimizer.best.y < 0.05


@every_method
def test_an_evaluation_without_the_parts_that_are_used_is_refused(method):
    assert {"value"} <= method.uses <= {"value", "residuals", "jacobian"}
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


@every_method
def test_a_batch_is_asked_until_told_in_any_order_and_portions(method):
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


@every_method
def test_other_points_join_the_archive_without_advancing_the_search(method):
    optimizer = make(method, seed=6)
    x = np.array([[1.0, 1.0], [0.0, 0.5]])
    optimizer.tell(x, *LANDSCAPE.evaluate(x))
    assert optimizer.evaluations == 2
    assert optimizer.best.y == 0.0
    assert not optimizer.done
    LANDSCAPE.run(optimizer, budget=20_000)
    assert optimizer.best.y == 0.0
    if optimizer.budget is not None:
        assert optimizer.evaluations == optimizer.budget + 2


@every_method
def test_failed_evaluations_do_not_stop_the_search(method):
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


@every_method
def test_a_run_of_failures_ends_without_an_error(method):
    optimizer = make(method, seed=8)
    for _ in range(30):
        if optimizer.done:
            break
        x = optimizer.ask()
        y, residuals, jacobian = LANDSCAPE.evaluate(x)
        optimizer.tell(x, np.full_like(y, np.inf), residuals, jacobian)
    assert optimizer.best.y == np.inf


def test_evaluations_are_copied():
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
        ((ONE, [1.0, 2.0]), r"x has shape \(1, 2\) and y has shape \(2,\)"),
        ((np.empty((0, 2)), []), r"x has shape \(0, 2\)"),
        (([[NAN, 1.0]], [1.0]), r"x\[0, 0\] = nan"),
        (([[1.0, 2.5]], [1.0]), r"x\[0, 1\] = 2.5 lies outside its bounds \[-2, 2\]; remove .* or widen"),
        ((ONE, [NAN]), r"y\[0\] = nan; it must be a number, or \+inf for a failed"),
        ((ONE, [-INF]), r"y\[0\] = -inf"),
        ((ONE, [1.0], [[NAN]]), r"residuals\[0, 0\] = nan; .* pass y = \+inf"),
        ((ONE, [1.0], [[1.0], [2.0]]), r"residuals has shape \(2, 1\); it must be \[1, m\]"),
        ((ONE, [1.0], [[]]), "residuals has 0 columns"),
        ((ONE, [2.0], [[1.0, 1.0]]), r"y\[0\] = 2, but sqrt\(mean\(residuals\[0\]\*\*2\)\) = 1"),
        ((ONE, [1.0], [[1.0]], [[[1.0]]]), r"jacobian has shape \(1, 1, 1\); it must be \[1, 1, 2\]"),
        ((ONE, [1.0], [[1.0]], [[[1.0, INF]]]), r"jacobian\[0, 0, 1\] = inf"),
    ],
)
def test_malformed_evaluations_are_refused_and_nothing_is_kept(arguments, message):
    optimizer = LeastSquares(LANDSCAPE.lower, LANDSCAPE.upper)
    valid = (ONE, [1.0], [[1.0]], [[[1.0, 1.0]]])
    optimizer.tell(*valid)
    with pytest.raises(InputError, match=message):
        optimizer.tell(*arguments, *valid[len(arguments) :])
    assert optimizer.evaluations == 1


def test_the_number_of_links_may_not_change():
    optimizer = LeastSquares(LANDSCAPE.lower, LANDSCAPE.upper)
    optimizer.tell(ONE, [1.0], [[1.0]], [[[1.0, 1.0]]])
    with pytest.raises(InputError, match="residuals have 2 columns, but earlier residuals had 1"):
        optimizer.tell(ONE, [1.0], [[1.0, 1.0]], [[[1.0, 1.0], [1.0, 1.0]]])


def test_the_first_of_equal_evaluations_is_the_best():
    optimizer = make(GWO)
    optimizer.tell([[0.0, 1.0], [1.0, 0.0]], [2.0, 2.0])
    optimizer.tell([[1.0, 1.0]], [2.0])
    assert np.array_equal(optimizer.best.x, [0.0, 1.0])


def test_repeated_points_are_merged_with_the_mean_of_their_values():
    x = np.array([[0.5, 0.1], [0.2, 0.2], [0.5, 0.1 + 1e-12]])
    points, values = merge_repeated(x, np.array([[1.0, 2.0], [5.0, 6.0], [3.0, 4.0]]))
    assert points == pytest.approx(np.array([[0.2, 0.2], [0.5, 0.1]]))
    assert values == pytest.approx(np.array([[5.0, 6.0], [2.0, 3.0]]))


def test_there_is_no_best_before_the_first_evaluation():
    with pytest.raises(InputError, match=r"there are no evaluations yet; call tell\(\)"):
        _ = make(GWO).best


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        ([0.0], [0.0], r"lower\[0\] = 0 and upper\[0\] = 0; .* remove a fixed parameter"),
        ([0.0, 5.0], [1.0, 4.0], r"lower\[1\] = 5 and upper\[1\] = 4; .* swap them"),
        ([0.0], [INF], r"upper\[0\] = inf; the bounds must be finite"),
        ([NAN], [1.0], r"lower\[0\] = nan"),
        ([0.0], [1.0, 2.0], r"lower has shape \(1,\) and upper \(2,\)"),
        ([], [], r"at least one entry"),
        (0.0, 1.0, "both must be vectors"),
    ],
)
def test_every_method_refuses_impossible_bounds(lower, upper, message):
    for method in METHODS.values():
        with pytest.raises(InputError, match=message):
            method(lower, upper)


@pytest.mark.parametrize("seed", [-1, 1.5, True, None])
def test_every_method_refuses_a_seed_that_is_no_whole_number(seed):
    for method in METHODS.values():
        with pytest.raises(InputError, match=r"seed = .* whole number >= 0"):
            make(method, seed=seed)
