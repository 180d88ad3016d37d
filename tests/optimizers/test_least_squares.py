"""Multi-start Levenberg-Marquardt against SciPy, brute force and known minima."""

from contextlib import suppress

import numpy as np
import pytest
from scipy.optimize import least_squares

from calibray.errors import InputError
from calibray.optimizers import POUNDERS, LeastSquares
from calibray.optimizers import least_squares as module
from calibray.optimizers.derivative_free import improving_point
from calibray.optimizers.descent import descend
from calibray.optimizers.least_squares import COMBINATIONS, SPACE, hops, recombine, returns
from calibray.optimizers.sampling import design
from problem_families.landscapes import blocks, hall, rosenbrock, tones, within


def scipy_search(landscape, start):
    return least_squares(
        lambda x: landscape.model(x[None])[0][0],
        start,
        jac=lambda x: landscape.model(x[None])[1][0],
        bounds=(landscape.lower, landscape.upper),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-13,
    )


@pytest.mark.parametrize("landscape", [rosenbrock(), tones(), hall(), blocks()], ids=lambda it: it.name)
def test_derivatives_of_the_landscapes_equal_finite_differences(landscape):
    x = np.random.default_rng(0).uniform(landscape.lower, landscape.upper, (4, len(landscape.lower)))
    jacobian = landscape.model(x)[1]
    for column, step in enumerate(1e-6 * np.eye(x.shape[1])):
        difference = (landscape.model(x + step)[0] - landscape.model(x - step)[0]) / 2e-6
        assert jacobian[:, :, column] == pytest.approx(difference, rel=1e-5, abs=1e-5)


def test_rosenbrock_from_one_start():
    landscape = rosenbrock()
    optimizer = landscape.run(LeastSquares(landscape.lower, landscape.upper, starts=1, x0=[-1.2, 1.0]))
    assert optimizer.best.x == pytest.approx(np.ones(2), abs=1e-6)
    assert optimizer.best.y < 1e-8


@pytest.mark.parametrize("landscape", [tones(), hall()], ids=lambda it: it.name)
def test_a_search_from_one_start_ends_as_low_as_scipys(landscape):
    """From the same start, one search at a time. Single searches may end in another basin, most may not end higher."""
    starts = np.random.default_rng(5).uniform(landscape.lower, landscape.upper, (7, 3))
    differences = []
    for start in starts:
        reference = np.sqrt(
            2.0 * scipy_search(landscape, start).cost / landscape.model(start[None])[0].shape[1]
        )
        optimizer = LeastSquares(landscape.lower, landscape.upper, starts=1, x0=start, iterations=300)
        optimizer.tell(start[None], *landscape.evaluate(start[None]))
        differences.append(landscape.run(optimizer).best.y - reference)
    assert np.median(differences) < 1e-8


@pytest.mark.parametrize("landscape", [tones(), hall()], ids=lambda it: it.name)
def test_scipy_cannot_improve_the_end(landscape):
    optimizer = landscape.run(LeastSquares(landscape.lower, landscape.upper, starts=16))
    polished = scipy_search(landscape, optimizer.best.x)
    assert optimizer.best.y == pytest.approx(landscape.value(polished.x[None])[0], abs=1e-9)
    assert optimizer.best.x == pytest.approx(polished.x, abs=1e-4)


@pytest.fixture(scope="module")
def exhaustive() -> float:
    """The global minimum of `tones` by brute force."""
    landscape = tones()
    axes = [
        np.linspace(a, b, n) for a, b, n in zip(landscape.lower, landscape.upper, (81, 81, 25), strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    values = np.concatenate([landscape.value(part) for part in np.array_split(grid, 60)])
    cost = min(scipy_search(landscape, x).cost for x in grid[np.argsort(values)[:10]])
    return np.sqrt(2.0 * cost / 30)


@pytest.mark.parametrize("seed", range(3))
def test_the_global_minimum_of_a_multimodal_problem_is_found(seed, exhaustive):
    landscape = tones()
    optimizer = landscape.run(LeastSquares(landscape.lower, landscape.upper, seed=seed))
    assert optimizer.best.y == pytest.approx(exhaustive, abs=1e-9)


def test_one_start_misses_the_global_minimum():
    """The negative control of the test above."""
    landscape = tones()
    ends = [
        landscape.run(LeastSquares(landscape.lower, landscape.upper, starts=1, seed=s)).best.y
        for s in range(9)
    ]
    assert np.median(ends) > landscape.minimum + 0.1


def test_the_global_minimum_of_resonating_panes_is_found():
    landscape = hall()
    optimizer = landscape.run(LeastSquares(landscape.lower, landscape.upper, seed=0))
    assert optimizer.best.y == pytest.approx(landscape.minimum, abs=1e-4)
    assert optimizer.evaluations < 12_000


@pytest.mark.parametrize("seed", range(2))
def test_searches_that_cannot_catch_up_with_a_known_minimum_are_given_up_early(seed):
    """With a smaller `catch_up` searches are given up sooner, and none that leads lower."""
    landscape = tones()
    known = landscape.run(LeastSquares(landscape.lower, landscape.upper, seed=5)).best

    def run(catch_up):
        settings = {"seed": seed, "starts": 8, "x0": known.x, "catch_up": catch_up}
        return landscape.run(LeastSquares(landscape.lower, landscape.upper, **settings))

    patient, quick, at_once = run(100.0), run(10.0), run(0.0)
    assert at_once.evaluations < quick.evaluations < patient.evaluations
    for optimizer in (patient, quick, at_once):
        assert optimizer.best.y == pytest.approx(known.y, abs=1e-9)


@pytest.mark.parametrize("catch_up", [-1.0, np.inf, "10"])
def test_an_impossible_catch_up_is_refused(catch_up):
    with pytest.raises(InputError, match="catch_up"):
        LeastSquares([0.0], [1.0], catch_up=catch_up)


@pytest.mark.parametrize("start", ["abc", [["a", 1.0]], {"a": 1.0}])
def test_a_start_that_is_not_numbers_is_refused(start):
    with pytest.raises(InputError, match=r"x0 = .*; it must contain one number for each parameter"):
        LeastSquares([0.0], [1.0], x0=start)


def test_active_bounds():
    """The minimum (1, 1) is outside; the constrained one is on the face x0 = 0.5 at x1 = 0.25."""
    landscape = within(rosenbrock(), [-2.0, -2.0], [0.5, 2.0])
    optimizer = landscape.run(LeastSquares(landscape.lower, landscape.upper, starts=8))
    assert optimizer.best.x == pytest.approx(np.array([0.5, 0.25]), abs=1e-7)
    corner = within(rosenbrock(), [1.2, -2.0], [2.0, 1.1])
    optimizer = corner.run(LeastSquares(corner.lower, corner.upper, starts=8))
    assert optimizer.best.x == pytest.approx(np.array([1.2, 1.1]), abs=1e-9)


def test_a_parameter_without_influence_does_no_harm():
    def residuals(x):
        jacobian = np.zeros((len(x), 1, 2))
        jacobian[:, :, 0] = 2.0
        return 2.0 * x[:, :1] - 1.0, jacobian

    optimizer = LeastSquares([0.0, 0.0], [1.0, 1.0], starts=4)
    while not optimizer.done:
        x = optimizer.ask()
        r, jacobian = residuals(x)
        optimizer.tell(x, np.abs(r[:, 0]), r, jacobian)
    assert optimizer.best.x[0] == pytest.approx(0.5, abs=1e-9)


def test_starts_are_asked_in_one_batch_and_drop_out():
    landscape = tones()
    optimizer = LeastSquares(
        landscape.lower, landscape.upper, starts=32, x0=[[5.0, 2.0, 1.0], [6.0, 2.0, 1.0]]
    )
    optimizer.tell([[5.0, 2.0, 0.5]], *landscape.evaluate(np.array([[5.0, 2.0, 0.5]])))
    sizes = []
    while not optimizer.done:
        x = optimizer.ask()
        sizes.append(len(x))
        if len(sizes) == 1:
            assert x[:3] == pytest.approx(np.array([[5.0, 2.0, 1.0], [6.0, 2.0, 1.0], [5.0, 2.0, 0.5]]))
        optimizer.tell(x, *landscape.evaluate(x))
    assert sizes[0] == 35
    again = np.flatnonzero(np.diff(sizes) > 0)[0] + 1  # searches from combinations of minima begin
    assert sizes[:again] == sorted(sizes[:again], reverse=True)
    assert sizes[again - 1] < 5
    assert max(sizes[again:]) <= COMBINATIONS


def test_duplicate_starts_are_merged():
    landscape = tones()
    optimizer = LeastSquares(landscape.lower, landscape.upper, starts=1, x0=[[5.0, 2.0, 1.0]] * 6)
    x = optimizer.ask()
    assert len(x) == 7
    optimizer.tell(x, *landscape.evaluate(x))
    assert len(optimizer.ask()) <= 2


@pytest.mark.parametrize(
    ("x0", "message"),
    [
        ([1.0], r"x0 has shape \(1,\); it must be \[2\] or \[k, 2\]"),
        ([[0.0, 3.0]], r"x0\[0, 1\] = 3 lies outside its bounds \[-2, 2\]; move the starting point or widen"),
        ([0.0, np.nan], r"x0\[0, 1\] = nan"),
    ],
)
def test_impossible_starts_are_refused(x0, message):
    with pytest.raises(InputError, match=message):
        LeastSquares([-2.0, -2.0], [2.0, 2.0], x0=x0)


def evaluations_for(count, wide):
    """Evaluations for `count` minima, the lowest in a basin of width `wide`, the others equally wide."""
    edges = np.concatenate([[0.0, wide], wide + (1.0 - wide) * np.linspace(0.0, 1.0, count)[1:]])
    centre, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    optimizer = LeastSquares([0.0], [1.0])
    while not optimizer.done:
        x = optimizer.ask()
        basin = np.clip(np.searchsorted(edges, x[:, 0], side="right") - 1, 0, count - 1)
        r = np.stack([(x[:, 0] - centre[basin]) / width[basin], 1.0 + 0.1 * basin], axis=1)
        slope = np.stack([1.0 / width[basin], np.zeros(len(x))], axis=1)[:, :, None]
        optimizer.tell(x, np.sqrt(np.mean(r**2, axis=1)), r, slope)
    assert optimizer.best.y == pytest.approx(np.sqrt(0.5), abs=1e-9)
    return optimizer.evaluations


def test_starts_end_when_the_best_minimum_keeps_coming_back():
    """And not before: if few searches end in the best basin, all starts are used."""
    often = evaluations_for(5, 0.4)
    seldom = evaluations_for(5, 0.01)
    assert often < 4 * 64
    assert seldom > 512


def test_every_search_is_counted_at_the_minimum_where_it_ended():
    """A merged search is counted by the one that it was merged with."""
    landscape = tones()
    width = np.subtract(landscape.upper, landscape.lower)
    ended = None

    def followed(descent):
        nonlocal ended
        ended = yield from descent

    descent = followed(descend(design("sobol", 64, 3, np.random.default_rng(0)), 100, 1e-10, 100.0))
    unit = next(descent, None)
    while ended is None:
        r, slope = landscape.model(landscape.lower + unit * width)
        with suppress(StopIteration):
            unit = descent.send((r, slope * width))
    assert ended.searches.sum() == 64
    assert 1 < returns(ended) < 64


LADDER = np.array([0.37, 0.62, 0.81])
"""Coordinates of the best of many minima of `ladder` that fit almost as well."""


def ladder(x):
    """Independent coordinates, each with nine minima in a row; the best minimum is 0, at `LADDER`."""
    phase = 9.0 * np.pi * (x - LADDER)
    r = np.concatenate([np.sin(phase), 0.5 * (x - LADDER)], axis=1)
    eye = np.eye(3)
    slope = [9.0 * np.pi * np.cos(phase)[:, :, None] * eye, np.broadcast_to(0.5 * eye, (len(x), 3, 3))]
    return r, np.concatenate(slope, axis=1)


def search_ladder(seed, starts=32):
    optimizer = LeastSquares(np.zeros(3), np.ones(3), seed=seed, starts=starts)
    while not optimizer.done:
        x = optimizer.ask()
        r, slope = ladder(x)
        optimizer.tell(x, np.sqrt(np.mean(r**2, axis=1)), r, slope)
    return optimizer


def test_combinations_of_minima_lead_to_the_best(monkeypatch):
    """No start comes near the best of 729 minima, but each of its coordinates is found by some."""
    assert sum(search_ladder(seed).best.y < 1e-6 for seed in range(8)) >= 6
    monkeypatch.setattr(module, "COMBINATIONS", 0)
    assert min(search_ladder(seed).best.y for seed in range(8)) > 1e-3


def test_minima_are_not_combined_where_the_best_keeps_coming_back(monkeypatch):
    often = evaluations_for(5, 0.4)
    monkeypatch.setattr(module, "COMBINATIONS", 0)
    assert evaluations_for(5, 0.4) == often


def test_two_starts_are_too_few_for_combinations(monkeypatch):
    """A fit that continues from the minima of another one has two starts."""
    spent = search_ladder(0, starts=2).evaluations
    monkeypatch.setattr(module, "COMBINATIONS", 0)
    assert search_ladder(0, starts=2).evaluations == spent


def test_a_step_between_two_minima_is_tried_from_the_best():
    """Steps that leave the box or lead to a known minimum are left out."""
    minima = np.array([[0.8, 0.6], [0.1, 0.3], [0.1, 0.5]])
    points = recombine(minima, 99)
    for point in ([0.8, 0.4], [0.8, 0.8], [0.1, 0.6], [0.8, 0.3], [0.8, 0.5]):
        assert np.linalg.norm(points - point, axis=1).min() < 1e-12
    assert len(points) == 5
    assert len(recombine(minima, 2)) == 2
    assert ((points >= 0.0) & (points <= 1.0)).all()
    assert recombine(minima[:1], 99).shape == (0, 2)


def test_combinations_keep_a_distance_from_minima_and_from_each_other():
    minima = design("sobol", 16, 3, np.random.default_rng(1))
    points = recombine(minima, 99)
    assert len(points) > 10
    distance = np.linalg.norm(np.concatenate([points, minima])[None] - points[:, None], axis=2)
    assert np.sort(distance, axis=1)[:, 1].min() > SPACE


def test_basin_hopping_finds_the_best_of_many_minima(monkeypatch):
    """Few starts come near the best of 729 minima, but each of its coordinates can be changed alone."""
    monkeypatch.setattr(module, "COMBINATIONS", 0)
    assert sum(search_ladder(seed, starts=128).best.y < 1e-6 for seed in range(8)) >= 6
    monkeypatch.setattr(module, "PATIENCE", 0)
    assert sum(search_ladder(seed, starts=128).best.y < 1e-6 for seed in range(8)) <= 2


def test_less_than_a_round_of_starts_is_too_few_for_basin_hopping(monkeypatch):
    """Each evaluation of a large program takes long."""
    spent = search_ladder(0, starts=32).evaluations, search_ladder(0, starts=64).evaluations
    monkeypatch.setattr(module, "PATIENCE", 0)
    assert search_ladder(0, starts=32).evaluations == spent[0]
    assert search_ladder(0, starts=64).evaluations < spent[1]


def test_hops_change_one_or_two_coordinates():
    best = np.array([0.2, 0.4, 0.6])
    points = hops(best, 400, np.random.default_rng(0))
    changed = points != best
    assert sorted(np.unique(changed.sum(axis=1))) == [1, 2]
    assert changed.mean(axis=0) == pytest.approx(np.full(3, 0.5), abs=0.1)
    assert ((points >= 0.0) & (points <= 1.0)).all()
    assert (hops(best[:1], 8, np.random.default_rng(0)) != best[:1]).all()


@pytest.mark.parametrize(
    ("centre", "direction", "expected"),
    [
        (
            [0.1, 0.2],
            [0.0, 1.0],
            [0.1, 0.7],
        ),  # an axis that the direction does not move along does not limit it
        ([0.1, 0.9], [0.0, 1.0], [0.1, 0.4]),
        ([1.0, 0.5], [0.6, 0.8], [0.7, 0.1]),  # away from a bound
        ([0.5, 0.5], [1.0, 0.0], [1.0, 0.5]),
        ([0.0, 0.0], [-0.6, 0.8], [0.0, 0.5]),  # both ways leave the corner, so along an axis
    ],
)
def test_an_improving_point_lies_where_there_is_most_room(centre, direction, expected):
    point = improving_point(np.array(centre), np.array([direction]), 0.5)
    assert point == pytest.approx(expected)


@pytest.mark.parametrize("dimension", [2, 4])
def test_a_search_that_ends_in_a_corner_does_not_evaluate_it_again_and_again(dimension):
    optimizer = POUNDERS(np.zeros(dimension), np.ones(dimension), budget=100)
    points = []
    while not optimizer.done:
        x = optimizer.ask()
        residuals = x + 0.3
        optimizer.tell(x, np.sqrt(np.mean(residuals**2, axis=1)), residuals=residuals)
        points.append(x)
    assert optimizer.best.x == pytest.approx(np.zeros(dimension))
    # Searches restart elsewhere: each ends in the corner, but evaluates other points before.
    assert len(np.unique(np.concatenate(points), axis=0)) > 50
