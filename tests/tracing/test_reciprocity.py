"""Links traced from the end with fewer positions: the same paths and gains, as few launches as the mirror image."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from sionna.rt.path_solvers.paths_buffer import PathsBuffer

from calibray.fields import path_gains
from calibray.paths import Kind, Paths
from calibray.scenes import read_scene
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Trace, Tracer
from calibray.tracing.sionna.buffers import drop_empty_entries
from calibray.tracing.trace_plan import starts_at_receivers
from small_scenes import block, write_scene

FREQUENCY = 3.5e9
AFIELD = np.array([[-15.0, 4, 1.5], [12, 1, 2], [14, 9, 1.5], [-9, -9, 6], [3, -8, 2]])
MASTS = np.array([[-20.0, 2, 12], [18, -6, 9]])
MANY_TX = SimpleNamespace(tx=np.repeat(AFIELD, 2, axis=0), rx=np.tile(MASTS, (len(AFIELD), 1)))
MANY_RX = SimpleNamespace(tx=MANY_TX.rx, rx=MANY_TX.tx)
BASE, PHONE = (
    Antenna("tr38901", "cross", (0.3, 0.1, 0.2)),
    Antenna("dipole", "VH", (0.2, 0.5, -0.4)),
)
SETTINGS = TraceSettings(max_depth=2, samples=50_000, refraction=True)


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Tracer:
    """A ground with a house in the middle and another beside it."""
    ground = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    houses = {"house": block((-5, -5, 0), (5, 5, 8)), "other": block((-5, 15, 0), (25, 20, 9))}
    file = write_scene(tmp_path_factory.mktemp("yard"), {"ground": ground, **houses})
    return Tracer(read_scene(file, FREQUENCY), FREQUENCY, SETTINGS, PHONE, BASE)


def both_ways(tracer: Tracer, monkeypatch: pytest.MonkeyPatch) -> tuple[Trace, Trace]:
    """The links traced from their receivers, and from their transmitters as if they were more."""
    back = tracer.find_paths(MANY_TX)
    with monkeypatch.context() as patch:
        patch.setattr("calibray.tracing.sionna.tracer.starts_at_receivers", lambda *_: False)
        return back, tracer.find_paths(MANY_TX)


def keys(paths: Paths, mirrored: bool = False) -> list[tuple]:
    """What tells a path: its link, its kinds, its length [mm], the zenith that it leaves to [rad]."""
    zenith = (paths.arrival if mirrored else paths.departure)[:, 0]
    chains = [paths.kind[a:b].tolist() for a, b in itertools.pairwise(paths.first)]
    return [
        (int(link), tuple(chain[::-1] if mirrored else chain), round(length), round(angle, 2))
        for link, chain, length, angle in zip(
            paths.link, chains, (paths.delay * 3e11).tolist(), zenith.tolist(), strict=True
        )
    ]


def common(one: Paths, other: Paths, mirrored: bool = False) -> tuple[list[int], list[int]]:
    """The paths that both hold, in the same order."""
    here, there = ({key: i for i, key in enumerate(keys(*each))} for each in ((one,), (other, mirrored)))
    both = sorted(here.keys() & there.keys())
    return [here[key] for key in both], [there[key] for key in both]


def assert_equal(back: Trace, forth: Trace) -> None:
    """Gains of every path, ours and those of Sionna's own field stage, with both antennas' ports."""
    paths = back.paths(), forth.paths()
    order = common(*paths)
    # Whether a ray near an edge is diffracted is drawn at random.
    assert len(order[0]) > 0.95 * max(each.num_paths for each in paths) > 30
    for name in ("link", "delay", "spreading", "departure", "arrival"):
        one, other = (getattr(each, name)[index] for each, index in zip(paths, order, strict=True))
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5, err_msg=name)
    ours = [path_gains(each)[index] for each, index in zip(paths, order, strict=True)]
    theirs = [each.path_gains()[index] for each, index in zip((back, forth), order, strict=True)]
    size = np.abs(ours[1]).max(axis=(1, 2), keepdims=True)
    assert ours[0].shape[1:] == (2, 2)
    for one, other in (ours, theirs):
        assert np.abs((one - other) / size).max() < 1e-4
    assert np.abs(np.abs(ours[0]) - np.abs(theirs[0])).max() < 1e-4 * size.max()


def test_reflected_and_refracted_paths_are_those_found_from_the_transmitters(yard, monkeypatch):
    back, forth = both_ways(yard, monkeypatch)
    assert_equal(back, forth)
    assert {int(kind) for kind in back.paths().kind} == {Kind.SPECULAR, Kind.REFRACTION}


def test_diffracted_paths_are_those_found_from_the_transmitters(yard, monkeypatch):
    """Faces of the edges are exchanged where the other one is lit."""
    edges = yard.with_settings(
        replace(SETTINGS, refraction=False, diffraction=True, samples=100_000, max_depth=2)
    )
    back, forth = both_ways(edges, monkeypatch)
    assert_equal(back, forth)
    assert (back.paths().kind == Kind.DIFFRACTION).sum() > 60


def test_many_transmitters_cost_as_many_launches_as_many_receivers(yard):
    mirror = Tracer(yard.scene, FREQUENCY, SETTINGS, BASE, PHONE)
    assert len(yard.plan(MANY_TX).launches) == len(mirror.plan(MANY_RX).launches) == len(MASTS)
    there, back = yard.trace(MANY_TX), mirror.trace(MANY_RX)
    order = common(there, back, mirrored=True)
    assert len(order[0]) == there.num_paths == back.num_paths
    one, other = path_gains(there)[order[0]], path_gains(back)[order[1]].transpose(0, 2, 1)
    assert np.abs(one - other).max() < 1e-4 * np.abs(other).max()
    flat = SimpleNamespace(tx=np.c_[np.arange(688), np.zeros(688), np.ones(688)], rx=np.zeros((688, 3)))
    launches = [
        len(yard.plan(SimpleNamespace(tx=tx, rx=rx)).launches)
        for tx, rx in ((flat.tx, flat.rx), (flat.rx, flat.tx))
    ]
    assert launches[0] == launches[1] == 4


def test_diffuse_reflection_has_a_direction():
    diffuse = replace(SETTINGS, diffuse_reflection=True)
    assert starts_at_receivers(MANY_TX.tx, MANY_TX.rx, SETTINGS)
    assert not starts_at_receivers(MANY_TX.rx, MANY_TX.tx, SETTINGS)
    assert not starts_at_receivers(MANY_TX.tx, MANY_TX.rx, diffuse)
    assert not starts_at_receivers(MANY_TX.tx[:2], MANY_TX.rx[:2] * [[1], [2]], SETTINGS)


def test_places_that_are_counted_but_not_filled_are_no_direct_paths(yard):
    """A direct path is found once; Sionna RT 2.2 leaves some candidates empty, which would be more of them."""
    buffer = PathsBuffer(3, 2, False)
    buffer.set_interaction_type(mi.UInt(1), mi.UInt([0, 1, 0]), mi.Bool(True))
    buffer.valid = mi.Bool([True, False, False])
    left = drop_empty_entries(buffer)
    assert left.buffer_size == 2
    assert np.array(left.valid).tolist() == [True, False]
    assert drop_empty_entries(left) is left
