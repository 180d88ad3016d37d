"""Facades: materials by where on one mesh a path interacts, against the geometry of the paths."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely

import planted
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.engines import Replay
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.fitting.problem import Problem
from calibray.materials import itu_material
from calibray.paths import Kind
from calibray.reporting.wording import scene_alone_text
from calibray.scenes.checks import SceneSurfaces
from calibray.study import Setup, Study
from calibray.study.facades import FacadeSection, _applies, with_facades
from calibray.study.regions import Place
from calibray.uncertainty.joint_model import joint_model
from link_tables import links_from_frame

SHOP = "shop.relative_permittivity"
GROUND_FLOOR = {"shop": {"of": "marble", "storeys": [1, 1], "storey_height": 2.0}}


@pytest.fixture(scope="module")
def paths():
    return planted.engine().paths


def opened(**sections) -> Setup:
    content = planted.content("links.csv", **sections)
    return Setup.open(Study.from_content(content), links=links_from_frame(planted.links()))


def test_a_stated_constant_of_a_facade_leaves_the_other_its_law_over_frequency():
    setup = opened(
        facades=GROUND_FLOOR,
        materials={"shop": {"itu": "glass", "relative_permittivity": 5.0}},
        parameters={"shop.itu_c": {"bounds": [1e-4, 1.0]}},
    )
    parameters = setup.parameters
    for carrier in (setup.study.scene.frequency, 28e9):
        shop = parameters.materials(parameters.start, setup.scene.materials, carrier)["shop"]
        assert shop.relative_permittivity == 5.0
        assert shop.conductivity == pytest.approx(itu_material("glass", carrier).conductivity)


def test_a_facade_of_smooth_walls_is_smooth():
    """A scattering coefficient of 0 that the study states is exact, also on a part of these walls."""
    parameters = {name: {"bounds": planted.BOUNDS} for name in ("marble.relative_permittivity", SHOP)}
    smooth = {"marble": {"scattering_coefficient": 0.0}}

    def uncertain(**sections) -> set[str]:
        setup = opened(facades=GROUND_FLOOR, parameters=parameters, noise=None, **sections)
        problem = Problem.of(setup, Replay(setup.trace(), setup.parameters))
        problem = replace(problem, objective=replace(problem.objective, measured=problem.before))
        point = setup.parameters.to_search(setup.parameters.start)
        model = joint_model(problem, point, 0.3**2, problem.freedom)
        return {name for name in model.parameters.names if name.endswith("scattering_coefficient")}

    assert uncertain() == {"marble.scattering_coefficient", "shop.scattering_coefficient"}
    assert not uncertain(materials=smooth)


def names_of(paths) -> np.ndarray:
    return np.array(list(paths.materials))[paths.material]


def test_a_storey_has_its_own_material(paths):
    setup = opened(facades=GROUND_FLOOR, materials={"shop": {"itu": "glass", "thickness": 0.02}})
    found = setup.trace()
    ground = SceneSurfaces.read("sionna:simple_street_canyon").bounds[2]  # 3 cm below z = 0
    low = (names_of(paths) == "marble") & (paths.vertex[:, 2] < ground + 2.0)
    high = (names_of(paths) == "marble") & ~low
    assert low.sum() > 3
    assert high.sum() > 3
    assert (names_of(found) == np.where(low, "shop", names_of(paths))).all()
    assert found.materials["shop"].relative_permittivity == pytest.approx(6.31)
    assert found.materials["shop"].thickness == 0.02
    # The tracer knows nothing of it, and with equal constants nothing changes.
    assert "shop" not in paths.materials
    equal = opened(facades=GROUND_FLOOR).trace()
    assert path_loss(equal) == pytest.approx(path_loss(paths), abs=1e-12)


def test_sides_are_told_by_the_outward_normal(paths):
    place = Place(None, lambda: SceneSurfaces.read("sionna:simple_street_canyon"))
    half = {"to the north": (270.0, 90.0), "to the south": (90.0, 270.0)}
    facades = {name: FacadeSection(of="wood", facing=facing) for name, facing in half.items()}
    materials = paths.materials | {name: paths.materials["wood"] for name in facades}
    found = with_facades(paths, facades, dict.fromkeys(facades), place, materials)
    of_path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    checked = 0
    for hit in np.flatnonzero((names_of(paths) == "wood") & (paths.kind == Kind.SPECULAR)):
        path = of_path[hit]
        link, first, last = paths.link[path], paths.first[path], paths.first[path + 1]
        nodes = np.vstack([paths.tx_position[link], paths.vertex[first:last], paths.rx_position[link]])
        at = hit - first + 1
        into, out = nodes[at] - nodes[at - 1], nodes[at + 1] - nodes[at]
        # A reflection turns the ray towards the normal of the side that it comes from.
        turn = out / np.linalg.norm(out) - into / np.linalg.norm(into)
        expected = "to the north" if turn[1] > 0 else "to the south"
        assert names_of(found)[hit] == expected
        checked += 1
    assert checked > 5


def wall_points() -> tuple[Place, np.ndarray]:
    """A wall 12 m long and 9 m high from (0, 0) to (12, 0) that faces south, on level ground, and points on it."""
    corner = np.array([[0, 0, 0], [12, 0, 0], [12, 0, 9], [0, 0, 9.0]])
    ground = np.array([[[-50, -50, 0], [50, -50, 0], [0, 90, 0.0]]])
    surfaces = SceneSurfaces(ground, corner[[[0, 1, 2], [0, 2, 3]]], np.array([-50, -50, 0, 50, 90, 9.0]))
    x = np.linspace(0.05, 11.95, 120)
    return Place(None, lambda: surfaces), np.column_stack([x, 0 * x, np.full(120, 4.0)])


def applied(place, point, files=None, **rules):
    """Names of the materials at points of a wall whose single facade is `part`."""
    paths = planted.engine().paths
    count = len(point)
    wall = {"wall": paths.materials["wood"]}
    none = np.zeros(count, dtype=int)
    few = replace(paths, vertex=point, material=none, kind=none + 1, materials=wall)
    section = FacadeSection(of="wall", **rules)
    materials = {"wall": paths.materials["wood"], "part": paths.materials["wood"]}
    return names_of(with_facades(few, {"part": section}, {"part": files}, place, materials)) == "part"


@pytest.mark.parametrize(
    "rules", [{"storeys": (1, 1)}, {"facing": (90.0, 270.0)}, {"share": 0.9, "module": 12.0}]
)
def test_ground_of_the_walls_material_is_no_part_of_a_facade(rules):
    """Points on the ground up to 40 m south of the wall; a scene of ground alone has no facade either."""
    place, point = wall_points()
    middle = point[50:70] * [1, 1, 0.25]
    assert applied(place, middle, **rules).all()
    ground = middle * [1, 0, 0] - np.linspace(0, 40, 20)[:, None] * [0, 1, 0]
    assert not applied(place, ground[1:], **rules).any()
    bare = replace(place.surfaces(), walls=np.zeros((0, 3, 3)))
    assert not applied(Place(None, lambda: bare), ground, **rules).any()


def test_strips_take_their_share_of_a_wall():
    place, point = wall_points()
    found = applied(place, point, share=0.25, module=3.2)  # four strips, one in the middle of every 3 m
    expected = np.abs(point[:, 0] % 3 - 1.5) < 0.375
    assert (found == expected).all()
    assert found.mean() == pytest.approx(0.25, abs=0.03)


def test_rules_apply_together_and_polygons_name_a_facade(tmp_path):
    place, point = wall_points()
    assert (
        applied(place, point, boxes=((2.0, -1.0, 5.0, 1.0),)).tolist()
        == ((point[:, 0] >= 2) & (point[:, 0] <= 5)).tolist()
    )
    assert not applied(place, point, storeys=(1, 1), boxes=((2.0, -1.0, 5.0, 1.0),)).any()
    assert applied(place, point, facing=(135.0, 225.0)).all()
    assert not applied(place, point, facing=(300.0, 60.0)).any()
    features = [
        {
            "type": "Feature",
            "properties": {"cladding": name},
            "geometry": json.loads(shapely.to_geojson(shapely.box(low, 0.2, low + 4, 10))),
        }
        for name, low in (("part", 0), ("brick", 4), ("part", 8))
    ]
    file = tmp_path / "houses.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    rules = {"file": "houses.geojson", "column": "cladding", "position": "scene"}
    found = applied(place, point, file, **rules)
    assert found[(point[:, 0] < 4) | (point[:, 0] > 8)].all()
    assert not found[(point[:, 0] > 4.5) & (point[:, 0] < 7.5)].any()
    with pytest.raises(InputError, match="no column 'colour'"):
        applied(place, point, file, **rules | {"column": "colour"})
    features[0]["properties"]["cladding"] = features[2]["properties"]["cladding"] = "stone"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    with pytest.raises(InputError, match="no polygon has 'part'"):
        applied(place, point, file, **rules)


def test_a_whole_number_names_a_facade(tmp_path):
    place, point = wall_points()
    shape, file = json.loads(shapely.to_geojson(shapely.box(0, 0.2, 12, 10))), tmp_path / "houses.geojson"
    feature = {"type": "Feature", "properties": {"house": 12}, "geometry": shape}
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    section = FacadeSection(of="brick", file="houses.geojson", column="house", position="scene")
    assert _applies("12", section, file, place, place.surfaces(), point).all()


def test_a_planted_ground_floor_is_found_and_used_for_predictions(tmp_path):
    parameters = {name: {"bounds": planted.BOUNDS} for name in ("marble.relative_permittivity", SHOP)}
    plan = opened(facades=GROUND_FLOOR, parameters=parameters)
    truth = np.array([8.0, 2.5])
    paths = plan.trace()
    engine = Replay(paths, plan.parameters)
    noise = 0.1 * np.random.default_rng(1).standard_normal(planted.LINKS)
    table = planted.links().assign(path_loss_db=engine.path_loss(truth[None])[0] + noise)
    few = {"name": "auto", "options": {"starts": 16}}
    study = planted.study(tmp_path, table, facades=GROUND_FLOOR, parameters=parameters, method=few)
    result = calibrate(study)
    assert result.parameters[SHOP] == pytest.approx(2.5, abs=0.3)
    assert result.intervals[SHOP].contains(2.5)
    result.save(tmp_path / "out")
    loaded = Result.load(tmp_path / "out")
    assert loaded.predict(planted.links()) == pytest.approx(result.links.after_db.to_numpy(), abs=1e-6)
    # The exported scene has marble on the ground floor, and the result says how much that changes.
    whole = plan.parameters.materials(list(result.parameters.values()), plan.scene.materials)
    alone = path_loss(paths, whole | {"shop": whole["marble"]})
    assert result.links.scene_db.to_numpy() == pytest.approx(alone, abs=1e-6)
    assert "a scene cannot contain the facade shop" in scene_alone_text(result)


def population(**prior) -> dict:
    """Parameters of marble, and of a facade with a prior."""
    marble = {"bounds": planted.BOUNDS}
    return {"marble.relative_permittivity": marble, SHOP: marble | {"prior": {"spread": 0.05, **prior}}}


def test_a_facade_is_like_the_walls_that_it_is_part_of(tmp_path):
    parameters = population(like="marble.relative_permittivity")
    plan = planted.study(tmp_path, planted.links(), facades=GROUND_FLOOR, parameters=parameters)
    assert plan.priors.like == ((1, 0),)
    residuals = plan.priors.residuals(np.array([[4.0, 4.0], [4.0, 4.0 * np.exp(0.05)]]))
    assert residuals[:, 0] == pytest.approx([0.0, 1.0])


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"like": "marbel.relative_permittivity"}, "must name another parameter"),
        ({"like": SHOP}, "must name another parameter"),
        ({"like": "marble.relative_permittivity", "itu": "glass"}, "one of itu, value and like"),
        ({"std": 1.0, "like": "marble.relative_permittivity"}, "remove itu, value, like"),
    ],
)
def test_impossible_populations_are_refused(tmp_path, prior, message):
    with pytest.raises(InputError, match=message):
        planted.study(tmp_path, planted.links(), facades=GROUND_FLOOR, parameters=population(**prior))


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"facades": {"shop": {"of": "marble"}}}, "needs a rule"),
        ({"facades": {"shop": {"of": "marble", "storeys": [2, 1]}}}, "first and the last"),
        ({"facades": {"shop": {"of": "marble", "share": 0.2, "column": "a"}}}, "state file as well"),
        (
            {"facades": GROUND_FLOOR, "engine": {"name": "retrace"}},
            r"\[facades\] needs engine.name = 'replay'",
        ),
    ],
)
def test_impossible_facades_are_refused(tmp_path, sections, message):
    with pytest.raises(InputError, match=message):
        planted.study(tmp_path, planted.links(), **sections)


@pytest.mark.parametrize(
    ("facades", "message"),
    [
        ({"shop": {"of": "marbel", "share": 0.2}}, "no material 'marbel'"),
        ({"wood": {"of": "marble", "share": 0.2}}, "has a material with this name"),
    ],
)
def test_facades_that_do_not_fit_the_scene_are_refused(facades, message):
    with pytest.raises(InputError, match=message):
        opened(facades=facades)
