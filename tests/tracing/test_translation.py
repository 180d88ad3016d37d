"""Path loss and number of paths do not depend on where a scene lies in its coordinates."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely

import calibray as cb
from calibray.errors import InputError
from calibray.scenes import has_copied_meshes, read_mesh, read_scene
from calibray.scenes.authoring import Palette, Segment, SurfaceMaterial, make_plan_scene, make_scene
from calibray.scenes.checks import check_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from planted_maps import footprints
from small_scenes import CONCRETE, block, write_scene

FREQUENCY = 3.5e9
OFFSETS = [(10, -10, 0), (10_000, 0, 0), (0, 700_000, 120), (690_000, 5_330_000, 500)]
IDS = ["10 m", "10 km", "700 km", "UTM"]
GROUND = [[(-60.0, -60.0, 0.0), (60.0, -60.0, 0.0), (60.0, 60.0, 0.0), (-60.0, 60.0, 0.0)]]
MAST = (-30.0, -28.0, 12.0)
DESK = (1.3, 1.2, 1.5)
ROOMS = [(3.1, 5.2, 1.1), (6.3, 2.2, 1.5), (8.9, 6.4, 1.2), (10.7, 1.4, 1.9), (2.2, 7.7, 0.8)]
STREET = [(-20.0, 3.0, 1.5), (1.5, 7.0, 1.5), (22.0, 3.3, 1.5), (27.0, 31.0, 1.5), (-38.0, 25.0, 1.5)]


def town(folder: Path) -> Path:
    """Six houses on the ground, made from footprints as from OpenStreetMap."""
    walls = SurfaceMaterial("stone", "concrete", 0.3)
    houses = [shapely.box(x, y, x + 13.3, y + 9.1) for x in (-33, -9, 15) for y in (-14, 12)]
    heights = [9.0, 12.0, 7.5, 15.0, 9.0, 6.0]
    made = make_scene(
        footprints(houses, heights), folder, palette=Palette(wall=walls, roof=None, ground=walls)
    )
    return made.path


def flat(folder: Path) -> Path:
    """Four rooms of 12 m by 9 m, made from a floor plan."""
    lines = [(0, 0, 12, 0), (12, 0, 12, 9), (12, 9, 0, 9), (0, 9, 0, 0), (5, 0, 5, 9), (0, 4, 12, 4)]
    walls = [Segment((a, b), (c, d), "brick", 0.0, 2.7, 0.2) for a, b, c, d in lines]
    return make_plan_scene(walls, folder).path


def corner(folder: Path) -> Path:
    """One block, around whose edges waves diffract."""
    return write_scene(folder, {"ground": GROUND, "block": block((-12, -9, 0), (14, 0.5, 9))})


SCENES = {
    "town": (town, MAST, STREET, {"max_depth": 2, "diffraction": True}),
    "flat": (flat, DESK, ROOMS, {"max_depth": 2, "refraction": True}),
    "corner": (corner, MAST, STREET, {"max_depth": 2, "diffraction": True}),
}


def write_moved(scene: Path, offset: tuple[float, ...], folder: Path, how: str) -> Path:
    """Copy a scene moved by an offset: its vertices, stored in double precision, or by a transform."""
    (folder / "meshes").mkdir(parents=True)
    text = scene.read_text()
    for mesh_file in (scene.parent / "meshes").glob("*.ply"):
        mesh = read_mesh(mesh_file, "ply")
        vertices = mesh.vertices + (offset if how == "vertices" else np.zeros(3))
        header = (
            f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
            f"property double z\nelement face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        rows = [" ".join(map(repr, vertex)) for vertex in vertices.tolist()]
        rows += [f"3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()]
        (folder / "meshes" / mesh_file.name).write_text(header + "\n".join(rows) + "\n")
    if how == "transform":
        x, y, z = offset
        move = f'<transform name="to_world"><translate x="{x}" y="{y}" z="{z}"/></transform></shape>'
        text = text.replace("</shape>", move)
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


def trace(case: SimpleNamespace, scene: Path, offset: tuple[float, ...]) -> cb.Paths:
    links = SimpleNamespace(tx=np.tile(case.tx, (len(case.rx), 1)) + offset, rx=np.array(case.rx) + offset)
    return cb.trace(scene, links, frequency=FREQUENCY, samples=20_000, **case.settings)


@pytest.fixture(scope="module", params=SCENES)
def original(request, tmp_path_factory) -> SimpleNamespace:
    make, tx, rx, settings = SCENES[request.param]
    case = SimpleNamespace(
        scene=make(tmp_path_factory.mktemp(request.param)), tx=tx, rx=rx, settings=settings
    )
    case.paths = trace(case, case.scene, (0, 0, 0))
    return case


@pytest.mark.parametrize("offset", OFFSETS, ids=IDS)
@pytest.mark.parametrize("how", ["vertices", "transform"])
def test_a_moved_scene_has_the_same_paths_and_path_loss(original, offset, how, tmp_path):
    moved_scene = write_moved(original.scene, offset, tmp_path / "moved", how)
    moved = trace(original, moved_scene, offset)
    assert np.bincount(moved.link).tolist() == np.bincount(original.paths.link).tolist()
    np.testing.assert_allclose(cb.path_loss(moved), cb.path_loss(original.paths), atol=1e-3)
    # Vertices and positions are those of the moved scene.
    assert (moved.rx_position == np.array(original.rx) + offset).all()
    lines = [np.lexsort(np.rint(100 * vertex).T) for vertex in (moved.vertex - offset, original.paths.vertex)]
    np.testing.assert_allclose((moved.vertex - offset)[lines[0]], original.paths.vertex[lines[1]], atol=2e-3)


def test_rays_in_rounds_and_enclosed_points_do_not_depend_on_the_origin(tmp_path):
    offset = OFFSETS[-1]
    original_scene = corner(tmp_path / "original")
    moved_scene = write_moved(original_scene, offset, tmp_path / "moved", "vertices")
    losses = []
    for scene, move in ((original_scene, (0, 0, 0)), (moved_scene, offset)):
        tracer = Tracer(
            read_scene(scene, FREQUENCY),
            FREQUENCY,
            TraceSettings(max_depth=1, samples="auto"),
            Antenna(),
            Antenna(),
        )
        links = SimpleNamespace(tx=np.tile(MAST, (len(STREET), 1)) + move, rx=np.array(STREET) + move)
        losses.append(cb.path_loss(tracer.trace(links)))
        inside = tracer.enclosed(np.array([[0, -3, 1.5], [0, 3, 1.5]]) + move)
        assert inside.tolist() == [True, False]
    np.testing.assert_allclose(losses[1], losses[0], atol=1e-3)


def test_a_scene_near_its_origin_is_traced_where_it_is(tmp_path):
    scene = read_scene(corner(tmp_path), FREQUENCY)
    assert not scene.local_origin.any()
    assert not has_copied_meshes(scene)


def test_a_mesh_whose_file_rounds_its_coordinates_is_refused(tmp_path):
    """Single precision separates points by half a metre at UTM northings, by 1 mm from 8 km on."""
    at_utm = write_scene(tmp_path / "utm", {"wall": block((690000, 5330000, 0), (690010, 5330010, 9))})
    with pytest.raises(InputError, match=r"'mesh-wall'.*steps of 0\.5 m; export it .* double"):
        read_scene(at_utm, FREQUENCY)
    assert "steps of 0.5 m" in check_scene(at_utm).findings[0].problem
    at_9_km = write_scene(tmp_path / "9 km", {"wall": block((9000, 0, 0), (9010, 10, 9))})
    assert [finding.severity for finding in check_scene(at_9_km).findings] == []
    at_20_km = write_scene(tmp_path / "20 km", {"wall": block((20000, 0, 0), (20010, 10, 9))})
    assert [finding.severity for finding in check_scene(at_20_km).findings] == ["warning"]


def test_a_transform_is_applied_as_mitsuba_does(tmp_path):
    """All elements of a transform, far from the origin and near it."""
    steps = (
        '<scale x="2" y="0.5"/><rotate x="1" y="2" z="-1" angle="35"/><rotate value="0, 0, 1" angle="20"/>'
        '<matrix value="1 0.1 0 3 0 1 0.2 4 0 0 1 5 0 0 0 1"/><scale value="1.5"/><translate value="{}, 20, 30"/>'
    )
    bodies = {
        "ply": '<string name="filename" value="meshes/wall.ply"/>', "rectangle": "", "cube": "",
    }  # fmt: skip
    write_scene(tmp_path, {"wall": block((1, 2, 3), (4, 6, 9))})
    for kind, body in bodies.items():
        for east in (10, 100_000):
            shape = f'<shape type="{kind}" id="mesh-wall">{body}<ref id="mat-stone" name="bsdf"/>'
            transform = f'<transform name="to_world">{steps.format(east)}</transform></shape>'
            (tmp_path / "scene.xml").write_text(
                f'<scene version="2.1.0">{CONCRETE}{shape}{transform}</scene>'
            )
            scene = read_scene(tmp_path / "scene.xml", FREQUENCY)
            # Refused unless bounds and area agree with what Mitsuba holds.
            Tracer(scene, FREQUENCY, TraceSettings(), Antenna(), Antenna())
            assert scene.local_origin.any() == (east > 10)
