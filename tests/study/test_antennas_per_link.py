"""Studies whose links differ in antenna, direction and power: from tables of transmitters to predictions."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray import engines
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements import SourceTable
from calibray.prediction.coverage_map import _column_values
from calibray.prediction.predict import as_links
from calibray.reporting.trust_figures import residuals_by_direction
from calibray.result.verdict import RemarkKind
from calibray.result.wording import remark_text
from calibray.study import Setup, Study
from calibray.study.mounting import largest_gain_dbi
from calibray.study.setup import input_digests
from calibray.tracing.antennas import AntennaPattern, stated_jones
from calibray.tracing.settings import Antenna
from link_tables import links_from_frame
from two_ray import COLUMNS, TRUTH, TwoRay

SITES = pd.DataFrame(
    {
        "transmitter": ["north", "east", "omni"],
        "site_x": [0.0, 0.0, 40.0],
        "antenna": ["sector", "sector", "rod"],
        "bearing": [0.0, 90.0, 0.0],
        "tilt": [4.0, 6.0, 0.0],
        "remote_tilt": [0.0, 3.0, 0.0],
        "eirp": [55.0, 53.0, 40.0],
    }
)
TYPES = {
    "sector": {"pattern": "tr38901", "polarization": "V"},
    "rod": {"pattern": "dipole", "polarization": "V"},
}
TX = {
    "type": "antenna",
    "azimuth_deg": "bearing",
    "downtilt_deg": "tilt",
    "electrical_downtilt_deg": "remote_tilt",
}


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Received powers of three transmitters at 36 places, each traced alone with its own antenna by the tracer."""
    folder = tmp_path_factory.mktemp("planted")
    plain = two_ray.study(folder)
    setup = Setup.open(plain, tracer=TwoRay)
    truth = {"ground": replace(setup.scene.materials["ground"], relative_permittivity=TRUTH)}
    random, parts = np.random.default_rng(1), []
    for site in SITES.itertuples():
        rx = np.column_stack([random.uniform(-120, 120, (12, 2)), np.full(12, 1.5)])
        table = pd.DataFrame(np.hstack([np.tile([site.site_x, 0.0, 10.0], (12, 1)), rx]), columns=COLUMNS)
        yaw, tilt = np.pi / 2 - np.radians(site.bearing), np.radians(site.tilt)
        pattern, gain = ("tr38901", 8.0) if site.antenna == "sector" else ("dipole", 10 * np.log10(1.5))
        tracer = TwoRay(
            replace(setup.scene, materials=truth), 3.5e9, setup.trace_settings,
            Antenna(pattern, "V", (yaw, tilt, 0.0)), Antenna("dipole"),
        )  # fmt: skip
        loss = path_loss(tracer.trace(links_from_frame(table)), combining="coherent")
        parts.append(
            table[["rx_x", "rx_y", "rx_z"]].assign(transmitter=site.transmitter, dbm=site.eirp - gain - loss)
        )
    pd.concat(parts).to_csv(folder / "powers.csv", index=False, float_format="%.17g")
    SITES.assign(remote_tilt=0.0).to_csv(folder / "sites.csv", index=False)
    return plain


def mounted(plain: Study, tx: dict[str, Any] = TX, **links: Any) -> Study:
    content = plain.content()
    content["antennas"]["types"] = TYPES
    content["links"] = {
        "file": "powers.csv",
        "tx": ["site_x", 0.0, 10.0],
        "rx": ["rx_x", "rx_y", "rx_z"],
        "value": "dbm",
        "quantity": "received_power",
        "eirp_dbm": "eirp",
        "transmitters": "sites.csv",
        "tx_antenna": tx,
    } | links
    return Study.from_content(
        {name: value for name, value in content.items() if value is not None}, plain.path
    )


def test_a_missing_column_of_the_antennas_is_named_with_its_key_and_both_tables(planted: Study) -> None:
    study = mounted(planted, TX | {"azimuth_deg": "bearin"})
    with pytest.raises(
        InputError,
        match=r"powers\.csv with \S+sites\.csv: no column 'bearin' \(links\.tx_antenna\.azimuth_deg\); "
        "did you mean 'bearing'",
    ):
        study.measurements()


def test_a_table_to_predict_without_the_columns_of_the_antennas_is_refused_before_tracing(
    planted: Study,
) -> None:
    """Positions in metres are not joined with the table of transmitters, which has these columns."""
    result = SimpleNamespace(study=mounted(planted, transmitter="transmitter"))
    table = pd.DataFrame([[0.0, 0.0, 10.0, 50.0, 0.0, 1.5]], columns=COLUMNS)
    with pytest.raises(
        InputError,
        match=r"links: no column 'antenna' \(links\.tx_antenna\.type\); add this column to tx_x, .* rx_z, or leave "
        r"out tx_x, tx_y and tx_z and give transmitter, rx_x, rx_y, rx_z as in the study's table, which .*sites\.csv",
    ):
        as_links(result, table)


def test_the_largest_gain_of_an_array_may_lie_in_a_side_lobe(tmp_path: Path) -> None:
    """Elements that look 40 degrees down, in four rows: the first side lobe, of opposite phase, is the strongest."""
    azimuth, elevation = (x.ravel() for x in np.meshgrid(np.arange(-180, 180, 5), np.arange(-90, 91, 5)))
    gain = np.maximum(15 - 12 * ((elevation + 40) / 20) ** 2 - 12 * (azimuth / 60) ** 2, -20)
    columns = {"azimuth_deg": azimuth, "elevation_deg": elevation, "gain_dbi": gain}
    pd.DataFrame(columns).to_csv(tmp_path / "element.csv", index=False)
    antenna = Antenna(pattern=str(tmp_path / "element.csv"), rows=4)
    down = np.radians(np.arange(-90.0, 91.0))
    direction = np.stack([np.cos(down), 0 * down, np.sin(down)], axis=-1)
    power = (np.abs(AntennaPattern.of(antenna).jones_vectors(direction)[:, 0]) ** 2).sum(axis=-1)
    assert largest_gain_dbi(antenna) == pytest.approx(10 * np.log10(power.max()), abs=1e-9)


def test_digests_name_files_relative_to_the_study(planted: Study, tmp_path: Path) -> None:
    """Also those of antennas, unless a file is outside the study's folder; the current folder has no influence."""
    folder, gain = planted.path.parent, "azimuth_deg,elevation_deg,gain_dbi\n"
    content = mounted(planted).content()
    for name, file in (("sector", folder / "inside.csv"), ("rod", tmp_path / "outside.csv")):
        file.write_text(gain)
        content["antennas"]["types"][name]["pattern"] = os.path.relpath(file, folder)
    study = Study.from_content(content, planted.path)
    scene = Setup.open(planted, tracer=TwoRay).scene
    digests = input_digests(study, scene)
    assert digests.keys() >= {"scene.xml", "inside.csv", str(tmp_path / "outside.csv")}
    assert digests["inside.csv"] == hashlib.sha256(gain.encode()).hexdigest()


def test_three_transmitters_with_their_own_antennas_and_powers_are_calibrated(planted: Study) -> None:
    result = cb.calibrate(mounted(planted), tracer=TwoRay)
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(TRUTH, rel=1e-6)
    assert result.rmse_db < 1e-6
    table = pd.read_csv(planted.path.parent / "powers.csv")
    # Pointing every sector to the east, as the study did that had one direction for all.
    wrong = cb.calibrate(mounted(planted, TX | {"azimuth_deg": 90.0}), tracer=TwoRay)
    assert wrong.rmse_db > 2.0
    assert len(table) == 36


@pytest.mark.parametrize(("turned", "engine"), [(0.0, {}), (12.0, {}), (12.0, {"chunk_links": 12})])
def test_a_sector_that_points_elsewhere_than_stated_is_named(
    planted: Study, turned: float, engine: dict[str, int]
) -> None:
    """Residuals of 1 dB by which only the sector to the east, 12 degrees off, is suspect; with none off, none is."""
    folder, random = planted.path.parent, np.random.default_rng(4)
    table = pd.read_csv(folder / "powers.csv")
    noisy = table.assign(dbm=table["dbm"] + random.standard_normal(len(table)))
    noisy.to_csv(folder / "noisy.csv", index=False)
    sites = pd.read_csv(folder / "sites.csv")
    east = sites["transmitter"] == "east"
    sites.assign(bearing=sites["bearing"] - turned * east).to_csv(folder / "turned.csv", index=False)
    study = mounted(planted, file="noisy.csv", transmitters="turned.csv")
    study = Study.from_content(study.content() | {"engine": {"name": "replay", **engine}}, study.path)
    result = cb.calibrate(study, tracer=TwoRay)
    remarks = [
        remark for remark in result.uncertainty.remarks if remark.kind == RemarkKind.ANTENNA_DIRECTIONS
    ]
    figure = residuals_by_direction(result)
    assert figure is not None
    for axes, name in zip(figure.axes, sorted(SITES["transmitter"]), strict=True):
        assert axes.get_title() == f"{name} (12)"
        points = axes.collections[0].get_offsets()
        own = result.links[noisy["transmitter"] == name]
        np.testing.assert_allclose(points[:, 1], own["predicted_db"] - own["measured_db"])
        angle, level = axes.lines[-1].get_data()
        if name != "omni":
            stated = 90.0 - turned if name == "east" else 0.0
            assert np.degrees(angle[np.argmax(level)]) % 360 == pytest.approx(stated)
    moved = result.links["rx_x"] + 1.0
    assert residuals_by_direction(replace(result, links=result.links.assign(rx_x=moved))) is None
    if not turned:
        assert not remarks
        return
    (remark,) = remarks
    values = {name: value[0] for name, value in remark.values.items() if isinstance(value, list)}
    assert remark.values["transmitters"] == ["east"]
    assert abs(values["azimuth_deg"] - turned) < 3 * values["azimuth_error_deg"] < turned
    assert "'east': add +1" in remark_text(remark)


def test_chunks_without_a_turned_antenna_have_the_slopes_of_all_links(planted: Study) -> None:
    content = mounted(planted).content()
    content["parameters"]["tx:east.azimuth"] = {"bounds": [-20.0, 20.0]}
    jacobians = []
    for engine in ({}, {"chunk_links": 12}):
        study = Study.from_content(content | {"engine": {"name": "replay", **engine}}, planted.path)
        replay = engines.make(Setup.open(study, tracer=TwoRay))
        jacobians.append(replay.path_loss_and_jacobian(replay.parameters.start[None])[1])
    np.testing.assert_allclose(jacobians[1], jacobians[0], rtol=1e-9, atol=1e-12)
    # Links of the two other transmitters do not depend on it.
    assert (jacobians[0][0, :, 1] == 0).sum() == 24


def test_traces_are_shared_by_all_directions(planted: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CALIBRAY_CACHE", str(planted.path.parent / "cache"))
    Setup.open(mounted(planted), tracer=TwoRay).trace()
    monkeypatch.setattr(TwoRay, "trace", lambda *_: pytest.fail("traced again"))
    paths = Setup.open(
        mounted(planted, TX | {"azimuth_deg": 17.0, "downtilt_deg": 2.0}), tracer=TwoRay
    ).trace()
    assert paths.num_links == 36


def test_azimuths_count_from_north_or_from_east(planted: Study) -> None:
    compass = Setup.open(mounted(planted, {"azimuth_deg": 30.0}), tracer=TwoRay).mountings["tx"]
    turned = {"azimuth_deg": 60.0, "azimuth_from": "east"}
    other = Setup.open(mounted(planted, turned), tracer=TwoRay).mountings["tx"]
    np.testing.assert_allclose(compass.pose.yaw, other.pose.yaw)
    np.testing.assert_allclose(compass.pose.yaw, np.radians(60.0))


def test_antennas_aimed_at_each_other_have_their_largest_gain(planted: Study) -> None:
    horns = {"type": "horn", "aim": "other end"}
    content = mounted(planted, horns, rx_antenna=horns).content()
    content["antennas"]["types"] = {"horn": {"pattern": "tr38901", "polarization": "V"}}
    content["links"]["file"], content["links"]["eirp_dbm"] = "horns.csv", 30.0
    pd.read_csv(planted.path.parent / "powers.csv").assign(horn="horn").to_csv(
        planted.path.parent / "horns.csv", index=False
    )
    paths = Setup.open(Study.from_content(content, planted.path), tracer=TwoRay).trace()
    direct = np.diff(paths.first) == 0
    for field in (paths.tx_field, paths.rx_field):
        np.testing.assert_allclose(
            10 * np.log10((np.abs(field[direct]) ** 2).sum(axis=(1, 2))), 8.0, atol=1e-9
        )


def test_arrays_are_steered_per_transmitter_from_columns(planted: Study) -> None:
    """A beam that is turned clockwise and tilted has its largest gain there; the element does not turn."""
    steered = {"azimuth_deg": "bearing", "electrical_downtilt_deg": "tilt", "steering_deg": 20.0}
    content = mounted(planted, steered).content()
    content["antennas"]["tx"] = {"pattern": "tr38901", "rows": 8, "columns": 8}
    setup = Setup.open(Study.from_content(content, planted.path), tracer=TwoRay)
    mounting = setup.mountings["tx"]
    grid = np.stack(np.meshgrid(np.arange(0.0, 20.0), np.arange(-180.0, 180.0)), axis=-1).reshape(-1, 2)
    angles = np.radians(np.column_stack([90.0 + grid[:, 0], 90.0 - grid[:, 1]]))
    for link in np.unique(setup.links.table.labels("transmitter"), return_index=True)[1]:
        jones = stated_jones(mounting.of_paths(np.full(len(grid), link)), angles)
        power = (jones**2).sum(axis=(1, 2))
        stated = setup.links.frame.iloc[link]
        downtilt, bearing = grid[power.argmax()]
        assert downtilt == pytest.approx(stated["tilt"], abs=1.0)
        assert (bearing - stated["bearing"] - 20.0 + 180) % 360 - 180 == pytest.approx(0.0, abs=1.0)
        # 64 elements, 12 (20 / 65)^2 dB beside the element's main direction.
        expected = 8 + 10 * np.log10(64) - 12 * (20 / 65) ** 2 - 12 * (stated["tilt"] / 65) ** 2
        assert 10 * np.log10(power.max()) == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize(
    ("tx", "links", "message"),
    [
        ({"steering_deg": 5.0}, {}, "tx_antenna.steering_deg: the antenna is not an array; state rows and columns"),
        ({"type": "transmitter"}, {}, r"row 2, column 'transmitter': 'north' is not an antenna of .antennas.types."),
        ({"azimuth_deg": "heading"}, {}, "no column 'heading'"),
        ({"azimuth_deg": 720.0}, {}, "links.tx_antenna.azimuth_deg: 720 must be -360 to 360; give degrees"),
        ({"downtilt_deg": 91.0}, {}, "links.tx_antenna.downtilt_deg: 91 must be -90 to 90; give degrees"),
        ({"azimuth_deg": 1.0, "aim": "other end"}, {}, "remove azimuth_deg and downtilt_deg"),
        ({}, {"cable_loss_db": 2.0}, "remove tx_power_dbm and cable_loss_db"),
    ],
)  # fmt: skip
def test_impossible_mountings_are_refused(
    planted: Study, tx: dict[str, Any], links: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Setup.open(mounted(planted, tx, **links), tracer=TwoRay).mountings  # noqa: B018


def test_other_engines_refuse_antennas_that_differ_between_links(planted: Study) -> None:
    with pytest.raises(
        InputError, match=r"links.tx_antenna with engine.name = 'retrace'.*use engine 'replay'"
    ):
        mounted(planted).replace(engine="retrace")


def test_cable_losses_lower_the_transmitted_power(planted: Study) -> None:
    power = {"eirp_dbm": None, "tx_power_dbm": "eirp"}
    without = mounted(planted, TX, **power).measurements()
    with_cable = mounted(planted, TX, **power, cable_loss_db=2.5).measurements()
    np.testing.assert_allclose(without.path_loss_db - with_cable.path_loss_db, 2.5)


def test_predictions_at_new_links_use_their_transmitter_s_antenna(planted: Study) -> None:
    study = mounted(planted)
    result = cb.calibrate(study, tracer=TwoRay)
    places = pd.DataFrame({"transmitter": ["north", "east"], "rx_x": 3.0, "rx_y": 60.0, "rx_z": 1.5})
    setup = Setup.open(study, tracer=TwoRay, links=study.places(SourceTable(places)))
    loss = path_loss(setup.trace(result.scene_materials), combining="coherent")
    assert loss[1] - loss[0] > 5.0


POSE = {
    "tx:north.azimuth": {"bounds": [-30.0, 30.0]},
    "tx:east.azimuth": {"bounds": [-30.0, 30.0]},
    "tx:north.downtilt": {"bounds": [-8.0, 8.0]},
}


def misdirected(plain: Study, **parameters: Any) -> Study:
    """The study whose table of transmitters states azimuths that are 12 and -9 degrees wrong, and a tilt by 2."""
    wrong = SITES.assign(remote_tilt=0.0)
    wrong["bearing"] += [12.0, -9.0, 0.0]
    wrong["tilt"] -= [2.0, 0.0, 0.0]
    wrong.to_csv(plain.path.parent / "misdirected.csv", index=False)
    content = mounted(plain, transmitters="misdirected.csv").content()
    content["parameters"] |= parameters
    return Study.from_content(content, plain.path)


def test_wrong_directions_are_found_with_the_materials(
    planted: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without = cb.calibrate(misdirected(planted), tracer=TwoRay)
    assert without.rmse_db > 0.5
    result = cb.calibrate(misdirected(planted, **POSE), tracer=TwoRay)
    assert result.rmse_db < 1e-4
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(TRUTH, rel=1e-4)
    for name, error in (("tx:north.azimuth", -12.0), ("tx:east.azimuth", 9.0), ("tx:north.downtilt", 2.0)):
        assert result.parameters[name] == pytest.approx(error, abs=0.01)
    assert list(result.scene_materials) == ["ground"]
    result.save(tmp_path / "result")
    monkeypatch.setattr("calibray.tracing.SionnaFactory.__call__", lambda _, *opened: TwoRay(*opened))
    loaded = cb.Result.load(tmp_path / "result")
    powers = pd.read_csv(planted.path.parent / "powers.csv")
    loss = SITES.set_index("transmitter")["eirp"][powers["transmitter"]].to_numpy() - powers["dbm"]
    gain = np.where(powers["transmitter"] == "omni", 10 * np.log10(1.5), 8.0)
    np.testing.assert_allclose(loaded.predict(powers.drop(columns="dbm")), loss - gain, atol=0.01)
    with pytest.raises(InputError, match=r"needs the links' column"):
        loaded.coverage_map([0.0, 0.0, 10.0], cell=50.0, level=None)
    maps = [
        loaded.coverage_map([0.0, 0.0, 10.0], cell=50.0, level=None, columns={"transmitter": name})
        for name in ("north", "east")
    ]
    assert np.nanmax(np.abs(maps[0].path_loss_db - maps[1].path_loss_db)) > 10.0
    loaded.report(tmp_path / "report.html")
    assert "tx:north.azimuth" in (tmp_path / "report.html").read_text()


def test_unknown_transmitters_are_refused(planted: Study) -> None:
    with pytest.raises(InputError, match=r"'tx:nort.gain': no link has the transmitter 'nort'.*'north'"):
        Setup.open(misdirected(planted, **{"tx:nort.gain": {"bounds": [-5.0, 5.0]}}), tracer=TwoRay)


def test_directions_have_gaussian_priors_and_materials_have_not(planted: Study) -> None:
    study = misdirected(planted, **{"tx:north.azimuth": {"bounds": [-30.0, 30.0], "prior": {"std": 5.0}}})
    assert (study.priors.index, study.priors.centre) == ((1,), (0.0,))
    assert (study.priors.spread, study.priors.linear) == ((5.0,), (1,))
    with pytest.raises(InputError, match=r"prior.std applies only to parameters of antennas"):
        misdirected(planted, **{"ground.conductivity": {"bounds": [0.1, 2.0], "prior": {"std": 0.1}}})


def test_an_empty_bearing_of_an_omnidirectional_antenna_counts_as_zero(planted: Study) -> None:
    """Also in the links of a map, which takes it from the links measured at the transmitter."""
    sites = SITES.assign(remote_tilt=0.0)
    sites.loc[sites["antenna"] == "rod", ["bearing", "tilt"]] = np.nan
    sites.to_csv(planted.path.parent / "gaps.csv", index=False)
    study = mounted(planted, transmitters="gaps.csv")
    result = cb.calibrate(study, tracer=TwoRay)
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(TRUTH, rel=1e-6)
    columns = _column_values(result, np.array([40.0, 0.0, 10.0]), {"transmitter": "omni"})
    assert np.isnan([columns["bearing"], columns["tilt"]]).all()
    sites.assign(antenna="sector").to_csv(planted.path.parent / "gaps.csv", index=False)
    with pytest.raises(
        InputError, match=r"column 'bearing' has missing or non-finite values for transmitter omni"
    ):
        Setup.open(study, tracer=TwoRay).mountings  # noqa: B018
