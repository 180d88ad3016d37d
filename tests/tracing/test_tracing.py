"""Tracing: which links have paths, what chunking and seeds change (nothing), and what is refused."""

from __future__ import annotations

import itertools
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
import sionna.rt
from sionna.rt.utils import fibonacci_lattice

import calibray as cb
from calibray.errors import EngineError, InputError
from calibray.fields import path_gains, path_loss
from calibray.paths import Paths
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from calibray.tracing.trace_plan import lattice_directions
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
CANYON = "sionna:simple_street_canyon"
MIXED = {
    "max_depth": 2, "samples": 10_000, "refraction": True, "diffraction": True, "edge_diffraction": True,
    "diffuse_reflection": True,
}  # fmt: skip
ROUGH = {
    name: {"scattering_coefficient": 0.4, "xpd_coefficient": 0.1}
    for name in ("glass", "wood", "marble", "brick", "concrete")
}


def links(tx: list, rx: list) -> SimpleNamespace:
    """Links from every transmitter of a list, or from one, to the receivers."""
    rx = np.array(rx, dtype=float)
    return SimpleNamespace(tx=np.broadcast_to(np.array(tx, dtype=float), rx.shape), rx=rx)


@pytest.fixture(scope="module")
def canyon() -> Tracer:
    scene = read_scene(CANYON, FREQUENCY, ROUGH)
    return Tracer(scene, FREQUENCY, TraceSettings(**MIXED), Antenna("dipole"), Antenna())


@pytest.fixture(scope="module")
def receivers() -> np.ndarray:
    return np.random.default_rng(6).uniform((-8, -8, 1.5), (8, 8, 2.5), (6, 3))


@pytest.fixture(scope="module")
def together(canyon: Tracer, receivers: np.ndarray) -> Paths:
    return canyon.trace(links([-20, 2, 15], receivers))


def assert_same(one: Paths, other: Paths) -> None:
    for entry in fields(one):
        a, b = getattr(one, entry.name), getattr(other, entry.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=entry.name)


# What does not change the result


def test_one_receiver_at_a_time_gives_what_all_at_once_give(
    canyon: Tracer, receivers: np.ndarray, together: Paths, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NVlabs/sionna#1172: a receiver's paths do not depend on which others are traced with it."""
    monkeypatch.setattr("calibray.tracing.sionna.tracer.LANES", MIXED["samples"] * MIXED["max_depth"])
    trace = canyon.find_paths(links([-20, 2, 15], receivers))
    assert len(trace.buffers) == len(receivers)
    alone = trace.paths()
    assert alone.num_paths == together.num_paths > 500
    order = [np.lexsort((paths.spreading, paths.delay, paths.link)) for paths in (alone, together)]
    for name in ("link", "delay", "spreading", "departure", "arrival"):
        a, b = (getattr(paths, name)[index] for paths, index in zip((alone, together), order, strict=True))
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(path_loss(alone), path_loss(together), atol=1e-6)


def test_order_of_the_links_is_kept(canyon: Tracer, receivers: np.ndarray, together: Paths) -> None:
    backwards = canyon.trace(links([-20, 2, 15], receivers[::-1]))
    np.testing.assert_allclose(path_loss(backwards)[::-1], path_loss(together), atol=1e-6)
    np.testing.assert_array_equal(backwards.rx_position, receivers[::-1])


def test_several_transmitters_in_any_order(canyon: Tracer, receivers: np.ndarray, together: Paths) -> None:
    masts = np.array([[-20.0, 2, 15], [25.0, -3, 12]])
    other = canyon.trace(links(masts[1], receivers))
    mixed = canyon.trace(links(masts[[0, 1] * 6], np.repeat(receivers, 2, axis=0)))
    assert (np.diff(mixed.link) >= 0).all()
    np.testing.assert_allclose(path_loss(mixed)[0::2], path_loss(together), atol=1e-6)
    np.testing.assert_allclose(path_loss(mixed)[1::2], path_loss(other), atol=1e-6)


def test_full_buffer_is_traced_again_with_the_same_result(
    canyon: Tracer, receivers: np.ndarray, together: Paths, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibray.tracing.sionna.tracer.BUFFER", 8)
    assert_same(canyon.trace(links([-20, 2, 15], receivers)), together)


def test_paths_that_memory_cannot_hold_are_an_error(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibray.tracing.sionna.tracer.BUFFER", 8)
    monkeypatch.setattr("calibray.tracing.sionna.tracer.available_memory", lambda: 32_000)
    with pytest.raises(
        EngineError, match=r"more paths than fit into memory, with 6 receivers at once; lower trace\.samples"
    ):
        canyon.trace(links([-20, 2, 15], receivers))


def test_same_seed_same_paths_and_another_seed_others(
    canyon: Tracer, receivers: np.ndarray, together: Paths
) -> None:
    assert_same(canyon.trace(links([-20, 2, 15], receivers)), together)
    settings = TraceSettings(**MIXED, seed=2)
    other = Tracer(canyon.scene, FREQUENCY, settings, canyon.solver.tx_antenna, canyon.solver.rx_antenna)
    found = other.trace(links([-20, 2, 15], receivers))
    assert not np.array_equal(np.sort(found.delay), np.sort(together.delay))
    np.testing.assert_allclose(path_loss(found), path_loss(together), atol=1.0)


def test_progress_counts_receivers(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibray.tracing.sionna.tracer.LANES", 2 * MIXED["samples"] * MIXED["max_depth"])
    seen = []
    canyon.trace(links([-20, 2, 15], receivers), lambda *step: seen.append(step))
    assert seen == [("tracing", done, 6) for done in (0, 2, 4, 6)]


def test_stored_paths_hold_on_to_nothing_else(canyon: Tracer, receivers: np.ndarray) -> None:
    """What Dr.Jit has still to compute keeps its inputs: all rays' candidates, for every launch."""
    (part,) = canyon.find_paths(links([-20, 2, 15], receivers)).buffers
    buffer = part.buffer
    kept = [buffer.vertices_x.array, buffer.k_tx.x, buffer.shapes.array, buffer.probs.array]
    assert {array.state for array in kept} == {dr.VarState.Evaluated}


def test_program_tells_how_it_was_traced(together: Paths) -> None:
    expected = {**TraceSettings(**MIXED).record(), "scene": CANYON, "sionna_rt": sionna.rt.__version__}
    assert together.settings == expected
    assert together.materials["brick"].scattering_coefficient == 0.4


# Rays shared out over launches


def split(canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch, **settings) -> tuple:
    """A trace in one launch, and one whose rays are shared out over seven for each receiver."""
    traces = []
    for lanes in (10**9, None):
        tracer = Tracer(
            canyon.scene,
            FREQUENCY,
            TraceSettings(**settings),
            canyon.solver.tx_antenna,
            canyon.solver.rx_antenna,
        )
        monkeypatch.setattr(
            "calibray.tracing.sionna.tracer.LANES",
            lanes or -(-settings["samples"] * settings["max_depth"] // 7),
        )
        traces.append(tracer.find_paths(links([-20, 2, 15], receivers)))
    assert [len(trace.buffers) for trace in traces] == [1, 7 * len(receivers)]
    return traces


@pytest.mark.parametrize("kinds", [{}, {"refraction": True}])
def test_rays_shared_out_over_launches_find_the_same_paths(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch, kinds: dict
) -> None:
    one, shared = split(canyon, receivers[:3], monkeypatch, max_depth=3, samples=100_003, **kinds)
    paths, pieces = one.paths(), shared.paths()
    assert paths.num_paths == pieces.num_paths > 20
    order = [np.lexsort((part.delay, part.link)) for part in (paths, pieces)]
    np.testing.assert_allclose(pieces.delay[order[1]], paths.delay[order[0]], rtol=1e-6)
    np.testing.assert_allclose(path_loss(pieces), path_loss(paths), atol=1e-3)
    np.testing.assert_allclose(
        np.abs(shared.path_gains()[:, 0, 0]), np.abs(path_gains(pieces)), rtol=1e-3, atol=1e-9
    )


def test_rays_shared_out_over_launches_find_the_same_edges(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether a ray near an edge is diffracted is drawn at random, so that weak paths may come and go."""
    edges = {"diffraction": True, "edge_diffraction": True}
    one, shared = split(canyon, receivers[:2], monkeypatch, max_depth=2, samples=60_000, **edges)
    paths, pieces = one.paths(), shared.paths()
    assert pieces.num_paths == pytest.approx(paths.num_paths, rel=0.05)
    assert len(paths.diffraction.distance) > 50
    np.testing.assert_allclose(path_loss(pieces), path_loss(paths), atol=0.01)


def test_rays_shared_out_over_launches_scatter_as_much(
    canyon: Tracer, receivers: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each launch's diffuse paths stand for a share of all rays, not of its own."""
    scatter = {"diffuse_reflection": True, "specular_reflection": False, "line_of_sight": False}
    one, shared = split(canyon, receivers[:2], monkeypatch, max_depth=1, samples=100_000, **scatter)
    paths, pieces = one.paths(), shared.paths()
    assert paths.num_paths > 10_000
    assert pieces.num_paths == pytest.approx(paths.num_paths, rel=0.05)
    np.testing.assert_allclose(path_loss(pieces), path_loss(paths), atol=0.2)


def test_rays_of_the_launches_are_those_of_one(canyon: Tracer) -> None:
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
    settings = TraceSettings(max_depth=1, samples=5000)
    return Tracer(read_scene(file, FREQUENCY), FREQUENCY, settings, Antenna(), Antenna())


def test_points_inside_buildings_are_told_from_those_outside(house: Tracer) -> None:
    inside = [[0, 0, 1.5], [4.5, -4.5, 7], [16, 0, 2], [12.5, 3.5, 0.5]]
    outside = [[8, 0, 1.5], [0, 5.2, 1.5], [0, 0, 9], [30, 30, 20], [11.8, 0, 3], [0, -39, 1]]
    assert house.enclosed(np.array(inside)).all()
    assert not house.enclosed(np.array(outside)).any()


def test_links_without_a_path_are_told_and_infinitely_weak(house: Tracer) -> None:
    paths = house.trace(links([-20, 0, 3], [[0, 0, 2], [-10, 3, 2], [16, 0, 2]]))
    assert paths.links_without_path.tolist() == [0, 2]
    loss = path_loss(paths)
    assert np.isposinf(loss[[0, 2]]).all()
    assert np.isfinite(loss[1])


def test_campaign_without_any_path(house: Tracer) -> None:
    trace = house.find_paths(links([-20, 0, 3], [[0, 0, 2], [1, 1, 2]]))
    paths = trace.paths()
    assert paths.num_paths == paths.num_interactions == 0
    assert paths.links_without_path.tolist() == [0, 1]
    assert np.isposinf(path_loss(paths)).all()
    assert path_gains(paths).shape == (0,)
    assert trace.path_gains().shape == (0, 1, 1)
    assert trace.link().shape == trace.delay().shape == (0,)


def test_line_of_sight_alone(house: Tracer) -> None:
    """With no interaction allowed and with the direct path switched off."""
    ends = links([-20, 0, 3], [[-10, 3, 2], [30, 3, 2]])
    direct = cb.trace(house.scene, ends, frequency=FREQUENCY, max_depth=0, samples=100)
    assert direct.num_interactions == 0
    assert direct.link.tolist() == [0]  # the second is behind the house
    indirect = cb.trace(
        house.scene, ends, frequency=FREQUENCY, max_depth=1, samples=5000, line_of_sight=False
    )
    assert (np.diff(indirect.first) == 1).all()
    assert indirect.num_paths > 0


# What is refused


@pytest.mark.parametrize(
    ("tx", "rx", "message"),
    [
        ([[0, 0, 9]], [[np.nan, 0, 1]], r"link 0: rx position .*nan.* is not finite"),
        ([[0, 0, 9], [0, np.inf, 9]], [[1, 0, 1], [2, 0, 1]], r"link 1: tx position .*inf.* is not finite"),
        ([[0, 0, 9], [1, 2, 3]], [[1, 0, 1], [1, 2, 3.0005]], r"link 1: transmitter and receiver coincide"),
        (
            [[0, 0, 9]],
            [[1, 0, 1], [2, 0, 1]],
            r"links: tx has the shape \(1, 3\), rx \(2, 3\); .*\[links, 3\]",
        ),
        ([[0, 0]], [[1, 0]], r"links: tx has the shape \(1, 2\), rx \(1, 2\); .*\[links, 3\]"),
        (np.zeros((0, 3)), np.zeros((0, 3)), r"links: .*at least one"),
    ],
)
def test_positions_that_cannot_be_used(house: Tracer, tx: list, rx: list, message: str) -> None:
    with pytest.raises(InputError, match=message):
        house.trace(SimpleNamespace(tx=np.array(tx, dtype=float), rx=np.array(rx, dtype=float)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": 3}, r"trace: unknown setting 'depth'; known: .*max_depth"),
        ({"samples": 0}, r"trace\.samples = 0: must be a whole number of at least 1"),
        ({"samples": -5}, r"trace\.samples = -5"),
        ({"samples": 1e6}, r"trace\.samples = 1000000\.0: must be a whole number"),
        ({"max_depth": -1}, r"trace\.max_depth = -1: must be a whole number of at least 0"),
        ({"max_depth": True}, r"trace\.max_depth = True"),
        ({"seed": -1}, r"trace\.seed = -1"),
        ({"refraction": "no"}, r"trace\.refraction = 'no': must be true or false"),
        ({"diffraction": 1}, r"trace\.diffraction = 1: must be true or false"),
        ({"frequency": 0.0}, r"frequency = 0\.0: must be"),
        ({"frequency": -1e9}, r"frequency = -1000000000\.0: must be"),
        ({"frequency": float("nan")}, r"frequency = nan: must be"),
        ({"tx_antenna": {"pattern": "yagi"}}, r"antenna pattern = 'yagi': must be one of iso, dipole"),
        ({"rx_antenna": {"polarization": "R"}}, r"antenna polarization = 'R': must be one of V, H"),
        ({"rx_antenna": {"gain": 3}}, r"antenna: unknown key 'gain'; known: pattern"),
        ({"rx_antenna": {"orientation": [0, 1]}}, r"antenna orientation = .*must be three angles"),
        ({"rx_antenna": {"orientation": ["a", 0, 0]}}, r"antenna orientation = .*must be three angles"),
        (
            {"rx_antenna": {"orientation": [float("nan"), 0, 0]}},
            r"antenna orientation = .*must be three angles",
        ),
        ({"rx_antenna": {"orientation": 0.3}}, r"antenna orientation = 0\.3: must be three angles"),
        (
            {"materials": {"bricks": {"thickness": 0.3}}},
            r"no material 'bricks'; did you mean 'stone'|there are: stone",
        ),
    ],
)
def test_options_that_cannot_be_used(house: Tracer, options: dict, message: str) -> None:
    given = {"frequency": FREQUENCY, "samples": 100, "max_depth": 1, **options}
    with pytest.raises(InputError, match=message):
        cb.trace(house.scene.path, links([-20, 0, 3], [[-10, 3, 2]]), **given)


def test_tracer_refuses_a_material_that_its_scene_lacks(house: Tracer) -> None:
    with pytest.raises(InputError, match="the scene has no material 'glass'; there are: stone"):
        house.trace(links([-20, 0, 3], [[-10, 3, 2]]), materials={"glass": cb.Material(6.0, 0.0, 0.01)})


def test_nothing_is_written(house: Tracer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        cb.trace("absent.xml", links([0, 0, 9], [[1, 0, 1]]), frequency=FREQUENCY)
    assert not list(tmp_path.iterdir())
