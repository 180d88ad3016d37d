"""Buildings raised on footprints: volumes and areas in closed form, closed surfaces, terrain, files."""

from __future__ import annotations

import json

import numpy as np
import pytest
import shapely
import trimesh

from calibray.errors import InputError
from calibray.scenes import buildings, read_frame, read_meshes, read_scene, read_triangles
from calibray.scenes.authoring import Palette, SurfaceMaterial, Terrain, Windows, make_scene
from calibray.scenes.authoring.extrusion import (
    ROOF,
    UNDERSIDE,
    WALL,
    WINDOW,
    Shell,
    extrude,
    split_overlaps,
)
from calibray.scenes.authoring.terrain import make_level_ground
from calibray.scenes.checks.positions import locate
from calibray.scenes.meshes import MILLIMETRE, weld
from planted_maps import FRAME, L_SHAPE, footprints

BOX = shapely.box


def shell_of(polygons, tops, windows=None, ground=None, **more) -> Shell:
    buildings = footprints(polygons, tops, **more)
    cells, _ = split_overlaps(buildings, buildings.bottom, buildings.top)
    return extrude(cells, windows, ground)


def body(shell: Shell) -> trimesh.Trimesh:
    mesh = weld(shell.corners)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def area(shell: Shell, kind: int) -> float:
    corners = shell.corners[shell.kind == kind] * MILLIMETRE
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normal, axis=1).sum() / 2)


# Closed forms


def test_an_l_shaped_building_with_a_courtyard_has_the_right_volume_and_areas():
    shell = shell_of([L_SHAPE], [10.0])
    assert body(shell).volume == pytest.approx(630.0 * 10.0)
    outer, inner = 30 + 10 + 18 + 30 + 12 + 40, 2 * (5 + 6)
    assert area(shell, WALL) == pytest.approx((outer + inner) * 10.0)
    assert area(shell, ROOF) == area(shell, UNDERSIDE) == pytest.approx(630.0)
    assert area(shell, WINDOW) == 0


@pytest.mark.parametrize("share", [0.25, 0.6])
def test_windows_take_their_share_of_each_wall(share):
    shell = shell_of([L_SHAPE], [10.0], Windows(share, module=4.0))
    whole = area(shell, WALL) + area(shell, WINDOW)
    assert whole == pytest.approx(area(shell_of([L_SHAPE], [10.0]), WALL), rel=1e-6)
    # Ends of strips are whole millimetres.
    assert area(shell, WINDOW) / whole == pytest.approx(share, abs=1e-3)
    assert body(shell).volume == pytest.approx(6300.0)


CASES = {
    "courtyard": ([L_SHAPE], [10.0], 6300.0),
    "a lower neighbour with walls in common": ([BOX(0, 0, 10, 10), BOX(10, 3, 20, 8)], [10, 6], 1300.0),
    "equal neighbours": ([BOX(0, 0, 10, 10), BOX(10, 0, 20, 10)], [10, 10], 2000.0),
    "overlapping": ([BOX(0, 0, 10, 10), BOX(5, 5, 20, 15)], [10, 6], 1000 + 6 * (150 - 25)),
    "one within another": ([BOX(0, 0, 10, 10), BOX(3, 3, 6, 6)], [10, 20], 1000 + 9 * 10),
    "twice the same": ([BOX(0, 0, 10, 10)] * 2, [10, 8], 1000.0),
    "filling a courtyard": ([BOX(0, 0, 9, 9) - BOX(3, 3, 6, 6), BOX(3, 3, 6, 6)], [10, 20], 810 + 90),
    "a row of three": ([BOX(0, 0, 5, 9), BOX(5, 0, 9, 9), BOX(9, 2, 12, 7)], [10, 12, 8], 450 + 432 + 120),
}


@pytest.mark.parametrize("windows", [None, Windows(0.4, module=3.0)], ids=["walls", "windows"])
@pytest.mark.parametrize(("polygons", "tops", "volume"), CASES.values(), ids=CASES)
def test_buildings_that_touch_or_overlap_are_one_closed_body(polygons, tops, volume, windows):
    solid = body(shell_of(polygons, tops, windows))
    assert solid.is_watertight
    # Neighbouring faces have the same orientation, and outward normals make the volume positive.
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(volume)


def test_parts_replace_the_outline():
    """A block of 30 m next to a low one with a slab above: outline 10 x 10, parts side by side and above each other."""
    polygons = [BOX(0, 0, 10, 10), BOX(0, 0, 5, 10), BOX(5, 0, 10, 10), BOX(5, 0, 10, 10)]
    solid = body(
        shell_of(
            polygons, [99, 30, 5, 12], bottoms=[0, 0, 0, 8], part=[False, True, True, True]
        )
    )  # fmt: skip
    assert solid.is_watertight
    assert solid.volume == pytest.approx(50 * 30 + 50 * 5 + 50 * 4)


def test_buildings_on_the_ground_are_open_below_and_canopies_are_closed():
    shell = shell_of([BOX(0, 0, 10, 10), BOX(30, 0, 40, 10)], [5, 9], ground=np.zeros(2), bottoms=[0, 4])
    assert area(shell, UNDERSIDE) == pytest.approx(100.0)
    assert body(shell).is_winding_consistent


def test_random_towns_are_closed():
    rng = np.random.default_rng(3)
    for _ in range(3):
        corners = rng.uniform(0, 150, (60, 2))
        turn = rng.uniform(0, 90, 60)
        polygons = [
            shapely.affinity.rotate(BOX(x, y, x + 16, y + 11), angle)
            for (x, y), angle in zip(corners, turn, strict=True)
        ]
        found = footprints(polygons, rng.choice([6.0, 9.0, 15.0], 60))
        cells, cut = split_overlaps(found, found.bottom, found.top)
        made = body(extrude(cells, Windows(0.3)))
        covered = shapely.union_all(found.polygon).area
        assert cut > 20
        # Crossings of borders move to the grid of 1 cm.
        assert area(extrude(cells), ROOF) == pytest.approx(covered, rel=5e-5)
        assert made.is_winding_consistent
        # Bodies that touch in one upright line have four walls there; else two faces meet at every edge.
        _, uses = np.unique(np.sort(made.edges, axis=1), axis=0, return_counts=True)
        assert set(uses) <= {2, 4}


@pytest.mark.parametrize("seed", range(4))
def test_any_outlines_make_closed_bodies_with_the_volume_of_their_cells(seed):
    """Outlines that cross themselves and each other, touch in corners, parts among them, some above the ground."""
    rng = np.random.default_rng(seed)
    polygons = []
    for _ in range(25):
        corners = rng.uniform(0, 60, 2) + rng.normal(0, 8, (rng.integers(3, 9), 2))
        polygons.append(shapely.Polygon(np.round(corners) if rng.random() < 0.3 else corners))
    tops = rng.choice([3.0, 6.0, 9.0, 12.5], 25)
    bottoms = np.minimum(rng.choice([0.0, 0.0, 3.0], 25), tops - 3)
    found = footprints(polygons, tops, bottoms, rng.random(25) < 0.2)
    cells, _ = split_overlaps(found, found.bottom, found.top)
    made = body(extrude(cells, Windows(0.3, module=3.0) if seed % 2 else None))
    _, uses = np.unique(np.sort(made.edges, axis=1), axis=0, return_counts=True)
    assert set(uses % 2) == {0}
    expected = sum(cell.polygon.area * (high - low) for cell in cells for low, high, _ in cell.stands)
    assert made.volume == pytest.approx(expected, rel=1e-4)


def test_self_crossing_outlines_are_repaired_and_counted():
    bow = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])
    found = footprints([bow, BOX(20, 0, 20.5, 0.5), L_SHAPE], [5, 5, 5])
    assert found.repairs == {"crossing or touching themselves, repaired": 1, "of less than 1 m2, left out": 1}
    assert found.name == ("b0", "b2")
    assert body(shell_of([bow], [5.0])).volume == pytest.approx(2 * 25 * 5)


# On the ground


def test_buildings_stand_on_the_lowest_ground_under_their_walls(tmp_path):
    axis = np.linspace(-20, 60, 9)
    slope = Terrain(axis, axis, np.add.outer(0.1 * axis, 0.0 * axis))
    made = make_scene(footprints([BOX(0, 0, 10, 20)], [9.0]), tmp_path, terrain=slope)
    walls = trimesh.load_mesh(tmp_path / "meshes" / "all-walls.ply", process=False)
    # Ground from 0 m at y = 0 to 2 m at y = 20, and half a metre deeper so that no gap opens.
    # The height of 9 m is measured from the lowest ground.
    assert walls.bounds[:, 2] == pytest.approx([-0.5, 9.0])
    assert made.counts == {"buildings": 1}
    ground = trimesh.load_mesh(tmp_path / "meshes" / "ground-surface.ply", process=False)
    assert (ground.face_normals[:, 2] > 0).all()


def test_the_parts_of_a_building_on_a_slope_stand_on_each_other(tmp_path):
    """A hall of 60 m on a slope of 10 %; its tower begins at 20 m, where the lower part ends, and has own ground."""
    axis = np.linspace(-50, 150, 41)
    slope = Terrain(axis, axis, np.add.outer(0.0 * axis, 0.1 * axis))
    outlines = [BOX(0, 0, 60, 20), BOX(0, 0, 60, 20), BOX(40, 0, 60, 20), BOX(80, 0, 100, 20)]
    parts = footprints(
        outlines, [20.0, 20.0, 40.0, 9.0], [0.0, 0.0, 20.0, 0.0], [False, True, True, True],
        ["hall", "podium", "tower", "lonely"],
    )  # fmt: skip
    made = make_scene(parts, tmp_path, terrain=slope, per_building=True)
    heights = {item.name: item.mesh.vertices[:, 2] for item in read_meshes(made.path)}
    assert heights["podium-walls"].max() == heights["tower-walls"].min() == pytest.approx(20.0)
    assert heights["tower-roofs"].max() == pytest.approx(40.0)
    assert heights["lonely-walls"].min() == pytest.approx(7.5)


def test_terrain_is_interpolated_on_its_triangles():
    rng = np.random.default_rng(0)
    terrain = Terrain(np.array([0.0, 10.0, 30.0]), np.array([0.0, 5.0]), rng.uniform(0, 5, (2, 3)))
    mesh = terrain.mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    middle = solid.triangles_center
    np.testing.assert_allclose(terrain.heights(middle[:, 0], middle[:, 1]), middle[:, 2])
    np.testing.assert_allclose(terrain.heights(mesh.vertices[:, 0], mesh.vertices[:, 1]), mesh.vertices[:, 2])
    assert (solid.face_normals[:, 2] > 0).all()
    assert terrain.heights([-99.0], [0.0]) == terrain.z[0, 0]
    assert make_level_ground((0, 0, 4, 2)).mesh().faces.shape == (2, 3)


# Files


def test_a_made_scene_can_be_read(tmp_path):
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path, FRAME, windows=Windows(0.3))
    scene = read_scene(made.path, 5e9)
    assert list(scene.materials) == ["roofs", "walls", "windows", "ground"]
    assert scene.materials["walls"].relative_permittivity == pytest.approx(5.24)
    assert scene.materials["windows"].thickness == 0.02
    assert read_frame(made.path) == FRAME == made.frame
    assert made.bounds == pytest.approx((-50, -50, 0, 80, 90, 10))
    record = json.loads((tmp_path / "scene.json").read_text())
    assert record["counts"] == {"buildings": 1}
    assert record["frame"] == FRAME.record()
    assert set(made.triangles) == set(scene.materials)


@pytest.mark.parametrize("gap", [8.0, 2.0])
def test_the_roofs_of_a_town_are_no_ground(tmp_path, gap):
    """All roofs are one level mesh as wide as the scene; with narrow gaps they cover most of it."""
    polygons = [BOX(20 * k, 20 * n, 20 * k + 20 - gap, 20 * n + 20 - gap) for k in range(4) for n in range(4)]
    made = make_scene(footprints(polygons, [10.0] * 16), tmp_path, FRAME, margin=5.0)
    triangles = read_triangles(read_scene(made.path, 5e9))
    assert set(triangles.vertex[triangles.face[triangles.ground]][..., 2].ravel()) == {0.0}
    outlines = buildings.footprints(triangles, -10.0, -10.0, 90.0, 90.0)
    corners = {tuple(corner) for outline in outlines for corner in outline.round(3)}
    assert {tuple(corner) for polygon in polygons for corner in polygon.exterior.coords} <= corners
    # A map is blank inside, and only inside.
    places = np.array([[10.0, 10.0, 1.5], [20.0 - gap / 2, 10.0, 1.5]])
    assert locate(triangles, places).tolist() == ["inside a building", ""]


def test_meshes_of_one_scene_have_corners_at_the_same_positions(tmp_path):
    make_scene(footprints([L_SHAPE], [10.0]), tmp_path, windows=Windows(0.3), ground=False)
    parts = [trimesh.load_mesh(path, process=False) for path in (tmp_path / "meshes").glob("*.ply")]
    together = trimesh.util.concatenate(parts)
    assert not together.is_watertight
    together.merge_vertices()
    assert together.is_watertight
    assert together.volume == pytest.approx(6300.0, rel=1e-6)


def test_a_mesh_per_building_has_the_name_of_the_building_made_safe(tmp_path):
    names = ['Town "hall" <&> ../..', "-->", "x", "x"]
    polygons = [BOX(20 * index, 0, 20 * index + 10, 10) for index in range(4)]
    made = make_scene(
        footprints(polygons, [5.0] * 4, names=names), tmp_path, FRAME, per_building=True
    )  # fmt: skip
    scene = read_scene(made.path, 5e9, split={"hall": "Town*walls"})
    assert [entry.name for entry in scene.objects] == [
        "Town_hall_-roofs", "Town_hall_-walls", "--_-roofs", "--_-walls", "x-roofs", "x-walls", "x-2-roofs",
        "x-2-walls", "ground-surface",
    ]  # fmt: skip
    assert "hall" in scene.materials
    assert {path.parent for path in tmp_path.rglob("*.ply")} == {tmp_path / "meshes"}


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (("concrete", "concrete", 0.1), "is an ITU-R P.2040 name"),
        (("itu_brick", "brick", 0.1), "name it 'brick_wall'"),
        (("a b", "brick", 0.1), "letters, digits"),
        (("walls", "bricks", 0.1), "did you mean 'brick'"),
        (("walls", "brick", 0.0), "greater than 0"),
    ],
)
def test_bad_materials_are_refused(material, message):
    with pytest.raises(InputError, match=message):
        SurfaceMaterial(*material)


def test_two_materials_with_the_same_name_are_refused(tmp_path):
    palette = Palette(roof=SurfaceMaterial("walls", "wood", 0.1))
    with pytest.raises(InputError, match="given twice"):
        make_scene(footprints([L_SHAPE], [5.0]), tmp_path, palette=palette)
    with pytest.raises(InputError, match="window share"):
        Windows(1.0)
