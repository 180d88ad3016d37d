"""Where to measure next, of a whole calibration: a flat ground seen by two rays, and the command."""

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
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements import links_from_frame
from calibray.scenes import read_scene
from calibray.study import Study
from calibray.tracing.settings import Antenna, TraceSettings
from changed import changed
from small_scenes import write_scene
from two_ray import TwoRay

FREQUENCY, TRUTH, NAME = 3.5e9, 6.3, "ground.relative_permittivity"
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
GROUND = (
    '<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="3.0"/>'
    '<float name="conductivity" value="0.5"/><float name="thickness" value="1.0"/></bsdf>'
)


def places(distance: np.ndarray) -> pd.DataFrame:
    """Links of some lengths from a mast of 10 m, all at one site."""
    count = len(distance)
    rx = np.stack([distance, np.zeros(count), np.full(count, 1.5)], axis=1)
    return pd.DataFrame(np.hstack([np.tile([0.0, 0.0, 10.0], (count, 1)), rx]), columns=COLUMNS).assign(
        site="a"
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory):
    """A noisy campaign over a flat ground, calibrated into `out`; wherever Sionna would trace, two rays are."""
    folder = tmp_path_factory.mktemp("suggest")
    corners = [(-300.0, -300.0, 0.0), (300.0, -300.0, 0.0), (300.0, 300.0, 0.0), (-300.0, 300.0, 0.0)]
    file, antenna = write_scene(folder, {"floor": [corners]}, GROUND, "mat-ground"), Antenna("dipole")
    truth = {"ground": {"relative_permittivity": TRUTH, "conductivity": 0.5, "thickness": 1.0}}
    tracer = TwoRay(read_scene(file, FREQUENCY, truth), FREQUENCY, TraceSettings(), antenna, antenna)
    table = places(np.geomspace(40, 150, 14))
    loss = path_loss(tracer.trace(links_from_frame(table)), combining="coherent")
    loss = loss + 0.5 * np.random.default_rng(4).standard_normal(len(loss))
    table.assign(path_loss_db=loss).to_csv(folder / "links.csv", index=False, float_format="%.17g")
    places(np.geomspace(3, 290, 25)).to_csv(folder / "candidates.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", str(folder / "cache"))
        patch.setattr("calibray.tracing.default_tracer.SionnaFactory.versions", {"two-ray": "1"})
        patch.setattr(
            "calibray.tracing.default_tracer.SionnaFactory.__call__", lambda _, *given: TwoRay(*given)
        )
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
    }
    return Study.from_content(content, folder / "study.toml")


@pytest.fixture
def result(folder: Path) -> Result:
    return Result.load(folder / "out")


@pytest.fixture
def table(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "candidates.csv")


def test_the_first_point_is_the_one_that_a_measurement_there_tells_most(result, table):
    """Against the textbook: one parameter and one offset, linear around the optimum."""
    found = cb.suggest(result, table, 1)
    told = np.abs(_slope(result, table) - _slope(result, result.links.assign(site="a")).mean())
    assert told[table.rx_x == found.rx_x[0]] > 0.9 * np.sort(told)[-3]


def _slope(result: Result, links: pd.DataFrame) -> np.ndarray:
    """Change of path loss by the permittivity, from predictions of results that differ in it."""
    loss = [_predicted(result, links, result.parameters[NAME] * factor) for factor in (0.99, 1.01)]
    return (loss[1] - loss[0]) / (0.02 * result.parameters[NAME])


def _predicted(result: Result, links: pd.DataFrame, value: float) -> np.ndarray:
    """Path loss of links for another permittivity, with the result's offset."""
    ground = changed(result.materials["ground"], relative_permittivity=value)
    return changed(result, materials={"ground": ground}).predict(links[[*COLUMNS, "site"]])


def test_intervals_are_expected_to_narrow_with_every_point(result, table):
    interval, width = result.intervals[NAME], cb.suggest(result, table, 6)[f"{NAME}_width"].to_numpy()
    assert width[-1] < 0.9 * (interval.upper - interval.lower)
    assert (np.diff(width) < 1e-9).all()


def test_what_is_expected_comes_about(folder, result, table):
    """Measured there in truth, the intervals become about as narrow as was said."""
    found = cb.suggest(result, table, 4)
    chosen = table[table.rx_x.isin(found.rx_x)]
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
    # What is expected takes errors for independent and Gaussian, the intervals average over other kinds as well.
    assert np.mean(widths) == pytest.approx(found[f"{NAME}_width"].iloc[-1], rel=0.5)


def test_a_site_never_measured_tells_little(result, table):
    """Its offset is anybody's guess, which the first point there goes to."""
    known, strange = (cb.suggest(result, table.assign(site=site), 2)[f"{NAME}_width"] for site in ("a", "b"))
    interval = result.intervals[NAME]
    assert strange[0] > 0.97 * (interval.upper - interval.lower) > known[0]
    assert strange[1] < strange[0]


def test_the_command_prints_and_writes_what_the_function_finds(folder, result, table):
    command = ["suggest", str(folder / "out"), str(folder / "candidates.csv"), "--count", "3"]
    told = CliRunner().invoke(app, [*command, "--json", "--out", str(folder / "next.csv")])
    assert told.exit_code == 0, told.output
    written, found = pd.read_csv(folder / "next.csv"), cb.suggest(result, table, 3)
    assert written.rx_x.tolist() == found.rx_x.tolist()
    assert [each["rx_x"] for each in json.loads(told.stdout)] == pytest.approx(found.rx_x.tolist())
    shown = CliRunner().invoke(app, command).stdout
    assert "Where to measure next" in shown
    assert "(now " in shown


def test_what_cannot_be_suggested_is_refused(result, table):
    with pytest.raises(InputError, match="count = 0"):
        cb.suggest(result, table, 0)
    with pytest.raises(InputError, match="kept no draws"):
        cb.suggest(changed(result, draws={}), table)
    with pytest.raises(InputError, match="tx_x"):
        cb.suggest(result, table.drop(columns="tx_x"))
    with pytest.raises(InputError, match="changed since the calibration"):
        cb.suggest(changed(result, files={name: "0" * 64 for name in result.provenance.files}), table)


def test_where_two_ranges_fit_the_first_point_tells_them_apart(result, table):
    """Of 128 draws three lie in the second range; to narrow the first, another place would come before."""
    values = np.where(np.arange(128) % 50 == 1, 14.0, np.linspace(3.0, 9.0, 128))
    interval = changed(result.intervals[NAME], lower=3.0, upper=14.1, pieces=((3.0, 9.0), (13.9, 14.1)))
    two = changed(result, rmse_db=1.0, draws={NAME: values.tolist()}, intervals={NAME: interval})
    one = changed(two, intervals={NAME: replace(interval, pieces=((3.0, 14.1),))})
    loss = [
        _predicted(result, links, value)
        for links in (table, result.links.assign(site="a"))
        for value in (6.0, 14.0)
    ]
    apart = np.abs(loss[1] - loss[0] - (loss[3] - loss[2]).mean())
    told, alone = cb.suggest(two, table, 1), cb.suggest(one, table, 1)
    assert apart[table.rx_x == told.rx_x[0]] == apart.max()
    assert apart[table.rx_x == alone.rx_x[0]] < apart.max()
    assert told[f"{NAME}_sure"][0] < 1
    assert f"{NAME}_sure" not in alone
    even = np.where(np.arange(128) % 2 == 1, 14.0, values)
    gain = cb.suggest(changed(two, draws={NAME: even.tolist()}), table, 1).gain[0]
    assert f"{NAME}'s right range known with" in gain
