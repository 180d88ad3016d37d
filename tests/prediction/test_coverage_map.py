"""Coverage maps: every cell equals a prediction at its centre, and lies at the right position on the globe."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import rasterio
from typer.testing import CliRunner

import calibray as cb
import planted
from calibray.cli.app import app
from calibray.coordinates import transformer
from calibray.errors import InputError
from calibray.prediction import batches
from calibray.prediction.coverage_map import _column_values
from calibray.prediction.map_files import CoverageMap, geotiff
from calibray.reporting.link_map import footprints
from calibray.result.held_out import FittedTerm, Model, PredictionModel
from calibray.scenes import Triangles, ground_heights, read_triangles
from calibray.scenes.obstruction import obstruction
from changed import changed

GOLDEN = Path(__file__).parents[1] / "golden"
TX = (0.0, 0.0, 12.0)
AREA = (-57.0, -57.0, 63.0, 33.0)
ORIGIN = (11.5755, 48.1374)
WEST = {"half": "west"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A stored calibration of two blocks and a tower, with an offset on either side."""
    study = tmp_path_factory.mktemp("map") / "study"
    shutil.copytree(GOLDEN / "study", study)
    shutil.copytree(GOLDEN / "result", study / "out")
    file = study / "out" / "result.json"
    stored = json.loads(file.read_text()) | {"study_file": str(study / "study.toml")}
    stored["study"]["trace"] |= {"max_depth": 1, "diffraction": False, "samples": 20_000}
    file.write_text(json.dumps(stored))
    return study / "out"


@pytest.fixture(scope="module")
def result(folder) -> cb.Result:
    """The same with a position on the globe, and draws from the posterior."""
    loaded = cb.Result.load(folder)
    content = loaded.study.content()
    content["scene"]["origin"] = list(ORIGIN)
    draws = {name: [0.9 * value, 1.2 * value] for name, value in loaded.parameters.items()}
    study = cb.Study.from_content(content, loaded.study.path)
    fallback = PredictionModel(
        "log-distance", None, (FittedTerm("slope", "log_distance", "", {"": 40.0}),), 9.0
    )
    return changed(loaded, study=study, draws=draws, fallback=replace(fallback, sizes_db=(9.0,) * 9))


@pytest.fixture(scope="module")
def coverage(result) -> CoverageMap:
    """The map of both blocks in cells of 30 m, traced in two batches."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "BATCH", 7)
        return cb.coverage_map(result, TX, cell=30.0, bounds=AREA, columns=WEST)


def links(x, y, z=1.5):
    """Links from the transmitter to some receivers."""
    ends = {f"tx_{axis}": TX[k] for k, axis in enumerate("xyz")}
    return pd.DataFrame({**ends, "rx_x": x, "rx_y": y, "rx_z": z, "half": "west"})


def test_a_cell_equals_the_prediction_at_its_centre(result, coverage):
    assert coverage.path_loss_db.shape == (3, 4)
    predicted = np.isfinite(coverage.path_loss_db)
    assert 0 < coverage.no_path.sum() < predicted.sum() < predicted.size
    row, column = (ends[::2] for ends in np.nonzero(predicted))
    predictions = result.predict_interval(links(coverage.x[column], coverage.y[row]))
    for name in ("path_loss_db", "lower_db", "upper_db"):
        layer = getattr(coverage, name)[row, column]
        assert layer == pytest.approx(predictions[name].to_numpy(float), abs=0.05, nan_ok=True)
    assert predictions.basis.str.startswith("no path").tolist() == coverage.no_path[row, column].tolist()
    assert (np.isfinite(coverage.lower_db) <= predicted).all()
    inside = np.isfinite(coverage.upper_db)
    assert (coverage.lower_db < coverage.path_loss_db)[inside].all()


def test_further_observables_are_layers_with_the_predictions_at_the_cells(result, tmp_path):
    content = result.study.content()
    content["observables"] = {"flight": {"kind": "time_of_flight", "column": "flight_ns", "unit": "ns"}}
    observed = replace(result, study=cb.Study.from_content(content, result.study.path))
    coverage = cb.coverage_map(observed, TX, cell=30.0, bounds=AREA, columns=WEST, level=None)
    (name,) = coverage.observables
    layer = coverage.observables[name]
    assert name == "flight_ns"
    assert layer.shape == coverage.path_loss_db.shape
    row, column = np.nonzero(np.isfinite(coverage.path_loss_db))
    predicted = observed.predict_interval(links(coverage.x[column], coverage.y[row]), None)
    np.testing.assert_allclose(layer[row, column], predicted[name].to_numpy(float), atol=0.05)
    assert np.nanmax(layer) > np.nanmin(layer) + 1.0
    coverage.save(tmp_path)
    table = pd.read_csv(tmp_path / "map.csv")
    assert table[name].to_numpy() == pytest.approx(layer.reshape(-1), abs=0.01, nan_ok=True)
    with rasterio.open(tmp_path / "map.tif") as file:
        assert name in file.descriptions


def test_cells_of_the_model_with_obstruction_have_what_blocks_their_line(result):
    coefficients = {"constant": 50.0, "log_distance": 30.0, "out_of_sight": 9.0, "obstruction_m": 0.3}
    terms = tuple(FittedTerm(name, name, "", {"": value}) for name, value in coefficients.items())
    model = replace(result.prediction.model, name=Model.OBSTRUCTION, parameters=None, terms=terms)
    rival = replace(result, prediction=replace(result.prediction, model=model, materials=None))
    coverage = cb.coverage_map(rival, TX, cell=30.0, bounds=AREA, columns=WEST, level=None)
    row, column = np.nonzero(np.isfinite(coverage.path_loss_db))
    receivers = np.column_stack([coverage.x[column], coverage.y[row], coverage.z[row, column]])
    start = np.tile(TX, (len(row), 1))
    triangles = read_triangles(cb.Setup.open(result.study, links=result.study.measurements()).scene)
    found = obstruction(triangles, start, receivers)
    assert found.out_of_sight.any()
    assert found.length_m.max() > 5
    law = 50 + 30 * np.log10(np.linalg.norm(receivers - start, axis=1))
    expected = law + 9 * found.out_of_sight + 0.3 * found.length_m
    assert coverage.path_loss_db[row, column] == pytest.approx(expected, abs=1e-6)


def test_the_geotiff_has_the_position_of_the_scene(result, coverage, tmp_path):
    names = coverage.save(tmp_path)
    assert names == ("map.tif", "map.png", "map.csv")
    table = pd.read_csv(tmp_path / "map.csv")
    with rasterio.open(tmp_path / "map.tif") as file:
        assert file.descriptions == ("path_loss_db", "lower_db", "upper_db", "no_path")
        assert (file.read(4)[::-1] == coverage.no_path).all()
        assert file.bounds.right - file.bounds.left == pytest.approx(120)
        # The scene's origin is 57 m from the western and southern edges of the map.
        east, north = transformer("EPSG:4326", file.crs.to_wkt()).transform(*ORIGIN)
        assert (east - file.bounds.left, north - file.bounds.bottom) == pytest.approx((57, 57), abs=1e-3)
        affine = file.transform
        band = file.read(1)
        for x, y, loss in table[["x_m", "y_m", "path_loss_db"]].to_numpy():
            row, column = int((north + y - affine.f) / affine.e), int((east + x - affine.c) / affine.a)
            assert band[row, column] == pytest.approx(
                loss if np.isfinite(loss) else np.nan, rel=1e-5, nan_ok=True
            )
    assert (tmp_path / "map.png").stat().st_size > 20_000


def test_a_map_is_written_into_a_folder_of_any_name(coverage, tmp_path):
    """GDAL cannot open file names that are not UTF-8."""
    folder = tmp_path / "\udcff"
    folder.mkdir()
    geotiff(coverage, folder / "map.tif")
    with rasterio.MemoryFile((folder / "map.tif").read_bytes()) as memory, memory.open() as file:
        assert file.count == len(coverage.layers) + 1


def test_the_position_of_the_transmitter_has_no_path_loss(result, coverage, monkeypatch):
    monkeypatch.setattr(cb.Setup, "trace", None)
    x, y, z = coverage.x[0], coverage.y[0], coverage.z[0, 0]
    bounds = (x - 5, y - 5, x + 5, y + 5)
    one_cell = cb.coverage_map(result, (x, y, z), cell=10.0, bounds=bounds, columns=WEST)
    assert np.isnan(one_cell.path_loss_db).all()


def test_a_map_is_shown_in_one_line(coverage):
    assert re.fullmatch(
        r"<map of 12 cells of 30 m, transmitter at \(.*\) m, path_loss_db [\d.]+ to [\d.]+>", repr(coverage)
    )


def test_received_power_is_transmitted_power_minus_path_loss(coverage):
    power = replace(coverage, power_dbm=43.0).layers
    assert list(power) == ["received_power_dbm", "lower_dbm", "upper_dbm"]
    finite = np.isfinite(coverage.lower_db)
    assert (power["lower_dbm"] < power["received_power_dbm"])[finite].all()
    assert power["upper_dbm"] + coverage.lower_db == pytest.approx(
        np.full_like(coverage.lower_db, 43.0) + 0 * coverage.lower_db, nan_ok=True
    )


def test_a_power_in_addition_to_that_in_the_offset_of_rsrp_is_announced(result, caplog):
    content = result.study.content()
    content["links"] |= {"quantity": "rsrp"}
    rsrp = changed(result, study=cb.Study.from_content(content, result.study.path))
    arguments = {"tx": TX, "cell": 30.0, "bounds": AREA, "columns": WEST, "level": None}
    shown = cb.coverage_map(rsrp, **arguments)
    assert "RSRP" not in caplog.text
    raised = cb.coverage_map(rsrp, power_dbm=17.0, **arguments)
    assert "so the map differs from RSRP by +17 dB; to map RSRP, omit the power" in caplog.text
    higher = raised.layers["received_power_dbm"] - shown.layers["received_power_dbm"]
    assert higher[np.isfinite(higher)] == pytest.approx(17.0)


def test_cells_outside_the_scene_are_announced(result, caplog):
    arguments = {"tx": TX, "cell": 5.0, "columns": WEST, "level": None}
    cb.coverage_map(result, bounds=(-57.0, -57.0, -47.0, -52.0), **arguments)
    assert "outside the scene" not in caplog.text
    cb.coverage_map(result, bounds=(500.0, 0.0, 510.0, 10.0), **arguments)
    assert "4 of 4 cells are outside the scene" in caplog.text


def test_a_transmitter_outside_the_scene_is_announced(result, caplog):
    arguments = {"cell": 5.0, "bounds": (-57.0, -57.0, -47.0, -52.0), "columns": WEST, "level": None}
    cb.coverage_map(result, tx=TX, **arguments)
    assert "the transmitter at" not in caplog.text
    cb.coverage_map(result, tx=(2000.0, 0.0, 4.0), **arguments)
    assert "the transmitter at (2000, 0, 4) m is outside the scene; check its position" in caplog.text


def test_a_column_that_the_links_do_not_have_is_refused(result):
    study = result.study
    assert _column_values(result, np.array(TX), {"half": "west"}) == {"half": "west"}
    with pytest.raises(InputError, match="--column Half: the links have no such column; did you mean 'half'"):
        _column_values(result, np.array(TX), {"half": "west", "Half": "east"})
    # Of the table, but not needed: such as the name of a sector.
    free = str(next(name for name in study.measurements().frame if name not in study.offset_groups))
    assert _column_values(result, np.array(TX), {"half": "west", free: 1.0})["half"] == "west"


def test_the_command_writes_a_map(folder, coverage, tmp_path):
    options = ["--bounds", *AREA, "--cell", 30, "--level", 0, "--power", 30, "--column", "half=west"]
    run = CliRunner().invoke(app, ["map", str(folder), *map(str, ["--tx", *TX, *options, "--out", tmp_path])])
    assert run.exit_code == 0, run.output
    table = pd.read_csv(tmp_path / "map.csv")
    assert list(table) == ["x_m", "y_m", "z_m", "received_power_dbm", "basis"]
    # The stored result has no fallback.
    reached = (np.isfinite(coverage.path_loss_db) & ~coverage.no_path).reshape(-1)
    assert table.received_power_dbm[reached].to_numpy() == pytest.approx(
        30 - coverage.path_loss_db.reshape(-1)[reached], abs=0.05
    )
    again = CliRunner().invoke(app, ["map", str(folder), "--column", "half"])
    assert again.exit_code == 2
    refused = CliRunner().invoke(app, ["map", str(folder), "--samples", "many"])
    assert refused.exit_code == 2
    assert '--samples many: must be a whole number or "auto"' in refused.stderr


def test_an_adaptive_number_of_rays_finds_the_study_s_paths(result, coverage):
    adaptive = cb.coverage_map(
        result, TX, cell=30.0, bounds=AREA, columns=WEST, level=None, samples="auto"
    ).path_loss_db
    reached = np.isfinite(coverage.path_loss_db)
    assert np.isfinite(adaptive)[reached].all()
    assert (adaptive[reached] - coverage.path_loss_db[reached]).max() < 0.05


def test_a_group_without_measurements_is_announced(result, caplog):
    arguments = {"tx": TX, "cell": 30.0, "bounds": AREA}
    with caplog.at_level("WARNING"):
        cb.coverage_map(result, columns=WEST, **arguments)
        assert not caplog.messages
        cb.coverage_map(result, columns={"half": "wset"}, **arguments)
    assert caplog.messages == [
        "half = wset: no link of this group was measured, so the map uses the mean offset"
    ]


@pytest.mark.parametrize("per", ["half", ["half"]])
def test_the_group_is_that_of_the_links_measured_at_the_transmitter(result, monkeypatch, per):
    def traced(*_, **__):
        raise InterruptedError

    monkeypatch.setattr(cb.Setup, "trace", traced)
    content = result.study.content()
    content["offset"]["per"] = per
    study = cb.Study.from_content(content, result.study.path)
    links = result.links.assign(group="west", tx_x=float(TX[0]), tx_y=float(TX[1]), tx_z=float(TX[2]))
    with pytest.raises(InterruptedError):
        cb.coverage_map(changed(result, study=study, links=links), TX, cell=30.0, bounds=AREA)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tx": None}, "has no transmitter positions"),
        ({"tx": [0.0, 0.0]}, "three finite numbers"),
        ({"cell": 0.0}, "cell = 0: must be a finite number greater than 0"),
        ({"cell": 0.01}, "must be at most 1000000"),
        ({"bounds": [10, 0, -10, 5]}, "west less than east"),
        ({"height": np.nan}, "height = nan"),
        ({"height": None}, "height = None: must be a finite number"),
        ({"height": -1.0}, "height = -1: must be a finite number greater than 0"),
        ({"cell": "5"}, "cell = '5': must be a finite number greater than 0"),
        ({"tx": "mast"}, "tx = 'mast': must be x, y and z"),
        ({"bounds": "scene"}, "bounds = 'scene': must be west, south, east and north"),
        ({"level": 1.5}, r"level = 1\.5"),
        ({"samples": 0}, "samples: is 0, must be a number of rays"),
        ({"columns": {}}, "--column half=VALUE"),
    ],
)
def test_impossible_arguments_are_refused_before_tracing(result, monkeypatch, arguments, message):
    monkeypatch.setattr(cb.Setup, "trace", None)
    with pytest.raises(InputError, match=message):
        cb.coverage_map(result, **{"tx": TX, "columns": WEST, "cell": 50.0, **arguments})


def test_clusters_of_one_term_are_those_of_all_terms(result, monkeypatch):
    """The side of the squares is stated once, so no term needs a column of clusters."""

    def traced(*_, **__):
        raise InterruptedError

    monkeypatch.setattr(cb.Setup, "trace", traced)
    content, term = result.study.content(), {"per": "cluster", "prior": "auto"}
    content["nuisance"] = {
        "a": term | {"by": "constant", "cluster_m": 30.0},
        "b": term | {"by": "log_distance"},
    }
    study = cb.Study.from_content(content, result.study.path)
    with pytest.raises(InterruptedError):
        cb.coverage_map(changed(result, study=study), TX, cell=30.0, bounds=AREA, columns=WEST)


def test_the_option_in_a_message_can_be_pasted_into_a_terminal(result):
    content = result.study.content()
    content["offset"]["per"] = "freq [GHz]"
    study = cb.Study.from_content(content, result.study.path)
    with pytest.raises(InputError, match=re.escape("--column 'freq [GHz]=VALUE'")):
        cb.coverage_map(changed(result, study=study), TX, cell=50.0)


def test_receivers_are_on_the_lowest_ground():
    """A slope z = 0.1 x + 0.2 y, a slab over all of it, and an area outside both."""
    corners = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], dtype=float)
    slope = np.column_stack([corners, corners @ [0.1, 0.2]])
    slab = np.column_stack([corners, np.full(4, 9.0)])
    face = np.array([[0, 1, 2], [0, 2, 3]])
    scene = Triangles(
        np.vstack([slope, slab]), np.vstack([face, face + 4]), np.zeros(4, int), np.ones(4, bool)
    )
    x, y = np.arange(0.5, 13), np.arange(0.5, 11)
    east, north = np.meshgrid(x, y)
    outside = (east > 10) | (north > 10)
    expected = np.where(outside, 0.0, 0.1 * east + 0.2 * north)
    assert ground_heights(scene, x, y) == pytest.approx(expected, abs=1e-12)


def test_a_building_on_the_border_keeps_its_outline():
    """A roof of four triangles around its middle, of which only the eastern one reaches into the area."""
    vertex = np.array([(0, 0), (-10, -10), (10, -10), (10, 10), (-10, 10)], dtype=float)
    face = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    roof = Triangles(np.column_stack([vertex, np.full(5, 9.0)]), face, np.zeros(4, int), np.zeros(4, bool))
    (outline,) = footprints(roof, 5.0, -50.0, 105.0, 50.0)
    assert sorted(map(tuple, outline)) == [(-10, -10), (-10, 10), (10, -10), (10, 10)]
    assert footprints(roof, 11.0, -50.0, 111.0, 50.0) == []


def test_a_map_has_the_carrier_of_the_links_measured_at_its_transmitter(tmp_path):
    """Two sectors at one position have two carriers; the stated sector chooses."""
    table = planted.links().assign(path_loss_db=90.0, sector=["a", "b"] * 6, carrier=[8e8, 3.5e9] * 6)
    columns = {"tx": list(planted.COLUMNS[:3]), "rx": list(planted.COLUMNS[3:]), "value": "path_loss_db"}
    links = {"file": "links.csv", **columns, "frequency": "carrier"}
    result = SimpleNamespace(study=planted.study(tmp_path, table, links=links), links=pd.DataFrame())
    tx = table[list(planted.COLUMNS[:3])].to_numpy()[0]
    for sector, carrier in (("a", 8e8), ("b", 3.5e9)):
        assert _column_values(result, tx, {"sector": sector})["carrier"] == carrier
    assert _column_values(result, tx + 5.0, {"carrier": 2e9}) == {"carrier": 2e9}
    for place, stated in ((tx, {}), (tx + 5.0, {"sector": "a"})):
        with pytest.raises(InputError, match="needs the links' column 'carrier'"):
            _column_values(result, place, stated)
    # A stated number is that of the table, however it is written; here the bearing follows from the carrier.
    table["bearing"] = [10.0, 20.0] * 6
    mounted = links | {"tx_antenna": {"azimuth_deg": "bearing"}}
    result.study = planted.study(tmp_path, table, links=mounted)
    for stated in (8e8, "8e8", "800000000"):
        assert _column_values(result, tx, {"carrier": stated})["bearing"] == 10.0
