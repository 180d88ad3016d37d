"""Diagnosis: each fault planted in a scene is found and named, and a sound scene has none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.reporting.position_plot import draw_positions
from calibray.scenes.authoring.extrusion import Windows
from calibray.scenes.authoring.scene_folder import make_scene
from calibray.scenes.checks.mesh_check import health
from calibray.scenes.checks.scene_check import SceneDiagnosis, diagnose
from calibray.scenes.meshes import Mesh, MeshObject, joined, write_scene
from planted_maps import L_SHAPE, footprints

STONE = {"stone": {"type": "concrete", "thickness": 0.2}}


def cube(size: float = 10.0, at: float = 0.0) -> Mesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return Mesh(corners * size + [at, at, 0], np.array(faces))


def scene(folder: Path, mesh: Mesh, materials=STONE, name: str = "body") -> SceneDiagnosis:
    return diagnose(write_scene(folder, [MeshObject(name, next(iter(materials)), mesh)], materials))


def problems(found: SceneDiagnosis) -> list[str]:
    return [finding.problem for finding in found.findings]


def test_a_sound_scene_has_no_finding(tmp_path):
    found = scene(tmp_path, cube())
    assert found.findings == ()
    assert found.bounds == (0, 0, 0, 10, 10, 10)
    assert (found.faces, found.objects[0].vertices, found.objects[0].open_edges) == (12, 8, 0)


def test_a_made_scene_is_sound(tmp_path):
    seen = []
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path, windows=Windows(0.4))
    found = diagnose(made.path, lambda *told: seen.append(told))
    assert found.findings == ()
    assert seen[-1] == ("examining", 4, 4)
    assert {item.name: item.flipped_faces for item in found.objects} == {
        "all-roofs": 0, "all-walls": 0, "all-windows": 0, "ground-surface": 0,
    }  # fmt: skip


def test_faces_that_share_no_vertices_are_found(tmp_path):
    sound = cube()
    loose = Mesh(sound.vertices[sound.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    found = scene(tmp_path, loose)
    assert problems(found) == [
        "18 edges at which faces meet without sharing vertices: no diffraction there"
    ]  # fmt: skip
    assert found.objects[0].open_edges == 0


@pytest.mark.parametrize("turned", [[0], [0, 5, 7], list(range(12))])
def test_faces_that_look_inward_are_counted(turned):
    mesh = cube()
    mesh.faces[turned] = mesh.faces[turned, ::-1]
    assert health("body", "stone", mesh).flipped_faces == len(turned)


def test_every_connected_piece_is_judged_by_itself():
    inward = cube(3.0, at=20.0)
    both = joined([cube(), Mesh(inward.vertices, inward.faces[:, ::-1])])
    assert health("body", "stone", both).flipped_faces == 12
    ground = Mesh(np.array([[0.0, 0, 0], [9, 0, 0], [0, 9, 0]]), np.array([[0, 2, 1]]))
    assert health("ground", "stone", ground).flipped_faces == 1
    # A sheet of wall has no inside.
    wall = Mesh(np.array([[0.0, 0, 0], [9, 0, 0], [9, 0, 3], [0, 0, 3]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert health("wall", "stone", wall).flipped_faces == 0
    assert health("wall", "stone", Mesh(wall.vertices, np.array([[0, 1, 2], [0, 3, 2]]))).flipped_faces == 1


def test_empty_repeated_and_crowded_faces_are_counted():
    sound = cube()
    faces = np.vstack([sound.faces, sound.faces[:2], [[0, 0, 1], [0, 4, 4]]])
    found = health("body", "stone", Mesh(sound.vertices, faces))
    assert (found.empty_faces, found.repeated_faces) == (2, 2)
    assert found.crowded_edges == 5


@pytest.mark.parametrize(
    ("factor", "offset", "problem"),
    [
        (1000.0, 0.0, "as if in millimetres"),
        (1e-5, 11.5, "as if in degrees"),
        (1.0, 691_000.0, "single precision is coarse"),
    ],
)
def test_a_wrong_unit_is_named(tmp_path, factor, offset, problem):
    mesh = cube(100.0)
    found = scene(tmp_path, Mesh(mesh.vertices * factor + offset, mesh.faces))
    assert any(problem in text for text in problems(found))
    assert found.findings[0].severity == "error"


def test_names_that_sionna_refuses_are_found(tmp_path):
    constants = {"relative_permittivity": 5.0, "conductivity": 0.1, "thickness": 0.1}
    assert problems(scene(tmp_path, cube(), {"concrete": constants})) == [
        "has a name of ITU-R P.2040's, which Sionna RT refuses"
    ]
    assert problems(scene(tmp_path, cube(), STONE, name="stone")) == [
        "is called like a material, which Sionna RT refuses"
    ]
    file = tmp_path / "scene.xml"
    file.write_text(file.read_text().replace('id="mat-stone" name', 'id="mat-brick_wall" name'))
    assert "refers to no material of the scene ('brick_wall')" in problems(diagnose(file))
    file.write_text(file.read_text().replace('type="itu-radio-material" id="mat-stone"', 'type="diffuse"'))
    assert "a BSDF of type 'diffuse' has no id" in problems(diagnose(file))


def test_meshes_that_cannot_be_read_are_named(tmp_path):
    file = write_scene(tmp_path, [MeshObject("body", "stone", cube())], STONE)
    mesh = tmp_path / "meshes" / "body.ply"
    mesh.write_bytes(mesh.read_bytes()[:150])
    with pytest.raises(InputError, match=r"body\.ply of 'body' cannot be read"):
        diagnose(file)
    mesh.unlink()
    with pytest.raises(InputError, match="does not exist"):
        diagnose(file)
    file.write_text('<scene version="2.1.0"></scene>')
    with pytest.raises(InputError, match="no mesh"):
        diagnose(file)


def test_a_drawing_shows_the_antennas_over_the_footprints(tmp_path):
    made = make_scene(footprints([L_SHAPE], [10.0]), tmp_path)
    figure = draw_positions(
        made.path, [[0, 0, 10]], [[5, 5, 1.5], [40, 5, 1.5]], {"within a building": [[5, 5, 1.5]]}
    )  # fmt: skip
    (axes,) = figure.axes
    labels = {text.get_text() for text in axes.get_legend().get_texts()}
    assert labels == {"2 receivers", "1 transmitters", "1 within a building"}
    # Roofs and walls; the ground is left out.
    assert len(axes.collections) - 3 == 2
    figure.savefig(tmp_path / "map.svg")
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.svg").read_text().startswith("<?xml")
