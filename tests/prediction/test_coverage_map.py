"""Coverage maps: every cell is what `predict` says there, at the place where the map says it is."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from typer.testing import CliRunner

import calibray as cb
from calibray.cli.app import app
from calibray.coordinates import transformer
from calibray.errors import InputError
from calibray.prediction import batches as shared_out
from calibray.prediction.map_files import geotiff
from calibray.reporting.link_map import footprints
from calibray.scenes import Triangles, ground_heights
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
    stored["study"]["trace"] |= {"max_depth": 1, "diffraction": False, "samples": 4000}
    file.write_text(json.dumps(stored))
    return study / "out"


@pytest.fixture(scope="module")
def result(folder) -> cb.Result:
    """The same with a place on the globe, and values that fit about as well."""
    loaded = cb.Result.load(folder)
    content = loaded.study.content()
    content["scene"]["origin"] = list(ORIGIN)
    drawn = {name: [0.9 * value, 1.2 * value] for name, value in loaded.parameters.items()}
    study = cb.Study.from_content(content, loaded.study.path)
    return changed(loaded, study=study, draws=drawn)


@pytest.fixture(scope="module")
def found(result) -> cb.coverage_map:
    """The map of both blocks in cells of 30 m, traced in two parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_out, "PIECE", 7)
        return cb.coverage_map(result, TX, cell=30.0, bounds=AREA, columns=WEST)


def rows(x, y, z=1.5):
    ends = {f"tx_{axis}": TX[k] for k, axis in enumerate("xyz")}
    return pd.DataFrame({**ends, "rx_x": x, "rx_y": y, "rx_z": z, "half": "west"})


def test_a_cell_is_what_is_predicted_there(result, found):
    assert found.path_loss_db.shape == (3, 4)
    column, row = np.array([0, 2, 3]), np.array([0, 1, 2])
    alone = result.predict_interval(rows(found.x[column], found.y[row]))
    for name in ("path_loss_db", "lower_db", "upper_db"):
        layer = getattr(found, name)[row, column]
        assert layer == pytest.approx(alone[name].to_numpy(float), abs=0.05, nan_ok=True)
    reached = np.isfinite(found.path_loss_db)
    assert 0 < reached.sum() < reached.size
    assert (np.isfinite(found.lower_db) <= reached).all()
    inside = np.isfinite(found.upper_db)
    assert (found.lower_db < found.path_loss_db)[inside].all()


def test_the_geotiff_lies_where_the_scene_does(result, found, tmp_path):
    names = cb.save_map(found, tmp_path)
    assert names == ("map.tif", "map.png", "map.csv")
    table = pd.read_csv(tmp_path / "map.csv")
    with rasterio.open(tmp_path / "map.tif") as file:
        assert file.descriptions == ("path_loss_db", "lower_db", "upper_db")
        assert file.bounds.right - file.bounds.left == pytest.approx(120)
        # The scene's own origin, found on the globe, lies where the map says: 57 m from its western edge.
        east, north = transformer("EPSG:4326", file.crs.to_wkt()).transform(*ORIGIN)
        assert (east - file.bounds.left, north - file.bounds.bottom) == pytest.approx((57, 57), abs=1e-3)
        place = file.transform
        band = file.read(1)
        for x, y, loss in table[["x_m", "y_m", "path_loss_db"]].to_numpy():
            row, column = int((north + y - place.f) / place.e), int((east + x - place.c) / place.a)
            assert band[row, column] == pytest.approx(
                loss if np.isfinite(loss) else np.nan, rel=1e-5, nan_ok=True
            )
    assert (tmp_path / "map.png").stat().st_size > 20_000


def test_a_map_is_written_into_a_folder_of_any_name(found, tmp_path):
    """Names that are no UTF-8 are names of files as well, though GDAL knows none."""
    folder = tmp_path / "\udcff"
    folder.mkdir()
    geotiff(found, folder / "map.tif")
    with rasterio.MemoryFile((folder / "map.tif").read_bytes()) as memory, memory.open() as file:
        assert file.count == len(found.layers)


def test_the_place_of_the_transmitter_has_no_path_loss(result, monkeypatch):
    monkeypatch.setattr(cb.Setup, "trace", None)
    alone = cb.coverage_map(result, TX, height=12.0, cell=10.0, bounds=(-5, -5, 5, 5), columns=WEST)
    assert np.isnan(alone.path_loss_db).all()


def test_power_is_what_is_sent_less_what_is_lost(found):
    power = replace(found, power_dbm=43.0).layers
    assert list(power) == ["received_power_dbm", "lower_dbm", "upper_dbm"]
    known = np.isfinite(found.lower_db)
    assert (power["lower_dbm"] < power["received_power_dbm"])[known].all()
    assert power["upper_dbm"] + found.lower_db == pytest.approx(
        np.full_like(found.lower_db, 43.0) + 0 * found.lower_db, nan_ok=True
    )


def test_the_command_writes_a_map(folder, found, tmp_path):
    options = ["--bounds", *AREA, "--cell", 30, "--level", 0, "--power", 30, "--column", "half=west"]
    run = CliRunner().invoke(app, ["map", str(folder), *map(str, ["--tx", *TX, *options, "--out", tmp_path])])
    assert run.exit_code == 0, run.output
    table = pd.read_csv(tmp_path / "map.csv")
    assert list(table) == ["x_m", "y_m", "z_m", "received_power_dbm"]
    assert table.received_power_dbm.to_numpy() == pytest.approx(30 - found.path_loss_db.reshape(-1), abs=0.05)
    again = CliRunner().invoke(app, ["map", str(folder), "--column", "half"])
    assert again.exit_code == 2
    refused = CliRunner().invoke(app, ["map", str(folder), "--samples", "many"])
    assert refused.exit_code == 2
    assert '--samples many: must be a whole number, or "auto"' in refused.stderr


def test_rays_added_in_rounds_find_what_the_study_finds(result, found):
    adaptive = cb.coverage_map(
        result, TX, cell=30.0, bounds=AREA, columns=WEST, level=None, samples="auto"
    ).path_loss_db
    reached = np.isfinite(found.path_loss_db)
    assert np.isfinite(adaptive)[reached].all()
    assert (adaptive[reached] - found.path_loss_db[reached]).max() < 0.05


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tx": None}, "does not tell where transmitters stood"),
        ({"tx": [0.0, 0.0]}, "three finite numbers"),
        ({"cell": 0.0}, "cell = 0: must be a finite number greater than 0"),
        ({"cell": 0.01}, "must be at most 1000000"),
        ({"bounds": [10, 0, -10, 5]}, "west less than east"),
        ({"height": np.nan}, "height = nan"),
        ({"level": 1.5}, r"level = 1\.5"),
        ({"samples": 0}, "trace.samples"),
        ({"columns": {}}, "--column half=VALUE"),
    ],
)
def test_what_cannot_be_mapped_is_refused_before_anything_is_traced(result, monkeypatch, given, message):
    monkeypatch.setattr(cb.Setup, "trace", None)
    with pytest.raises(InputError, match=message):
        cb.coverage_map(result, **{"tx": TX, "columns": WEST, "cell": 50.0, **given})


def test_receivers_stand_on_the_lowest_ground():
    """A slope z = 0.1 x + 0.2 y, a slab over all of it, and a place beside both."""
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
