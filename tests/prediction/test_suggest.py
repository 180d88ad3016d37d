"""Suggestions for a calibration of a flat ground with two rays per link, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import calibray as cb
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.engines.kinds.replay import replay
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements.observables import Statistic
from calibray.prediction import suggestion
from calibray.prediction.batches import predict_links
from calibray.prediction.predict import as_links, open_for_links
from calibray.scenes import read_scene
from calibray.study import Study
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.uncertainty.residual_correlation import Correlation
from changed import changed
from link_tables import links_from_frame
from small_scenes import write_scene
from two_ray import TwoRay

FREQUENCY, TRUTH, NAME = 3.5e9, 6.3, "ground.relative_permittivity"
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
GROUND = (
    '<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="3.0"/>'
    '<float name="conductivity" value="0.5"/><float name="thickness" value="1.0"/></bsdf>'
)


def links_at(distance: np.ndarray) -> pd.DataFrame:
    """Links of given lengths [m] from a mast of 10 m, all at one site."""
    count = len(distance)
    rx = np.stack([distance, np.zeros(count), np.full(count, 1.5)], axis=1)
    return pd.DataFrame(np.hstack([np.tile([0.0, 0.0, 10.0], (count, 1)), rx]), columns=COLUMNS).assign(
        site="a"
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory):
    """A noisy campaign over a flat ground, calibrated into `out`; a two-ray model replaces Sionna."""
    folder = tmp_path_factory.mktemp("suggest")
    corners = [(-300.0, -300.0, 0.0), (300.0, -300.0, 0.0), (300.0, 300.0, 0.0), (-300.0, 300.0, 0.0)]
    file, antenna = write_scene(folder, {"floor": [corners]}, GROUND, "mat-ground"), Antenna("dipole")
    truth = {"ground": {"relative_permittivity": TRUTH, "conductivity": 0.5, "thickness": 1.0}}
    tracer = TwoRay(read_scene(file, FREQUENCY, truth), FREQUENCY, TraceSettings(), antenna, antenna)
    table = links_at(np.geomspace(40, 150, 14))
    loss = path_loss(tracer.trace(links_from_frame(table)), combining="coherent")
    loss = loss + 0.5 * np.random.default_rng(4).standard_normal(len(loss))
    table.assign(path_loss_db=loss).to_csv(folder / "links.csv", index=False, float_format="%.17g")
    links_at(np.geomspace(3, 290, 25)).to_csv(folder / "candidates.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", str(folder / "cache"))
        patch.setattr("calibray.tracing.SionnaFactory.versions", {"two-ray": "1"})
        patch.setattr("calibray.tracing.SionnaFactory.__call__", lambda _, *arguments: TwoRay(*arguments))
        cb.calibrate(study(folder), out=folder / "out")
        yield folder


def study(folder: Path) -> Study:
    dipole = {"pattern": "dipole", "polarization": "V"}
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": FREQUENCY},
        "links": {"file": "links.csv", "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db"},
        "antennas": {"tx": dipole, "rx": dipole},
        "objective": {"combining": "coherent"},
        "offset": {"per": "site"},
        "parameters": {NAME: {"bounds": [1.5, 15.0]}},
        "noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0},
    }
    return Study.from_content(content, folder / "study.toml")


@pytest.fixture
def result(folder: Path) -> Result:
    return Result.load(folder / "out")


@pytest.fixture
def table(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "candidates.csv")


def test_the_first_suggestion_has_the_largest_slope(result, table):
    """Reference: one parameter and one offset, linear around the optimum."""
    suggestions = cb.suggest(result, table, 1)
    slope = np.abs(_slope(result, table) - _slope(result, result.links.assign(site="a")).mean())
    assert slope[table.rx_x == suggestions.rx_x[0]] > 0.9 * np.sort(slope)[-3]


def test_every_stage_of_a_suggestion_is_announced(result, table):
    stages = []
    cb.suggest(result, table, 1, lambda stage, *_: stages.append(stage))
    announced = [stage for stage in dict.fromkeys(stages) if stage != "tracing"]
    assert announced == [
        "reading scene and links", "evaluating draws", "evaluating candidates", "choosing candidates"
    ]  # fmt: skip


def test_a_promised_width_keeps_how_much_other_buildings_differ(result, table):
    """The draws are of the measured buildings; what the interval of all buildings has besides is not narrowed."""
    plain = cb.suggest(result, table, 3)[f"{NAME}_width"].to_numpy()
    interval = result.intervals[NAME]
    assert (plain < interval.upper - interval.lower).all()
    wide = replace(
        interval,
        lower=interval.lower - 1.0,
        upper=interval.upper + 1.0,
        seen=((interval.lower, interval.upper),),
    )
    promised = cb.suggest(changed(result, intervals={NAME: wide}), table, 3)[f"{NAME}_width"].to_numpy()
    seen, every = interval.upper - interval.lower, wide.upper - wide.lower
    assert promised == pytest.approx(np.sqrt(every**2 - seen**2 + plain**2))


def test_devices_of_a_random_effect_that_do_not_differ_promise_the_same(folder, table):
    """The spread between groups is the estimated one, here nearly none, so a new device says as much as a known one."""
    content = study(folder).content()
    rows = pd.read_csv(folder / "links.csv").assign(site=list("abcdefg") * 2)
    rows.to_csv(folder / "devices.csv", index=False, float_format="%.17g")
    content["links"]["file"] = "devices.csv"
    del content["offset"]
    content["nuisance"] = {"device": {"by": "constant", "per": "site", "prior": "auto"}}
    found = cb.calibrate(Study.from_content(content, folder / "devices.toml"))
    before = found.intervals[NAME].upper - found.intervals[NAME].lower
    known, new = (
        before - cb.suggest(found, table.assign(site=site), 1)[f"{NAME}_width"][0] for site in ("a", "new")
    )
    assert known > 0.04 * before
    assert new == pytest.approx(known, rel=0.2)


def test_a_further_link_is_not_expected_to_have_the_error_of_a_few_exact_ones(folder, table):
    content = study(folder).content()
    rows = pd.read_csv(folder / "links.csv").assign(std=np.append([1e-3, 1e-3], np.full(12, 0.5)))
    rows.to_csv(folder / "exact.csv", index=False, float_format="%.17g")
    content["links"] |= {"file": "exact.csv", "std": "std"}
    found = cb.calibrate(Study.from_content(content, folder / "exact.toml"))
    before = found.intervals[NAME].upper - found.intervals[NAME].lower
    assert cb.suggest(found, table, 1)[f"{NAME}_width"][0] > 0.5 * before


def test_errors_that_the_study_states_as_independent_are_so(result, table, monkeypatch):
    """Also if the residuals of neighbouring links are alike."""
    assert result.study.noise.range_m == 0
    plain = cb.suggest(result, table, 3)
    alike = Correlation(range_m=100.0, shared_db=0.5, own_db=0.01, log_likelihood=9.0, independent=0.0)
    monkeypatch.setattr(suggestion, "shared_errors", lambda *_: alike)
    pd.testing.assert_frame_equal(cb.suggest(result, table, 3), plain)
    content = result.study.content()
    del content["noise"]["range_m"]
    unstated = replace(result, study=Study.from_content(content, result.study.path))
    assert not cb.suggest(unstated, table, 3).equals(plain)


def test_constants_of_the_scene_take_no_degrees_of_freedom(folder, table):
    """Four links, a parameter, an offset, and two constants that vary in the draws."""
    content = study(folder).content()
    pd.read_csv(folder / "links.csv")[::4].to_csv(folder / "few.csv", index=False, float_format="%.17g")
    content["links"]["file"] = "few.csv"
    del content["noise"]
    found = cb.calibrate(Study.from_content(content, folder / "few.toml"))
    assert {*found.uncertainty.constants_db} >= {"ground.conductivity", "ground.scattering_coefficient"}
    interval, suggested = found.intervals[NAME], cb.suggest(found, table, 1)
    assert 0 < suggested[f"{NAME}_width"][0] < interval.upper - interval.lower


def test_links_that_the_calibration_left_out_near_the_noise_floor_have_no_influence(result, table, folder):
    faint = np.arange(len(result.links)) % 2 == 1
    marked = replace(result, links=result.links.assign(faint=faint))
    content, rows = result.study.content(), pd.read_csv(folder / "links.csv")
    rows["path_loss_db"] += np.where(faint, 30.0, 0.0)
    rows.to_csv(folder / "wrong.csv", index=False, float_format="%.17g")
    content["links"]["file"] = str(folder / "wrong.csv")
    wrong = replace(marked, study=Study.from_content(content, result.study.path))
    one, other = (cb.suggest(each, table, 2, allow_changed_inputs=True) for each in (marked, wrong))
    pd.testing.assert_frame_equal(one, other)


def _slope(result: Result, links: pd.DataFrame) -> np.ndarray:
    """Derivative of path loss with respect to the permittivity, by central differences [dB]."""
    loss = [_predicted(result, links, result.parameters[NAME] * factor) for factor in (0.99, 1.01)]
    return (loss[1] - loss[0]) / (0.02 * result.parameters[NAME])


def _predicted(result: Result, links: pd.DataFrame, value: float) -> np.ndarray:
    """Path loss of links for another permittivity, with the result's offset."""
    ground = replace(result.materials["ground"], relative_permittivity=value)
    return changed(result, materials={"ground": ground}, parameters={NAME: value}).predict(
        links[[*COLUMNS, "site"]]
    )


def test_intervals_are_expected_to_narrow_with_every_suggestion(result, table):
    interval, width = result.intervals[NAME], cb.suggest(result, table, 6)[f"{NAME}_width"].to_numpy()
    assert width[-1] < 0.9 * (interval.upper - interval.lower)
    assert (np.diff(width) < 1e-9).all()


def test_measured_suggestions_narrow_the_interval_as_expected(folder, result, table):
    suggestions = cb.suggest(result, table, 4)
    chosen = table[table.rx_x.isin(suggestions.rx_x)]
    scene = read_scene(folder / "scene.xml", FREQUENCY, {"ground": {"relative_permittivity": TRUTH}})
    antenna = Antenna("dipole")
    tracer = TwoRay(scene, FREQUENCY, TraceSettings(), antenna, antenna)
    loss = path_loss(tracer.trace(links_from_frame(chosen)), combining="coherent")
    measured = pd.read_csv(folder / "links.csv")
    widths = []
    for seed in range(3):
        noise = 0.5 * np.random.default_rng([9, seed]).standard_normal(len(loss))
        more = pd.concat([measured, chosen.assign(path_loss_db=loss + noise)])
        more.to_csv(folder / "more.csv", index=False, float_format="%.17g")
        content = study(folder).content()
        content["links"] = {**content["links"], "file": "more.csv"}
        interval = cb.calibrate(Study.from_content(content, folder / "study.toml")).intervals[NAME]
        widths.append(interval.upper - interval.lower)
    # The expectation assumes independent Gaussian errors; the intervals average over other noise models as well.
    assert np.mean(widths) == pytest.approx(suggestions[f"{NAME}_width"].iloc[-1], rel=0.5)


def test_a_new_site_gains_little(result, table):
    """The first measurement there determines the offset of the site."""
    measured, new = (cb.suggest(result, table.assign(site=site), 2)[f"{NAME}_width"] for site in ("a", "b"))
    interval = result.intervals[NAME]
    assert new[0] > 0.97 * (interval.upper - interval.lower) > measured[0]
    assert new[1] < new[0]


def test_an_observable_is_worth_more_where_path_loss_says_nothing(result, table):
    """At a new site, any number of copies of one link determine the offset alone: n observables add n times one."""
    copies = pd.concat([table.iloc[[8]]] * 10).assign(site="new")
    at_optimum = changed(result, draws={NAME: [result.parameters[NAME]] * 64})
    gains = cb.suggest(at_optimum, copies, 10, observables=True).observable_gain
    narrowed = gains.str.extract(r" to (\S+) of its width")[0].astype(float).to_numpy()
    added = 1 / narrowed[0] ** 2 - 1
    # The text has two digits.
    assert narrowed == pytest.approx(1 / np.sqrt(1 + np.arange(1, 11) * added), rel=0.05)


def test_an_observable_whose_error_is_estimated_counts_as_if_it_was_stated(folder, table):
    rows, rng = pd.read_csv(folder / "links.csv"), np.random.default_rng(1)
    content = study(folder).content()
    content["observables"] = {"spread": {"kind": "rms_delay_spread", "column": "spread_ns", "unit": "ns"}}
    content["links"]["file"] = "spreads.csv"
    rows.assign(spread_ns=1.0).to_csv(folder / "spreads.csv", index=False, float_format="%.17g")
    setup = cb.Setup.open(Study.from_content(content, folder / "spreads.toml"))
    answer = replay(setup, setup.trace()).respond(np.array([[TRUTH]]), (Statistic("rms_delay_spread"),))
    spread = answer.observed[0, 0] * 1e9 * np.exp(0.02 * rng.standard_normal(len(rows)))
    rows.assign(spread_ns=spread).to_csv(folder / "spreads.csv", index=False, float_format="%.17g")
    found = cb.calibrate(Study.from_content(content, folder / "spreads.toml"))
    content["observables"]["spread"]["std"] = found.fit.observables["spread"].error
    stated = replace(found, study=Study.from_content(content, folder / "spreads.toml"))
    one, other = (cb.suggest(each, table, 3, observables=True) for each in (found, stated))
    pd.testing.assert_frame_equal(one, other)


def test_the_command_prints_and_writes_the_suggestions(folder, result, table):
    command = ["suggest", str(folder / "out"), str(folder / "candidates.csv"), "--count", "3"]
    run = CliRunner().invoke(app, [*command, "--json", "--out", str(folder / "next.csv")])
    assert run.exit_code == 0, run.output
    written, suggestions = pd.read_csv(folder / "next.csv"), cb.suggest(result, table, 3)
    assert written.rx_x.tolist() == suggestions.rx_x.tolist()
    assert [row["rx_x"] for row in json.loads(run.stdout)] == pytest.approx(suggestions.rx_x.tolist())
    assert "`calibray predict`, which uses the model 'calibrated', may give other values" in run.stderr
    printed = CliRunner().invoke(app, [*command, "--observables"]).stdout
    assert "Where to measure next" in printed
    assert "Further observables to measure there" in printed
    assert " of its width" in printed
    assert "(now " in printed


def test_impossible_suggestions_are_refused(result, table):
    with pytest.raises(InputError, match="count = 0"):
        cb.suggest(result, table, 0)
    with pytest.raises(InputError, match="has no draws from the posterior"):
        cb.suggest(changed(result, draws={}), table)
    with pytest.raises(InputError, match="tx_x"):
        cb.suggest(result, table.drop(columns="tx_x"))
    with pytest.raises(InputError, match="changed since the calibration"):
        cb.suggest(changed(result, files={name: "0" * 64 for name in result.provenance.files}), table)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.iloc[:-1],
        lambda t: t.assign(path_loss_db=t.path_loss_db + 0.1),
        lambda t: t.assign(rx_x=t.rx_x + 0.1),
    ],
)
def test_links_that_changed_since_the_calibration_are_refused(folder, result, table, change):
    """The draws are those of the old links."""
    file = folder / "links.csv"
    before = file.read_text()
    try:
        change(pd.read_csv(file)).to_csv(file, index=False)
        with pytest.raises(InputError, match=r"links\.csv: the links changed since the calibration"):
            cb.suggest(result, table)
        if len(pd.read_csv(file)) < len(result.links):
            with pytest.raises(InputError, match="has 13 links, but 14 were calibrated"):
                cb.suggest(result, table, allow_changed_inputs=True)
    finally:
        file.write_text(before)


def test_fewer_candidates_than_requested_are_counted_in_a_warning(result, table, caplog):
    assert len(cb.suggest(result, table.iloc[:2], 2)) == 2
    assert "suggestions instead" not in caplog.text
    assert len(cb.suggest(result, table.iloc[:2], 10)) == 2
    assert (
        "fewer suggestions (2) than requested (10): only 2 of 2 candidates have a path and enough power"
        in caplog.text
    )


@pytest.mark.parametrize("above_db", [1.0, 6.0])
def test_candidates_as_near_the_noise_floor_as_the_calibration_leaves_out_are_left_out(
    folder, result, table, caplog, above_db
):
    """Eight errors above the floor, or as near as the weakest link of a calibration that uses nearer links."""
    measured = pd.read_csv(folder / "links.csv")
    measured.assign(rsrp_dbm=-measured.path_loss_db).to_csv(folder / "powers.csv", index=False)
    floor = -float(result.links.after_db.max()) - above_db
    content = study(folder).content()
    content["links"] |= {
        "file": "powers.csv",
        "value": "rsrp_dbm",
        "quantity": "rsrp",
        "noise_floor_dbm": floor,
    }
    powers = changed(result, study=Study.from_content(content, folder / "powers.toml"))
    every = cb.suggest(result, table, len(table))
    margin = min(8 * result.rmse_db * np.sqrt(14 / 12), above_db)
    weak = every.path_loss_db >= -floor - margin
    assert (every.path_loss_db >= -floor).sum() < weak.sum() < len(table)
    assert set(cb.suggest(powers, table, len(table)).row) == set(every.row[~weak])
    reason = f"less than {margin:.1f} dB above links.noise_floor_dbm = {floor:g}, and the calibration uses no"
    assert f"{weak.sum()} of 25 candidates left out, because the predicted power is {reason}" in caplog.text
    with pytest.raises(
        InputError, match=rf"all {weak.sum()} candidates .* is less than {margin:.1f} dB above"
    ):
        cb.suggest(powers, table[table.rx_x.isin(every.rx_x[weak])])
    content["links"]["below_floor"] = "censor"
    censored = changed(result, study=Study.from_content(content, folder / "powers.toml"))
    weak = every.path_loss_db >= -floor
    assert set(cb.suggest(censored, table, len(table)).row) == set(every.row[~weak])


def test_where_two_ranges_fit_the_first_suggestion_distinguishes_them(result, table):
    """Three of 128 draws lie in the second range; another point would narrow the first range more."""
    values = np.where(np.arange(128) % 50 == 1, 14.0, np.linspace(3.0, 9.0, 128))
    interval = replace(result.intervals[NAME], lower=3.0, upper=14.1, pieces=((3.0, 9.0), (13.9, 14.1)))
    two = changed(result, rmse_db=1.0, draws={NAME: values.tolist()}, intervals={NAME: interval})
    one = changed(two, intervals={NAME: replace(interval, pieces=((3.0, 14.1),))})
    loss = [
        _predicted(result, links, value)
        for links in (table, result.links.assign(site="a"))
        for value in (6.0, 14.0)
    ]
    difference = np.abs(loss[1] - loss[0] - (loss[3] - loss[2]).mean())
    for_two, for_one = cb.suggest(two, table, 1), cb.suggest(one, table, 1)
    assert difference[table.rx_x == for_two.rx_x[0]] == difference.max()
    assert difference[table.rx_x == for_one.rx_x[0]] < difference.max()
    assert for_two[f"{NAME}_sure"][0] < 1
    assert f"{NAME}_sure" not in for_one
    even = np.where(np.arange(128) % 2 == 1, 14.0, values)
    gain = cb.suggest(changed(two, draws={NAME: even.tolist()}), table, 1).gain[0]
    assert f"right range of {NAME} known with" in gain


def test_fitted_heights_are_traced_at_their_values(folder, result, table):
    """Interpolated from the stated height, path loss would differ from that of a prediction."""
    height, name = 1.7, "tx:*.height"
    content = study(folder).content()
    content["objective"] = {"combining": "power"}
    content["parameters"] = {**content["parameters"], name: {"bounds": [-4.0, 4.0]}}
    values = {NAME: result.parameters[NAME], name: height}
    placed = changed(
        result,
        study=Study.from_content(content, folder / "heights.toml"),
        parameters=values,
        draws={key: [value] * 64 for key, value in values.items()},
    )
    suggested = cb.suggest(placed, table, len(table)).set_index("row").path_loss_db.sort_index()
    # The offset of this fit is another one.
    assert np.ptp(suggested.to_numpy() - placed.predict(table)) < 1e-6


def test_the_scene_is_loaded_once_for_all_links(result, table, monkeypatch):
    loaded = []

    def load(_, *arguments):
        loaded.append(arguments)
        return TwoRay(*arguments)

    monkeypatch.setattr("calibray.tracing.SionnaFactory.__call__", load)
    monkeypatch.setenv("CALIBRAY_CACHE", "")
    result.suggest(table, 1)
    assert len(loaded) == 1
    setup = open_for_links(result, as_links(result, table))
    for part in (table[:5], table[5:10]):
        setup = setup.at(as_links(result, part))
        predict_links(result, setup, 0.9)
    assert len(loaded) == 2
