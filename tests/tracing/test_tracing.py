"""Tracing with Sionna RT: launches and seeds do not change the result, links without a path, and refused input."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import sionna.rt
from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
from sionna.rt.utils import fibonacci_lattice

import calibray as cb
from calibray.errors import EngineError, InputError
from calibray.fields import path_gains, path_loss
from calibray.paths import Paths
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Trace, Tracer
from calibray.tracing.sionna.buffers import aligned, normals_at, per_interaction
from calibray.tracing.sionna.solver import HASHES
from calibray.tracing.trace_plan import lattice_directions
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
CANYON = "sionna:simple_street_canyon"
MAST = [-20.0, 2, 15]
MIXED = {
    "max_depth": 2, "samples": 20_000, "refraction": True, "diffraction": True, "edge_diffraction": True,
    "diffuse_reflection": True,
}  # fmt: skip
ROUGH = {
    name: {"scattering_coefficient": 0.4, "xpd_coefficient": 0.1}
    for name in ("glass", "wood", "marble", "brick", "concrete")
}


def links(tx: list, rx: list) -> SimpleNamespace:
    """Links from one transmitter, or from each of a list, to the receivers."""
    rx = np.array(rx, dtype=float)
    return SimpleNamespace(tx=np.broadcast_to(np.array(tx, dtype=float), rx.shape), rx=rx)


@pytest.fixture(scope="module")
def canyon() -> Tracer:
    scene = read_scene(CANYON, FREQUENCY, ROUGH)
    return Tracer(scene, FREQUENCY, TraceSettings(**MIXED), Antenna("dipole"), Antenna())


@pytest.fixture(scope="module")
def receivers() -> np.ndarray:
    return np.random.default_rng(6).uniform((-8, -8, 1.5), (8, 8, 2.5), (4, 3))


@pytest.fixture(scope="module")
def trace(canyon: Tracer, receivers: np.ndarray) -> Trace:
    """All receivers traced in one launch."""
    return canyon.find_paths(links(MAST, receivers))


@pytest.fixture(scope="module")
def paths(trace: Trace) -> Paths:
    return trace.paths()


# Results that launches, buffers and the order of links do not change


def test_one_receiver_at_a_time_gives_the_same_paths(
    canyon: Tracer, receivers: np.ndarray, paths: Paths, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NVlabs/sionna#1172: a receiver's paths do not depend on the other receivers of the launch."""
    monkeypatch.setattr("calibray.tracing.sionna.tracer.LANES", MIXED["samples"] * MIXED["max_depth"])
    reports = []
    trace = canyon.find_paths(links(MAST, receivers), lambda *report: reports.append(report))
    assert len(trace.buffers) == len(receivers)
    assert reports == [("tracing", done, 4) for done in range(5)]
    separate = trace.paths()
    assert separate.num_paths == paths.num_paths > 300
    order = [np.lexsort((part.spreading, part.delay, part.link)) for part in (separate, paths)]
    for name in ("link", "delay", "spreading", "departure", "arrival"):
        a, b = (getattr(part, name)[index] for part, index in zip((separate, paths), order, strict=True))
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(path_loss(separate), path_loss(paths), atol=1e-6)


def test_the_order_of_transmitters_and_links_is_kept(
    canyon: Tracer, receivers: np.ndarray, paths: Paths
) -> None:
    masts = np.array([MAST, [25.0, -3, 12]])
    second = canyon.trace(links(masts[1], receivers))
    mixed = canyon.trace(links(masts[[0, 1] * 4], np.repeat(receivers[::-1], 2, axis=0)))
    assert (np.diff(mixed.link) >= 0).all()
    np.testing.assert_array_equal(mixed.rx_position[0::2], receivers[::-1])
    np.testing.assert_allclose(path_loss(mixed)[0::2], path_loss(paths)[::-1], atol=1e-6)
    np.testing.assert_allclose(path_loss(mixed)[1::2], path_loss(second)[::-1], atol=1e-6)


def test_a_full_buffer_is_traced_again_with_the_same_result(
    canyon: Tracer, receivers: np.ndarray, paths: Paths, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same seed, too, gives the same paths."""
    monkeypatch.setattr("calibray.tracing.sionna.tracer.BUFFER", 200)
    again = canyon.trace(links(MAST, receivers))
    for entry in fields(again):
        value = getattr(again, entry.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(paths, entry.name), err_msg=entry.name)


def test_another_seed_gives_other_paths(canyon: Tracer, receivers: np.ndarray, paths: Paths) -> None:
    other = canyon.with_settings(TraceSettings(**MIXED, seed=2)).trace(links(MAST, receivers))
    assert not np.array_equal(np.sort(other.delay), np.sort(paths.delay))
    np.testing.assert_allclose(path_loss(other), path_loss(paths), atol=1.0)


def test_more_paths_than_memory_can_hold_are_an_error(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibray.tracing.sionna.tracer.available_memory", lambda: 32_000)
    for count in (4, 3):  # of three receivers, the last is repeated
        message = rf"more paths than fit into memory, with {count} receivers at once; reduce trace\.samples"
        with pytest.raises(EngineError, match=message):
            canyon.trace(links(MAST, receivers[:count]))


def test_traced_buffers_keep_nothing_else_in_memory(trace: Trace) -> None:
    """Pending results of Dr.Jit would keep their inputs: all candidates of every launch."""
    (part,) = trace.buffers
    buffer = part.buffer
    arrays = [buffer.vertices_x.array, buffer.k_tx.x, buffer.shapes.array, buffer.probs.array]
    assert {array.state for array in arrays} == {dr.VarState.Evaluated}


def test_normals_are_read_with_the_same_kernels_however_many(trace: Trace) -> None:
    """Compiling a kernel takes longer than all that it computes."""
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for number in (11, 13):
            some = trace.buffers[0].buffer.gather(mi.UInt(aligned(np.arange(number), np.uint32)))
            some.schedule()
            dr.eval()
            met = per_interaction(some, "interaction_types")[:, 0] != 0
            dr.kernel_history_clear()
            assert normals_at(some, 0, met).shape == (number, 3)
            kernels.append([kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])])
    assert kernels[0] == kernels[1] != []


def test_a_few_more_receivers_need_no_further_kernel(canyon: Tracer) -> None:
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for number in (5, 7):
            rx = np.random.default_rng(number).uniform((-8, -8, 1.5), (8, 8, 2.5), (number, 3))
            dr.kernel_history_clear()
            found = canyon.find_paths(links(MAST, rx))
            assert set(found.link()) == set(range(number))
            kernels.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    assert kernels[0] == kernels[1] != set()


def test_the_path_program_records_how_it_was_traced(paths: Paths) -> None:
    expected = {**TraceSettings(**MIXED).record(), "scene": CANYON, "sionna_rt": sionna.rt.__version__}
    assert paths.settings == expected
    assert paths.materials["brick"].scattering_coefficient == 0.4


# Rays that are shared by several launches


def one_and_shared(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch, **settings
) -> tuple[Trace, Trace]:
    """A trace in one launch, and one whose rays to each receiver are shared by three launches."""
    traces = []
    for lanes in (10**9, -(-settings["samples"] * settings["max_depth"] // 3)):
        monkeypatch.setattr("calibray.tracing.sionna.tracer.LANES", lanes)
        traces.append(canyon.with_settings(TraceSettings(**settings)).find_paths(links(MAST, receivers)))
    assert [len(trace.buffers) for trace in traces] == [1, 3 * len(receivers)]
    return traces[0], traces[1]


def test_launches_that_share_the_rays_find_the_same_paths(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"max_depth": 3, "samples": 50_003, "refraction": True}
    one, shared = one_and_shared(canyon, receivers[:2], monkeypatch, **settings)
    paths, shared_paths = one.paths(), shared.paths()
    assert paths.num_paths == shared_paths.num_paths > 20
    order = [np.lexsort((part.delay, part.link)) for part in (paths, shared_paths)]
    np.testing.assert_allclose(shared_paths.delay[order[1]], paths.delay[order[0]], rtol=1e-6)
    np.testing.assert_allclose(path_loss(shared_paths), path_loss(paths), atol=1e-3)
    np.testing.assert_allclose(
        np.abs(shared.path_gains()[:, 0, 0]), np.abs(path_gains(shared_paths)), rtol=1e-3, atol=1e-9
    )


def test_launches_that_share_the_rays_find_the_same_edges(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sionna decides at random whether a ray near an edge is diffracted, so weak paths may differ."""
    edges = {"diffraction": True, "edge_diffraction": True}
    one, shared = one_and_shared(canyon, receivers[:2], monkeypatch, max_depth=2, samples=60_000, **edges)
    paths, shared_paths = one.paths(), shared.paths()
    assert shared_paths.num_paths == pytest.approx(paths.num_paths, rel=0.05)
    assert len(paths.diffraction.distance) > 50
    np.testing.assert_allclose(path_loss(shared_paths), path_loss(paths), atol=0.01)


def test_launches_that_share_the_rays_scatter_as_much(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The diffuse paths of each launch count as a share of all rays, not of the rays of the launch."""
    scatter = {"diffuse_reflection": True, "specular_reflection": False, "line_of_sight": False}
    one, shared = one_and_shared(canyon, receivers[:2], monkeypatch, max_depth=1, samples=100_000, **scatter)
    paths, shared_paths = one.paths(), shared.paths()
    assert paths.num_paths > 10_000
    assert shared_paths.num_paths == pytest.approx(paths.num_paths, rel=0.05)
    np.testing.assert_allclose(path_loss(shared_paths), path_loss(paths), atol=0.2)


def test_launches_that_share_the_rays_send_sionnas_lattice() -> None:
    for samples in (3, 1000):
        lattice = np.array(fibonacci_lattice(samples)).reshape(2, -1)
        ends = [0, samples // 3, samples]
        shares = np.hstack([lattice_directions(a, b - a, samples) for a, b in itertools.pairwise(ends)])
        np.testing.assert_allclose(shares, lattice, atol=1e-6)


# Links without a path, points inside buildings


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Tracer:
    """A closed house, and one without a floor, on a ground."""
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"closed": block((-5, -5, 0), (5, 5, 8)), "open": block((12, -4, 0), (20, 4, 6))[1:]}
    file = write_scene(tmp_path_factory.mktemp("house"), {"ground": ground, **houses})
    settings = TraceSettings(max_depth=1, samples=20_000)
    return Tracer(read_scene(file, FREQUENCY), FREQUENCY, settings, Antenna(), Antenna())


def test_points_inside_buildings_are_enclosed(house: Tracer) -> None:
    inside = [[0, 0, 1.5], [4.5, -4.5, 7], [16, 0, 2], [12.5, 3.5, 0.5]]
    outside = [[8, 0, 1.5], [0, 5.2, 1.5], [0, 0, 9], [30, 30, 20], [11.8, 0, 3], [0, -39, 1]]
    assert house.enclosed(np.array(inside)).all()
    assert not house.enclosed(np.array(outside)).any()


def test_links_without_a_path_are_listed_and_have_infinite_loss(house: Tracer) -> None:
    paths = house.trace(links([-20, 0, 3], [[0, 0, 2], [-10, 3, 2], [16, 0, 2]]))
    assert paths.links_without_path.tolist() == [0, 2]
    loss = path_loss(paths)
    assert np.isposinf(loss[[0, 2]]).all()
    assert np.isfinite(loss[1])


def test_links_without_any_path(house: Tracer) -> None:
    trace = house.find_paths(links([-20, 0, 3], [[0, 0, 2], [1, 1, 2]]))
    paths = trace.paths()
    assert paths.num_paths == paths.num_interactions == 0
    assert paths.links_without_path.tolist() == [0, 1]
    assert np.isposinf(path_loss(paths)).all()
    assert path_gains(paths).shape == (0,)
    assert trace.path_gains().shape == (0, 1, 1)
    assert trace.link().shape == trace.delay().shape == (0,)


def test_direct_paths_alone_and_excluded(house: Tracer) -> None:
    ends = links([-20, 0, 3], [[-10, 3, 2], [30, 3, 2]])
    direct = cb.trace(house.scene, ends, frequency=FREQUENCY, max_depth=0, samples=100)
    assert direct.num_interactions == 0
    assert direct.link.tolist() == [0]  # the second is behind the house
    indirect = cb.trace(
        house.scene, ends, frequency=FREQUENCY, max_depth=1, samples=20_000, line_of_sight=False
    )
    assert (np.diff(indirect.first) == 1).all()
    assert indirect.num_paths > 0


def test_materials_replace_those_of_a_scene_already_read(house: Tracer) -> None:
    ends = links([-20, 0, 3], [[-10, 3, 2]])
    options = {"frequency": FREQUENCY, "max_depth": 1, "samples": 20_000}
    stone = replace(house.scene.materials["stone"], relative_permittivity=12.0)
    read, named = (
        cb.trace(scene, ends, materials={"stone": stone}, **options)
        for scene in (house.scene, house.scene.path)
    )
    assert read.materials["stone"] == named.materials["stone"] == stone
    np.testing.assert_array_equal(path_loss(read), path_loss(named))
    with pytest.raises(InputError, match="the scene has no material 'glass'"):
        cb.trace(house.scene, ends, materials={"glass": stone}, **options)
    with pytest.raises(InputError, match="a scene already read: 'stone' is not a Material"):
        cb.trace(house.scene, ends, materials={"stone": {"thickness": 0.3}}, **options)


# Refused input


@pytest.mark.parametrize(
    ("tx", "rx", "message"),
    [
        ([[0, 0, 9]], [[np.nan, 0, 1]], r"link 0: rx position .*nan.* is not finite"),
        ([[0, 0, 9], [0, np.inf, 9]], [[1, 0, 1], [2, 0, 1]], r"link 1: tx position .*inf.* is not finite"),
        ([[0, 0, 9]], [[1e300, 0, 1]], r"link 0: rx position .*is too far away"),
        ([[0, 0, 9], [1, 2, 3]], [[1, 0, 1], [1, 2, 3.0005]], r"link 1: transmitter and receiver coincide"),
        (
            [[0, 0, 9]],
            [[1, 0, 1], [2, 0, 1]],
            r"links: tx has the shape \(1, 3\) and rx the shape \(2, 3\); .*\[links, 3\]",
        ),
        ([[0, 0]], [[1, 0]], r"links: tx has the shape \(1, 2\) and rx the shape \(1, 2\); .*\[links, 3\]"),
        (np.zeros((0, 3)), np.zeros((0, 3)), r"links: .*at least one"),
    ],
)
def test_invalid_positions_are_refused(house: Tracer, tx: list, rx: list, message: str) -> None:
    with pytest.raises(InputError, match=message):
        house.trace(SimpleNamespace(tx=np.array(tx, dtype=float), rx=np.array(rx, dtype=float)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": 3}, r"trace: unknown setting 'depth'; known: .*max_depth"),
        ({"samples": 0}, r"trace\.samples = 0: must be a whole number from 1 to"),
        ({"samples": -5}, r"trace\.samples = -5"),
        ({"samples": 1e6}, r"trace\.samples = 1000000\.0: must be a whole number"),
        ({"max_depth": -1}, r"trace\.max_depth = -1: must be a whole number from 0 to 100"),
        ({"max_depth": True}, r"trace\.max_depth = True"),
        ({"seed": -1}, r"trace\.seed = -1"),
        ({"refraction": "no"}, r"trace\.refraction = 'no': must be true or false"),
        ({"diffraction": 1}, r"trace\.diffraction = 1: must be true or false"),
        ({"frequency": 0.0}, r"frequency = 0\.0: must be"),
        ({"frequency": 3.5}, r"frequency = 3\.5: must be from 1e\+06 to 1e\+12 Hz"),
        ({"frequency": -1e9}, r"frequency = -1000000000\.0: must be"),
        ({"frequency": float("nan")}, r"frequency = nan: must be"),
        ({"tx_antenna": {"pattern": "yagi"}}, r"antenna pattern = 'yagi': must be one of iso, dipole"),
        ({"rx_antenna": {"polarization": "R"}}, r"antenna polarization = 'R': must be one of V, H"),
        ({"rx_antenna": {"gain": 3}}, r"rx_antenna: unknown key 'gain'; known: pattern"),
        ({"tx_antenna": "dipole"}, r"tx_antenna: is 'dipole', but must be an Antenna or its attributes"),
        ({"rx_antenna": {"orientation": [0, 1]}}, r"antenna orientation = .*must be three angles"),
        ({"rx_antenna": {"orientation": ["a", 0, 0]}}, r"antenna orientation = .*must be three angles"),
        (
            {"rx_antenna": {"orientation": [float("nan"), 0, 0]}},
            r"antenna orientation = .*must be three angles",
        ),
        ({"rx_antenna": {"orientation": 0.3}}, r"antenna orientation = 0\.3: must be three angles"),
        (
            {"materials": {"bricks": {"thickness": 0.3}}},
            r"no material 'bricks'; did you mean 'stone'|use one of: stone",
        ),
    ],
)
def test_invalid_options_are_refused(house: Tracer, options: dict, message: str) -> None:
    arguments = {"frequency": FREQUENCY, "samples": 100, "max_depth": 1, **options}
    with pytest.raises(InputError, match=message):
        cb.trace(house.scene.path, links([-20, 0, 3], [[-10, 3, 2]]), **arguments)


def test_a_material_that_the_scene_lacks_is_refused(house: Tracer) -> None:
    with pytest.raises(InputError, match="the scene has no material 'glass'; use one of: stone"):
        house.trace(links([-20, 0, 3], [[-10, 3, 2]]), materials={"glass": cb.Material(6.0, 0.0, 0.01)})


def test_a_refused_trace_writes_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        cb.trace("absent.xml", links([0, 0, 9], [[1, 0, 1]]), frequency=FREQUENCY)
    assert not list(tmp_path.iterdir())


def test_large_launches_have_more_hashes_and_sionna_keeps_its_own(canyon: Tracer, monkeypatch) -> None:
    """Launches end where Sionna would begin: the size of the table is all that matters here."""
    own, entries = SBCandidateGenerator.MIN_SPEC_COUNT_SIZE, []

    def recorded(**arguments: object) -> None:
        entries.append(SBCandidateGenerator.MIN_SPEC_COUNT_SIZE)
        raise InterruptedError

    monkeypatch.setattr(canyon.solver, "_generate_candidates", recorded)
    for count in (1, 300):
        ends = np.tile([5.0, 0.0, 1.5], (count, 1)) + np.arange(count)[:, None] / 100
        with pytest.raises(InterruptedError):
            canyon.find_paths(links(MAST, ends))
    assert entries == list(HASHES)
    assert own == SBCandidateGenerator.MIN_SPEC_COUNT_SIZE
