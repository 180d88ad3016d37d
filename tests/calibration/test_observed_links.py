"""Calibration on delay spreads and times of flight besides path loss, from the study to predictions."""

import numpy as np
import pandas as pd
import pytest
from scipy.special import stdtrit

import planted
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.fitting.observed import with_errors
from calibray.fitting.preliminary_fits import estimate_noise
from calibray.fitting.problem import Problem
from calibray.measurements.observables import Statistic
from calibray.reporting import result_tables as tables
from calibray.reporting.figures import measured_over_modelled
from calibray.result import wording
from calibray.result.held_out import Model
from calibray.result.verdict import RemarkKind
from calibray.study import Setup, Study
from calibray.tables import render
from calibray.uncertainty.remarks import conflict
from calibray.validation.validate import validate_problem
from link_tables import links_from_frame

MARBLE = "marble.relative_permittivity"
SPREAD = {"kind": "rms_delay_spread", "column": "spread_ns", "unit": "ns"}
FLIGHT = {"kind": "round_trip_time", "column": "rtt_ns", "unit": "ns", "bias": "half", "path": "first"}
PROFILE = {
    "kind": "power_delay_profile",
    "columns": ["early", "late"],
    "unit": "dB",
    "edges": [0.0, 2e-8, 2e-7],
}
FEW = {"name": "auto", "options": {"starts": 8}}
PLAN = {
    "parameters": {
        MARBLE: {"bounds": planted.BOUNDS},
        "wood.relative_permittivity": {"bounds": planted.BOUNDS},
    },
    "offset": {},
    "method": FEW,
    "noise": {"constants_spread": 0, "heterogeneity": 0, "range_m": 0},
}
TRUTH = np.array([planted.TRUTH[MARBLE], planted.TRUTH["wood.relative_permittivity"]])


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    study = planted.study(tmp_path_factory.mktemp("plan"), planted.links(), **PLAN)
    return engines.make(Setup.open(study, links=links_from_frame(planted.links())))


@pytest.fixture(scope="module")
def table(engine):
    """Path loss with 2 dB of noise and an offset; delay spreads with 0.3 ns; round trips with a bias per half."""
    random = np.random.default_rng(6)
    wanted = Statistic("rms_delay_spread"), Statistic("round_trip_time", "first")
    spread, flight = engine.respond(TRUTH[None], wanted).observed[0]
    links = planted.links()
    bias = links.half.map({"west": 40.0, "east": -15.0}).to_numpy()
    return links.assign(
        path_loss_db=engine.path_loss(TRUTH[None])[0] + 3.0 + 2.0 * random.standard_normal(planted.LINKS),
        spread_ns=1e9 * spread + 0.3 * random.standard_normal(planted.LINKS),
        rtt_ns=1e9 * flight + bias + 0.5 * random.standard_normal(planted.LINKS),
    )


def run(folder, table, **sections):
    return calibrate(planted.study(folder, table, **(PLAN | sections)))


def test_delay_spreads_determine_what_path_loss_does_not(tmp_path, table, engine):
    alone = run(tmp_path, table)
    gappy = table.assign(spread_ns=table.spread_ns.where(table.index != 3))
    both = run(tmp_path, gappy, observables={"spread": SPREAD, "rtt": FLIGHT}, holdout={"where": "rx_x > 15"})
    for name, truth in zip(engine.parameters.names, TRUTH, strict=True):
        assert both.intervals[name].contains(truth)
    width = [result.intervals[MARBLE].upper - result.intervals[MARBLE].lower for result in (alone, both)]
    assert width[1] < 0.6 * width[0]
    fit = both.fit.observables["spread"]
    assert (fit.links, fit.unit) == (planted.LINKS - 4, "ns")
    assert fit.rmse < 0.5 < fit.initial_rmse
    assert fit.error == pytest.approx(0.3, rel=0.7)
    assert fit.rmse < 0.5 * fit.mean_rmse
    # The first path's delay depends on no material; its bias per device is found.
    biases = both.fit.observables["rtt"].biases
    assert biases == {"west": pytest.approx(40.0, abs=0.6), "east": pytest.approx(-15.0, abs=0.6)}
    assert both.fit.observables["rtt"].rmse < 1.0
    errors = both.fit.observables["rtt"].bias_errors
    assert {name: 0.1 < error < 0.5 for name, error in errors.items()} == {"west": True, "east": True}
    held_out = both.accuracy.observables["spread"]
    assert held_out.links == (planted.links().rx_x > 15).sum()
    residual = (both.links.spread_after_ns - both.links.spread_measured_ns)[both.links.held_out]
    assert held_out.rmse == pytest.approx(np.sqrt(np.mean(residual**2)))
    others = both.links.spread_measured_ns[~both.links.held_out].mean()
    of_mean = (others - both.links.spread_measured_ns)[both.links.held_out]
    assert held_out.mean_rmse == pytest.approx(np.sqrt(np.mean(of_mean**2)))
    assert held_out.rmse < 0.5 * min(held_out.mean_rmse, held_out.distance_rmse)
    flight = both.accuracy.observables["rtt"]
    assert flight.rmse < 1.5 < flight.mean_rmse
    assert "Observables of links held out" in render(*tables.tables(both))
    assert "spread [ns]" in render(*tables.tables(both))
    bias = both.links.groupby("half")["rtt_bias_ns"].mean().to_dict() if "half" in both.links else biases
    assert bias == pytest.approx(biases)
    picture = measured_over_modelled(both)
    assert [axes.get_title() for axes in picture.axes] == ["spread", "rtt"]
    points = picture.axes[1].collections[0].get_offsets()
    assert np.abs(points[:, 0] - points[:, 1]).max() < 3.0
    assert not any(remark.kind == RemarkKind.CONFLICT for remark in both.uncertainty.remarks)
    both.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.fit.observables == both.fit.observables
    intervals = loaded.predict_interval(planted.links())
    predicted = intervals["spread_ns"].to_numpy()
    lower, upper = intervals["spread_lower_ns"], intervals["spread_upper_ns"]
    assert ((lower < predicted) & (predicted < upper)).all()
    inside = (lower < table.spread_ns) & (table.spread_ns < upper)
    assert inside.sum() >= 10
    # Student's t with the three held-out links
    assert (upper - lower).min() >= 2 * 2.35 * held_out.rmse
    assert predicted == pytest.approx(both.links.spread_after_ns.to_numpy())
    assert predicted == pytest.approx(table.spread_ns.to_numpy(), abs=1.5)


def test_biases_take_degrees_of_freedom_from_the_interval_of_an_observable(tmp_path, table):
    """Two links per device; the delay of the first path depends on no material."""
    devices = table.assign(device=list("aabbccddeeff"))
    found = run(tmp_path, devices, observables={"rtt": FLIGHT | {"bias": "device"}})
    ends = found.predict_interval(planted.links())
    half_width = (ends.rtt_upper_ns - ends.rtt_lower_ns).to_numpy() / 2
    assert half_width == pytest.approx(stdtrit(planted.LINKS - 6, 0.95) * found.fit.observables["rtt"].error)


def test_a_conflict_is_reported_with_both_answers(tmp_path, table, engine):
    other = engine.respond(np.array([[2.0, 9.0]]), (Statistic("rms_delay_spread"),)).observed[0, 0]
    exact = engine.path_loss(TRUTH[None])[0] + 0.2 * np.random.default_rng(1).standard_normal(planted.LINKS)
    result = run(
        tmp_path,
        table.assign(path_loss_db=exact, spread_ns=1e9 * other),
        observables={"spread": SPREAD | {"std": 0.3}},
    )
    (remark,) = [remark for remark in result.uncertainty.remarks if remark.kind == RemarkKind.CONFLICT]
    assert remark.values["standard_errors"] > 4.0
    assert abs(remark.values["path_loss"][0] - 2.0) > 2.0
    assert remark.values["further"] == pytest.approx([2.0, 9.0], abs=1.0)
    assert any("require parameter values that differ by" in text for text in result.remarks)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (SPREAD | {"unit": "dB"}, "given in s or ms"),
        (SPREAD | {"path": "first"}, "applies only to a time of flight"),
        (SPREAD | {"kind": "doppler"}, "rms_delay_spread"),
        (SPREAD | {"std": 0.0}, "std"),
        (SPREAD | {"file": "multipath.csv"}, "give exactly one of column"),
        (SPREAD | {"edges": [0.0, 1e-7]}, "does not use this key"),
        (PROFILE | {"edges": [0.0, 1e-7]}, "must be 3 increasing"),
        (PROFILE | {"edges": [0.0, 2e-7, 1e-7]}, "increasing"),
        (PROFILE | {"kind": "azimuth_power_arrival"}, "does not use this key"),
        (
            {**PROFILE, "kind": "azimuth_power_arrival", "edges": [], "edges_deg": [0, 180, 400]},
            "must span at most 360",
        ),
        ({**SPREAD, "column": None, "columns": ["a", "b"]}, "has only one column"),
    ],
)
def test_impossible_observables_are_refused(tmp_path, table, section, message):
    section = {key: value for key, value in section.items() if value is not None}
    with pytest.raises(InputError, match=message):
        planted.study(tmp_path, table, observables={"spread": section})


def test_columns_and_engines_that_cannot_be_used_are_refused(tmp_path, table):
    with pytest.raises(InputError, match="no column 'nothing'"):
        run(tmp_path, table, observables={"spread": SPREAD | {"column": "nothing"}})
    with pytest.raises(
        InputError, match=r"row 5, column 'spread_ns': -3: a rms_delay_spread must be at least 0 ns"
    ):
        run(
            tmp_path,
            table.assign(spread_ns=np.where(table.index == 3, -3.0, table.spread_ns)),
            observables={"spread": SPREAD},
        )
    with pytest.raises(InputError, match="two or more calibration links"):
        run(tmp_path, table.assign(spread_ns=np.nan), observables={"spread": SPREAD})
    held_out = table.assign(spread_ns=table.spread_ns.where(table.rx_x > 15))
    with pytest.raises(InputError, match="values for two or more calibration links, but has 0"):
        run(tmp_path, held_out, observables={"spread": SPREAD}, holdout={"where": "rx_x > 15"})


def test_blocks_held_out_in_turn_judge_every_observable(tmp_path, table, engine):
    study = planted.study(tmp_path, table, **(PLAN | {"observables": {"spread": SPREAD, "rtt": FLIGHT}}))
    problem = estimate_noise(Problem.of(Setup.open(study), engine))
    known = {Model.CALIBRATED: problem.parameters.to_search(TRUTH[None])}
    validation = validate_problem(problem, 4, known_minima=known)
    spread, flight = (validation.observables[name] for name in ("spread", "rtt"))
    assert (spread.links, spread.unit) == (planted.LINKS, "ns")
    assert spread.rmse < 0.7 * min(spread.mean_rmse, spread.distance_rmse)
    assert flight.rmse < 0.5 * flight.mean_rmse
    assert "spread [ns]" in repr(validation)
    assert validation.content()["observables"]["rtt"]["rmse"] == flight.rmse


def test_every_bin_of_a_profile_is_an_observable(tmp_path, table, engine):
    """Measured are the shares of power of the paths, which the dynamic range limits as it limits the model."""
    paths, links = engine.paths, planted.LINKS
    power = np.abs(path_gains(paths, engine.parameters.materials(TRUTH, paths.materials))) ** 2
    first = np.array([paths.delay[paths.link == link].min() for link in range(links)])
    late = paths.delay - first[paths.link] >= 2e-8
    share = np.bincount(paths.link[late], power[late], links) / np.bincount(paths.link, power, links)
    early, late = 10 * np.log10(1 - share), 10 * np.log10(np.maximum(share, 1e-6))
    assert (late < -10.0).any()
    measured = table.assign(early=early, late=late)
    study = planted.study(tmp_path, measured, **(PLAN | {"observables": {"profile": PROFILE}}))
    assert list(study.observables) == ["profile_1", "profile_2"]
    assert Study.from_content(study.content(), study.path).observables == study.observables
    problem = Problem.of(Setup.open(study), engine)
    at_truth = problem.evaluate(problem.parameters.to_search(TRUTH[None]))
    assert np.abs(at_truth.residuals[0, -2 * planted.LINKS :]).max() < 1e-6
    assert early.std() > 0.3


def test_a_single_column_may_be_in_a_list(tmp_path, table):
    sections = {
        "late": {**PROFILE, "columns": ["late"], "edges": [2e-8, 2e-7]},
        "spread": {"kind": "rms_delay_spread", "columns": ["spread_ns"], "unit": "ns"},
    }
    study = planted.study(tmp_path, table, **(PLAN | {"observables": sections}))
    assert [section.column for section in study.observables.values()] == ["late", "spread_ns"]
    assert Study.from_content(study.content(), study.path).observables == study.observables


def test_values_are_computed_from_a_file_of_components(tmp_path, table, engine):
    """The paths themselves as components: no residual is left at the truth, but that of the smooth limit."""
    paths = engine.paths
    gains = path_gains(paths, engine.parameters.materials(TRUTH, paths.materials))
    components = {
        "name": paths.link,
        "delay_ns": 1e9 * paths.delay,
        "path_gain_db": 20 * np.log10(np.abs(gains)),
    }
    pd.DataFrame(components).to_csv(tmp_path / "multipath.csv", index=False)
    section = {
        "kind": "rms_delay_spread",
        "file": "multipath.csv",
        "id": "name",
        "unit": "ns",
        "floor_db": -100.0,
    }
    study = planted.study(
        tmp_path, table.assign(name=np.arange(len(table))), **(PLAN | {"observables": {"spread": section}})
    )
    assert tmp_path / "multipath.csv" in study.files()
    problem = Problem.of(Setup.open(study), engine)
    (each,) = problem.observed
    expected = engine.respond(TRUTH[None], (each.statistic,)).observed[0, 0]
    assert each.measured == pytest.approx(1e9 * expected, abs=0.05 * each.measured.max())
    section["where"] = "half == 'west'"
    study = planted.study(
        tmp_path, table.assign(name=np.arange(len(table))), **(PLAN | {"observables": {"spread": section}})
    )
    (part,) = Problem.of(Setup.open(study), engine).observed
    np.testing.assert_array_equal(np.isfinite(part.measured), table.half == "west")
    (tmp_path / "multipath.csv").unlink()
    with pytest.raises(InputError, match=r"multipath\.csv"):
        Problem.of(Setup.open(study), engine)


def test_the_filter_of_an_observable_is_applied_before_rows_are_merged(tmp_path, table, engine):
    other = table.assign(spread_ns=1e6, state="NLOS")
    rows = pd.concat([other, table.assign(state="LOS")], ignore_index=True)
    section = SPREAD | {"where": "state == 'LOS'"}
    study = planted.study(tmp_path, rows, **(PLAN | {"observables": {"spread": section}}))
    (each,) = Problem.of(Setup.open(study), engine).observed
    assert each.measured == pytest.approx(table.spread_ns)


def test_a_number_for_a_missing_time_of_flight_is_no_time(tmp_path, table):
    rtt_ns = table.rtt_ns.where(table.index != 3, -200.0)
    study = planted.study(tmp_path, table.assign(rtt_ns=rtt_ns), **(PLAN | {"observables": {"rtt": FLIGHT}}))
    links = study.measurements()
    assert np.flatnonzero(links.frame["rtt_ns"].isna()).tolist() == [3]
    assert links.prepared == {"codes for missing values in rtt_ns (-200)": 1}


def test_averages_have_means_of_a_column_and_stay_apart_by_the_labels_of_a_file(tmp_path, table):
    links = planted.content("links.csv")["links"] | {"average": "place"}
    twice = pd.concat([table.assign(name="a"), table.assign(spread_ns=table.spread_ns + 2.0, name="b")])
    observables = {"spread": SPREAD}
    study = planted.study(tmp_path, twice, **(PLAN | {"links": links, "observables": observables}))
    averages = study.measurements()
    assert averages.frame["spread_ns"].tolist() == pytest.approx((table.spread_ns + 1.0).tolist())
    observables = {"spread": {"kind": "rms_delay_spread", "file": "links.csv", "id": "name", "unit": "ns"}}
    study = planted.study(tmp_path, twice, **(PLAN | {"links": links, "observables": observables}))
    assert len(study.measurements()) == 2 * planted.LINKS


def test_a_calibration_that_does_not_fit_from_link_to_link_is_a_conflict(tmp_path, table, engine):
    """Spreads that are small where the model's are large belong to other links."""

    def remarks(measured):
        study = planted.study(tmp_path, measured, **(PLAN | {"observables": {"spread": SPREAD}}))
        problem = estimate_noise(Problem.of(Setup.open(study), engine))
        return conflict(problem, problem.parameters.to_search(TRUTH[None]))

    assert remarks(table) == ()
    foreign = table.assign(spread_ns=2 * table.spread_ns.mean() - table.spread_ns)
    (remark,) = [remark for remark in remarks(foreign) if "slope" in remark.values]
    assert remark.values["slope"] + 2 * remark.values["slope_error"] < 1.0
    assert "from link to link" in wording.remark_text(remark)


def test_a_link_without_a_path_does_not_change_biases_and_errors(tmp_path):
    """Its path loss counts with a ceiling; its round trip is measured, but the model has no value for it."""
    engine = planted.engine(blocked=True)
    truth = np.array([planted.TRUTH[name] for name in engine.parameters.names])[None]
    answer = engine.respond(truth, (Statistic("round_trip_time"),))
    flight, reached = answer.observed[0, 0], np.isfinite(answer.path_loss[0])
    noise_ns = np.random.default_rng(5).standard_normal(planted.LINKS)
    table = planted.links(blocked=True).assign(
        path_loss_db=np.where(reached, answer.path_loss[0], 120.0),
        rtt_ns=40.0 + noise_ns + np.where(reached, 1e9 * flight, 700.0),
    )
    study = planted.study(
        tmp_path,
        table,
        objective={"no_path": "censor", "ceiling_db": 120.0},
        observables={"rtt": {"kind": "round_trip_time", "column": "rtt_ns", "unit": "ns", "bias": "all"}},
    )
    problem = Problem.of(Setup.open(study), engine)
    weight, (rtt,) = problem.objective.weight, problem.observed
    assert (weight > 0).all()
    assert np.count_nonzero(~reached) == 1
    residuals, biases = rtt.residuals(answer.observed[:, 0], weight)
    assert biases == pytest.approx(40.0 + noise_ns[reached].mean())
    assert residuals[0, ~reached] == 0
    (estimated,) = with_errors(problem.observed, answer.observed[0], weight)
    assert estimated.std == pytest.approx(np.std(noise_ns[reached], ddof=1))
    # Derivatives away from the truth are those of the residuals.
    point = problem.parameters.to_search(truth + np.array([0.5, -1.0, 0.7]))
    assert problem.evaluate(point, derivatives=True).slopes[0] == pytest.approx(
        np.stack([central(problem, point, index) for index in range(point.shape[1])], axis=1), abs=1e-5
    )


def central(problem, point, index):
    step = 1e-5 * np.eye(point.shape[1])[index]
    above, below = problem.evaluate(np.concatenate([point + step, point - step])).residuals
    return (above - below) / 2e-5
