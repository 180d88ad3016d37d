"""Nuisances: planted slopes, the order of groups, many groups, faults."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import lsq_linear

from calibray.errors import EngineError, InputError
from calibray.fitting import elimination as elimination_module
from calibray.fitting.elimination import DENSE, Elimination
from calibray.fitting.nuisance import Nuisance, make_term, transmitters
from calibray.fitting.objective import Objective, make_objective
from calibray.measurements import Measurements, SourceTable


def campaign(count: int, groups: int, seed: int = 0) -> Measurements:
    """Links in groups, with a column of trees."""
    rng = np.random.default_rng(seed)
    return Measurements(
        tx=np.zeros((count, 3)),
        rx=rng.uniform(20, 400, (count, 3)),
        path_loss_db=np.zeros(count),
        weight=rng.uniform(0.2, 3.0, count),
        group=np.array([f"set {k:05}" for k in rng.integers(0, groups, count)]),
        table=SourceTable(pd.DataFrame({"trees_m": rng.uniform(0, 30, count)}), source="links.csv"),
    )


def planted(links: Measurements, nuisance: Nuisance, truth: np.ndarray, noise: float = 0.0) -> Objective:
    """An objective over links whose measured path loss is a nuisance of known coefficients, around zero."""
    measured = nuisance.contribution(truth[None])[0]
    measured += np.random.default_rng(7).normal(0, noise, len(links)) if noise else 0.0
    everything = np.ones(len(links), dtype=bool)
    target = make_objective(links, everything, everything, nuisance=nuisance, noise_db=2.0)
    return Objective(measured, target.weight, nuisance, None, 2.0)


def test_a_slope_per_decade_is_recovered_together_with_offsets():
    links = campaign(200, 6)
    terms = make_term(links, "offset", labels=links.group), make_term(links, "clutter", "log_distance")
    nuisance = Nuisance(200, terms)
    truth = np.array([3.0, -2.0, 0.5, 7.0, -4.0, 1.0, 12.5])
    found = planted(links, nuisance, truth).coefficients(np.zeros((1, 200)))[0]
    assert found == pytest.approx(truth, abs=1e-9)
    assert nuisance.columns[-1] == "clutter"
    # The slope is one per decade: ten times the distance costs 12.5 dB more.
    decades = terms[1].value - np.log10(links.distance)
    assert decades == pytest.approx(-np.log10(links.distance).mean())


@pytest.mark.parametrize("bounds", [None, (-1.0, 2.0)])
@pytest.mark.parametrize("prior", [None, 1.5])
@pytest.mark.parametrize("per_group", [False, True])
def test_coefficients_agree_with_dense_least_squares(per_group, prior, bounds):
    links = campaign(150, 4)
    nuisance = Nuisance(
        150,
        (
            make_term(links, "offset", labels=links.group, bounds=bounds, prior=prior),
            make_term(
                links, "slope", "log_distance", labels=links.group if per_group else None, bounds=(-5, 12)
            ),
            make_term(links, "trees", "trees_m", prior=prior),
        ),
    )
    count = len(nuisance.columns)
    target = planted(links, nuisance, np.linspace(-3, 11, count), noise=2.0)
    weight = links.weight / links.weight.mean()
    ridge = np.diag(2.0 / nuisance.prior)
    matrix = np.concatenate([nuisance.design.toarray() * np.sqrt(weight)[:, None], ridge])
    side = np.concatenate([target.measured * np.sqrt(weight), np.zeros(count)])
    reference = lsq_linear(matrix, side, (nuisance.lower, nuisance.upper), tol=1e-14, method="bvls").x
    found = target.coefficients(np.zeros((1, 150)))[0]
    assert found == pytest.approx(reference, abs=1e-9)
    active = (found == nuisance.lower) | (found == nuisance.upper)
    assert active.any() == (bounds is not None)


def columns_by_name(target: Objective, loss: np.ndarray) -> dict[str, float]:
    return dict(zip(target.nuisance.columns, target.coefficients(loss[None])[0].tolist(), strict=True))


def test_the_order_of_links_groups_and_terms_does_not_matter():
    links = campaign(120, 5)
    rng = np.random.default_rng(4)
    measured = rng.normal(0, 5, 120)
    shuffled, renamed = rng.permutation(120), {name: f"{9 - k}" for k, name in enumerate(links.group_names)}

    def coefficients(order: np.ndarray, names: dict[str, str], turned: bool) -> dict[str, float]:
        mine = links.select(np.ones(120, dtype=bool))
        mine = Measurements(
            tx=mine.tx[order], rx=mine.rx[order], path_loss_db=measured[order], weight=mine.weight[order]
        )
        labels = np.array([names.get(label, label) for label in links.group[order]])
        terms = (
            make_term(mine, "offset", labels=labels, bounds=(-1.0, 1.0)),
            make_term(mine, "slope", "log_distance"),
            make_term(mine, "slopes", "log_distance", labels=labels, prior=3.0),
        )
        nuisance = Nuisance(120, terms[::-1] if turned else terms)
        return columns_by_name(Objective(measured[order], mine.weight, nuisance, None, 2.0), np.zeros(120))

    plain = coefficients(np.arange(120), {}, turned=False)
    for found in (coefficients(shuffled, {}, turned=False), coefficients(shuffled, {}, turned=True)):
        assert found == pytest.approx(plain, abs=1e-9)
    other = coefficients(shuffled, renamed, turned=True)
    back = {f"[{new}]": f"[{old}]" for old, new in renamed.items()}
    for name, value in other.items():
        place = name.find("[")
        before = name[:place] + back[name[place:]] if place >= 0 else name
        assert value == pytest.approx(plain[before], abs=1e-9)


@pytest.mark.parametrize("bounds", [None, (-3.0, 3.0)])
def test_many_links_in_many_groups(bounds):
    links = campaign(100_000, 3000)
    nuisance = Nuisance(
        100_000,
        (
            make_term(links, "offset", labels=links.group, bounds=bounds),
            make_term(links, "slope", "log_distance"),
            make_term(links, "trees", "trees_m", labels=[name[:5] for name in links.group]),
        ),
    )
    assert nuisance.design.nnz == 3 * 100_000
    count = len(nuisance.columns)
    truth = np.random.default_rng(2).normal(0, 1, count)
    target = planted(links, nuisance, truth)
    loss = np.zeros((2, 100_000))
    if bounds is None:
        assert target.coefficients(loss) == pytest.approx(np.tile(truth, (2, 1)), abs=1e-6)
    else:
        assert (target.coefficients(loss)[:, :3000] <= 3.0).all()
    slope = target.jacobian(loss, np.random.default_rng(0).normal(size=(2, 100_000, 3)))
    # What is left of derivatives is at right angles to every free column.
    left = (nuisance.design * np.sqrt(links.weight)[:, None]).T @ slope[0]
    free = (target.coefficients(loss)[0] > nuisance.lower) & (target.coefficients(loss)[0] < nuisance.upper)
    assert abs(left[free]).max() < 1e-6


def test_dense_and_sparse_designs_agree(monkeypatch):
    links = campaign(300, 8)
    nuisance = Nuisance(
        300, (make_term(links, "offset", labels=links.group), make_term(links, "slope", "log_distance"))
    )
    assert 300 * len(nuisance.columns) < DENSE
    gap, slope = np.random.default_rng(1).normal(size=(3, 300)), np.ones((3, 300, 2))
    slope[..., 1] = gap
    answers = []
    for limit in (DENSE, 0):
        monkeypatch.setattr("calibray.fitting.elimination.DENSE", limit)
        elimination = Elimination.of(nuisance, links.weight, np.zeros(9))
        found = elimination.coefficients(gap)
        left = slope.copy()
        elimination.remove(left, elimination.projection(slope, found))
        answers.append((found, left))
    assert answers[0][0] == pytest.approx(answers[1][0], abs=1e-12)
    assert answers[0][1] == pytest.approx(answers[1][1], abs=1e-12)
    assert isinstance(elimination.design, np.ndarray) is False


@pytest.mark.parametrize("columns", [2, 5, 9])
def test_bounds_are_kept_exactly_in_hard_problems(columns):
    """Nearly equal columns and many active bounds, for which full exchanges can cycle."""
    rng = np.random.default_rng(columns)
    links = Measurements(
        tx=np.zeros((60, 3)),
        rx=rng.uniform(20, 400, (60, 3)),
        path_loss_db=np.zeros(60),
        table=SourceTable(
            pd.DataFrame(
                rng.normal(size=(60, columns)) * 0.05 + rng.normal(size=(60, 1)),
                columns=[f"c{k}" for k in range(columns)],
            ),
            source="links.csv",
        ),
    )
    terms = tuple(make_term(links, f"c{k}", f"c{k}", bounds=(-0.4, 0.7)) for k in range(columns))
    nuisance = Nuisance(60, terms)
    elimination = Elimination.of(nuisance, np.ones(60), np.zeros(columns))
    gap = rng.normal(0, 2, (200, 60))
    matrix = nuisance.design.toarray()
    for side, found in zip(gap, elimination.coefficients(gap), strict=True):
        pull = matrix.T @ (side - matrix @ found)
        low, high = found <= -0.4, found >= 0.7
        assert abs(pull[~low & ~high]).max(initial=0) < 1e-7
        assert (pull[low] < 1e-9).all()
        assert (pull[high] > -1e-9).all()


def test_exchanges_without_end_raise_an_error(monkeypatch):
    links = campaign(40, 2)
    terms = make_term(links, "offset", bounds=(-0.1, 0.1)), make_term(links, "slope", "log_distance")
    elimination = Elimination.of(Nuisance(40, terms), links.weight, np.zeros(2))
    monkeypatch.setattr(elimination_module, "MAX_EXCHANGES", 1)
    with pytest.raises(EngineError, match="no minimum within the bounds"):
        elimination.coefficients(np.full((1, 40), 5.0))


def test_single_exchanges_give_the_same_result(monkeypatch):
    links = campaign(80, 3)
    rng = np.random.default_rng(0)
    terms = (
        make_term(links, "offset", labels=links.group, bounds=(-0.3, 0.3)),
        make_term(links, "slope", "log_distance", labels=links.group, bounds=(-0.5, 0.5)),
        make_term(links, "trees", "trees_m", bounds=(0.0, 0.01)),
    )
    elimination = Elimination.of(Nuisance(80, terms), links.weight, np.zeros(7))
    gap = rng.normal(0, 3, (50, 80))
    all_at_once = elimination.coefficients(gap)
    monkeypatch.setattr(elimination_module, "PATIENCE", 0)
    assert elimination.coefficients(gap) == pytest.approx(all_at_once, abs=1e-10)


def test_dependent_columns_are_held_at_zero():
    links = campaign(50, 3)
    terms = (
        make_term(links, "all"),
        make_term(links, "offset", labels=links.group),
        make_term(links, "again", "trees_m"),
        make_term(links, "trees", "trees_m"),
    )
    nuisance = Nuisance(50, terms)
    target = planted(links, nuisance, np.array([2.0, 1.0, 0.0, -1.0, 0.3, 0.2]))
    assert target.rmse(np.zeros((1, 50)))[0] == pytest.approx(0.0, abs=1e-9)
    assert columns_by_name(target, np.zeros(50)) == pytest.approx(
        {
            "all": 0,
            "offset[set 00000]": 3,
            "offset[set 00001]": 2,
            "offset[set 00002]": 1,
            "again": 0.5,
            "trees": 0,
        },
        abs=1e-8,
    )
    assert target.determined.tolist() == [False, True, True, True, True, False]


def test_a_dependent_column_moves_where_bounds_keep_the_others_from_the_minimum():
    """Levels of 11, 9 and 10 dB: an offset of 8 dB or more explains them with terms of at most 3 dB."""
    links = campaign(60, 3)
    terms = (
        make_term(links, "all", bounds=(-20.0, 20.0)),
        make_term(links, "offset", labels=links.group, bounds=(-3.0, 3.0)),
    )
    nuisance = Nuisance(60, terms)
    elimination = Elimination.of(nuisance, links.weight, np.zeros(4))
    gap = np.array([11.0, 9.0, 10.0])[terms[1].group][None]
    found = elimination.coefficients(gap)
    assert nuisance.design @ found[0] == pytest.approx(gap[0], abs=1e-4)
    # The change of a level changes the coefficients, and nothing of it is left.
    slope = (terms[1].group == 0)[None, :, None].astype(float)
    elimination.remove(slope, elimination.projection(slope, found))
    assert slope == pytest.approx(0.0, abs=1e-4)


def test_terms_at_other_links_keep_centre_and_columns():
    links = campaign(50, 3)
    slope = make_term(links, "slope", "log_distance", labels=links.group)
    new = campaign(10, 3, seed=9)
    labels = np.where(np.arange(10) == 4, "elsewhere", new.group)
    there = slope.at(new, labels)
    assert there.value == pytest.approx(np.log10(new.distance) - np.log10(links.distance).mean())
    assert there.columns == slope.columns
    assert there.group[4] == -1
    truth = np.array([[1.0, 2.0, 3.0]])
    shift = Nuisance(10, (there,)).contribution(truth)[0]
    assert shift[4] == 0
    known = np.searchsorted(links.group_names, new.group)
    assert np.delete(shift, 4) == pytest.approx(np.delete(there.value * truth[0][known], 4))
    with pytest.raises(InputError, match="'slope': needs the labels"):
        slope.at(new)
    with pytest.raises(InputError, match="'offset': takes no labels"):
        make_term(links, "offset").at(new, labels)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"bounds": (2.0, 1.0)}, r"'x': bounds = \[2, 1\]; the lower bound must be less"),
        ({"bounds": (np.nan, 1.0)}, r"'x': bounds"),
        ({"prior": 0.0}, "'x': prior = 0; a standard deviation must be greater than 0"),
        ({"labels": ["a"]}, r"'x': labels have shape \(1,\), but must have \(5,\)"),
        ({"by": "tree_m"}, "no column 'tree_m'; did you mean 'trees_m'"),
    ],
)
def test_an_invalid_term_is_refused(options, fault):
    with pytest.raises(InputError, match=fault):
        make_term(campaign(5, 2), "x", **options)


def test_incompatible_terms_are_refused():
    links = campaign(5, 2)
    with pytest.raises(InputError, match="'x': two terms have this name"):
        Nuisance(5, (make_term(links, "x"), make_term(links, "x", "log_distance")))
    with pytest.raises(InputError, match="'x': 5 links, must be 6"):
        Nuisance(6, (make_term(links, "x"),))


def test_a_transmitter_on_an_axis_is_one_transmitter():
    """Conversions of coordinates leave rounding errors of both signs around zero."""
    links = Measurements(
        tx=[[0.0, 5.0, 10.0], [-0.0, 5.0, 10.0], [1e-12, 5.0, 10.0], [-1e-12, 5.0, 10.0]],
        rx=[[30.0, 40.0, 1.5]] * 4,
        path_loss_db=[85.0] * 4,
    )
    assert set(transmitters(links)) == {"0.00,5.00,10.00"}
