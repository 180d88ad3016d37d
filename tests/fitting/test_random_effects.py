"""Random effects: a coefficient per group around a mean, with a spread that is estimated."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import planted
import programs
from calibray.calibration.calibrate import calibrate
from calibray.calibration.link_diagnostics import diagnose_links
from calibray.errors import InputError
from calibray.fitting.nuisance import UNKNOWN_DB, Nuisance, random_effect
from calibray.fitting.objective import make_objective
from calibray.fitting.preliminary_fits import estimate_noise, group_spread
from calibray.fitting.problem import Problem
from calibray.fitting.search import least_squares
from calibray.measurements import Measurements
from calibray.result.held_out import Model
from calibray.study import Study
from calibray.validation.models import variants
from fitting.test_preliminary_fits import Ramp

GROUPS, EACH = 40, 6
GROUP = np.repeat(np.arange(GROUPS), EACH)
SPREAD_DB, NOISE_DB = 6.0, 2.0


def shifted(seed: int, spread_db: float = SPREAD_DB) -> tuple[np.ndarray, np.ndarray]:
    """Shifts of the groups, and errors of all links that contain them."""
    random = np.random.default_rng(seed)
    shift = spread_db * random.standard_normal(GROUPS)
    return shift, shift[GROUP] + NOISE_DB * random.standard_normal(GROUPS * EACH)


def test_restricted_likelihood_of_a_balanced_design_is_the_analysis_of_variance():
    _, errors = shifted(1, 3.0)
    means = errors.reshape(GROUPS, EACH).mean(axis=1)
    within = np.sum((errors - means[GROUP]) ** 2) / (GROUPS * (EACH - 1))
    between = means.var(ddof=1) - within / EACH
    found = group_spread(errors, np.ones((len(errors), 1)), np.ones(len(errors)), GROUP)
    # The ratio of variances is taken from a grid in steps of 12 %.
    assert found.between**2 == pytest.approx(between, rel=0.08)
    assert found.within**2 == pytest.approx(within, rel=0.01)


def test_groups_that_do_not_differ_have_no_spread():
    alternating = np.tile([1.0, -1.0], GROUPS * EACH // 2)
    assert group_spread(alternating, np.ones((len(GROUP), 1)), np.ones(len(GROUP)), GROUP).between == 0
    # Nor is there a spread left where each group has a coefficient of its own.
    _, errors = shifted(2)
    own = (GROUP[:, None] == np.arange(GROUPS)).astype(float)
    assert group_spread(errors, own, np.ones(len(GROUP)), GROUP).within == pytest.approx(NOISE_DB, rel=0.2)


def test_spread_noise_and_shrinkage_follow_from_the_data():
    shift, errors = shifted(3)
    way = np.random.default_rng(4).uniform(0.0, 10.0, len(GROUP))
    fitted = estimate_noise(along(way, 4.0 + errors, street=GROUP))
    spread = fitted.objective.nuisance.terms[1].prior
    assert spread == pytest.approx(shift.std(), rel=0.12)
    assert fitted.objective.noise_db == pytest.approx(NOISE_DB, rel=0.12)
    coefficients = fitted.objective.coefficients((80.0 + 5.0 * way)[None])[0]
    sums = fitted.objective.nuisance.by_term(coefficients, fitted.objective.determined)
    # The best linear unbiased prediction of a balanced design shrinks the means of the groups.
    means = (4.0 + errors).reshape(GROUPS, EACH).mean(axis=1)
    share = spread**2 / (spread**2 + fitted.objective.noise_db**2 / EACH)
    expected = means.mean() + share * (means - means.mean())
    assert list(sums) == ["street"]
    assert list(sums["street"].values()) == pytest.approx(expected.tolist(), abs=1e-6)
    # A group that is left out has the mean 0.
    without = fitted.objective.reweighted(np.where(GROUP == 0, 0.0, 1.0))
    assert without.completed((80.0 + 5.0 * way)[None])[0, 1] == 0
    block = np.where(GROUP < 3, 0, 1 + GROUP % 2)
    alone = fitted.objective.nuisance.new_group_spread(block)
    assert alone[GROUP < 3] == pytest.approx(spread)
    split = np.arange(len(GROUP)) % 2
    assert not fitted.objective.nuisance.new_group_spread(split).any()


def along(way: np.ndarray, errors: np.ndarray, **effects: np.ndarray) -> Problem:
    """A problem along a route with errors and random effects, given by the number of every link's group."""
    place = np.column_stack([way, np.zeros((len(way), 2))])
    links = Measurements(tx=place + 1.0, rx=place, path_loss_db=80.0 + 5.0 * way + errors)
    terms = [
        random_effect(links, name, "constant", [f"{each:03d}" for each in group])
        for name, group in effects.items()
    ]
    every, engine = np.ones(len(way), dtype=bool), Ramp(way)
    nuisance = Nuisance(len(way), tuple(term for pair in terms for term in pair))
    objective = make_objective(links, every, every, nuisance=nuisance, noise_db=1.0)
    study = SimpleNamespace(noise=SimpleNamespace(std_db=None), links=SimpleNamespace(std=None))
    setup = SimpleNamespace(links=links, study=study)
    return Problem(setup, engine, objective, engine.path_loss(engine.parameters.start[None])[0])  # type: ignore[arg-type]


@pytest.mark.parametrize("spread_db", [0.0, 6.0])
def test_groups_of_few_links_do_not_raise_the_noise(spread_db):
    """Two links in each group: a coefficient of each that its prior keeps small explains none of their errors."""
    random, group = np.random.default_rng(3), np.repeat(np.arange(150), 2)
    way = random.uniform(0.0, 10.0, len(group))
    errors = 4.0 * random.standard_normal(len(group)) + spread_db * random.standard_normal(150)[group]
    fitted = estimate_noise(along(way, errors, street=group))
    best = least_squares(fitted, 4, np.zeros((0, 1))).best.x
    optimum = fitted.squares(best[None])
    noise_db = optimum.rmse_db[0] * np.sqrt(len(way) / fitted.freedom)
    assert fitted.objective.noise_db == pytest.approx(4.0, rel=0.1)
    assert noise_db == pytest.approx(fitted.objective.noise_db, rel=0.03)
    prior = variants(fitted, best)[Model.PRIOR].objective
    assert prior.noise_db == pytest.approx(noise_db)


def test_a_link_alone_in_its_group_has_little_leverage_if_groups_hardly_differ():
    random, group = np.random.default_rng(3), np.append(np.repeat(np.arange(40), 2), 40)
    way = random.uniform(0.0, 10.0, len(group))
    fitted = estimate_noise(along(way, 4.0 * random.standard_normal(len(group)), street=group))
    best = least_squares(fitted, 4, np.zeros((0, 1))).best.x
    leverage = diagnose_links(fitted, best, None).columns["leverage"]
    assert leverage[-1] < 0.2
    assert leverage.sum() == pytest.approx(len(group) - fitted.freedom, abs=0.5)


def test_the_spread_of_streets_does_not_count_as_that_of_places_within_them():
    random, street = np.random.default_rng(5), np.repeat(np.arange(30), 12)
    place = street * 3 + np.tile(np.arange(3), 120)
    shift = SPREAD_DB * random.standard_normal(30)
    errors = shift[street] + 2.0 * random.standard_normal(90)[place]
    errors += NOISE_DB * random.standard_normal(len(street))
    way = random.uniform(0.0, 10.0, len(street))
    fitted = estimate_noise(along(way, errors, street=street, place=place))
    spread = {term.around: term.prior for term in fitted.objective.nuisance.terms if term.around}
    assert spread == pytest.approx({"street": shift.std(), "place": 2.0}, rel=0.2)
    assert fitted.objective.noise_db == pytest.approx(NOISE_DB, rel=0.1)


def test_one_group_does_not_show_a_spread():
    random = np.random.default_rng(6)
    fitted = estimate_noise(
        along(random.uniform(0.0, 10.0, 60), 2.0 * random.standard_normal(60), street=np.zeros(60, int))
    )
    assert fitted.objective.nuisance.terms[1].prior == UNKNOWN_DB
    assert fitted.objective.noise_db == pytest.approx(2.0, rel=0.2)


def test_a_new_street_is_predicted_with_the_mean_and_the_spread(tmp_path):
    street = np.array([f"s{number % 4}" for number in range(planted.LINKS)])
    shift = {"s0": 6.0, "s1": -2.0, "s2": 1.0, "s3": 9.0}
    table = planted.campaign(noise_db=0.5).assign(street=street)
    table = table.assign(path_loss_db=table.path_loss_db + [shift[name] for name in street])
    effect = {"street": {"by": "constant", "per": "street", "prior": "auto"}}
    fixed = {
        name: {"bounds": [value - 0.1, value + 0.1], "start": value} for name, value in planted.TRUTH.items()
    }
    study = planted.study(tmp_path, table, nuisance=effect, parameters=fixed)
    result = calibrate(study)
    (term,) = result.prediction.model.terms
    assert term.spread_db == pytest.approx(np.std(list(shift.values()), ddof=1), rel=0.3)
    assert result.nuisance.coefficients["street"] == pytest.approx(shift, abs=1.0)
    known, new = table.head(1), table.head(1).assign(street="elsewhere")
    one, other = result.predict_interval(known), result.predict_interval(new)
    mean = np.mean(list(term.coefficients.values()))
    assert other.path_loss_db[0] - one.path_loss_db[0] == pytest.approx(
        mean - term.coefficients["s0"], abs=1e-6
    )
    assert (
        other.upper_db[0] - other.lower_db[0] > 2 * 1.6 * term.spread_db > one.upper_db[0] - one.lower_db[0]
    )
    result.save(tmp_path / "out")
    loaded = type(result).load(tmp_path / "out")
    assert loaded.prediction.model.terms == result.prediction.model.terms


def test_streets_that_a_filter_holds_out_have_the_mean_and_their_spread_counts_once(tmp_path):
    street = np.array([f"s{number // 2}" for number in range(planted.LINKS)])
    shift = dict(zip(sorted(set(street)), [3.0, -2.0, 1.0, 5.0, 0.0, -4.0], strict=True))
    table = planted.campaign(noise_db=0.5).assign(street=street)
    table["path_loss_db"] += table.street.map(shift)
    beside = table.assign(rx_x=table.rx_x + 0.7)
    study = planted.study(
        tmp_path,
        pd.concat([table, beside], ignore_index=True),
        nuisance={"street": {"by": "constant", "per": "street", "prior": "auto"}},
        parameters={"marble.relative_permittivity": {"bounds": [1.5, 12.0]}},
        holdout={"where": "street == 's1' or street == 's3'"},
    )
    result = calibrate(study)
    known = result.nuisance.coefficients["street"]
    assert list(known) == ["s0", "s2", "s4", "s5"]
    rows = result.links[result.links.held_out]
    excess_db = (rows.measured_db - rows.after_db).to_numpy().reshape(2, 2, 2).mean(axis=(0, 2))
    mean_db = np.mean([shift[name] for name in known])
    assert excess_db == pytest.approx([shift["s1"] - mean_db, shift["s3"] - mean_db], abs=1.5)
    model = result.prediction.model
    assert model.blocks is not None
    assert model.blocks.groups_db == pytest.approx(model.terms[0].spread_db)


def test_clusters_of_receivers_are_groups_without_a_column(tmp_path):
    table = planted.campaign(noise_db=0.2)
    side = float(np.ptp(table.rx_x)) / 3
    square = [f"{x:.0f} {y:.0f}" for x, y in np.floor(table[["rx_x", "rx_y"]].to_numpy() / side)]
    shift = {name: 7.0 * (number % 3) for number, name in enumerate(sorted(set(square)))}
    assert len(shift) >= 3
    table = table.assign(path_loss_db=table.path_loss_db + [shift[name] for name in square])
    fixed = {
        name: {"bounds": [value - 0.1, value + 0.1], "start": value} for name, value in planted.TRUTH.items()
    }
    effect = {"patch": {"by": "constant", "per": "cluster", "cluster_m": side, "prior": "auto"}}
    result = calibrate(planted.study(tmp_path, table, nuisance=effect, parameters=fixed))
    assert result.nuisance.coefficients["patch"] == pytest.approx(shift, abs=1.0)
    far = table.head(1).assign(rx_x=table.rx_x.max() + 2 * side)
    (term,) = result.prediction.model.terms
    wide, known = result.predict_interval(far), result.predict_interval(table.head(1))
    assert result.predict(far) == pytest.approx(wide.path_loss_db.to_numpy())
    assert np.ptp(wide[["lower_db", "upper_db"]].to_numpy()) > 2 * 1.6 * term.spread_db
    assert np.ptp(known[["lower_db", "upper_db"]].to_numpy()) < term.spread_db


def test_on_an_external_program_the_spread_takes_no_further_call(tmp_path):
    content = programs.content(tmp_path) | {
        "nuisance": {"side": {"by": "constant", "per": "half", "prior": "auto"}},
        "method": {"name": "random", "options": {"budget": 4}},
    }
    content["noise"] |= {"std_db": 1.0}
    table = pd.read_csv(tmp_path / "links.csv")
    noise_db = np.random.default_rng(0).standard_normal(len(table))
    shifted = table.path_loss_db + noise_db + np.where(table.half == "west", 6.0, 0.0)
    table.assign(path_loss_db=shifted).to_csv(tmp_path / "links.csv", index=False)
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"))
    assert len(programs.calls(tmp_path)) == 1 + 4
    side = result.nuisance.coefficients["side"]
    assert side["west"] - side["east"] == pytest.approx(6.0, abs=2.5)
    (term,) = result.prediction.model.terms
    assert 2.0 < term.spread_db < 10.0


def test_squares_of_a_side_need_clusters_and_one_side(tmp_path):
    plain = {"by": "constant", "per": "street", "cluster_m": 10.0}
    with pytest.raises(InputError, match="cluster_m, the side length of the squares, needs per = 'cluster'"):
        planted.study(tmp_path, planted.campaign(), nuisance={"x": plain})
    terms = {name: plain | {"per": "cluster", "cluster_m": side} for name, side in (("x", 5.0), ("y", 6.0))}
    with pytest.raises(InputError, match="cluster_m differs between terms"):
        planted.study(tmp_path, planted.campaign(), nuisance=terms)


@pytest.mark.parametrize("keys", [{}, {"per": "half", "bounds": [-3.0, 3.0]}])
def test_a_random_effect_needs_groups_and_no_bounds(tmp_path, keys):
    with pytest.raises(
        InputError,
        match=r"prior = 'auto' needs per, the column of the groups, and cannot be combined with bounds",
    ):
        planted.study(
            tmp_path, planted.campaign(), nuisance={"x": {"by": "constant", "prior": "auto", **keys}}
        )
