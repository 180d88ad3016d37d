"""Objects with a separate material: the scene is split, the physics stays the same."""

from types import SimpleNamespace

import numpy as np
import pytest

import calibray as cb
from calibray.errors import InputError
from calibray.scenes import Scene, export_scene, read_scene
from calibray.scenes.scene import exported_names

CANYON = "sionna:simple_street_canyon"
FREQUENCY = 3.5e9


def material_names(scene: Scene) -> dict[str, str]:
    return {item.name: item.material for item in scene.objects}


def test_a_pattern_gives_matching_objects_a_separate_material():
    whole, split = read_scene(CANYON, FREQUENCY), read_scene(CANYON, FREQUENCY, split={"north": "building_1"})
    before, after = material_names(whole), material_names(split)
    assert after["building_1"] == "north"
    assert {name for name in before if before[name] != after[name]} == {"building_1"}
    assert split.materials["north"] == whole.materials[before["building_1"]]


def test_a_star_gives_each_object_a_separate_material():
    split = read_scene(CANYON, FREQUENCY, split={"own/*": "building_*"})
    buildings = {
        name: material for name, material in material_names(split).items() if name.startswith("building_")
    }
    assert len(buildings) == 6
    assert all(material == f"own/{name}" for name, material in buildings.items())


def test_constants_of_the_whole_material_apply_unless_the_split_material_has_its_own():
    material = material_names(read_scene(CANYON, FREQUENCY))["building_1"]
    overrides = {material: {"thickness": 0.4, "relative_permittivity": 9.0}, "north": {"thickness": 0.2}}
    north = read_scene(CANYON, FREQUENCY, overrides, {"north": "building_1"}).materials["north"]
    assert (north.thickness, north.relative_permittivity) == (0.2, 9.0)


@pytest.mark.parametrize("pattern", ["wall[1]?", "wall[*", "*]?"])
def test_brackets_in_names_of_objects_have_no_meaning(tmp_path, pattern):
    """As exporters write them."""
    shape = '<shape type="rectangle" id="mesh-{}"><ref id="mat-itu_brick" name="bsdf"/></shape>'
    shapes = "".join(map(shape.format, ["wall[1]?", "wall1x"]))
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="2.1.0"><bsdf type="diffuse" id="mat-itu_brick"/>{shapes}</scene>')
    split = read_scene(file, FREQUENCY, split={"north": pattern})
    assert material_names(split) == {"wall[1]?": "north", "wall1x": "itu_brick"}


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ({"north": "house_*"}, "matches no object"),
        ({"all": "*"}, "have the materials"),
        ({"concrete": "building_1"}, "already"),
    ],
)
def test_bad_patterns_are_refused(split, message):
    with pytest.raises(InputError, match=message):
        read_scene(CANYON, FREQUENCY, split=split)


def test_a_split_scene_traces_like_the_whole_one_and_one_object_can_change_separately(tmp_path):
    rng = np.random.default_rng(3)
    rx = np.c_[rng.uniform(-20, 20, 4), rng.uniform(-3, 3, 4), np.full(4, 1.5)]
    links = SimpleNamespace(tx=np.tile([-30.0, 0, 10], (4, 1)), rx=rx)
    settings = {"frequency": FREQUENCY, "max_depth": 2, "samples": 20_000}
    whole = cb.trace(CANYON, links, **settings)
    scene = read_scene(CANYON, FREQUENCY, split={"own/*": "building_*"})
    split = cb.trace(scene, links, **settings)
    np.testing.assert_allclose(cb.path_loss(split), cb.path_loss(whole), atol=1e-3)
    index, name = next(
        (k, name) for k, name in enumerate(split.materials) if (split.material == k).any() and "own/" in name
    )
    overrides = {name: {"relative_permittivity": 2.0}}
    changed = read_scene(CANYON, FREQUENCY, overrides, {"own/*": "building_*"}).materials
    path = np.repeat(np.arange(split.num_paths), np.diff(split.first))
    via_object = set(split.link[path[split.material == index]])
    moved = np.abs(cb.path_loss(split, changed) - cb.path_loss(split)) > 1e-9
    assert set(np.flatnonzero(moved)) == via_object
    export_scene(scene, changed, tmp_path / "scene.xml")
    exported = read_scene(tmp_path / "scene.xml", FREQUENCY)
    written = exported_names(changed)[name]
    assert exported.materials[written] == changed[name]
    assert material_names(exported)[name.removeprefix("own/")] == written
