"""Made scenes traced: equal to a scene made by hand, diffraction at edges, points inside buildings."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import sionna.rt

import calibray as cb
from calibray.paths import Kind
from calibray.scenes import read_scene
from calibray.scenes.authoring import (
    Palette,
    Segment,
    SurfaceMaterial,
    Windows,
    make_plan_scene,
    make_scene,
)
from calibray.scenes.checks.scene_check import CLOSE
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from planted_maps import L_SHAPE, footprints
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
STONE = SurfaceMaterial("stone", "concrete", 0.3)
PALETTE = Palette(wall=STONE, roof=None, ground=SurfaceMaterial("soil", "concrete", 1.0))
BSDF = (
    '<bsdf type="itu-radio-material" id="mat-stone"><string name="type" value="concrete"/>'
    '<float name="thickness" value="0.3"/></bsdf>'
)
BUILDINGS = [shapely.box(0, 0, 20, 12), shapely.box(0, 30, 25, 45)]
TOPS = [15.0, 9.0]


def trace(scene: Path, tx: list, rx: list, **settings) -> cb.Paths:
    # Tests with the same settings share what Dr.Jit compiles.
    links = SimpleNamespace(tx=np.array(tx, float), rx=np.array(rx, float))
    settings = {"max_depth": 1, "samples": 20_000, "diffraction": True, **settings}
    return cb.trace(scene, links, frequency=FREQUENCY, **settings)


def interactions(paths: cb.Paths) -> list[tuple[int, float, tuple[int, ...]]]:
    """Link, length [m] and kinds of interactions of each path, sorted."""
    kinds = np.split(paths.kind, paths.first[1:-1])
    return sorted(
        (int(link), round(float(delay) * 299_792_458.0, 2), tuple(kind.tolist()))
        for link, delay, kind in zip(paths.link, paths.delay, kinds, strict=True)
    )


def test_a_made_scene_has_the_paths_of_one_made_by_hand(tmp_path):
    made = make_scene(footprints(BUILDINGS, TOPS), tmp_path / "made", palette=PALETTE, ground=False)
    hand = write_scene(
        tmp_path / "hand",
        {"one": block((0, 0, 0), (20, 12, 15)), "two": block((0, 30, 0), (25, 45, 9))},
        BSDF,
    )
    tx, rx = [[-15, 20, 4]] * 3, [[30, 21, 1.5], [12, 18, 1.5], [-5, -20, 1.5]]
    ours, theirs = (trace(scene, tx, rx) for scene in (made.path, hand))
    assert set(ours.link) == {0, 1, 2}
    assert interactions(ours) == interactions(theirs)
    assert ours.materials["stone"] == theirs.materials["stone"]


def test_upright_edges_of_a_made_building_diffract(tmp_path):
    """Behind the corner at (20, 12) nothing arrives except by diffraction at its edge."""
    made = make_scene(footprints(BUILDINGS[:1], TOPS), tmp_path, windows=Windows(0.3), ground=False)
    paths = trace(made.path, [[25, 2, 1.5]], [[5, 17, 1.5]])
    assert {kinds for _, _, kinds in interactions(paths)} == {(Kind.DIFFRACTION,)}
    # Around the corner in one plane: the path has the length of the two legs.
    corner = np.hypot(5, 10) + np.hypot(15, 5)
    assert np.abs(paths.delay * 299_792_458.0 - corner).min() < 1e-2


def test_eaves_diffract_only_if_roof_and_walls_share_a_material(tmp_path):
    """Sionna RT looks for wedges within one mesh."""
    count = {}
    for name, roof in (("one", None), ("two", SurfaceMaterial("slate", "concrete", 0.3))):
        palette = Palette(wall=STONE, roof=roof)
        made = make_scene(
            footprints([shapely.box(-200, 0, 200, 12)], [8.0]), tmp_path / name, palette=palette
        )
        paths = trace(made.path, [[0, -20, 12.0]], [[0, 17, 1.5]])
        count[name] = int((paths.kind == Kind.DIFFRACTION).sum())
    assert count["one"] >= 1
    assert count["two"] == 0


def test_points_inside_a_made_building_are_recognized(tmp_path):
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path, windows=Windows(0.4))
    tracer = Tracer(read_scene(made.path, FREQUENCY), FREQUENCY, TraceSettings(), Antenna(), Antenna())
    points = np.array([[20, 5, 2], [6, 30, 2], [6, 5.5, 2], [40, 5, 2], [20, 20, 2], [20, 5, 12]], float)
    # The third is in the courtyard, the others from the fourth on are next to and above the building.
    assert tracer.enclosed(points).tolist() == [True, True, False, False, False, False]


def test_sionna_loads_a_made_scene_unchanged(tmp_path):
    made = make_scene(footprints(BUILDINGS, TOPS), tmp_path, windows=Windows(0.3))
    scene = sionna.rt.load_scene(str(made.path))
    scene.frequency = FREQUENCY
    assert set(made.triangles) <= set(scene.radio_materials)
    assert float(scene.radio_materials["windows"].thickness.numpy().item()) == pytest.approx(0.02)


def test_a_plan_with_both_faces_drawn_is_traced_like_one_with_centre_lines(tmp_path):
    """Waves would pass two slabs through a wall that is drawn twice."""

    def lines(*ends):
        return [Segment((x0, y0), (x1, y1), "brick", 0.0, 3.0) for x0, y0, x1, y1 in ends]

    outer = lines((0, 0, 8, 0), (8, 0, 8, 5), (8, 5, 0, 5), (0, 5, 0, 0))
    inner = lines((0.2, 0.2, 7.8, 0.2), (7.8, 0.2, 7.8, 4.8), (7.8, 4.8, 0.2, 4.8), (0.2, 4.8, 0.2, 0.2))
    centre = lines((0.1, 0.1, 7.9, 0.1), (7.9, 0.1, 7.9, 4.9), (7.9, 4.9, 0.1, 4.9), (0.1, 4.9, 0.1, 0.1))
    types = {"brick": SurfaceMaterial("brick_wall", "brick", 0.2)}
    both = make_plan_scene([*outer, *inner], tmp_path / "both", types)
    once = make_plan_scene(centre, tmp_path / "once", types)
    drawn = make_plan_scene([*outer, *inner], tmp_path / "drawn", types, merge=False)
    tx, rx = [[4, 2.5, 1.5]] * 2, [[12, 3.1, 1.2], [1.7, 0.9, 1.4]]
    traced = [
        interactions(trace(made.path, tx, rx, max_depth=2, refraction=True, diffraction=False))
        for made in (both, once, drawn)
    ]
    assert traced[0] == traced[1]
    direct = [next(kinds for link, _, kinds in paths if link == 0) for paths in (traced[1], traced[2])]
    assert direct == [(Kind.REFRACTION,), (Kind.REFRACTION, Kind.REFRACTION)]


@pytest.mark.parametrize(("gap", "reflections"), [(CLOSE / 10, 2), (CLOSE, 1)])
def test_sheets_that_are_too_close_reflect_twice(tmp_path, gap, reflections):
    """`check_scene` warns below `CLOSE`."""
    ground, patch = (
        [[(-size, -size, z), (size, -size, z), (size, size, z), (-size, size, z)]]
        for size, z in ((90, 0), (60, gap))
    )
    scene = write_scene(tmp_path, {"ground": ground, "patch": patch}, BSDF)
    paths = trace(scene, [[0, 0, 10]] * 3, [[-40, 8, 1.5], [20, 5, 1.5], [3, 30, 1.5]], diffraction=False)
    assert np.bincount(paths.link).tolist() == [1 + reflections] * 3


@pytest.mark.parametrize(("gap", "reached"), [(CLOSE / 10, False), (CLOSE, True)])
def test_no_path_passes_walls_that_are_too_close(tmp_path, gap, reached):
    walls = {str(x): [[(x, -9, 0), (x, 9, 0), (x, 9, 9), (x, -9, 9)]] for x in (10, 10 + gap)}
    scene = write_scene(tmp_path, walls)
    paths = trace(scene, [[0, 0, 5]], [[20, 3, 2]], diffraction=False, refraction=True, max_depth=3)
    assert bool(paths.num_paths) == reached
