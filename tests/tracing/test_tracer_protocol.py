"""The seam to ray tracers: one of a few lines serves as well as Sionna RT, which is imported only to trace."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.constants import epsilon_0, speed_of_light

import calibray as cb
import planted
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.scenes import Scene, read_scene
from calibray.study import Setup
from calibray.support import cache_folder as caching
from calibray.tracing import SIONNA, convergence
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.protocol import EnclosedAntennas, Tracer, TracerFactory
from calibray.tracing.settings import PATTERNS, POLARIZATIONS, Antenna, TraceSettings
from link_tables import links_from_frame
from small_scenes import write_scene
from two_ray import MIRROR, TwoRay

FREQUENCY = 3.5e9
PERMITTIVITY, CONDUCTIVITY = 5.0, 0.5
# So thick and lossy that nothing comes back from below: a half-space to better than 1e-15.
GROUND = (
    '<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="5.0"/>'
    '<float name="conductivity" value="0.5"/><float name="thickness" value="1.0"/></bsdf>'
)
DISTANCE = np.geomspace(3.0, 150.0, 40)
LINKS = SimpleNamespace(
    tx=np.tile([0.0, 0.0, 10.0], (40, 1)), rx=np.stack([DISTANCE, 0.3 * DISTANCE, np.full(40, 1.5)], axis=1)
)
COHERENT = partial(path_loss, combining="coherent")
SETTINGS = TraceSettings(max_depth=1, samples=20_000)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    corners = [(-300.0, -300.0, 0.0), (300.0, -300.0, 0.0), (300.0, 300.0, 0.0), (-300.0, 300.0, 0.0)]
    folder = tmp_path_factory.mktemp("plane")
    return read_scene(write_scene(folder, {"floor": [corners]}, GROUND, "mat-ground"), FREQUENCY)


def open_with(
    factory: TracerFactory, scene: Scene, pattern: str = "dipole", polarization: str = "V"
) -> Tracer:
    antenna = Antenna(pattern, polarization)
    return factory(scene, FREQUENCY, SETTINGS, antenna, antenna)


# A tracer of a few lines


def textbook(pattern: str, polarization: str) -> np.ndarray:
    """Path loss over a flat half-space in closed form (Rappaport, Wireless Communications, section 4.6) [L], [dB]."""
    eta = PERMITTIVITY - 1j * CONDUCTIVITY / (2 * np.pi * FREQUENCY * epsilon_0)
    field = 0
    for target in (LINKS.rx, LINKS.rx * MIRROR):
        length = np.linalg.norm(target - LINKS.tx, axis=1)
        rise = np.abs(target - LINKS.tx)[:, 2] / length
        gain = {"iso": 1.0, "dipole": 1.5 * (1 - rise**2)}[pattern]
        # ITU-R P.2040-3, eq. 37 with the angle from the normal.
        root = np.sqrt(eta - (1 - rise**2))
        slope = eta * rise if polarization == "V" else rise
        reflected = 1.0 if target is LINKS.rx else (slope - root) / (slope + root)
        field = field + gain * reflected * np.exp(-2j * np.pi * FREQUENCY * length / speed_of_light) / length
    return -20 * np.log10(speed_of_light / FREQUENCY / (4 * np.pi) * np.abs(field))


@pytest.mark.parametrize(("pattern", "polarization"), [("iso", "V"), ("iso", "H"), ("dipole", "V")])
def test_two_rays_give_the_path_loss_of_the_textbook(plane: Scene, pattern: str, polarization: str) -> None:
    paths = open_with(TwoRay, plane, pattern, polarization).trace(LINKS)
    np.testing.assert_allclose(COHERENT(paths), textbook(pattern, polarization), atol=1e-9)
    free = open_with(TwoRay, plane, "iso").trace(LINKS)
    assert np.ptp(COHERENT(free) - path_loss(free)) > 10


@pytest.mark.parametrize(("pattern", "polarization"), [("iso", "VH"), ("dipole", "V"), ("tr38901", "cross")])
def test_two_rays_are_those_of_sionna_on_a_plane(plane: Scene, pattern: str, polarization: str) -> None:
    ours, theirs = (open_with(factory, plane, pattern, polarization) for factory in (TwoRay, SIONNA))
    one, other = ours.trace(LINKS), theirs.trace(LINKS)
    np.testing.assert_array_equal(np.bincount(other.link), np.full(40, 2))
    np.testing.assert_allclose(path_loss(one), path_loss(other), atol=1e-4)
    np.testing.assert_allclose(COHERENT(one), COHERENT(other), atol=0.02)
    wet = {"ground": cb.Material(15.0, 0.1, 1.0)}
    found = [tracer.solve(LINKS, wet) for tracer in (ours, theirs)]
    assert found[0].gain.shape == found[1].gain.shape == (80, ours.rx_antenna.ports, ours.tx_antenna.ports)
    powers = [np.bincount(solution.link, (np.abs(solution.gain) ** 2).sum(axis=(1, 2))) for solution in found]
    np.testing.assert_allclose(powers[0], powers[1], rtol=1e-3)
    assert np.abs(path_loss(one, wet) - path_loss(one)).max() > 0.1


@pytest.mark.parametrize("factory", [TwoRay, SIONNA])
def test_what_is_asked_changes_no_later_answer(plane: Scene, factory: TracerFactory) -> None:
    tracer = open_with(factory, plane)
    before, wet = tracer.trace(LINKS), {"ground": cb.Material(15.0, 0.1, 1.0)}
    tracer.solve(LINKS, wet)
    assert tracer.trace(LINKS, materials=wet).materials == wet
    tracer.with_settings(TraceSettings(max_depth=0, samples=10)).trace(LINKS)
    again = tracer.trace(LINKS)
    assert again.materials == before.materials == plane.materials
    assert again.num_paths == before.num_paths
    np.testing.assert_array_equal(path_loss(again), path_loss(before))
    assert tracer.settings == SETTINGS


def note(told: list[tuple], *step: object) -> None:
    told.append(step)


def test_any_tracer_tells_progress_launches_and_points_below_the_ground(plane: Scene) -> None:
    for factory in (TwoRay, SIONNA):
        told: list[tuple] = []
        tracer = open_with(factory, plane)
        tracer.trace(LINKS, partial(note, told))
        assert told[-1] == ("tracing", 40, 40)
        assert len(tracer.plan(LINKS).launches) == 1
        assert dict(factory.versions)
    assert open_with(TwoRay, plane).enclosed(np.array([[0, 0, -1.0], [0, 0, 1.0]])).tolist() == [True, False]


def test_convergence_is_checked_of_any_tracer(plane: Scene) -> None:
    tracer = open_with(TwoRay, plane)

    def trace(settings: TraceSettings) -> Paths:
        return tracer.with_settings(settings).trace(LINKS)

    found = convergence.check(tracer.settings, trace, tracer.trace(LINKS), COHERENT)
    assert found.samples == SETTINGS.samples
    assert found.converged(0.0)


# Antennas in closed form


@pytest.mark.parametrize("polarization", POLARIZATIONS)
@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("orientation", [(0.0, 0.0, 0.0), (0.4, -0.3, 1.2)])
def test_antennas_radiate_as_sionnas(pattern: str, polarization: str, orientation: tuple) -> None:
    import mitsuba as mi
    from sionna.rt.antenna_pattern import antenna_pattern_registry, antenna_pattern_to_world_implicit
    from sionna.rt.utils import rotation_matrix

    random = np.random.default_rng(5).normal(size=(300, 3))
    axes = np.concatenate([np.eye(3), -np.eye(3), [[0.01, 0, 1], [0, -0.01, -1]]])
    direction = np.concatenate([random, axes])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    antenna = Antenna(pattern, polarization, orientation)
    to_world = rotation_matrix(mi.Point3f(*orientation))
    look = mi.Vector3f(*direction.T.astype(np.float32))
    functions = antenna_pattern_registry.get(pattern)(polarization=polarization).patterns
    for arriving in (False, True):
        ours = AntennaPattern.of(antenna).jones_vectors(direction, arriving)
        assert ours.shape == (len(direction), antenna.ports, 2)
        for port, function in enumerate(functions):
            parts = antenna_pattern_to_world_implicit(function, to_world, look, "in" if arriving else "out")
            theirs = np.array(parts, dtype=float)
            np.testing.assert_allclose(ours[:, port].real.T, theirs[:2], atol=2e-5)
            np.testing.assert_allclose(ours[:, port].imag.T, theirs[2:], atol=2e-5)


@pytest.mark.parametrize(("pattern", "mean"), [("iso", 1.0), ("dipole", 1.0), ("hw_dipole", 1.0)])
def test_lossless_antennas_radiate_the_power_they_take(pattern: str, mean: float) -> None:
    """Gauss-Legendre in the cosine of the zenith; the half-wave dipole's factor 1.643 is rounded."""
    cosine, weight = np.polynomial.legendre.leggauss(200)
    gain = AntennaPattern.of(Antenna(pattern)).amplitude(np.arccos(cosine), np.zeros(200)) ** 2
    assert gain @ weight / 2 == pytest.approx(mean, abs=2e-3 if pattern == "hw_dipole" else 1e-12)


# Traces kept between runs


def test_a_kept_trace_is_found_without_opening_a_tracer_and_never_by_another_one(
    plane: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(caching.CACHE_VARIABLE, str(tmp_path / "cache"))
    sections = {
        "scene": {"file": str(plane.path), "frequency": FREQUENCY},
        "parameters": {"ground.relative_permittivity": {"bounds": [1.5, 12.0]}},
    }
    study = planted.study(tmp_path, planted.links().assign(path_loss_db=90.0), **sections)
    opened: list[str] = []

    class Counting:
        def __init__(self, version: str) -> None:
            self.versions = {"two-ray": version}

        def __call__(self, *arguments: Any) -> Tracer:
            opened.append(self.versions["two-ray"])
            return TwoRay(*arguments)

    first, second = (Setup.open(study, tracer=Counting("1")).trace() for _ in range(2))
    assert opened == ["1"]
    np.testing.assert_array_equal(path_loss(first), path_loss(second))
    Setup.open(study, tracer=Counting("2")).trace()
    assert opened == ["1", "2"]


# A study is traced


def test_a_study_is_traced_with_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(caching.CACHE_VARIABLE, "")
    study = planted.study(tmp_path, planted.campaign())
    told: list[tuple] = []
    paths = cb.trace(study, progress=lambda *step: told.append(step))
    assert told[-1] == ("tracing", planted.LINKS, planted.LINKS)
    scene = Setup.open(study).scene
    same = cb.trace(scene, study.measurements(), frequency=3.5e9, **study.trace.record())
    np.testing.assert_array_equal(path_loss(paths), path_loss(same))
    assert paths.materials == same.materials == scene.materials
    fewer = cb.trace(
        study, links_from_frame(planted.links().head(3)), materials={"marble": cb.Material(8.1, 0.2, 0.1)}
    )
    assert fewer.num_links == 3
    assert fewer.materials["marble"] == cb.Material(8.1, 0.2, 0.1)
    assert fewer.materials["wood"] == paths.materials["wood"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frequency": 2e9}, r"the study .*study\.toml states frequency; change"),
        ({"max_depth": 2}, "states max_depth"),
        ({"rx_antenna": "dipole"}, "states rx_antenna"),
        ({"measurements": LINKS}, "must be Measurements"),
        ({"materials": {"marbel": {"thickness": 0.1}}}, "marbel"),
    ],
)
def test_a_study_is_not_contradicted(tmp_path: Path, arguments: dict, message: str) -> None:
    study = planted.study(tmp_path, planted.links().assign(path_loss_db=90.0))
    with pytest.raises(InputError, match=message):
        cb.trace(study, **arguments)


def test_a_scene_alone_is_not_enough() -> None:
    with pytest.raises(InputError, match="give measurements, the links"):
        cb.trace("sionna:box", frequency=1e9)
    with pytest.raises(InputError, match="give frequency, the carrier in Hz"):
        cb.trace("sionna:box", LINKS)


# Antennas inside closed bodies


def test_enclosed_antennas_are_told_by_row_unless_most_are() -> None:
    row, no = np.arange(2, 7), np.zeros(5, dtype=bool)
    found = EnclosedAntennas.of(row, no, np.arange(5) == 3)
    assert (found.tx, found.rx, found.indoors) == ((), (5,), False)
    assert EnclosedAntennas.of(row, np.arange(5) < 2, np.arange(5) > 1) == EnclosedAntennas(
        (2, 3), (4, 5, 6), True
    )


# What loads the ray tracer

LIGHT = (
    "calibray.tracing", "calibray.tracing.protocol", "calibray.tracing.settings",
    "calibray.tracing.antennas", "calibray.tracing.cache", "calibray.tracing.convergence",
    "calibray.tracing.antennas", "calibray.study.trace", "calibray.study", "calibray.result", "calibray.engines",
)  # fmt: skip


TRACE = """
import sys
from types import SimpleNamespace
from typing import Any
import numpy as np
from calibray.tracing import llvm
import calibray as cb

class Reached:
    def find_spec(self, name, *_):
        if name.split(".")[0] in ("drjit", "mitsuba"):
            raise SystemExit("reached the ray tracer")

sys.meta_path.insert(0, Reached())
links = SimpleNamespace(tx=np.array([[0.0, 0, 1]]), rx=np.array([[1.0, 0, 1]]))
for devices in (0, 1):
    llvm.cuda_device_count = lambda: devices
    try:
        cb.trace("sionna:box", links, frequency=1e9)
    except (cb.errors.InputError, SystemExit) as end:
        print(end)
"""


@pytest.fixture(scope="module")
def printed() -> list[str]:
    """What a process that cannot use LLVM prints: the ray tracer's packages that are loaded, and two attempts."""
    code = (
        f"import importlib, sys, calibray as cb\nfor name in {LIGHT!r}: importlib.import_module(name)\n"
        "cb.trace, cb.Study, cb.Result, cb.engines.make\n"
        "print({'sionna', 'mitsuba', 'drjit'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code + TRACE]
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": os.devnull}
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


def test_nothing_but_tracing_loads_the_ray_tracer(printed: list[str]) -> None:
    assert printed[0] == "set()"


def test_a_machine_without_a_usable_llvm_traces_on_its_gpu_alone(printed: list[str]) -> None:
    """What a GPU is found by is put in place; what is imported before Dr.Jit is the package's own."""
    _, refused, reached = printed
    assert refused.startswith("DRJIT_LIBLLVM_PATH")
    assert reached == "reached the ray tracer"
