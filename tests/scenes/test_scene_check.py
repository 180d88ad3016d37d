"""Scene checks: each fault planted in a scene is found and named, and a sound scene has none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.scenes import Mesh, MeshObject, join_meshes, read_scene, write_scene
from calibray.scenes.authoring import Windows, make_scene
from calibray.scenes.checks import SceneCheck, check_scene
from calibray.scenes.checks.scene_check import count_faults, find_covers
from planted_maps import L_SHAPE, footprints

STONE = {"stone": {"type": "concrete", "thickness": 0.2}}


def cube(size: float = 10.0, offset: float = 0.0) -> Mesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return Mesh(corners * size + [offset, offset, 0], np.array(faces))


def check(folder: Path, mesh: Mesh, materials=STONE, name: str = "body") -> SceneCheck:
    return check_scene(write_scene(folder, [MeshObject(name, next(iter(materials)), mesh)], materials))


def problems(result: SceneCheck) -> list[str]:
    return [finding.problem for finding in result.findings]


def flipped_faces(mesh: Mesh) -> int:
    return count_faults(MeshObject("body", "stone", mesh)).flipped_faces


def test_a_sound_scene_has_no_finding(tmp_path):
    result = check(tmp_path, cube())
    assert result.findings == ()
    assert result.bounds == (0, 0, 0, 10, 10, 10)
    assert (result.faces, result.objects[0].vertices, result.objects[0].open_edges) == (12, 8, 0)


def test_a_made_scene_is_sound(tmp_path):
    progress = []
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path, windows=Windows(0.4))
    result = check_scene(made.path, lambda *step: progress.append(step))
    assert result.findings == ()
    assert progress[-1] == ("examining", 4, 4)
    assert {item.name: item.flipped_faces for item in result.objects} == {
        "all-roofs": 0, "all-walls": 0, "all-windows": 0, "ground-surface": 0,
    }  # fmt: skip


def test_faces_that_share_no_vertices_are_found(tmp_path):
    sound = cube()
    loose = Mesh(sound.vertices[sound.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    result = check(tmp_path, loose)
    assert problems(result) == [
        "18 edges at which faces meet without sharing vertices, where Sionna RT finds no diffraction"
    ]  # fmt: skip
    assert result.objects[0].open_edges == 0


@pytest.mark.parametrize("flipped", [[0], [0, 5, 7], list(range(12))])
def test_faces_with_inward_normals_are_counted(flipped):
    mesh = cube()
    mesh.faces[flipped] = mesh.faces[flipped, ::-1]
    assert flipped_faces(mesh) == len(flipped)


def test_each_connected_piece_is_judged_separately():
    inward = cube(3.0, offset=20.0)
    assert flipped_faces(join_meshes([cube(), Mesh(inward.vertices, inward.faces[:, ::-1])])) == 12
    ground = Mesh(np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0]]), np.array([[0, 2, 1]]))
    assert flipped_faces(ground) == 1
    # A sheet of wall has no inside.
    wall = Mesh(np.array([[0.0, 0, 0], [9, 0, 0], [9, 0, 3], [0, 0, 3]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert flipped_faces(wall) == 0
    assert flipped_faces(Mesh(wall.vertices, np.array([[0, 1, 2], [0, 3, 2]]))) == 1


def test_empty_repeated_and_crowded_faces_are_counted():
    sound = cube()
    faces = np.vstack([sound.faces, sound.faces[:2], [[0, 0, 1], [0, 4, 4]]])
    faults = count_faults(MeshObject("body", "stone", Mesh(sound.vertices, faces)))
    assert (faults.empty_faces, faults.repeated_faces) == (2, 2)
    assert faults.crowded_edges == 5


@pytest.mark.parametrize(
    ("factor", "offset", "problem"),
    [
        (1000.0, 0.0, "as if in millimetres"),
        (1e-5, 11.5, "as if in degrees"),
    ],
)
def test_a_wrong_unit_is_named(tmp_path, factor, offset, problem):
    mesh = cube(100.0)
    result = check(tmp_path, Mesh(mesh.vertices * factor + offset, mesh.faces))
    assert any(problem in text for text in problems(result))
    assert result.findings[0].severity == "error"


def test_a_mesh_in_millimetres_that_its_shape_scales_is_sound(tmp_path):
    """At 300 m, single precision stores millimetres in steps of 0.03 mm: fine, though 0.03 m would not be."""
    meshes = [MeshObject("body", "stone", cube(300_000.0))]
    file = write_scene(tmp_path, meshes, STONE)
    scale = '<transform name="to_world"><scale value="0.001"/></transform></shape>'
    file.write_text(file.read_text().replace("</shape>", scale))
    result = check_scene(file)
    assert result.findings == ()
    assert result.bounds == pytest.approx([0.0] * 3 + [300.0] * 3)
    assert read_scene(file, 2e9).sizes[0].high == pytest.approx([300.0] * 3)


def test_names_that_sionna_refuses_are_found(tmp_path):
    constants = {"relative_permittivity": 5.0, "conductivity": 0.1, "thickness": 0.1}
    assert problems(check(tmp_path, cube(), {"concrete": constants})) == [
        "has an ITU-R P.2040 name, which Sionna RT refuses"
    ]
    assert problems(check(tmp_path, cube(), STONE, name="stone")) == [
        "has the name of a material, which Sionna RT refuses"
    ]
    file = tmp_path / "scene.xml"
    file.write_text(file.read_text().replace('id="mat-stone" name', 'id="mat-brick_wall" name'))
    assert "refers to a material that the scene does not contain ('brick_wall')" in problems(
        check_scene(file)
    )
    file.write_text(file.read_text().replace('type="itu-radio-material" id="mat-stone"', 'type="diffuse"'))
    assert "a BSDF of type 'diffuse' has no id" in problems(check_scene(file))


def test_two_objects_of_one_id_are_found(tmp_path):
    file = write_scene(tmp_path, [MeshObject(name, "stone", cube()) for name in ("one", "other")], STONE)
    file.write_text(file.read_text().replace('id="mesh-other"', 'id="mesh-one"'))
    found = [item for item in check_scene(file).findings if item.severity == "error"]
    assert [(item.subject, item.problem) for item in found] == [
        ("mesh-one", "is the id of 2 objects, which Sionna RT refuses")
    ]


def test_meshes_that_cannot_be_read_are_named(tmp_path):
    file = write_scene(tmp_path, [MeshObject("body", "stone", cube())], STONE)
    mesh = tmp_path / "meshes" / "body.ply"
    mesh.write_bytes(mesh.read_bytes()[:150])
    with pytest.raises(InputError, match=r"mesh .*body\.ply: is not a PLY file, or its header is damaged"):
        check_scene(file)
    mesh.unlink()
    with pytest.raises(InputError, match="does not exist"):
        check_scene(file)
    file.write_text('<scene version="2.1.0"></scene>')
    with pytest.raises(InputError, match="no mesh"):
        check_scene(file)


def sheet(x: float, low: float, high: float) -> Mesh:
    """A wall across the x axis, from y and z = low to high."""
    corners = [[x, low, low], [x, high, low], [x, high, high], [x, low, high]]
    return Mesh(np.array(corners, dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("turn", [[0, 1, 2], [1, 2, 0], [2, 0, 1]])
@pytest.mark.parametrize(("gap", "count"), [(0.0, 2), (0.001, 2), (0.009, 2), (0.011, 0)])
def test_faces_closer_than_a_centimetre_are_found(turn, gap, count):
    """The small sheet lies at the large one, whose centroids it does not cover."""
    corners = np.concatenate(
        [mesh.vertices[mesh.faces] for mesh in (sheet(5.0, -9.0, 9.0), sheet(5.0 + gap, 1.0, 2.0))]
    )
    cover = find_covers(corners[:, :, turn])
    assert (cover[:2] < 0).all()
    assert (cover >= 0).sum() == count


def test_touching_buildings_and_floors_on_the_ground_are_no_overlap():
    neighbour = cube()
    neighbour.vertices[:, 0] += 10.0
    ground = Mesh(np.array([[-90.0, -90, 0], [90, -90, 0], [0, 90, 0]]), np.array([[0, 1, 2]]))
    corners = [mesh.vertices[mesh.faces] for mesh in (cube(), neighbour, ground)]
    assert (find_covers(np.concatenate(corners)) < 0).all()
    # The copy of a building shows its walls and its roof twice.
    assert (find_covers(np.concatenate([*corners, corners[1]])) >= 0).sum() > 10


def test_a_road_in_the_plane_of_the_ground_is_named(tmp_path):
    materials = STONE | {"tar": {"type": "concrete", "thickness": 0.1}}
    plane = [MeshObject(name, material, Mesh(sheet(0.0, -size, size).vertices[:, [1, 2, 0]], sheet(0, 0, 1).faces))
             for name, material, size in (("ground", "stone", 90.0), ("road", "tar", 20.0))]  # fmt: skip
    finding = next(item for item in check_scene(write_scene(tmp_path, plane, materials)).findings if not item.subject
                   and "parallel" in item.problem)  # fmt: skip
    assert finding.severity == "warning"
    assert (
        "(such as faces of 'mesh-road' and 'mesh-ground'), 2 of them to a face of a different material"
        in finding.problem
    )
