"""Objects with a material of their own: the scene is split, the physics stays."""

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements import Measurements
from calibray.scenes import export_scene, read_scene
from calibray.tracing.default_tracer import trace

CANYON = "sionna:simple_street_canyon"
FREQUENCY = 3.5e9


def names(scene):
    return {entry.name: entry.material for entry in scene.objects}


def test_a_pattern_gives_its_objects_a_material_and_leaves_the_others():
    whole, split = read_scene(CANYON, FREQUENCY), read_scene(CANYON, FREQUENCY, split={"north": "building_1"})
    before, after = names(whole), names(split)
    assert after["building_1"] == "north"
    assert {name for name in before if before[name] != after[name]} == {"building_1"}
    assert split.materials["north"] == whole.materials[before["building_1"]]


def test_a_star_makes_a_material_for_every_object():
    split = read_scene(CANYON, FREQUENCY, split={"own/*": "building_*"})
    buildings = {name: material for name, material in names(split).items() if name.startswith("building_")}
    assert len(buildings) == 6
    assert all(material == f"own/{name}" for name, material in buildings.items())


def test_constants_of_all_objects_reach_the_split_ones_unless_they_have_their_own():
    material = names(read_scene(CANYON, FREQUENCY))["building_1"]
    overrides = {material: {"thickness": 0.4, "relative_permittivity": 9.0}, "north": {"thickness": 0.2}}
    north = read_scene(CANYON, FREQUENCY, overrides, {"north": "building_1"}).materials["north"]
    assert (north.thickness, north.relative_permittivity) == (0.2, 9.0)


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


def test_a_split_scene_traces_alike_and_one_object_changes_alone(tmp_path):
    rng = np.random.default_rng(3)
    rx = np.c_[rng.uniform(-20, 20, 4), rng.uniform(-3, 3, 4), np.full(4, 1.5)]
    links = Measurements(tx=np.tile([-30.0, 0, 10], (4, 1)), rx=rx, path_loss_db=np.full(4, np.nan))
    settings = {"frequency": FREQUENCY, "max_depth": 2, "samples": 20_000}
    whole = trace(CANYON, links, **settings)
    split = trace(read_scene(CANYON, FREQUENCY, split={"own/*": "building_*"}), links, **settings)
    np.testing.assert_allclose(path_loss(split), path_loss(whole), atol=1e-3)
    touched = [
        name for k, name in enumerate(split.materials) if (split.material == k).any() and "own/" in name
    ]
    changed = {touched[0]: read_scene(CANYON, FREQUENCY, {touched[0]: {"relative_permittivity": 2.0}},
                                      {"own/*": "building_*"}).materials[touched[0]]}  # fmt: skip
    through = np.unique(split.link[np.repeat(np.arange(split.num_paths), np.diff(split.first))[
        split.material == list(split.materials).index(touched[0])]])  # fmt: skip
    moved = np.abs(path_loss(split, changed) - path_loss(split)) > 1e-9
    assert set(np.flatnonzero(moved)) == set(through)
    scene = read_scene(CANYON, FREQUENCY, split={"own/*": "building_*"})
    export_scene(scene, {**split.materials, **changed}, tmp_path / "scene.xml")
    again = trace(tmp_path / "scene.xml", links, **settings)
    np.testing.assert_allclose(path_loss(again), path_loss(split, changed), atol=1e-3)
