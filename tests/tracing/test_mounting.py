"""Antennas mounted per link: the fields equal those of Sionna RT, for any pose, at both ends, without a new trace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sionna.rt as rt
from scipy.spatial.transform import Rotation

from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.scenes import Scene, read_scene
from calibray.tracing.antennas import AntennaPattern, Mounting, Pose, jones_vectors, mount, wave_basis
from calibray.tracing.protocol import LinkPositions
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
SETTINGS = TraceSettings(max_depth=2, refraction=True, diffraction=True, samples=20_000)
SECTOR = Antenna("tr38901", "cross")
PANEL = Antenna("tr38901", "cross", rows=4, columns=2, spacing=(0.5, 0.7))
DIPOLE = Antenna("hw_dipole", "V", (0.3, 0.0, 0.4))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    ground = [[(-60.0, -60.0, 0.0), (60.0, -60.0, 0.0), (60.0, 60.0, 0.0), (-60.0, 60.0, 0.0)]]
    houses = block((5.0, -10.0, 0.0), (15.0, 10.0, 8.0)) + block((-20.0, 12.0, 0.0), (-8.0, 25.0, 12.0))
    file = write_scene(tmp_path_factory.mktemp("scene"), {"ground": ground, "houses": houses})
    return read_scene(file, FREQUENCY)


@pytest.mark.parametrize("sector", [SECTOR, PANEL])
def test_random_poses_give_the_path_gains_of_sionna_rt(scene: Scene, sector: Antenna) -> None:
    random = np.random.default_rng(3)
    links = LinkPositions(tx=np.array([[-30.0, -20.0, 10.0]]), rx=np.array([[30.0, 15.0, 1.5]]))
    paths = Tracer(scene, FREQUENCY, SETTINGS, Antenna(), Antenna()).trace(links)
    assert paths.num_paths > 3
    for _ in range(3):
        yaw, tilt = random.uniform(-np.pi, np.pi, 2), random.uniform(-0.4, 0.4, 2)
        mounted = mount(
            paths,
            {
                end: Mounting(
                    (antenna,), np.zeros(1, int), Pose(yaw[k : k + 1], tilt[k : k + 1], *np.zeros((2, 1)))
                )
                for k, (end, antenna) in enumerate((("tx", sector), ("rx", DIPOLE)))
            },
        )
        turned = [
            replace(antenna, orientation=composed(yaw[k], tilt[k], antenna))
            for k, antenna in enumerate((sector, DIPOLE))
        ]
        solution = Tracer(scene, FREQUENCY, SETTINGS, *turned).solve(links, {})
        gains = path_gains(mounted)
        largest = np.abs(solution.gain).max()
        order, other = np.argsort(mounted.delay), np.argsort(solution.delay)
        np.testing.assert_allclose(gains[order], solution.gain[other], atol=1e-4 * largest)


def composed(yaw: float, tilt: float, antenna: Antenna) -> tuple[float, ...]:
    """Yaw, pitch and roll of an antenna that is turned in its mount, by SciPy."""
    mounted = Rotation.from_euler("ZY", [yaw, tilt]) * Rotation.from_euler("ZYX", antenna.orientation)
    return tuple(mounted.as_euler("ZYX"))


def test_links_differ_in_antenna_and_direction(scene: Scene) -> None:
    tx = np.tile([-30.0, -20.0, 10.0], (3, 1))
    links = LinkPositions(tx=tx, rx=np.array([[30.0, 15.0, 1.5], [-25.0, 20.0, 1.5], [0.0, -30.0, 2.0]]))
    paths = Tracer(scene, FREQUENCY, SETTINGS, Antenna(), Antenna()).trace(links)
    horn, dipole = Antenna("tr38901"), Antenna("dipole")
    pose = Pose(np.array([0.5, 2.0, -1.0]), np.array([0.1, 0.0, 0.2]), *np.zeros((2, 3)))
    mounted = mount(paths, {"tx": Mounting((horn, dipole), np.array([0, 1, 0]), pose)})
    for link, antenna in enumerate((horn, dipole, horn)):
        orientation = (float(pose.yaw[link]), float(pose.downtilt[link]), 0.0)
        alone = Tracer(scene, FREQUENCY, SETTINGS, replace(antenna, orientation=orientation), Antenna())
        expected = alone.trace(LinkPositions(links.tx[[link]], links.rx[[link]]))
        np.testing.assert_allclose(mounted.tx_field[mounted.link == link], expected.tx_field, atol=1e-9)


@pytest.mark.parametrize("aside", [0.0, 3e-9, 3e-7])
def test_a_panel_that_points_straight_down_keeps_its_polarization(tmp_path: Path, aside: float) -> None:
    room = read_scene(write_scene(tmp_path, {"room": block((-4.0, -3.0, 0.0), (5.0, 6.0, 3.0))}), FREQUENCY)
    settings = TraceSettings(max_depth=2, samples=20_000)
    # The direct path has the azimuth of the rounding error of a position.
    links = LinkPositions(tx=np.array([[1.1, 0.7, 2.9]]), rx=np.array([[1.1, 0.7 + aside, 1.3]]))
    panel = Antenna("tr38901", "V")
    upwards, downwards = (replace(panel, orientation=(0.6, pitch, 0.0)) for pitch in (-np.pi / 2, np.pi / 2))
    paths = Tracer(room, FREQUENCY, settings, Antenna(), upwards).trace(links)
    pose = Pose(*np.array([[0.6], [np.pi / 2], [0.0], [0.0]]))
    mounted = mount(paths, {"tx": Mounting((panel,), np.zeros(1, int), pose)})
    expected = Tracer(room, FREQUENCY, settings, downwards, upwards).trace(links)
    gains = np.abs(path_gains(expected))
    np.testing.assert_allclose(np.abs(path_gains(mounted)), gains, rtol=1e-6, atol=1e-6 * gains.max())


def test_electrical_downtilt_shifts_the_pattern_in_the_antenna_s_frame() -> None:
    elevation = np.radians(np.arange(-40.0, 41.0))
    angles = np.stack([np.pi / 2 - elevation, np.full(81, 0.3)], axis=-1)
    tilted = Pose(np.full(81, 0.3), np.zeros(81), np.full(81, np.radians(10.0)), np.zeros(81))
    power = (jones_vectors(AntennaPattern.of(Antenna("tr38901")), wave_basis(angles), tilted) ** 2).sum(
        axis=(1, 2)
    )
    assert np.degrees(elevation[power.argmax()]) == pytest.approx(-10.0)


def test_an_array_is_sionna_s_planar_array_with_steered_weights() -> None:
    random, tilt, steering = np.random.default_rng(5), np.radians(8.0), np.radians(-25.0)
    zenith, azimuth = np.arccos(random.uniform(-1, 1, 200)), random.uniform(-np.pi, np.pi, 200)
    directions = _directions(zenith, azimuth)
    array = rt.PlanarArray(
        num_rows=PANEL.rows, num_cols=PANEL.columns, horizontal_spacing=0.5, vertical_spacing=0.7,
        pattern="tr38901", polarization="V",
    )  # fmt: skip
    positions = np.array(array.normalized_positions).T
    aim = _directions(np.array([np.pi / 2 + tilt]), np.array([steering]))
    weights = np.exp(-2j * np.pi * positions @ aim.T) / np.sqrt(len(positions))
    expected = np.exp(2j * np.pi * directions @ positions.T) @ weights
    pattern = AntennaPattern.of(PANEL)
    field = pattern.amplitude(zenith, azimuth, tilt, steering)
    np.testing.assert_allclose(field, pattern.element(zenith, azimuth) * expected[:, 0], atol=1e-6)
    along = pattern.amplitude(np.pi / 2 + tilt, steering, tilt, steering)
    assert along == pytest.approx(np.sqrt(8) * pattern.element(np.pi / 2 + tilt, steering))


def _directions(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def test_antennas_of_one_end_have_as_many_ports() -> None:
    pose = Pose(*np.zeros((4, 2)))
    with pytest.raises(InputError, match=r"'V' and 'cross'.*one port each, or two each"):
        Mounting((Antenna(), SECTOR), np.array([0, 1]), pose)
