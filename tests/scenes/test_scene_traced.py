"""Made scenes traced: equal to scenes made by hand, diffraction at their edges, points within buildings."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import sionna.rt

from calibray.fields import path_loss
from calibray.paths import Kind, Paths
from calibray.scenes import read_scene
from calibray.scenes.authoring.extrusion import Windows
from calibray.scenes.authoring.floor_plan import make_plan_scene
from calibray.scenes.authoring.floor_plan_file import Segment
from calibray.scenes.authoring.scene_folder import Palette, SurfaceMaterial, make_scene
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
EXTRACT = [shapely.box(0, 0, 20, 12), shapely.box(0, 30, 25, 45)]
TOPS = [15.0, 9.0]


def traced(scene: Path, tx: list, rx: list, **settings) -> tuple[Tracer, Paths]:
    tracer = Tracer(
        read_scene(scene, FREQUENCY), FREQUENCY, TraceSettings(**{"samples": 20_000, **settings}),
        Antenna("dipole"), Antenna("dipole"),
    )  # fmt: skip
    return tracer, tracer.trace(SimpleNamespace(tx=np.array(tx, float), rx=np.array(rx, float)))


def test_a_made_scene_has_the_path_loss_of_one_made_by_hand(tmp_path):
    made = make_scene(footprints(EXTRACT, TOPS), tmp_path / "made", palette=PALETTE, ground=False)
    hand = write_scene(
        tmp_path / "hand",
        {"one": block((0, 0, 0), (20, 12, 15)), "two": block((0, 30, 0), (25, 45, 9))},
        BSDF,
    )
    tx, rx = [[-15, 20, 4]] * 3, [[30, 21, 1.5], [12, 18, 1.5], [-5, -20, 1.5]]
    losses = [
        path_loss(traced(scene, tx, rx, max_depth=2, diffraction=True)[1]) for scene in (made.path, hand)
    ]
    assert np.isfinite(losses[0]).all()
    np.testing.assert_allclose(losses[0], losses[1], atol=1e-3)


@pytest.mark.parametrize("windows", [None, Windows(0.3)], ids=["walls", "windows"])
def test_waves_bend_around_the_upright_edge_of_a_made_building(tmp_path, windows):
    """Behind the corner nothing arrives but what its edge diffracts; the edge leads through (20, 12)."""
    made = make_scene(
        footprints(EXTRACT[:1], TOPS), tmp_path, windows=windows, ground=False
    )  # fmt: skip
    tx, rx = [[25, 2, 1.5]], [[5, 17, 1.5]]
    assert traced(made.path, tx, rx)[1].num_paths == 0
    _, paths = traced(made.path, tx, rx, diffraction=True)
    assert paths.num_paths >= 1
    assert (paths.kind == Kind.DIFFRACTION).any()
    # Around the corner in one plane: the path has the length of the two legs.
    corner = np.hypot(5, 10) + np.hypot(15, 5)
    assert np.abs(paths.delay * 299_792_458.0 - corner).min() < 1e-2


def test_eaves_diffract_if_roofs_are_of_the_walls_material(tmp_path):
    """Sionna RT looks for wedges within one mesh: over the roof waves bend if walls and roof are one."""
    found = {}
    for name, roof in (("one", None), ("two", SurfaceMaterial("slate", "concrete", 0.3))):
        palette = Palette(wall=STONE, roof=roof)
        made = make_scene(
            footprints([shapely.box(-200, 0, 200, 12)], [8.0]), tmp_path / name, palette=palette
        )
        _, paths = traced(made.path, [[0, -20, 12.0]], [[0, 17, 1.5]], diffraction=True, max_depth=1)
        found[name] = int((paths.kind == Kind.DIFFRACTION).sum())
    assert found["one"] >= 1
    assert found["two"] == 0


def test_points_within_a_made_building_are_known(tmp_path):
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path, windows=Windows(0.4))
    tracer = Tracer(read_scene(made.path, FREQUENCY), FREQUENCY, TraceSettings(), Antenna(), Antenna())
    points = np.array([[20, 5, 2], [6, 30, 2], [6, 5.5, 2], [40, 5, 2], [20, 20, 2], [20, 5, 12]], float)
    # The fourth to sixth are beside and above the building; the third is in its courtyard.
    assert tracer.enclosed(points).tolist() == [True, True, False, False, False, False]


def test_sionna_loads_a_made_scene_as_it_is(tmp_path):
    made = make_scene(footprints(EXTRACT, TOPS), tmp_path, windows=Windows(0.3))
    scene = sionna.rt.load_scene(str(made.path))
    scene.frequency = FREQUENCY
    assert set(made.triangles) <= set(scene.radio_materials)
    assert float(scene.radio_materials["windows"].thickness.numpy().item()) == pytest.approx(0.02)


def test_a_plan_with_both_faces_drawn_is_traced_as_one_with_middles(tmp_path):
    """Through a wall drawn twice waves would pass two slabs."""

    def lines(*ends):
        return [Segment((x0, y0), (x1, y1), "brick", 0.0, 3.0) for x0, y0, x1, y1 in ends]

    outer = lines((0, 0, 8, 0), (8, 0, 8, 5), (8, 5, 0, 5), (0, 5, 0, 0))
    inner = lines((0.2, 0.2, 7.8, 0.2), (7.8, 0.2, 7.8, 4.8), (7.8, 4.8, 0.2, 4.8), (0.2, 4.8, 0.2, 0.2))
    middle = lines((0.1, 0.1, 7.9, 0.1), (7.9, 0.1, 7.9, 4.9), (7.9, 4.9, 0.1, 4.9), (0.1, 4.9, 0.1, 0.1))
    types = {"brick": SurfaceMaterial("brick_wall", "brick", 0.2)}
    both = make_plan_scene([*outer, *inner], tmp_path / "both", types)
    once = make_plan_scene(middle, tmp_path / "once", types)
    drawn = make_plan_scene([*outer, *inner], tmp_path / "drawn", types, merge=False)
    tx, rx = [[4, 2.5, 1.5]] * 2, [[12, 3.1, 1.2], [1.7, 0.9, 1.4]]
    losses = [
        path_loss(traced(made.path, tx, rx, max_depth=2, refraction=True)[1]) for made in (both, once, drawn)
    ]
    np.testing.assert_allclose(losses[0], losses[1], atol=1e-3)
    assert np.abs(losses[2] - losses[1]).max() > 1.0
