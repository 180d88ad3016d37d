"""The loop against planted truths: what every method must keep, and what the objective may not see."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from functools import cached_property

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

import planted
import two_ray
from calibray.calibration.calibrate import calibrate
from calibray.calibration.held_out_accuracy import rmse_of
from calibray.calibration.result import Result
from calibray.engines import Replay
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose
from calibray.optimizers import METHODS
from calibray.parameters import Parameter, Parameters
from calibray.reporting.result_tables import nuisances
from calibray.reporting.summary import summary
from calibray.reporting.wording import method_text
from calibray.result.held_out import Model
from calibray.result.verdict import RemarkKind
from calibray.result.wording import judgement_text
from calibray.study import Setup
from calibray.tables import render
from calibray.validation.validate import validate

PAPER_CALLS = {"gwo": 600, "sgwo-im": 225}
METHOD_NAMES = ("auto", *METHODS)


def run(folder, table: pd.DataFrame, name: str = "auto", seed: int = 0, **sections) -> Result:
    """Calibrate on some links, with the engine that was traced once."""
    return calibrate(planted.study(folder, table, **sections), name, seed, engine=planted.engine())


@pytest.fixture(scope="module")
def exact() -> pd.DataFrame:
    """The links with their exact path loss at the planted values."""
    return planted.campaign()


@pytest.fixture(scope="module")
def noisy() -> pd.DataFrame:
    """The links with 1 dB of noise."""
    return planted.campaign(noise_db=1.0)


@pytest.fixture(scope="module")
def of_noisy(tmp_path_factory, noisy) -> Result:
    """A calibration on the noisy links."""
    return run(tmp_path_factory.mktemp("noisy"), noisy)


def test_the_planted_truth_is_not_the_start_and_matters(exact):
    start = dict(zip(planted.engine().parameters.names, planted.engine().parameters.start, strict=True))
    assert np.isfinite(exact.path_loss_db).all()
    for name in planted.TRUTH:
        moved = planted.path_loss(planted.TRUTH | {name: start[name]})
        assert np.sqrt(np.mean((moved - exact.path_loss_db) ** 2)) > 0.1


@pytest.mark.parametrize("method", ["auto", "least-squares"])
def test_least_squares_recovers_planted_values(tmp_path, exact, method):
    result = run(tmp_path, exact, method)
    assert result.parameters == pytest.approx(planted.TRUTH, abs=1e-4)
    assert result.rmse_db < 1e-5 < 0.5 < result.initial_rmse_db
    assert {interval.verdict for interval in result.intervals.values()} == {"identified"}


@pytest.mark.parametrize("step", [0.0, 1e-7])
def test_rows_that_were_logged_twice_change_nothing(tmp_path, noisy, of_noisy, step):
    """Their values and positions differ by what rounding leaves."""
    again = noisy.assign(path_loss_db=noisy.path_loss_db + step, rx_x=noisy.rx_x + step)[::2]
    twice = run(tmp_path, pd.concat([noisy, again]))
    assert twice.provenance.rows == {"rows that repeat a link, merged": len(again)}
    losses = [planted.path_loss(result.parameters) for result in (of_noisy, twice)]
    assert losses[1] == pytest.approx(losses[0], abs=0.01)


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_every_method_keeps_the_contract(tmp_path, exact, method):
    calls = planted.engine().calls
    result = run(tmp_path, exact, method, seed=4)
    # The initial materials and the diagnostics cost one replay each, which are not the method's RT calls.
    # Draws replay the paths with further constants, apart from the study's engine.
    calls = planted.engine().calls - calls - result.rt_calls - 2
    assert 0 < calls <= result.cost.uncertainty_replays
    assert result.rt_calls == len(result.history) == PAPER_CALLS.get(method, result.rt_calls)
    assert all(low <= value <= high for (low, high), value in zip(
        [planted.BOUNDS] * 3, result.parameters.values(), strict=True))  # fmt: skip
    assert result.rmse_db < 0.5 * result.initial_rmse_db
    assert result.rmse_db == result.history.rmse_db.min() == result.history.best_db.iloc[-1]
    assert (np.diff(result.history.best_db) <= 0).all()
    loss = planted.path_loss(result.parameters)
    assert np.sqrt(np.mean((loss - exact.path_loss_db) ** 2)) == pytest.approx(result.rmse_db, abs=1e-9)


class BlackBox:
    """The engine without its derivatives."""

    def __init__(self) -> None:
        self.parameters, self.materials, self.calls = (
            planted.engine().parameters,
            planted.engine().materials,
            0,
        )

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        self.calls += len(candidates)
        return planted.engine().path_loss(candidates)


class Losing(BlackBox):
    """The engine without its derivatives, whose first link has no path if the first permittivity exceeds 6."""

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        loss = super().path_loss(candidates)
        loss[np.asarray(candidates)[:, 0] > 6.0, 0] = np.inf
        return loss


@pytest.mark.parametrize("engine", [BlackBox, Losing])
def test_a_given_engine_and_the_calls_that_lose_a_link_are_named(tmp_path, exact, engine):
    given = engine()
    first, *others = given.parameters.items
    given.parameters = replace(given.parameters, items=(replace(first, start=4.0), *others))
    method = {"name": "random", "options": {"budget": 12}}
    result = calibrate(planted.study(tmp_path, exact, method=method), engine=given)
    of_kind = {remark.kind: remark.values for remark in result.uncertainty.remarks}
    described = {"engine": engine.__name__, "differentiable": False, "used": "replay"}
    assert of_kind[RemarkKind.GIVEN_ENGINE] == described
    assert f"engine {engine.__name__}" in str(result)
    assert f"with the engine {engine.__name__}:" in " ".join(sentence.text for sentence in summary(result))
    assert method_text(result, "auto") == "auto (vector surrogate)"
    infinite = int(np.isinf(result.history.rmse_db).sum())
    if engine is BlackBox:
        assert infinite == 0
        assert RemarkKind.LOST_PATHS not in of_kind
    else:
        assert 0 < infinite < 12
        assert of_kind[RemarkKind.LOST_PATHS] == {
            "calls": infinite,
            "of": 12,
            "rows": [int(result.links.row[0])],
        }
        assert "RT calls cannot be the result" in " ".join(result.remarks)


@pytest.mark.parametrize("fits", [True, False])
def test_initial_values_that_a_program_was_called_for_may_be_the_best(tmp_path, exact, fits):
    engine, method = BlackBox(), {"name": "gwo", "options": {"population": 4, "iterations": 3}}
    if fits:
        starts = zip(engine.parameters, planted.TRUTH.values(), strict=True)
        items = tuple(replace(each, start=value) for each, value in starts)
        engine.parameters = replace(engine.parameters, items=items)
    result = calibrate(planted.study(tmp_path, exact, method=method), engine=engine)
    assert result.rt_calls == len(result.history)
    assert result.history.rmse_db.min() > 0.1
    if fits:
        assert result.parameters == planted.TRUTH
        assert result.rmse_db < 1e-9
    else:
        assert result.rmse_db == result.history.rmse_db.min()


@pytest.mark.parametrize("method", ["auto", "gwo"])
def test_the_seed_determines_a_calibration(tmp_path, exact, method):
    one, again, other = (run(tmp_path, exact, method, seed=seed) for seed in (4, 4, 5))
    assert again.history.rmse_db.tolist() == one.history.rmse_db.tolist()
    assert again.intervals == one.intervals
    assert other.history.rmse_db.tolist() != one.history.rmse_db.tolist()


def test_auto_reaches_the_optimum_of_a_brute_force_scan(noisy, of_noisy):
    replay, measured = planted.engine(), noisy.path_loss_db.to_numpy()

    def rmse(candidates: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean((replay.path_loss(candidates) - measured) ** 2, axis=1))

    axis = np.linspace(*planted.BOUNDS, 22)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    scan = rmse(grid)
    leaders = grid[np.argsort(scan)[:3]]
    options = {"xatol": 1e-5, "fatol": 1e-9}
    polished = [
        minimize(
            lambda x: rmse(x[None])[0],
            leader,
            method="Nelder-Mead",
            bounds=[planted.BOUNDS] * 3,
            options=options,
        ).fun
        for leader in leaders
    ]
    assert of_noisy.rmse_db <= min(polished) + 1e-6
    assert 0.3 < of_noisy.rmse_db < scan.min()  # with a noise floor, and finer than the scan


def test_held_out_links_do_not_change_the_fit(tmp_path, exact):
    held_out = exact.rx_x > 10
    noisy = exact.assign(path_loss_db=exact.path_loss_db + 0.5 * np.random.default_rng(0).standard_normal(12))
    shift = {
        "held out": noisy.path_loss_db + 5.0 * held_out,
        "calibrated on": noisy.path_loss_db + 5.0 * ~held_out * (exact.rx_x > 0),
    }
    results = {
        name: run(tmp_path, noisy.assign(path_loss_db=values), holdout={"where": "rx_x > 10"})
        for name, values in {"none": noisy.path_loss_db, **shift}.items()
    }
    assert results["held out"].parameters == results["none"].parameters
    assert results["held out"].rmse_db == results["none"].rmse_db
    assert results["held out"].holdout_rmse_db > results["none"].holdout_rmse_db + 3
    assert results["calibrated on"].parameters != results["none"].parameters
    table = results["none"].links
    assert table.held_out.tolist() == held_out.tolist()
    error = (table.after_db - table.measured_db)[table.held_out]
    assert results["none"].holdout_rmse_db == pytest.approx(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("holdout", [{"where": "rx_x > 0"}, {"blocks": 2}])
def test_held_out_links_count_equally(tmp_path, noisy, holdout):
    """As in the judgement, whose RMSE is that of the table, and in the intervals of predictions."""
    result = run(
        tmp_path,
        noisy.assign(weight=np.where(noisy.index % 2 == 0, 1.0, 25.0)),
        links=planted.content("links.csv")["links"] | {"weight": "weight"},
        holdout=holdout,
    )
    accuracy, judgement, table = result.accuracy, result.accuracy.judgement, result.links
    judged = table[table.held_out] if "where" in holdout else table
    error = judged.before_db - judged.measured_db
    assert accuracy.initial_holdout_rmse_db == pytest.approx(np.sqrt(np.mean(error**2)))
    assert accuracy.holdout_rmse_db == pytest.approx(judgement.rmse_db)


def test_a_filter_has_the_baselines_of_blocks(tmp_path, exact, of_noisy):
    """The initial materials with an offset explain these links, although the study declares none."""
    shifted = exact.assign(path_loss_db=planted.path_loss(of_noisy.fit.initial_parameters) + 4.0)
    judgement = run(tmp_path, shifted, holdout={"where": "rx_x > 0"}).accuracy.judgement
    assert (judgement.baseline, judgement.baseline_rmse_db) == (Model.INITIAL, pytest.approx(0, abs=1e-9))
    assert not judgement.helped
    assert "more than the initial materials with fitted nuisances, the best baseline" in judgement_text(
        judgement
    )


def test_rmses_of_other_models_have_the_weights_of_the_fit(tmp_path, noisy):
    """Links whose path loss was interpolated poorly between heights have less weight than the table states."""
    problem = Problem.of(Setup.open(planted.study(tmp_path, noisy)), planted.engine())
    objective = replace(problem.objective, weight=np.linspace(0.1, 2.0, planted.LINKS))
    rmse_db = rmse_of(replace(problem, objective=objective), problem.before, objective.weight > 0)
    assert rmse_db == pytest.approx(objective.rmse(problem.before[None])[0])


def test_weights_act(tmp_path, exact):
    wrong = exact.assign(path_loss_db=exact.path_loss_db + 10.0 * (exact.index == 4))
    trusting = run(tmp_path, wrong, links=planted.content("links.csv")["links"] | {"weight": "weight"})
    wary = run(
        tmp_path,
        wrong.assign(weight=np.where(exact.index == 4, 1e-9, 1.0)),
        links=planted.content("links.csv")["links"] | {"weight": "weight"},
    )
    assert wary.parameters == pytest.approx(planted.TRUTH, abs=1e-3)
    assert trusting.parameters != pytest.approx(planted.TRUTH, abs=0.1)


@pytest.mark.parametrize(
    ("offset", "planted_db", "found"),
    [
        ({}, {"west": 4.0, "east": 4.0}, {"": 4.0}),
        ({"per": "half"}, {"west": -3.0, "east": 6.0}, {"west": -3.0, "east": 6.0}),
        ({"per": "half", "bounds": [-10.0, 10.0]}, {"west": -3.0, "east": 6.0}, {"west": -3.0, "east": 6.0}),
    ],
)
def test_offsets_are_fitted_with_the_materials(tmp_path, exact, offset, planted_db, found):
    shifted = exact.assign(path_loss_db=exact.path_loss_db + exact.half.map(planted_db))
    result = run(tmp_path, shifted, offset=offset)
    assert result.nuisance.offsets_db == pytest.approx(found, abs=1e-4)
    assert result.parameters == pytest.approx(planted.TRUTH, abs=1e-3)
    assert result.rmse_db < 1e-4
    assert result.rmse_db <= result.fit.nuisance_only_rmse_db <= result.initial_rmse_db


def test_an_offset_stays_within_its_bounds(tmp_path, exact):
    shifted = exact.assign(path_loss_db=exact.path_loss_db + 40.0)  # more than the materials can take up
    assert run(tmp_path, shifted, offset={"bounds": [-1.0, 1.5]}).nuisance.offsets_db == {"": 1.5}


def test_a_study_without_offset_has_none(tmp_path, exact):
    result = run(tmp_path, exact.assign(path_loss_db=exact.path_loss_db + 4.0))
    assert (
        result.nuisance.offsets_db,
        result.fit.nuisance_only_rmse_db,
        result.accuracy.nuisance_only_holdout_rmse_db,
    ) == (
        {},
        None,
        None,
    )
    assert result.rmse_db > 0.5


def test_a_group_that_is_held_out_completely_is_refused(tmp_path, exact):
    with pytest.raises(InputError, match=r"need offset\[east\], which no calibration link determines"):
        run(tmp_path, exact, offset={"per": "half"}, holdout={"where": "half == 'east'"})
    slope = {"slope": {"by": "log_distance", "per": "half"}}
    with pytest.raises(InputError, match=r"need slope\[east\], which no calibration link determines"):
        run(tmp_path, exact, nuisance=slope, holdout={"where": "half == 'east'"})


def test_the_log_distance_baseline_is_fitted_to_the_calibration_links_only(tmp_path, exact):
    distance = np.linalg.norm(exact[["rx_x", "rx_y"]].assign(z=-1.5), axis=1)
    law = exact.assign(path_loss_db=40 + 23 * np.log10(distance) + 9.0 * (exact.rx_x > 10))
    result = run(tmp_path, law, holdout={"where": "rx_x > 10"})
    assert result.fit.log_distance_rmse_db == pytest.approx(0, abs=1e-9)
    assert result.accuracy.log_distance_holdout_rmse_db == pytest.approx(9.0)


@pytest.fixture(scope="module")
def blocked(tmp_path_factory) -> dict[str, Result]:
    """Calibrations on links of which one has no path, with that link's value as each of them needs it."""
    assert np.isinf(planted.path_loss(blocked=True)[planted.INSIDE])
    folder = tmp_path_factory.mktemp("blocked")
    measured = planted.campaign(blocked=True)

    def result(at_no_path_db: float, **sections) -> Result:
        values = measured.path_loss_db.replace(np.inf, at_no_path_db)
        study = planted.study(folder, measured.assign(path_loss_db=values), **sections)
        return calibrate(study, engine=planted.engine(blocked=True))

    censored = {"no_path": "censor", "ceiling_db": 120.0}
    beyond = {"where": "rx_y > 15 or rx_x > 20"}
    return {
        "left out": result(75.0),
        "censored": result(120.0, objective=censored),
        "censored wrongly": result(75.0, objective=censored),
        "held out": result(75.0, holdout=beyond),
        "censored, held out": result(120.0, objective=censored, holdout=beyond),
    }


def test_a_link_without_a_path_is_reported_and_left_out(blocked):
    result = blocked["left out"]
    assert result.links.row[~result.links.has_path].tolist() == [planted.INSIDE + 2]
    assert np.isinf(result.links.before_db[planted.INSIDE])
    assert np.isinf(result.links.after_db[planted.INSIDE])
    assert result.parameters == pytest.approx(planted.TRUTH, abs=1e-3)
    assert result.rmse_db < 1e-4


def test_a_censored_link_counts_as_lost_at_the_ceiling(blocked):
    right, wrong = blocked["censored"], blocked["censored wrongly"]
    assert right.parameters == pytest.approx(planted.TRUTH, abs=1e-3)
    assert right.rmse_db < 1e-4
    assert np.isinf(right.links.after_db[planted.INSIDE])  # the table still says that there is none
    assert wrong.rmse_db == pytest.approx((120 - 75) / np.sqrt(planted.LINKS), rel=1e-3)


def test_a_censored_link_is_predicted_at_the_ceiling_as_it_was_fitted_and_judged(blocked):
    """Whether links are held out by a filter or not; blocks are validated with the ceiling as well."""
    for result in (blocked["censored"], blocked["censored, held out"]):
        predicted = result.predict(planted.links(blocked=True))
        assert predicted == pytest.approx(result.links.predicted_db.to_numpy(), abs=1e-3)
        assert predicted[planted.INSIDE] == 120.0
    assert blocked["censored, held out"].holdout_rmse_db < 1e-4


def test_a_link_without_a_path_is_not_judged_either(blocked):
    assert blocked["held out"].holdout_rmse_db < 1e-4


def test_a_study_without_any_path_is_refused(tmp_path):
    measured = planted.campaign(blocked=True).replace(np.inf, 75.0)
    with pytest.raises(InputError, match="no path reaches any of the 1 calibration links; raise"):
        calibrate(
            planted.study(tmp_path, measured, holdout={"where": "rx_y < 15"}),
            engine=planted.engine(blocked=True),
        )


@pytest.mark.usefixtures("all_draws")
def test_the_interval_does_not_depend_on_the_scale_of_the_search(tmp_path):
    replay, noisy = planted.engine(), planted.campaign(noise_db=0.02)
    logarithmic = Parameters(tuple(replace(parameter, scale="log") for parameter in replay.parameters))
    sections = {name: {"bounds": planted.BOUNDS, "scale": "log"} for name in planted.TRUTH}
    study = planted.study(tmp_path, noisy, parameters=sections)
    result = calibrate(study, engine=Replay(replay.paths, logarithmic))
    linear = run(tmp_path, noisy)
    assert result.parameters == pytest.approx(linear.parameters, rel=1e-4)
    for name, value in result.parameters.items():
        interval, other = result.intervals[name], linear.intervals[name]
        # The likelihood is the same on either scale; what is flat beforehand is not.
        assert (interval.lower, interval.upper) == pytest.approx((other.lower, other.upper), rel=0.02)
        assert interval.standard_error == pytest.approx(other.standard_error, rel=1e-2)
        assert interval.lower < value < interval.upper


def test_a_logarithmic_parameter_is_searched_by_its_logarithm():
    parameters = Parameters(
        (
            Parameter("walls.relative_permittivity", 1.5, 12.0, 5.0),
            Parameter("walls.conductivity", 1e-3, 1.0, 0.1, "log"),
        )
    )
    values = np.array([[5.0, 0.1], [12.0, 1.0]])
    points = parameters.to_search(values)
    assert points.tolist() == [[5.0, np.log(0.1)], [12.0, 0.0]]
    assert parameters.from_search(points) == pytest.approx(values)
    step = 1e-6
    ahead, behind = (parameters.from_search(points + each) for each in (step, -step))
    assert parameters.search_slope(values)[0] == pytest.approx((ahead - behind)[0] / (2 * step))


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("sgwoim", "method 'sgwoim': there is no such method; did you mean 'sgwo-im'"),
        ("zzz", "use one of: auto"),
    ],
)
def test_an_unknown_method_is_refused_before_any_work(tmp_path, exact, method, message):
    calls = planted.engine().calls
    with pytest.raises(InputError, match=message):
        run(tmp_path, exact, method)
    assert planted.engine().calls == calls


def test_the_name_of_a_file_is_no_study():
    with pytest.raises(
        InputError, match=r"study: is a str; it must be a Study; .* calibrate\(Study\.load\(file\)\)"
    ):
        calibrate("study.toml")


def test_an_unknown_option_of_a_method_is_refused(tmp_path, exact):
    with pytest.raises(InputError, match=r"method\.options\.wolfes: the method 'gwo' has no such setting"):
        run(tmp_path, exact, None, method={"name": "gwo", "options": {"wolfes": 3}})


def test_a_single_link_is_refused_before_the_search(tmp_path):
    study = two_ray.study(tmp_path, holdout={"where": "rx_x > 3.1"})
    setup = Setup.open(study, two_ray.TwoRay)
    engine = Replay(setup.trace(), setup.parameters, "coherent")
    with pytest.raises(
        InputError, match=r"links\.csv: only 1 calibration link has a path; at least 2 are needed"
    ):
        calibrate(setup, engine=engine)
    assert engine.calls == 1


def test_starting_points_have_the_units_of_the_parameters(tmp_path):
    parameter = {"bounds": [1.5, 12.0], "scale": "log"}
    method = {"name": "least-squares", "options": {"starts": 1, "x0": [[6.0], [9.0]]}}
    study = two_ray.study(tmp_path, parameters={"ground.relative_permittivity": parameter}, method=method)
    setup = Setup.open(study, two_ray.TwoRay)
    problem = Problem.of(setup, Replay(setup.trace(), setup.parameters, "coherent"))
    assert choose(problem).ask()[:2] == pytest.approx(np.log([[6.0], [9.0]]))


def test_a_group_without_a_path_is_named_and_only_held_out_links_are_judged(tmp_path):
    """The receiver in the building is a group of its own; of two links held out one has no path."""
    table = planted.campaign(noise_db=0.1).assign(place=lambda each: each.half)
    table.loc[planted.INSIDE, "place"] = "cellar"
    study = planted.study(tmp_path, table, offset={"per": "place"})
    result = calibrate(study, engine=planted.engine(blocked=True))
    assert sorted(result.nuisance.offsets_db) == ["east", "west"]
    assert result.nuisance.groups_without_path == ("cellar",)
    assert re.search(r"^cellar +no link with a path$", render(nuisances(result)), re.MULTILINE)
    faint = replace(result, links=result.links.assign(faint=False))
    assert "no link with a path and a power well above the noise floor" in render(nuisances(faint))
    assert result.content()["nuisance"]["groups_without_path"] == ["cellar"]

    held = planted.study(
        tmp_path, table, holdout={"where": f"rx_x in [{table.rx_x[planted.INSIDE]}, {table.rx_x[0]}]"}
    )
    result = calibrate(held, engine=planted.engine(blocked=True))
    judged = result.links[result.links.held_out & result.links.has_path]
    assert result.counts["held_out"] == len(judged) == 1
    assert result.holdout_rmse_db == pytest.approx(abs(judged.after_db - judged.measured_db).item(), abs=1e-9)


def test_antennas_inside_bodies_are_reported(tmp_path, monkeypatch):
    table = planted.campaign(blocked=False).assign(**planted.links(blocked=True)[["rx_x", "rx_y", "rx_z"]])
    seen = []
    original = Setup.enclosed.func

    def enclosed(self):
        seen.append("looked")
        return original(self)

    looked = cached_property(enclosed)
    looked.__set_name__(Setup, "enclosed")
    monkeypatch.setattr(Setup, "enclosed", looked)
    module = sys.modules["calibray.calibration.calibrate"]
    monkeypatch.setattr(module, "search", lambda *_: seen.append("searched") or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        calibrate(planted.study(tmp_path, table))
    assert seen == ["looked", "searched"]
    monkeypatch.undo()
    study = planted.study(tmp_path, table, method={"name": "auto", "options": {"starts": 4}})
    result = calibrate(study, out=tmp_path / "out")
    assert result.provenance.enclosed.rx == (planted.INSIDE + 2,)
    assert Result.load(tmp_path / "out").provenance.enclosed == result.provenance.enclosed


def test_days_held_out_in_turn_keep_their_rows_of_one_link(tmp_path):
    """Rows of one position without times are one link, unless a block is one of their days."""
    table = pd.concat([planted.campaign(noise_db=1.0).assign(day=day) for day in (1, 2)], ignore_index=True)
    found = validate(planted.study(tmp_path, table), by="day")
    assert found.labels == ("1", "2")
    assert np.bincount(found.block).tolist() == [planted.LINKS, planted.LINKS]
