"""OpenStreetMap extracts, vector files and height models with known content."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import osmium
import pyogrio
import pytest
import rasterio
import shapely
from rasterio.transform import Affine

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.scenes.authoring import (
    HeightRule,
    lower_origin,
    make_scene,
    read_footprints,
    read_openstreetmap,
    read_terrain,
)
from planted_maps import FRAME, write_extract

SQUARE = [(0, 0), (20, 0), (20, 20), (0, 20)]


def moved(ring, east: float, north: float = 0.0):
    return [(x + east, y + north) for x, y in ring]


@pytest.fixture
def extract(tmp_path: Path) -> Path:
    hole = moved([(5, 5), (5, 15), (15, 15), (15, 5)], 200)
    return write_extract(
        tmp_path / "town.osm",
        [
            (SQUARE, {"building": "yes", "height": "12 m"}),
            (moved(SQUARE, 50), {"building": "house", "building:levels": "4"}),
            (moved(SQUARE, 100), {"building": "yes", "height": "tall"}),
            (moved(SQUARE, 150), {"building:part": "yes", "height": "30", "min_height": "20"}),
            (moved(SQUARE, 200), {}),
            (hole, {}),
            (moved(SQUARE, 300), {"building": "no"}),
            (moved(SQUARE, 350), {"highway": "pedestrian"}),
        ],
        [
            ([("outer", 5), ("inner", 6)], {"building": "yes", "height": "40'6\""}),
            ([("outer", 99)], {"building": "yes"}),
        ],
    )


def test_buildings_of_an_extract_have_holes_and_heights(extract):
    buildings, frame = read_openstreetmap(extract, FRAME)
    assert frame == FRAME
    assert buildings.name == ("way-1", "way-2", "way-3", "way-4", "relation-1")
    assert buildings.top == pytest.approx([12, 12, 9, 30, 12.3444])
    assert buildings.bottom == pytest.approx([0, 0, 0, 20, 0])
    assert buildings.height_from == ("height", "levels", "default", "height", "height")
    assert buildings.guessed() == {"levels": ["way-2"], "default": ["way-3"]}
    assert buildings.part.tolist() == [False, False, False, True, False]
    assert buildings.repairs == {"incomplete in the extract, left out": 1}
    # Corners come back to the grid of 1 cm.
    assert shapely.area(buildings.polygon) == pytest.approx([400, 400, 400, 400, 300], rel=2e-3)
    assert buildings.bounds == pytest.approx([0, 0, 220, 20], abs=0.011)


def test_a_binary_extract_gives_the_same_buildings(extract, tmp_path):
    binary = tmp_path / "town.osm.pbf"
    with osmium.SimpleWriter(str(binary)) as writer:
        for item in osmium.FileProcessor(extract):
            writer.add(item)
    one, frame = read_openstreetmap(extract)
    other, same = read_openstreetmap(binary)
    # PBF keeps degrees to 1e-7, as pyosmium does.
    assert frame == same
    assert one.name == other.name
    assert shapely.equals(one.polygon, other.polygon).all()


def test_the_default_frame_is_centred_on_the_buildings(extract):
    buildings, frame = read_openstreetmap(extract, rule=HeightRule(default=5.0))
    assert buildings.bounds == pytest.approx([-110, -10, 110, 10], abs=0.02)
    assert buildings.top[2] == 5.0
    corner = frame.to_geographic([*buildings.bounds[:2], 0.0])
    np.testing.assert_allclose(FRAME.to_scene(*corner[:2])[:2], [0, 0], atol=0.02)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("<osm version='0.6'></osm>", "no complete building"),
        ("no XML", "cannot be read"),
        ("<osm version='0.6'><node id='1'", "cannot be read"),
        ("<osm version='0.6'><node id='1' version='1' lat='50.0x' lon='9'/></osm>", "cannot be read"),
    ],
)
def test_a_file_that_is_not_an_extract_is_refused(tmp_path, text, message):
    path = tmp_path / "x.osm"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_openstreetmap(path)


@pytest.mark.parametrize("wrong", [{"storey": 0.0}, {"default": float("nan")}])
def test_a_senseless_height_rule_is_refused(wrong):
    with pytest.raises(InputError, match="greater than 0"):
        HeightRule(**wrong)


# Vector files


def layer(path: Path, heights: list, driver: str, crs: str = "EPSG:32632", **columns) -> Path:
    """Three squares in UTM metres around the planted origin."""
    origin = Frame.utm(11.5755, 48.1374)
    squares = [
        shapely.Polygon(moved(SQUARE, 50 * index + origin.easting, origin.northing)) for index in range(3)
    ]
    fields = {"hoehe": np.array(heights), **{name: np.array(values) for name, values in columns.items()}}
    pyogrio.raw.write(
        path, shapely.to_wkb(squares), list(fields.values()), list(fields), driver=driver, crs=crs,
        geometry_type="Polygon",
    )  # fmt: skip
    return path


@pytest.mark.parametrize(("driver", "ending"), [("GPKG", "gpkg"), ("ESRI Shapefile", "shp")])
def test_footprints_of_a_vector_file(tmp_path, driver, ending):
    path = layer(tmp_path / f"town.{ending}", [7.5, np.nan, 0.0], driver, storeys=[1.0, 5.0, np.nan])
    buildings, frame = read_footprints(path, "hoehe", levels="storeys", frame=Frame.utm(11.5755, 48.1374))
    assert buildings.top == pytest.approx([7.5, 15.0, 9.0])
    assert buildings.height_from == ("height", "levels", "default")
    assert buildings.bounds == pytest.approx([0, 0, 120, 20], abs=1e-6)
    assert frame.crs == "EPSG:32632"
    assert buildings.name == ("building-1", "building-2", "building-3")


def test_footprints_of_geojson_are_projected(tmp_path):
    corners = FRAME.to_geographic([(*corner, 0) for corner in [*SQUARE, SQUARE[0]]])[:, :2].tolist()
    feature = {
        "type": "Feature",
        "properties": {"h": "12,5 m", "name": "Hall"},
        "geometry": {"type": "Polygon", "coordinates": [corners]},
    }
    path = tmp_path / "town.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature, feature]}))
    buildings, frame = read_footprints(path, "h", name="name")
    assert buildings.name == ("Hall", "Hall-2")
    assert buildings.top == pytest.approx([12.5, 12.5])
    assert shapely.area(buildings.polygon) == pytest.approx([400, 400], rel=1e-3)
    assert frame.crs.startswith("+proj=aeqd")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": "height"}, "no column 'height'"),
        ({"height": "word"}, "holds 'high', must hold metres"),
        ({"height": "negative"}, "feature 2: negative = -1, must be finite and not negative"),
        ({"layer": "roads"}, "cannot be read"),
    ],
)
def test_wrong_columns_and_layers_are_refused(tmp_path, change, message):
    path = layer(tmp_path / "t.gpkg", [1.0, 2.0, 3.0], "GPKG", word=["high"] * 3, negative=[1.0, -1.0, 2.0])
    with pytest.raises(InputError, match=message):
        read_footprints(path, **{"height": "hoehe", **change})


@pytest.mark.filterwarnings("ignore")  # warnings of GDAL
@pytest.mark.parametrize(
    ("old", "new"),
    [(b"[0, 0], [1, 0], [1, 1], [0, 0]", b"[0, 0], [1, 0], [1, 1], [0, 2]"), (b'"h"', b'"\x85"')],
    ids=["open ring", "encoding"],
)
def test_malformed_geojson_is_refused(tmp_path, old, new):
    sound = (
        b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"h": 5}, "geometry": '
        b'{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}}]}'
    )
    path = tmp_path / "town.geojson"
    path.write_bytes(sound)
    assert len(read_footprints(path, 5.0)[0]) == 1
    path.write_bytes(sound.replace(old, new))
    with pytest.raises(InputError, match=r"town\.geojson: cannot be read"):
        read_footprints(path, 5.0)


def test_a_vector_file_needs_a_reference_system(tmp_path):
    path = layer(tmp_path / "town.shp", [1.0, 2.0, 3.0], "ESRI Shapefile")
    path.with_suffix(".prj").unlink()
    with pytest.raises(InputError, match="no reference system"):
        read_footprints(path, "hoehe")
    with pytest.raises(InputError, match="does not exist"):
        read_footprints(tmp_path / "nowhere.gpkg", "hoehe")


# Height models


def height_model(path: Path, missing: bool = False) -> Path:
    """A plane in UTM metres: 500 m and 0.05 m a metre to the east, 0.02 m to the north."""
    origin = Frame.utm(11.5755, 48.1374)
    west, north, cell, count = origin.easting - 400.0, origin.northing + 400.0, 10.0, 80
    middle = (np.arange(count) + 0.5) * cell - 400.0
    heights = np.add.outer(-0.02 * middle, 0.05 * middle) + 500.0
    if missing:
        heights[30:33, 40:44] = -9999.0
    with rasterio.open(
        path, "w", driver="GTiff", width=count, height=count, count=1, dtype="float64", crs="EPSG:32632",
        transform=Affine(cell, 0, west, 0, -cell, north), nodata=-9999.0,
    ) as model:  # fmt: skip
        model.write(heights, 1)
    return path


def test_a_plane_is_interpolated_exactly(tmp_path):
    frame = Frame.utm(11.5755, 48.1374, height=490.0)
    terrain = read_terrain(
        height_model(tmp_path / "dem.tif"), frame, (-103.0, -50.0, 203.0, 151.0), spacing=7.0
    )
    east, north = np.meshgrid(terrain.x, terrain.y)
    np.testing.assert_allclose(terrain.z, 10.0 + 0.05 * east + 0.02 * north, atol=1e-9)
    assert np.diff(terrain.x).max() <= 7.0
    assert (terrain.x[0], terrain.x[-1], terrain.y[0], terrain.y[-1]) == (-103.0, 203.0, -50.0, 151.0)
    x, y = np.random.default_rng(1).uniform(-50, 150, (2, 40))
    np.testing.assert_allclose(terrain.heights(x, y), 10.0 + 0.05 * x + 0.02 * y, atol=1e-9)


def test_the_origin_moves_to_the_lowest_ground(tmp_path):
    terrain = read_terrain(height_model(tmp_path / "dem.tif"), FRAME, (-100, -100, 100, 100))
    low, frame = lower_origin(terrain, FRAME)
    assert 0 <= low.z.min() < 1
    np.testing.assert_allclose(low.z + frame.height, terrain.z)
    assert frame.crs == FRAME.crs


def test_a_height_model_in_another_projection_is_placed_correctly(tmp_path):
    """A local frame is rotated against UTM by the meridian convergence, here 2 degrees from the central meridian."""
    terrain = read_terrain(height_model(tmp_path / "dem.tif"), FRAME, (-100, -100, 100, 100))
    utm = Frame.utm(11.5755, 48.1374)
    corner = utm.to_scene(*FRAME.to_geographic([100.0, 100.0, 0.0])[:2])
    assert terrain.heights([100.0], [100.0])[0] == pytest.approx(
        500 + 0.05 * corner[0] + 0.02 * corner[1], abs=1e-6
    )
    assert 21 <= len(terrain.x) <= 22


def test_missing_heights_are_filled_and_counted(tmp_path):
    frame = Frame.utm(11.5755, 48.1374)
    terrain = read_terrain(height_model(tmp_path / "dem.tif", missing=True), frame, (-100, -100, 100, 100))
    assert np.isfinite(terrain.z).all()
    assert terrain.repairs == {"heights missing, taken from the nearest": 12}
    buildings, _ = read_footprints(layer(tmp_path / "t.gpkg", [5.0, 5.0, 5.0], "GPKG"), "hoehe", frame=frame)
    wide = read_terrain(height_model(tmp_path / "dem.tif", missing=True), frame, (-100, -100, 200, 100))
    made = make_scene(buildings, tmp_path / "scene", frame, wide)
    assert made.counts["heights missing, taken from the nearest"] == 12


@pytest.mark.parametrize(
    ("bounds", "spacing", "message"),
    [
        ((0, 0, 1000, 10), None, "does not cover"),
        ((-100, -100, 100, 100), 0.01, "give a wider one"),
        ((-100, -100, 100, 100), -1.0, "greater than 0"),
    ],
)
def test_an_unsuitable_height_model_is_refused(tmp_path, bounds, spacing, message):
    with pytest.raises(InputError, match=message):
        read_terrain(height_model(tmp_path / "dem.tif"), Frame.utm(11.5755, 48.1374), bounds, spacing)
    (tmp_path / "no.tif").write_text("text")
    with pytest.raises(InputError, match="cannot be read"):
        read_terrain(tmp_path / "no.tif", FRAME, (0, 0, 1, 1))


# Without the libraries


@pytest.mark.parametrize("package", ["osmium", "shapely", "pyproj"])
def test_a_missing_library_is_named_with_its_extra(extract, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        InputError, match=rf"{package} is not installed .*pip install 'calibray\[(scenes|geo)\]'"
    ):
        read_openstreetmap(extract)
