"""Links traced from the end with fewer positions: same paths and gains, as few launches as for the reversed links."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
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

FREQUENCY = 3.5e9
STREET = np.array([[-15.0, 4, 1.5], [12, 1, 2], [14, 9, 1.5], [-9, -9, 6], [3, -8, 2]])
MASTS = np.array([[-20.0, 2, 12], [18, -6, 9]])
MANY_TX = SimpleNamespace(tx=np.repeat(STREET, 2, axis=0), rx=np.tile(MASTS, (len(STREET), 1)))
MANY_RX = SimpleNamespace(tx=MANY_TX.rx, rx=MANY_TX.tx)
BASE, PHONE = (
    Antenna("tr38901", "cross", (0.3, 0.1, 0.2)),
    Antenna("dipole", "VH", (0.2, 0.5, -0.4)),
)
SETTINGS = TraceSettings(max_depth=2, samples=20_000, refraction=True)


@pytest.fixture(scope="module")
def yard(yard_file: Path) -> Tracer:
    return Tracer(read_scene(yard_file, FREQUENCY), FREQUENCY, SETTINGS, PHONE, BASE)


def both_ways(tracer: Tracer, monkeypatch: pytest.MonkeyPatch) -> tuple[Trace, Trace]:
    """The links traced from their receivers, as they are by default, and from their transmitters."""
    back = tracer.find_paths(MANY_TX)
    with monkeypatch.context() as patch:
        patch.setattr("calibray.tracing.sionna.tracer.starts_at_receivers", lambda *_: False)
        return back, tracer.find_paths(MANY_TX)


def keys(paths: Paths, mirrored: bool = False) -> list[tuple]:
    """Identify each path by its link, kinds, length [mm] and zenith of departure [rad]."""
    zenith = (paths.arrival if mirrored else paths.departure)[:, 0]
    chains = [paths.kind[a:b].tolist() for a, b in itertools.pairwise(paths.first)]
    return [
        (int(link), tuple(chain[::-1] if mirrored else chain), round(length), round(angle, 2))
        for link, chain, length, angle in zip(
            paths.link, chains, (paths.delay * 3e11).tolist(), zenith.tolist(), strict=True
        )
    ]


def common(one: Paths, other: Paths, mirrored: bool = False) -> tuple[list[int], list[int]]:
    """Indices of the paths that both hold, in the same order."""
    index = {key: i for i, key in enumerate(keys(one))}
    other_index = {key: i for i, key in enumerate(keys(other, mirrored))}
    both = sorted(index.keys() & other_index.keys())
    return [index[key] for key in both], [other_index[key] for key in both]


def assert_equal(back: Trace, forth: Trace) -> None:
    """Compare the gains of every path, of replay and of Sionna's field stage, with both antennas' ports."""
    paths = back.paths(), forth.paths()
    order = common(*paths)
    # Sionna decides at random whether a ray near an edge is diffracted.
    assert len(order[0]) > 0.95 * max(part.num_paths for part in paths) > 30
    for name in ("link", "delay", "spreading", "departure", "arrival"):
        one, other = (getattr(part, name)[index] for part, index in zip(paths, order, strict=True))
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5, err_msg=name)
    ours = [path_gains(part)[index] for part, index in zip(paths, order, strict=True)]
    theirs = [trace.path_gains()[index] for trace, index in zip((back, forth), order, strict=True)]
    size = np.abs(ours[1]).max(axis=(1, 2), keepdims=True)
    assert ours[0].shape[1:] == (2, 2)
    for one, other in (ours, theirs):
        assert np.abs((one - other) / size).max() < 1e-4
    assert np.abs(np.abs(ours[0]) - np.abs(theirs[0])).max() < 1e-4 * size.max()


def test_reflected_and_refracted_paths_equal_those_found_from_the_transmitters(yard, monkeypatch):
    back, forth = both_ways(yard, monkeypatch)
    assert_equal(back, forth)
    assert {int(kind) for kind in back.paths().kind} == {Kind.SPECULAR, Kind.REFRACTION}


def test_diffracted_paths_equal_those_found_from_the_transmitters(yard, monkeypatch):
    """The faces of an edge are exchanged if the other one is illuminated."""
    edges = yard.with_settings(replace(SETTINGS, refraction=False, diffraction=True, samples=50_000))
    back, forth = both_ways(edges, monkeypatch)
    assert_equal(back, forth)
    assert (back.paths().kind == Kind.DIFFRACTION).sum() > 60


def test_many_transmitters_take_as_many_launches_as_many_receivers(yard):
    mirror = Tracer(yard.scene, FREQUENCY, SETTINGS, BASE, PHONE)
    assert len(yard.plan(MANY_TX).launches) == len(mirror.plan(MANY_RX).launches) == len(MASTS)
    there, back = yard.trace(MANY_TX), mirror.trace(MANY_RX)
    order = common(there, back, mirrored=True)
    assert len(order[0]) == there.num_paths == back.num_paths
    one, other = path_gains(there)[order[0]], path_gains(back)[order[1]].transpose(0, 2, 1)
    assert np.abs(one - other).max() < 1e-4 * np.abs(other).max()
    flat = SimpleNamespace(tx=np.c_[np.arange(1720), np.zeros(1720), np.ones(1720)], rx=np.zeros((1720, 3)))
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


def test_empty_entries_of_a_buffer_are_no_direct_paths(yard):
    """Sionna RT 2.2 counts some entries that it does not fill; each would become another direct path."""
    buffer = PathsBuffer(3, 2, False)
    buffer.set_interaction_type(mi.UInt(1), mi.UInt([0, 1, 0]), mi.Bool(True))
    buffer.valid = mi.Bool([True, False, False])
    filled = drop_empty_entries(buffer)
    assert filled.buffer_size == 2
    assert np.array(filled.valid).tolist() == [True, False]
    assert drop_empty_entries(filled) is filled
