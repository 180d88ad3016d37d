"""A study with a region of extra loss, from its file to predictions."""

import json
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.errors import InputError
from calibray.reporting import link_map
from calibray.reporting.page import collect, page
from calibray.reporting.wording import scene_alone_text
from calibray.scenes.authoring import Terrain, make_scene, read_openstreetmap, read_trees
from calibray.scenes.checks import SceneSurfaces
from calibray.scenes.obstruction import clutter_loss_db
from calibray.study import Setup, Study
from calibray.study.regions import Place, RegionSection, dense_trees, region_effects
from calibray.study.row_steps import study_regions
from commands import write_study
from link_tables import links_from_frame
from planted_maps import FRAME, write_park

TREES = "region:trees.specific_attenuation"
BOX = [5.0, -10.0, 15.0, 10.0]
REGIONS = {"trees": {"boxes": [BOX], "top": 8.0, "specific_attenuation": 0.3, "maximum_db": 40.0}}
PARAMETERS = {"marble.relative_permittivity": {"bounds": planted.BOUNDS}, TREES: {"bounds": [0.0, 3.0]}}
TRUTH = np.array([planted.TRUTH["marble.relative_permittivity"], 0.9])
FEW = {"name": "auto", "options": {"starts": 16}}


def study(folder, **sections):
    changes = {"regions": REGIONS, "parameters": PARAMETERS, "method": FEW, **sections}
    return planted.study(folder, planted.links(), **changes)


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    return Setup.open(study(tmp_path_factory.mktemp("regions")), links=links_from_frame(planted.links()))


@pytest.fixture(scope="module")
def engine(opened):
    return engines.make(opened)


def test_the_length_in_the_region_is_that_of_the_paths(opened, engine):
    (effect,) = opened.effects(engine.paths)
    paths = engine.paths
    share = (np.arange(4000) + 0.5) / 4000
    for number in range(0, paths.num_paths, 7):
        link = paths.link[number]
        inner = paths.vertex[paths.first[number] : paths.first[number + 1]]
        nodes = np.vstack([paths.tx_position[link], inner, paths.rx_position[link]])
        length = 0.0
        for start, end in pairwise(nodes):
            point = start + share[:, None] * (end - start)
            inside = (point[:, 0] > 5) & (point[:, 0] < 15) & (np.abs(point[:, 1]) < 10) & (point[:, 2] < 8)
            length += np.mean(inside & (point[:, 2] > 0)) * np.linalg.norm(end - start)
        assert effect.length[number] == pytest.approx(length, abs=0.05)
    assert effect.length.max() > 9.0


def test_a_planted_attenuation_is_found_and_used_for_predictions(tmp_path, engine):
    noise = 0.2 * np.random.default_rng(4).standard_normal(planted.LINKS)
    table = planted.links().assign(path_loss_db=engine.path_loss(TRUTH[None])[0] + noise)
    plan = planted.study(tmp_path, table, regions=REGIONS, parameters=PARAMETERS, method=FEW)
    result = calibrate(plan)
    assert result.parameters[TREES] == pytest.approx(0.9, abs=0.1)
    assert result.intervals[TREES].contains(0.9)
    assert "region:trees" not in result.materials
    result.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.predict(planted.links()) == pytest.approx(result.links.after_db.to_numpy(), abs=1e-6)
    # The exported scene has no trees, and the result says how much that changes.
    difference = result.links.after_db - result.links.scene_db
    assert difference.max() > 5.0
    assert "a scene cannot contain the region trees" in scene_alone_text(result)
    # The map of the report has the outline of the trees.
    data = collect(loaded)
    layout = link_map.plan(data.links, data.triangles, data.regions.values())
    html = page(loaded, data, {})
    assert re.search(f'class="regions" d="{layout.regions}".*<i class="regions"></i>trees<', html, re.DOTALL)
    corners = np.array([corner.split(",") for corner in layout.regions.strip("MZ").split("L")], dtype=float)
    west, south, east, north = BOX
    box = layout.project(np.array([[west, south], [east, north]]))
    assert [*corners.min(axis=0), *corners.max(axis=0)] == pytest.approx(
        [*box.min(axis=0), *box.max(axis=0)], abs=0.051
    )
    # With the attenuation that the study states, no permittivity comes close.
    stated = np.column_stack([np.linspace(*planted.BOUNDS, 100), np.full(100, 0.3)])
    error = engine.path_loss(stated) - table["path_loss_db"].to_numpy()
    assert np.sqrt(np.mean(error**2, axis=1)).min() > result.rmse_db + 0.3


@pytest.mark.parametrize(("column", "height"), [("h", 8.0), ("height_ft", 8.0 / 0.3048)])
def test_a_file_of_polygons_gives_the_same_as_a_box(tmp_path, opened, engine, column, height):
    west, south, east, north = BOX
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    feature = {
        "type": "Feature",
        "properties": {column: height},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    content = {"type": "FeatureCollection", "features": [feature]}
    (tmp_path / "trees.geojson").write_text(json.dumps(content))
    section = {"file": "trees.geojson", "position": "scene", "top": column, "specific_attenuation": 0.3}
    other = Setup.open(study(tmp_path, regions={"trees": section}), links=links_from_frame(planted.links()))
    (effect,), (expected,) = other.effects(engine.paths), opened.effects(engine.paths)
    assert effect.length == pytest.approx(expected.length)
    assert effect.maximum_db == pytest.approx(1.15 * 3500**0.43)
    assert "trees.geojson" in other.files


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"regions": {}}, r"no \[regions\.trees\]"),
        ({"regions": {"trees": REGIONS["trees"] | {"boxes": []}}}, "a canopy or boxes"),
        ({"regions": {"trees": REGIONS["trees"] | {"canopy": "c.tif"}}}, "give exactly one of these"),
        ({"regions": {"trees": {"boxes": [BOX], "specific_attenuation": 0.3}}}, r"needs top \[m\]"),
        ({"regions": {"trees": REGIONS["trees"] | {"boxes": [[5, 0, 1, 2]]}}}, "west less than east"),
        ({"regions": {"trees": REGIONS["trees"] | {"bottom": 9.0}}}, "must be less than top"),
        ({"regions": {"trees": REGIONS["trees"] | {"top": "h"}}}, "column names apply only to a file"),
        (
            {
                "regions": {},
                "parameters": {"marble.relative_permittivity": PARAMETERS["marble.relative_permittivity"]},
                "nuisance": {"trees": {"by": "region_m"}},
            },
            r"needs \[regions\]",
        ),
        ({"engine": {"name": "retrace"}}, "needs engine.name = 'replay'"),
        ({"engine": {"name": "replay", "compress_db": 0.1}}, "compress_db"),
        ({"parameters": {"region:trees.colour": {"bounds": [0, 1]}}}, "no field 'colour'"),
        ({"parameters": {TREES: {"bounds": [0, 1], "start": "itu:wood"}}}, "give a number"),
        ({"parameters": {TREES: {"bounds": [-1, 1]}}}, "must be"),
    ],
)
def test_impossible_regions_are_refused(tmp_path, sections, message):
    with pytest.raises(InputError, match=message):
        study(tmp_path, **sections)


def test_files_and_columns_that_cannot_be_used_are_named(tmp_path):
    section = {"file": "trees.geojson", "top": "h", "specific_attenuation": 0.3}
    with pytest.raises(InputError, match=r"regions\.trees\.file"):
        study(tmp_path, regions={"trees": section}).check_files()
    point = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [1, 2]}}
    (tmp_path / "trees.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [point]}))
    opened = Setup.open(study(tmp_path, regions={"trees": section}), links=links_from_frame(planted.links()))
    with pytest.raises(InputError, match="none of the 1 features is a polygon"):
        opened.effects(planted.engine().paths)
    metres = {"type": "Polygon", "coordinates": [[[200, 0], [210, 0], [210, 5], [200, 0]]]}
    feature = {"type": "Feature", "properties": {"h": 8.0}, "geometry": metres}
    file = tmp_path / "trees.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(
        InputError, match=r"trees\.geojson: longitude of position 0 is 200.*position = 'scene'"
    ):
        RegionSection.model_validate(section).region(file, Place(FRAME, lambda: None))


def test_trees_are_written_next_to_a_scene_and_read_as_a_region(tmp_path):
    wooded = write_park(tmp_path / "park.osm")
    buildings, frame = read_openstreetmap(wooded, FRAME)
    trees = read_trees(wooded, frame)
    made = make_scene(buildings, tmp_path / "scene", frame, trees=trees)
    assert made.counts["trees"] == 2
    file = tmp_path / "scene" / "trees.geojson"
    content = {
        "file": file.name,
        "heights": "ground",
        "bottom": "bottom",
        "top": "top",
        "specific_attenuation": 0.5,
    }
    section = RegionSection(**content)
    place = Place(frame, lambda: SceneSurfaces.read(made.path))
    region = section.region(file, place)
    # Through the crown of 8 m at 6 m, and under it at 2 m; through the wood.
    start = np.array([[30, 5, 0.0], [25, 5, 6.0], [25, 5, 2.0], [35, 10, 9.0]])
    end = np.array([[30, 5, 20.0], [35, 5, 6.0], [35, 5, 2.0], [70, 10, 9.0]])
    assert region.length_inside(start, end) == pytest.approx([9.5, 8.0, 0.0, 20.0], abs=0.1)
    # A scene without trees in the same folder has no file of them.
    make_scene(buildings, tmp_path / "scene", frame)
    assert not file.exists()


def test_heights_above_the_ground_follow_a_slope():
    slope = np.array([[[0, 0, 0], [100, 0, 50], [0, 100, 0]], [[100, 0, 50], [100, 100, 50], [0, 100, 0]]])
    surfaces = SceneSurfaces(slope.astype(float), np.zeros((0, 3, 3)), np.array([0, 0, 0, 100, 100, 50.0]))
    boxes = ((10, 10, 20, 20), (60, 10, 70, 20), (90, 10, 190, 20), (400, 0, 410, 9))
    heights = {"bottom": 2.0, "top": 8.0, "heights": "ground"}
    section = RegionSection(boxes=boxes, specific_attenuation=0.3, **heights)
    region = section.region(None, Place(None, lambda: surfaces))
    # The third box is cut at the edge of the ground, the fourth has none. A line along the slope 5 m above the ground;
    # a level one, which enters the first box 9.5 m above the ground and is at 8 m after 3 m; and an upright one.
    start = np.array([[0, 15, 5.0], [0, 15, 14.5], [65, 15, 100.0]])
    end = np.array([[100, 15, 55.0], [100, 15, 14.5], [65, 15, 0.0]])
    assert region.length_inside(start, end) == pytest.approx([30 * np.hypot(1, 0.5), 7.0, 6.0])


def test_a_wood_follows_the_hills_below_it():
    """A wood of 15 m over hills of 50 m; lines from 1.5 to 25 m above the ground to 1.5 m."""
    side = np.linspace(0.0, 400.0, 81)
    hills = Terrain(side, side, 25 * np.outer(np.cos(side / 60), np.sin(side / 70)))
    mesh = hills.mesh()
    corners = mesh.vertices[mesh.faces]
    bounds = np.concatenate([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    surfaces = SceneSurfaces(corners, np.zeros((0, 3, 3)), bounds)
    section = RegionSection(boxes=((40, 40, 360, 360),), top=15.0, heights="ground", specific_attenuation=0.3)
    region = section.region(None, Place(None, lambda: surfaces))
    random = np.random.default_rng(0)
    plan = random.uniform(50, 350, (2, 300, 2))
    above = np.array([random.uniform(1.5, 25, 300), np.full(300, 1.5)])
    start, end = (np.column_stack([p, hills.heights(*p.T) + h]) for p, h in zip(plan, above, strict=True))
    share = (np.arange(400) + 0.5)[:, None, None] / 400
    point = start + share * (end - start)
    height = point[..., 2] - hills.heights(*point[..., :2].reshape(-1, 2).T).reshape(point.shape[:2])
    inside = ((height > 0) & (height < 15)).mean(axis=0) * np.linalg.norm(end - start, axis=1)
    error = region.length_inside(start, end) - inside
    assert inside.mean() > 50
    assert np.sqrt(np.mean(error**2)) < 0.5


def test_a_polygon_without_ground_below_it_is_refused_by_its_number():
    """The ground is an L."""
    quads = [((0, 0), (100, 50)), ((0, 50), (50, 100))]
    faces = [[[a, b, 0], [c, b, 0], [c, d, 0]] for (a, b), (c, d) in quads]
    faces += [[[a, b, 0], [c, d, 0], [a, d, 0]] for (a, b), (c, d) in quads]
    surfaces = SceneSurfaces(np.array(faces, float), np.zeros((0, 3, 3)), np.array([0, 0, 0, 100, 100, 0.0]))
    boxes = ((400, 0, 410, 9), (10, 10, 20, 20), (60, 60, 90, 90))
    section = RegionSection(boxes=boxes, top=8.0, heights="ground", specific_attenuation=0.3)
    with pytest.raises(
        InputError, match=r"boxes: the scene has no ground below polygon 3; remove the polygon"
    ):
        section.region(None, Place(None, lambda: surfaces))


def test_a_region_outside_the_scene_is_named_in_a_warning(tmp_path, caplog):
    away = REGIONS["trees"] | {"boxes": [[5000, 5000, 5010, 5010]], "heights": "ground"}
    assert not len(study_regions(study(tmp_path, regions={"trees": away}))["trees"].outline)
    assert "study.toml: [regions.trees] is outside the scene and has no effect" in caplog.text
    caplog.clear()
    study_regions(study(tmp_path, regions={"trees": REGIONS["trees"] | {"heights": "ground"}}))
    assert not caplog.text


def test_keys_without_effect_are_named_when_the_study_is_read(tmp_path, caplog):
    planted.links().to_csv(tmp_path / "links.csv", index=False)
    facade = {"of": "marble", "boxes": [BOX], "position": "scene", "module": 2.0, "storey_height": 4.0}
    regions = {"trees": REGIONS["trees"] | {"position": "geographic"}}
    trace = {"edge_diffraction": True, "diffraction_lit_region": False}
    content = planted.content("links.csv") | {"regions": regions, "facades": {"shop": facade}, "trace": trace}
    write_study(tmp_path, content)
    Study.load(tmp_path / "study.toml")
    for key, needed in (
        ("regions.trees.position", "file"),
        ("facades.shop.position", "file"),
        ("facades.shop.module", "share"),
        ("facades.shop.storey_height", "storeys"),
        ("trace.edge_diffraction", "diffraction = true"),
        ("trace.diffraction_lit_region", "diffraction = true"),
    ):
        assert f"study.toml: {key} has no effect without {needed}" in caplog.text
    caplog.clear()
    rules = {"of": "marble", "storeys": [1, 1], "storey_height": 4.0, "share": 0.2, "module": 2.0}
    trace["diffraction"] = True
    write_study(tmp_path, content | {"regions": REGIONS, "facades": {"shop": rules}})
    Study.load(tmp_path / "study.toml")
    assert "no effect" not in caplog.text


def test_attenuation_rises_with_the_carrier(opened, engine):
    twice = engine.paths.at(2 * engine.paths.frequency)
    arguments = opened.study.regions, opened.regions, opened.parameters
    (effect,) = region_effects(*arguments, twice, engine.paths.frequency)
    (stated,) = opened.effects(engine.paths)
    assert effect.length == pytest.approx(2**0.284 * stated.length)
    assert dense_trees(2e9) == pytest.approx(0.45 * 2**0.284)


def test_nuisances_by_region_and_clutter_have_their_columns(tmp_path):
    nuisance = {"trees": {"by": "region_m"}, "clutter": {"by": "clutter_db", "bounds": [0.0, 1.0]}}
    table = planted.links()
    table.loc[0, "rx_x"] = -900.0
    setup = Setup.open(study(tmp_path, nuisance=nuisance), links=links_from_frame(table))
    # The straight line from (0, 0) to a receiver at x > 15 crosses the box from x = 5 to 15.
    far = (table["rx_x"] > 15).to_numpy()
    rise = np.linalg.norm(setup.links.rx - setup.links.tx, axis=1) / table["rx_x"]
    assert setup.links.table.numbers("region_m")[far] == pytest.approx(10 * rise[far])
    clutter = setup.links.table.numbers("clutter_db")
    assert clutter[0] == pytest.approx(clutter_loss_db(setup.links.distance[:1], 3.5e9)[0])
    assert clutter[0] > 20
    assert not clutter[1:].any()
    # Other links get them too, and a study without such a nuisance has neither.
    assert {"region_m", "clutter_db"} <= set(setup.at(links_from_frame(planted.links())).links.frame)
    assert "region_m" not in Setup.open(study(tmp_path), links=links_from_frame(table)).links.frame


def test_a_study_without_regions_has_no_effects():
    plain = Setup.open(
        Study.from_content(planted.content("links.csv")), links=links_from_frame(planted.links())
    )
    assert plain.effects(planted.engine().paths) == ()


@pytest.mark.parametrize("other", ["chunks", "carriers"])
def test_the_scene_alone_has_no_trees_at_several_carriers_and_in_chunks(engine, opened, other):
    study, links = opened.study, opened.links
    if other == "chunks":
        study = Study.from_content(
            study.content() | {"engine": {"name": "replay", "chunk_links": 5}}, study.path
        )
    else:
        links = replace(links, frequency=np.where(np.arange(planted.LINKS) % 2, 3.5e9, 2e9))
    divided = engines.make(Setup.open(study, links=links))
    with_trees, alone = divided.path_loss(TRUTH[None])[0], divided.scene_path_loss(TRUTH[None], {})[0]
    expected = engine.scene_path_loss(TRUTH[None], {})[0]
    same = slice(1, None, 2) if other == "carriers" else slice(None)
    assert alone[same] == pytest.approx(expected[same], abs=1e-6)
    assert (with_trees - alone).max() > 5.0
