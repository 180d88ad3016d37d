"""The demo district and its campaign: what the geometry promises, what is planted, and whose the files are."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import coastal_district as district
import demo_campaign as campaign
from calibray.engines import Replay
from calibray.errors import InputError
from calibray.scenarios import demo_study_path
from calibray.scenes import Mesh, join_meshes, ply_bytes
from calibray.study import Study
from calibray.support.output_files import SIGNATURES

PACKAGED = demo_study_path().parent
BUILDINGS = district.district()
PLANTED = [5.8, 4.65, 4.2]  # concrete, glass, soil
START = [5.31, 6.27, 2.25]


@pytest.fixture(scope="module")
def truth():
    return json.loads((PACKAGED / "truth.json").read_text())


@pytest.fixture(scope="module")
def links():
    return pd.read_csv(PACKAGED / "links.csv")


@pytest.fixture(scope="module")
def replay():
    setup = Study.load(demo_study_path()).opened()
    return Replay(setup.trace(), setup.parameters)


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder; the signatures of what was just written are left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != SIGNATURES)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def directed_edges(faces: np.ndarray) -> Counter[tuple[int, int]]:
    return Counter((int(face[k]), int(face[(k + 1) % 3])) for face in faces for k in range(3))


def welded(meshes: list[Mesh]) -> Mesh:
    """One mesh in which vertices at the same place are one."""
    mesh = join_meshes(meshes)
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh(vertices, index.reshape(-1)[mesh.faces])


def open_edges(mesh: Mesh) -> list[tuple[int, int]]:
    """Edges of one face only, as their two vertices."""
    edges = directed_edges(mesh.faces)
    return [edge for edge in edges if edge[::-1] not in edges]


def plan_area(footprint: np.ndarray) -> float:
    x, y = footprint.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def rmse(loss: np.ndarray, measured: np.ndarray) -> np.ndarray:
    return np.sqrt(((loss - measured) ** 2).mean(axis=-1))


# The files


def test_regenerating_what_needs_no_tracer_gives_the_same_bytes(tmp_path):
    campaign.write_model(tmp_path, campaign.world())
    committed = contents(PACKAGED)
    del committed["links.csv"]
    assert contents(tmp_path) == committed


def test_regenerating_the_measurement_gives_the_same_bytes():
    """Measured for a link of either transmitter, which is the same as among all."""
    true_world, committed = campaign.world(), pd.read_csv(PACKAGED / "links.csv")
    values = committed[["path_loss_db", "path_loss_std_db"]].to_numpy()
    measured = slice(6, None, 27)
    values[measured] = campaign.measure(true_world, links=measured)
    assert set(committed["tx"][measured]) == {"TX1", "TX2"}
    assert campaign.links_csv(true_world, values).encode() == (PACKAGED / "links.csv").read_bytes()


def test_another_seed_gives_another_world_in_the_same_streets():
    other = campaign.world(seed=campaign.SEED + 1)
    same = campaign.world()
    assert not np.array_equal(other.rx, same.rx)
    assert not np.array_equal(other.permittivity, same.permittivity)
    assert [building.footprint.tolist() for building in other.buildings] == [
        building.footprint.tolist() for building in same.buildings
    ]


def test_the_files_are_small():
    sizes = [len(content) for content in contents(PACKAGED).values()]
    assert max(sizes) < 1_000_000
    assert sum(sizes) < 1_100_000


def test_the_study_is_the_papers_experiment():
    study = Study.load(demo_study_path())
    assert (study.scene.frequency, study.scene.bandwidth) == (4e9, 200e6)
    content = tomllib.loads(demo_study_path().read_text())
    assert {name: content["materials"][name].get("revision") for name in ("concrete", "glass")} == {
        "concrete": "P.2040-1",
        "glass": "P.2040-1",
    }
    assert study.trace.record() == {**study.trace.record(), **campaign.SPECULAR}


def test_a_ply_file_is_little_endian_and_complete():
    mesh = Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.5, 0.0]]), np.array([[0, 1, 2]]))
    header, _, body = ply_bytes(mesh).partition(b"end_header\n")
    assert b"binary_little_endian" in header
    assert np.frombuffer(body[:36], "<f4").tolist() == mesh.vertices.ravel().tolist()
    assert body[36] == 3
    assert np.frombuffer(body[37:], "<i4").tolist() == [0, 1, 2]


# The district


def test_the_district_has_the_papers_extent_and_heights():
    everything = join_meshes(item.mesh for item in district.scene_objects(BUILDINGS))
    span = np.ptp(everything.vertices, axis=0)
    assert span[:2].tolist() == [2100.0, 1700.0]
    assert everything.vertices[:, 2].min() == 0.0
    heights = [building.height for building in BUILDINGS]
    assert 60.0 <= min(heights) < 62.0
    assert 68.0 < max(heights) <= 70.0
    assert len(BUILDINGS) > 150


def test_all_vertices_are_exact_in_32_bit_floats():
    for item in district.scene_objects(BUILDINGS):
        assert np.array_equal(item.mesh.vertices.astype(np.float32), item.mesh.vertices)


@pytest.mark.parametrize("building", BUILDINGS[::13], ids=lambda building: building.name)
def test_a_building_is_watertight_and_faces_outwards(building):
    body = welded(list(district.building_meshes(building)))
    assert max(directed_edges(body.faces).values()) == 1
    # Only the foot is open: the ground closes it.
    assert all(body.vertices[list(edge), 2].tolist() == [0.0, 0.0] for edge in open_edges(body))
    # By the divergence theorem: the foot lies at z = 0 and adds nothing.
    corner = body.vertices[body.faces]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    assert volume == pytest.approx(plan_area(building.footprint) * building.height, rel=1e-9)


@pytest.mark.parametrize("building", BUILDINGS[::13], ids=lambda building: building.name)
def test_every_edge_of_a_building_is_a_wedge_within_the_concrete(building):
    concrete, _ = district.building_meshes(building)
    edges = directed_edges(concrete.faces)
    index = {tuple(place): k for k, place in enumerate(concrete.vertices.tolist())}
    roof = concrete.vertices[:, 2] == building.height
    for start, end in pairwise([*building.footprint, building.footprint[0]]):
        # The vertical corner, up to the band and along it.
        levels = [
            index[(*start, height)] for height in (0.0, building.height - district.BAND, building.height)
        ]
        assert all(edges[pair] == edges[pair[::-1]] == 1 for pair in pairwise(levels))
        # The edge between wall and roof.
        along = (concrete.vertices[:, :2] - start) @ (end - start) / ((end - start) @ (end - start))
        aside = concrete.vertices[:, :2] - start - along[:, None] * (end - start)
        rim = np.flatnonzero(roof & (np.abs(aside).max(axis=1) < 1e-9))
        rim = rim[np.argsort(along[rim])].tolist()
        assert len(rim) >= 4
        assert all(edges[pair] == edges[pair[::-1]] == 1 for pair in pairwise(rim))


def test_a_building_torn_at_a_corner_is_found():
    concrete, glass = district.building_meshes(BUILDINGS[0])
    torn = concrete.faces.copy()
    torn[0, 0] = len(concrete.vertices)  # a vertex of its own, a metre aside
    aside = concrete.vertices[concrete.faces[0, 0]] + [1.0, 0.0, 0.0]
    body = welded([Mesh(np.vstack([concrete.vertices, aside]), torn), glass])
    assert any(body.vertices[list(edge), 2].max() > 0.0 for edge in open_edges(body))


def test_walls_are_glass_to_their_share():
    for building in BUILDINGS[::13]:
        _, glass = district.building_meshes(building)
        at_foot = glass.vertices[:, 2] == 0.0
        lower = [face for face in glass.faces if at_foot[face].sum() == 2]
        length = sum(np.ptp(glass.vertices[face][at_foot[face]], axis=0) @ [1, 1, 0] for face in lower)
        ring = np.diff([*building.footprint, building.footprint[0]], axis=0)
        assert length / np.abs(ring).sum() == pytest.approx(building.window_share, abs=0.01)


def test_buildings_stand_apart_and_off_the_streets():
    for one in BUILDINGS:
        for other in BUILDINGS:
            assert one is other or not district.inside(one, other.footprint).any()
    corners = np.concatenate([building.footprint for building in BUILDINGS])
    for axis, lines in enumerate((district.AVENUES, district.STREETS)):
        distance = np.abs(corners[:, axis, None] - np.array(lines)).min(axis=1)
        assert distance.min() >= district.STREET_HALF_WIDTH


def test_the_ground_covers_the_extent_once_and_roadways_are_asphalt():
    objects = {item.name: item for item in district.scene_objects(BUILDINGS)}
    area = {}
    for name in ("ground", "streets"):
        corner = objects[name].mesh.vertices[objects[name].mesh.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (normal[:, 2] > 0).all()
        area[name] = normal[:, 2].sum() / 2
    assert sum(area.values()) == pytest.approx(2100.0 * 1700.0)
    width, across, along = 2 * district.ROADWAY_HALF_WIDTH, len(district.AVENUES), len(district.STREETS)
    roadways = width * (across * 1700.0 + along * 2100.0) - across * along * width**2
    assert area["streets"] == pytest.approx(roadways)
    assert objects["streets"].material == "asphalt"
    assert objects["ground"].material == "soil"


def test_inside_tells_a_building_from_its_surroundings():
    building = BUILDINGS[0]
    centre = building.footprint.mean(axis=0)
    assert district.inside(building, np.array([centre, centre + 500.0, [-1500.0, 0.0]])).tolist() == [
        True,
        False,
        False,
    ]


# The campaign


def test_two_transmitters_have_27_and_13_receivers(links):
    assert links.groupby("tx").size().to_dict() == {"TX1": 27, "TX2": 13}
    assert links["id"].tolist() == list(range(1, 41))
    assert links["rx"].nunique() == 40
    assert (links[["tx_z_m", "rx_z_m"]] == 4.0).all(axis=None)


def test_all_antennas_stand_on_streets_and_clear_of_lamp_posts():
    true_world = campaign.world()
    spots = np.concatenate(
        [true_world.tx, true_world.rx, true_world.tx_recorded, true_world.rx_recorded], axis=0
    )[:, :2]
    assert not any(district.inside(building, spots).any() for building in BUILDINGS)
    across = np.abs(spots[:, :1] - np.array(district.AVENUES)).min(axis=1)
    along = np.abs(spots[:, 1:] - np.array(district.STREETS)).min(axis=1)
    assert np.minimum(across, along).max() < district.STREET_HALF_WIDTH
    to_post = np.linalg.norm(spots[:, None] - district.lamp_positions(), axis=2)
    assert to_post.min() > 1.0


def test_path_losses_span_line_of_sight_to_deep_shadow(links):
    loss = links.set_index("id")["path_loss_db"]
    distance = np.hypot(links["tx_x_m"] - links["rx_x_m"], links["tx_y_m"] - links["rx_y_m"])
    free_space = 20 * np.log10(4 * np.pi * distance * 4e9 / 299792458.0)
    # A dipole gains 1.76 dB at either end, and the canyon of a street guides waves; more would be a mistake.
    assert ((links["path_loss_db"] - free_space) > -12.0).all()
    assert 68.0 < loss.min() < 75.0
    assert 125.0 < loss.max() < 150.0
    shadow = [*range(12, 17), *range(25, 28)]
    assert loss[shadow].median() > loss.drop(shadow).median() + 15.0
    assert links["path_loss_std_db"].between(0.1, 6.0).all()


def test_the_truth_is_complete(truth, links):
    assert set(truth) == {"materials", "buildings", "links", "lamp_posts_m"}
    means = [truth["materials"][name]["relative_permittivity_mean"] for name in ("concrete", "glass", "soil")]
    assert means == PLANTED
    assert set(truth["buildings"]) == {building.name for building in BUILDINGS}
    recorded = links.set_index("id")
    for number, entry in truth["links"].items():
        row = recorded.loc[int(number)]
        for end in ("tx", "rx"):
            error = np.array(entry[f"{end}_m"]) + entry[f"{end}_error_m"]
            assert error.tolist() == pytest.approx([row[f"{end}_{axis}_m"] for axis in "xyz"], abs=2e-3)
    assert len(truth["links"]) == 40
    assert len(truth["lamp_posts_m"]) == len(district.lamp_positions())


def test_planted_permittivities_scatter_as_said(truth):
    for name in ("concrete", "glass"):
        drawn = [entry[f"{name}.relative_permittivity"] for entry in truth["buildings"].values()]
        planted = campaign.PLANTED[name]
        standard_error = planted.spread / np.sqrt(len(drawn))
        assert np.mean(drawn) == pytest.approx(planted.relative_permittivity, abs=3 * standard_error)
        assert np.std(drawn) == pytest.approx(planted.spread, rel=0.15)
        assert len(set(drawn)) == len(campaign.LEVELS)


def test_recorded_positions_are_off_by_about_a_metre(truth):
    error = np.array([entry["rx_error_m"] for entry in truth["links"].values()])
    assert 0.8 < np.sqrt((error**2).sum(axis=1).mean()) < 1.4
    assert (error[:, 2] == 0.0).all()


def test_the_true_world_has_its_own_materials_and_lamp_posts():
    true_world = campaign.world()
    materials = true_world.materials()
    objects = true_world.scene_objects()
    assert {item.material for item in objects} == set(materials)
    assert not {item.name for item in objects} & set(materials)
    assert all(constants["scattering_coefficient"] > 0 for constants in materials.values())
    for column, name in enumerate(("concrete", "glass")):
        for level, value in zip(true_world.level[:, column], true_world.permittivity[:, column], strict=True):
            assert materials[f"{name}_{level}"]["relative_permittivity"] == value
    faces = {item.name: len(item.mesh.faces) for item in objects}
    calibrated = {item.name: len(item.mesh.faces) for item in district.scene_objects(BUILDINGS)}
    assert sum(n for name, n in faces.items() if name.startswith("structures")) == calibrated["structures"]
    assert faces["lamp_posts"] == 10 * len(district.lamp_positions())


# The sounder


def sound(power, delay, is_diffuse, seed=0):
    rng = np.random.Generator(np.random.PCG64(seed))
    return campaign.sounded_path_loss(np.array(power), np.array(delay), np.array(is_diffuse), rng)


def test_one_strong_path_is_measured_exactly():
    loss, spread = sound([1e-8], [1e-6], [False])
    assert loss == pytest.approx(80.0, abs=0.01)
    assert spread < 0.02


def test_paths_in_one_tap_fade_and_their_powers_add():
    losses, spreads = zip(
        *(sound([1e-8, 1e-8], [1e-6, 1e-6], [False, False], k) for k in range(50)), strict=True
    )
    # |1 + e^{j phi}|^2 has mean 2 and standard deviation sqrt(2).
    assert np.mean(losses) == pytest.approx(80 - 10 * np.log10(2), abs=0.15)
    assert np.mean(spreads) == pytest.approx(10 / np.log(10) / np.sqrt(2), rel=0.05)


def test_paths_in_two_taps_do_not_fade():
    loss, spread = sound([1e-8, 1e-8], [1.0e-6, 1.1e-6], [False, False])
    assert loss == pytest.approx(80 - 10 * np.log10(2), abs=0.01)
    assert spread < 0.02


def test_diffuse_paths_in_one_tap_fade_as_rayleigh():
    losses, spreads = zip(
        *(sound(np.full(30, 1e-9), np.full(30, 1e-6), np.full(30, True), k) for k in range(50)), strict=True
    )
    # An exponential variable's standard deviation is its mean.
    assert np.mean(spreads) == pytest.approx(10 / np.log(10), rel=0.05)
    assert np.mean(losses) == pytest.approx(-10 * np.log10(3e-8), abs=0.2)


def test_noise_is_subtracted():
    losses = [sound([10 ** (-campaign.NOISE_DB / -10 + 0.6)], [0.0], [False], k)[0] for k in range(50)]
    assert np.mean(losses) == pytest.approx(-campaign.NOISE_DB - 6.0, abs=0.2)


def test_the_order_of_the_paths_does_not_matter():
    power, delay, diffuse = (
        [1e-8, 2e-8, 3e-9, 4e-9],
        [1e-6, 1.001e-6, 1.002e-6, 1.2e-6],
        [False, False, True, False],
    )
    order = [2, 0, 3, 1]
    shuffled = [[column[k] for k in order] for column in (power, delay, diffuse)]
    assert sound(*shuffled) == pytest.approx(sound(power, delay, diffuse), rel=1e-12)


@pytest.mark.parametrize(("power", "fault"), [([], "no path"), ([1e-17], "the noise of")])
def test_a_receiver_below_the_noise_is_refused(power, fault):
    with pytest.raises(InputError, match=fault):
        sound(power, [1e-6] * len(power), np.full(len(power), False))


# What a calibration meets


def test_every_link_has_a_path(replay):
    assert replay.paths.num_links == 40
    assert replay.paths.links_without_path.tolist() == []
    assert 200 < replay.paths.num_paths < 400


def test_calibration_starts_where_the_paper_does(replay):
    assert replay.parameters.start.tolist() == pytest.approx(START)


def test_the_planted_means_explain_the_measurements_and_the_start_does_not(replay, links):
    before, planted = rmse(replay.path_loss(np.array([START, PLANTED])), links["path_loss_db"].to_numpy())
    assert 2.5 < planted < 3.5
    assert before > planted + 2.0


def test_concrete_and_glass_are_identifiable_and_soil_is_not(replay, links):
    measured = links["path_loss_db"].to_numpy()
    concrete, glass = np.meshgrid(np.linspace(1.5, 12.0, 22), np.linspace(1.5, 10.0, 35), indexing="ij")
    grid = np.stack([concrete.ravel(), glass.ravel(), np.full(concrete.size, 4.2)], axis=1)
    landscape = rmse(replay.path_loss(grid), measured).reshape(concrete.shape)
    best = np.unravel_index(landscape.argmin(), landscape.shape)
    assert 2.4 < landscape[best] < 3.2
    assert concrete[best] == pytest.approx(PLANTED[0], abs=1.0)
    assert glass[best] == pytest.approx(PLANTED[1], abs=0.3)
    by_concrete, by_glass = landscape.min(axis=1), landscape.min(axis=0)
    assert by_concrete.max() > landscape[best] + 3.0
    assert by_glass.max() > landscape[best] + 5.0
    # Glass resonates: a second valley keeps a search that starts on its side.
    valleys = (by_glass[1:-1] < by_glass[:-2]) & (by_glass[1:-1] < by_glass[2:])
    assert valleys.sum() >= 2
    soil = np.array([[concrete[best], glass[best], value] for value in (1.5, 2.25, 4.2, 10.0, 20.0)])
    assert np.ptp(rmse(replay.path_loss(soil), measured)) < 0.2
