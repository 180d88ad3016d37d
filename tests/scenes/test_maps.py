"""OpenStreetMap extracts, vector files and height models with known content."""

from __future__ import annotations

import http.server
import json
import sys
import threading
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
from calibray.scenes import export_scene, read_frame, read_scene
from calibray.scenes.authoring import (
    FootprintColumns,
    HeightRule,
    lower_origin,
    make_scene,
    read_footprints,
    read_openstreetmap,
    read_terrain,
    read_trees,
)
from calibray.scenes.authoring.trees import read_canopy
from planted_maps import FRAME, write_extract, write_park

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
    assert buildings.repairs == {
        "incomplete in the extract, left out": 1,
        "buildings with an unusable height or number of storeys, such as 'tall'": 1,
    }
    # Corners come back to the grid of 1 cm.
    assert shapely.area(buildings.polygon) == pytest.approx([400, 400, 400, 400, 300], rel=2e-3)
    assert buildings.bounds == pytest.approx([0, 0, 220, 20], abs=0.011)


def test_an_exported_scene_keeps_its_position_on_the_globe(extract, tmp_path):
    buildings, frame = read_openstreetmap(extract)
    made = make_scene(buildings, tmp_path / "scene", frame)
    scene = read_scene(made.path, 3.5e9)
    export_scene(scene, scene.materials, tmp_path / "exported.xml")
    assert read_frame(tmp_path / "exported.xml") == frame
    assert read_scene(tmp_path / "exported.xml", 3.5e9).sizes == scene.sizes


def test_a_denied_part_is_no_part(tmp_path):
    """An outline of 30 m with building:part=no has a part of 12 m over its whole area; another part is denied too."""
    tags = [
        {"building": "yes", "building:part": "no", "height": "30"},
        {"building": "no", "building:part": "yes", "height": "12"},
    ]
    ways = [(SQUARE, tag) for tag in tags] + [(moved(SQUARE, 50), {"building:part": "no", "height": "7"})]
    buildings, frame = read_openstreetmap(write_extract(tmp_path / "town.osm", ways), FRAME)
    assert dict(zip(buildings.top.tolist(), buildings.part.tolist(), strict=True)) == {
        30.0: False,
        12.0: True,
    }
    made = make_scene(buildings, tmp_path / "scene", frame)
    assert made.bounds[5] == 12.0


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
    buildings, frame = read_footprints(
        path, "hoehe", FootprintColumns(levels="storeys"), frame=Frame.utm(11.5755, 48.1374)
    )
    assert buildings.top == pytest.approx([7.5, 15.0, 9.0])
    assert buildings.height_from == ("height", "levels", "default")
    assert buildings.bounds == pytest.approx([0, 0, 120, 20], abs=1e-6)
    assert frame.crs == "EPSG:32632"
    assert buildings.name == ("building-1", "building-2", "building-3")


def test_heights_are_in_the_unit_of_their_name(tmp_path):
    path = layer(tmp_path / "t.gpkg", [1.0] * 3, "GPKG", HEIGHT_FT=[100.0] * 3, Top_ft=["50", "8 m", "50 ft"])
    assert read_footprints(path, "HEIGHT_FT")[0].top == pytest.approx([30.48] * 3)
    assert read_footprints(path, "Top_ft")[0].top == pytest.approx([15.24, 8.0, 15.24])


def test_footprints_of_geojson_are_projected(tmp_path):
    corners = FRAME.to_geographic([(*corner, 0) for corner in [*SQUARE, SQUARE[0]]])[:, :2].tolist()
    feature = {
        "type": "Feature",
        "properties": {"h": "12,5 m", "name": "Hall"},
        "geometry": {"type": "Polygon", "coordinates": [corners]},
    }
    path = tmp_path / "town.geojson"
    unnamed = feature | {"properties": {"h": "12,5 m", "name": None}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature, feature, unnamed]}))
    buildings, frame = read_footprints(path, "h", FootprintColumns(name="name"))
    assert buildings.name == ("Hall", "Hall-2", "building-3")
    assert buildings.top == pytest.approx([12.5] * 3)
    assert shapely.area(buildings.polygon) == pytest.approx([400] * 3, rel=1e-3)
    assert frame.crs.startswith("+proj=aeqd")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": "height"}, "no column 'height'"),
        (
            {"height": "word"},
            "polygon 1: word = 'high', but must be a length in metres; correct it, or leave",
        ),
        (
            {"height": None, "columns": FootprintColumns(levels="storeys")},
            "polygon 2: storeys = '4;5', but must be a number of storeys; correct it, or leave it empty",
        ),
        (
            {"height": "negative"},
            "polygon 2: negative = -1, but must be finite, not negative and at most 1000",
        ),
        ({"layer": "roads"}, r"^\S+t\.gpkg: no layer 'roads'; use one of: t$"),
    ],
)
def test_wrong_columns_and_layers_are_refused(tmp_path, change, message):
    fields = {"word": ["high"] * 3, "negative": [1.0, -1.0, 2.0], "storeys": ["4", "4;5", None]}
    path = layer(tmp_path / "t.gpkg", [1.0, 2.0, 3.0], "GPKG", **fields)
    with pytest.raises(InputError, match=message):
        read_footprints(path, **{"height": "hoehe", **change})


@pytest.mark.filterwarnings("ignore")  # warnings of GDAL
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"[0, 0], [0.1, 0], [0.1, 0.1], [0, 0]", b"[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.2]"),
        (b'"h"', b'"\x85"'),
    ],
    ids=["open ring", "encoding"],
)
def test_malformed_geojson_is_refused(tmp_path, old, new):
    sound = (
        b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"h": 5}, "geometry": '
        b'{"type": "Polygon", "coordinates": [[[0, 0], [0.1, 0], [0.1, 0.1], [0, 0]]]}}]}'
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
    with pytest.raises(InputError, match="no coordinate reference system"):
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
    assert terrain.repairs == {"missing heights, filled from the nearest cell": 12}
    buildings, _ = read_footprints(layer(tmp_path / "t.gpkg", [5.0, 5.0, 5.0], "GPKG"), "hoehe", frame=frame)
    wide = read_terrain(height_model(tmp_path / "dem.tif", missing=True), frame, (-100, -100, 200, 100))
    made = make_scene(buildings, tmp_path / "scene", frame, wide)
    assert made.counts["missing heights, filled from the nearest cell"] == 12


@pytest.mark.parametrize(
    ("bounds", "spacing", "message"),
    [
        ((0, 0, 1000, 10), None, "does not cover"),
        ((-100, -100, 100, 100), 0.01, "give a larger spacing"),
        ((-100, -100, 100, 100), -1.0, "greater than 0"),
    ],
)
def test_an_unsuitable_height_model_is_refused(tmp_path, bounds, spacing, message):
    with pytest.raises(InputError, match=message):
        read_terrain(height_model(tmp_path / "dem.tif"), Frame.utm(11.5755, 48.1374), bounds, spacing)
    (tmp_path / "no.tif").write_text("text")
    with pytest.raises(InputError, match="cannot be read"):
        read_terrain(tmp_path / "no.tif", FRAME, (0, 0, 1, 1))


# Formats, bounds and units of what GDAL opens


@pytest.mark.parametrize("height", ["9" * 400, "1000001", "1e400"])
def test_an_impossible_height_of_an_extract_is_a_guess(tmp_path, height):
    path = write_extract(tmp_path / "town.osm", [(SQUARE, {"building": "yes", "height": height})])
    buildings, _ = read_openstreetmap(path, FRAME)
    assert buildings.top.tolist() == [9.0]
    assert buildings.guessed()["default"] == list(buildings.name)


def test_an_unknown_reference_system_of_geojson_is_refused(tmp_path):
    path = tmp_path / "town.geojson"
    square = {"type": "Polygon", "coordinates": [[[0, 0], [0.1, 0], [0.1, 0.1], [0, 0]]]}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::999999"}}
    feature = {"type": "Feature", "properties": {}, "geometry": square}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    with pytest.raises(InputError, match=r"EPSG::999999.*unknown to PROJ"):
        read_footprints(path, 5.0)


@pytest.fixture
def requests():
    """A server on this machine, and the paths that were asked of it."""
    paths = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            paths.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", paths
    server.shutdown()
    server.server_close()


VECTORS = {
    "vrt": '<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/{url}/a.geojson</SrcDataSource>'
    "</OGRVRTLayer></OGRVRTDataSource>",
    "wfs": "<OGRWFSDataSource><URL>{url}/wfs</URL></OGRWFSDataSource>",
    "gdalg": '{{"type": "gdal_streamed_alg", "command_line": "gdal vector convert /vsicurl/{url}/a.geojson"}}',
    "geojson": '{{"type": "FeatureCollection", "features": [], "type": "gdal_streamed_alg", "command_line": '
    '"gdal vector convert /vsicurl/{url}/a.geojson"}}',
    "gml": '<gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml" '
    'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="x {url}/a.xsd"/>',
}
RASTERS = {
    "vrt": '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand band="1"><SimpleSource>'
    "<SourceFilename>/vsicurl/{url}/a.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
    "wms": '<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/a</ServerUrl></Service></GDAL_WMS>',
    "stac": '{{"type": "Feature", "stac_version": "1.0.0", "assets": {{"a": {{"href": "{url}/a.tif"}}}}}}',
}


@pytest.mark.parametrize("kind", VECTORS)
@pytest.mark.parametrize("ending", ["geojson", "gpkg", "shp"])
def test_a_vector_file_that_refers_to_the_network_is_refused(tmp_path, requests, kind, ending):
    url, paths = requests
    file = tmp_path / f"town.{ending}"
    file.write_text(VECTORS[kind].format(url=url))
    with pytest.raises(InputError, match=r"not in a supported format|cannot be read"):
        read_footprints(file, 5.0)
    assert not paths


@pytest.mark.parametrize("kind", RASTERS)
@pytest.mark.parametrize("ending", ["tif", "vrt"])
def test_a_height_model_that_refers_to_the_network_is_refused(tmp_path, requests, kind, ending):
    url, paths = requests
    file = tmp_path / f"dem.{ending}"
    file.write_text(RASTERS[kind].format(url=url))
    with pytest.raises(InputError, match=r"cannot be read .*give a GeoTIFF"):
        read_terrain(file, FRAME, (-10, -10, 10, 10))
    assert not paths


def test_a_mask_in_another_file_is_refused(tmp_path, requests):
    url, paths = requests
    file = height_model(tmp_path / "dem.tif")
    (tmp_path / "dem.tif.msk").write_text(RASTERS["vrt"].format(url=url))
    with pytest.raises(InputError, match=r"its mask dem\.tif\.msk is not read"):
        read_terrain(file, FRAME, (-10, -10, 10, 10))
    assert not paths
    (tmp_path / "dem.tif.msk").unlink()
    auxiliary = tmp_path / "dem.tif.aux.xml"
    auxiliary.write_text("<PAMDataset><PAMRasterBand><Scale>0.1</Scale></PAMRasterBand></PAMDataset>")
    with pytest.raises(InputError, match=r"dem\.tif\.aux\.xml states Scale, which is not read"):
        read_terrain(file, FRAME, (-10, -10, 10, 10))


def rewrite(
    source: Path, stored: str = "float64", crs: str = "EPSG:32632", unit: str = "", **changes
) -> Path:
    """A height model stored in another way, its numbers divided by `scale`."""
    scale, offset = changes.pop("scale", 1.0), changes.pop("offset", 0.0)
    with rasterio.open(source) as model:
        profile = {**model.profile, "dtype": stored, "crs": crs, **changes}
        heights = model.read(1)
    with rasterio.open(source, "w", **profile) as model:
        model.write(((heights - offset) / scale).astype(stored), 1)
        model.scales, model.offsets = (scale,), (offset,)
        if unit:
            model.units = (unit,)
    return source


@pytest.mark.parametrize(
    ("change", "factor"),
    [
        ({"stored": "int32", "scale": 0.001, "offset": 100.0, "nodata": None}, 1.0),
        ({"unit": "ft"}, 0.3048),
        ({"unit": "US survey foot"}, 1200 / 3937),
        ({"crs": "EPSG:32632+8228"}, 0.3048),
        ({"crs": "EPSG:32632+5773", "unit": "m"}, 1.0),
    ],
    ids=str,
)
def test_scale_offset_and_unit_of_a_height_model_are_respected(tmp_path, change, factor):
    file = rewrite(height_model(tmp_path / "dem.tif"), **change)
    terrain = read_terrain(file, Frame.utm(11.5755, 48.1374), (-100, -100, 100, 100), spacing=10.0)
    east, north = np.meshgrid(terrain.x, terrain.y)
    np.testing.assert_allclose(terrain.z, factor * (500 + 0.05 * east + 0.02 * north), atol=2e-3)


LOCAL = 'ENGCRS["site",EDATUM["site"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unit": "cubits"}, "the unit 'cubits' of its heights is not known"),
        ({"unit": "m", "crs": "EPSG:32632+8228"}, "states another unit"),
        ({"crs": LOCAL}, "has no position on the globe"),
        ({"crs": "EPSG:5773"}, "has no position on the globe|no coordinate reference system"),
        ({"transform": Affine(0, 0, 5, 0, 0, 6)}, "is not a grid|cannot be read|no reference|does not cover"),
        ({"transform": Affine(float("nan"), 0, 5, 0, -1, 6)}, "is not a grid"),
    ],
)
def test_a_height_model_without_a_usable_grid_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_terrain(rewrite(height_model(tmp_path / "dem.tif"), **change), FRAME, (-10, -10, 10, 10))


@pytest.mark.parametrize("gap", [-32768.0, -9999.0, -999.0, 9999.0, 32767.0, -3.4e38])
def test_an_undeclared_gap_is_no_height(tmp_path, gap):
    file = height_model(tmp_path / "dem.tif", missing=True)
    with rasterio.open(file) as model:
        heights, profile = model.read(1), model.profile
    heights[heights == -9999.0] = gap
    with rasterio.open(file, "w", **{**profile, "nodata": None}) as model:
        model.write(heights, 1)
    with pytest.raises(InputError, match=r"12 of .* values are .* not heights on land, such as .*a_nodata"):
        read_terrain(file, Frame.utm(11.5755, 48.1374), (-100, -100, 100, 100))


def test_cells_far_below_all_cells_around_them_cause_a_warning(tmp_path, caplog):
    """The number -999 in feet, not declared as nodata, is -304 m, a height that occurs on land."""
    file = height_model(tmp_path / "dem.tif", missing=True)
    with rasterio.open(file) as model:
        heights, profile = model.read(1), model.profile
    feet = np.where(heights == -9999.0, -999.0, heights / 0.3048)
    with rasterio.open(file, "w", **{**profile, "nodata": None}) as model:
        model.write(feet, 1)
        model.units = ("ft",)
    read_terrain(file, Frame.utm(11.5755, 48.1374), (-100, -100, 100, 100))
    assert "the height in 12 of 576 cells is -304.5 m" in caplog.text
    # Row 30 and column 40: 95 m to the north and 5 m to the east of the frame's origin, in UTM.
    assert "longitude 11.57561, latitude 48.13825" in caplog.text
    assert "-a_nodata -999)" in caplog.text
    caplog.clear()
    read_terrain(height_model(tmp_path / "dem.tif", missing=True), FRAME, (-100, -100, 100, 100))
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("tiled", "reach", "message"), [(True, 400, "at most 25,000,000"), (False, 4, "is stored in blocks of")]
)
def test_a_height_model_of_enormous_size_is_refused_before_it_is_read(tmp_path, tiled, reach, message):
    """A file of some kilobytes that declares 10^10 heights."""
    origin = Frame.utm(11.5755, 48.1374)
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=100_000, height=100_000, count=1, dtype="float64",
        crs="EPSG:32632", transform=Affine(0.01, 0, origin.easting - 500, 0, -0.01, origin.northing + 500),
        sparse_ok=True, compress="deflate", **({"tiled": True} if tiled else {"blockysize": 100_000}),
    ):  # fmt: skip
        pass
    with pytest.raises(InputError, match=message):
        read_terrain(tmp_path / "dem.tif", origin, (-reach, -reach, reach, reach))


def test_a_file_that_another_driver_takes_is_refused(tmp_path):
    """GDAL chooses its driver by content and by name; this file has the first bytes of another format."""
    (tmp_path / "town.csv").write_bytes(b"fgb\x03fgb\0" + b"\0" * 100 + b"\nid,h\n1,2\n")
    with pytest.raises(InputError, match=r"town\.csv: is damaged; give GeoJSON"):
        read_footprints(tmp_path / "town.csv", 5.0)


def test_a_vector_file_that_declares_more_than_fits_into_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("calibray.scenes.authoring.geodata.available_memory", lambda: 1000)
    with pytest.raises(InputError, match="declares 3 features, more than fit into memory"):
        read_footprints(layer(tmp_path / "town.gpkg", [1.0, 2.0, 3.0], "GPKG"), "hoehe")
    (tmp_path / "town.geojson").write_text('{"type": "FeatureCollection", "features": []}' + " " * 100)
    with pytest.raises(InputError, match=r"need about .* of memory; convert"):
        read_footprints(tmp_path / "town.geojson", 5.0)


# Without the libraries


@pytest.mark.parametrize("package", ["osmium", "shapely", "pyproj"])
def test_a_missing_library_is_named_with_its_extra(extract, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        InputError, match=rf"{package} is not installed .*pip install 'calibray\[(scenes|geo)\]'"
    ):
        read_openstreetmap(extract)


# Canopies


def canopy(path: Path, heights: np.ndarray, **changes) -> Path:
    """A raster of cells of 10 m around the origin of the frame, north up."""
    origin = Frame.utm(11.5755, 48.1374)
    rows, columns = heights.shape
    place = Affine(10.0, 0, origin.easting - 5 * columns, 0, -10.0, origin.northing + 5 * rows)
    profile = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": 1,
        "dtype": "float32",
        "nodata": -1.0,
    }
    with rasterio.open(path, "w", **profile | {"crs": "EPSG:32632", "transform": place} | changes) as model:
        model.write(heights.astype("float32"), 1)
    return path


def test_a_canopy_becomes_polygons_of_equal_height(tmp_path):
    heights = np.zeros((20, 20))
    heights[4:6, 10:15] = 12.4  # 50 m east of the origin, 40 to 60 m north of it
    heights[4, 15], heights[10, 2], heights[0, 0], heights[19, 19] = 7.0, 1.9, -1.0, 30.0
    heights[8, 8], heights[8, 12] = -9999.0, -999.0  # no trees, although the file declares only -1 as nodata
    frame = Frame.utm(11.5755, 48.1374)
    outline, top = read_canopy(canopy(tmp_path / "c.tif", heights), frame, np.array([-60, -60, 99, 99]))
    assert sorted(top) == [7.0, 12.0]
    big = outline[np.argmax(top)]
    assert big.bounds == pytest.approx((0, 40, 50, 60), abs=1e-6)
    assert shapely.area(outline).sum() == pytest.approx(1100, rel=1e-6)


def test_a_canopy_without_trees_in_the_scene_or_of_another_format_is_refused(tmp_path):
    frame, bounds = Frame.utm(11.5755, 48.1374), np.array([-60, -60, 99, 99])
    with pytest.raises(InputError, match="has no trees of 2 m or more within the scene"):
        read_canopy(canopy(tmp_path / "c.tif", np.ones((20, 20))), frame, bounds)
    (tmp_path / "c.vrt").write_text("<VRTDataset rasterXSize='1' rasterYSize='1'></VRTDataset>")
    with pytest.raises(InputError, match="give a GeoTIFF"):
        read_canopy(tmp_path / "c.vrt", frame, bounds)
    with pytest.raises(InputError, match="not heights on land"):
        read_canopy(canopy(tmp_path / "d.tif", np.full((20, 20), 60_000.0)), frame, bounds)


# Trees


def test_trees_of_an_extract_have_crowns_and_heights(tmp_path):
    trees = read_trees(write_park(tmp_path / "park.osm"), FRAME)
    assert len(trees) == 6
    near = trees.within(np.array([-50, -50, 110, 110]))
    assert near.counts == {
        "trees": 2,
        "tree rows": 1,
        "woods": 1,
        "forests": 1,
        "trees, tree rows and woods with an assumed height": 2,
    }
    by = {
        (kind, top): (shape, low)
        for kind, top, shape, low in zip(near.kind, near.top, near.outline, near.bottom, strict=True)
    }
    assert {key: low for key, (_, low) in by.items()} == {
        ("tree", 12.0): 2.5, ("tree", 10.0): 2.5, ("tree row", 4.0): 2.0, ("wood", 18.0): 0.0, ("forest", 15.0): 0.0,
    }  # fmt: skip
    # A crown of 8 m and an assumed one of 6 m; a row 50 m long with round ends; a wood; a forest with a clearing.
    areas = {key: shapely.area(shape) for key, (shape, _) in by.items()}
    assert areas["tree", 12.0] == pytest.approx(np.pi * 16, rel=0.01)
    assert areas["tree", 10.0] == pytest.approx(np.pi * 9, rel=0.01)
    assert areas["tree row", 4.0] == pytest.approx(300 + np.pi * 9, rel=0.01)
    assert areas["wood", 18.0] == pytest.approx(400, rel=0.01)
    assert areas["forest", 15.0] == pytest.approx(1800 - 200, rel=0.01)
    assert shapely.centroid(by["tree", 12.0][0]).coords[0] == pytest.approx((30, 5), abs=0.02)
