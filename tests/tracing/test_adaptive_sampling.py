"""Rays added in rounds: they find every path that many rays find, once and with the same gain, for all receivers."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.fields import path_gains, path_loss
from calibray.paths import Kind, Paths
from calibray.reporting import scene_tables as report
from calibray.scenes import read_scene
from calibray.tracing import convergence
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer, adaptive_sampling
from calibray.tracing.sionna.image_method import Edges, Surfaces, unfold
from small_scenes import write_scene

FREQUENCY = 3.5e9
RECEIVERS = np.array(
    [[-15.0, 4, 1.5], [12, 1, 2], [14, 9, 1.5], [-9, -9, 6], [0, 0, 2]]
)  # the last one in the house
LINKS = SimpleNamespace(tx=np.tile([-20.0, 2, 12], (len(RECEIVERS), 1)), rx=RECEIVERS)
REVERSED = SimpleNamespace(tx=LINKS.rx, rx=LINKS.tx)
AUTO = TraceSettings(max_depth=2, samples="auto", refraction=True, diffraction=True)


@pytest.fixture(scope="module")
def yard(yard_file: Path) -> Tracer:
    return Tracer(read_scene(yard_file, FREQUENCY), FREQUENCY, AUTO, Antenna("dipole"), Antenna("iso", "VH"))


@pytest.fixture(scope="module")
def rounds(yard: Tracer) -> Paths:
    return yard.trace(LINKS)


def by_key(paths: Paths) -> dict[tuple, int]:
    """Paths by link, kinds, length [mm] and direction of departure [mrad]."""
    chains = [tuple(paths.kind[a:b].tolist()) for a, b in itertools.pairwise(paths.first)]
    rows = zip(
        paths.link.tolist(), chains, (paths.delay * 3e11).tolist(), paths.departure.tolist(), strict=True
    )
    return {
        (link, chain, round(length), *(round(1e3 * angle) for angle in angles)): i
        for i, (link, chain, length, angles) in enumerate(rows)
    }


def test_all_paths_of_many_rays_are_found_once_with_the_same_gains(yard: Tracer, rounds: Paths) -> None:
    many = yard.with_settings(replace(AUTO, samples=200_000)).trace(LINKS)
    ours, theirs = by_key(rounds), by_key(many)
    common = sorted(ours.keys() & theirs.keys())
    assert len(common) > 0.9 * many.num_paths > 40
    gain = [path_gains(paths) for paths in (rounds, many)]
    one, other = gain[0][[ours[key] for key in common]], gain[1][[theirs[key] for key in common]]
    assert np.abs(one - other).max() < 1e-5 * np.abs(other).max()
    assert {Kind.SPECULAR, Kind.REFRACTION, Kind.DIFFRACTION} == set(rounds.kind.tolist())
    # More power is a path that the many rays missed; a path found twice would change 3 dB.
    change = path_loss(rounds) - path_loss(many)
    assert change.max() < 0.01
    assert change.min() > -0.1
    exact = [key for key in by_key(rounds) if Kind.DIFFRACTION not in key[1]]
    assert len(exact) == sum(not (rounds.kind[a:b] == 8).any() for a, b in itertools.pairwise(rounds.first))
    assert {key for key in theirs if Kind.DIFFRACTION not in key[1]} <= set(exact)


def test_the_last_round_is_the_check(yard: Tracer, rounds: Paths) -> None:
    assert rounds.settings["samples"] == "auto"
    assert rounds.settings["rays"] >= 4 * 250_000
    assert 0 <= rounds.settings["last_round_db"] <= 0.05
    text = report.last_round(rounds.settings, 0.5)
    assert text.startswith("Converged: 1,000,000 rays per position") or rounds.settings["rays"] > 1_000_000
    assert report.last_round({"rays": 8, "last_round_db": 0.7}, 0.5) == (
        "Not converged: 8 rays per position; the second half of these rays changed a link by 0.70 dB "
        "(fidelity.tolerance_db = 0.5); increase trace.samples, or reduce trace.max_depth."
    )
    with pytest.raises(InputError, match="its last round of rays is the check"):
        convergence.check(yard.settings, lambda _: rounds, rounds, path_loss)


def test_rays_are_sent_once_for_all_links_of_a_source(yard: Tracer, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (
        SimpleNamespace(tx=LINKS.tx[part], rx=LINKS.rx[part]) for part in (slice(3), slice(3, None))
    )
    settings = replace(AUTO, seed=7)
    alone = yard.with_settings(settings).trace(second)
    yard.sequence_cache.clear()
    tracer, sent = yard.with_settings(settings), []
    find_candidates = tracer.solver.find_candidates

    def count(*arguments):
        sent.append(arguments[-1].count)
        return find_candidates(*arguments)

    monkeypatch.setattr(tracer.solver, "find_candidates", count)
    tracer.trace(first)
    rays = sum(sent)
    assert rays >= 1_000_000
    after = tracer.trace(second)
    assert sum(sent) - rays < rays / 2  # only launches that the first links did not need
    assert by_key(after).keys() == by_key(alone).keys()
    np.testing.assert_array_equal(path_loss(after), path_loss(alone))
    # Whether a ray is reflected or transmitted depends on the material: other walls need new rays.
    name, wall = next(iter(yard.scene.materials.items()))
    tracer.trace(second, materials={name: replace(wall, relative_permittivity=30.0)})
    assert sum(sent) >= 2 * rays
    assert len(tracer.sequence_cache) == 2


def test_reversed_links_have_the_same_path_loss(yard: Tracer, rounds: Paths) -> None:
    plain = yard.with_settings(replace(AUTO, diffraction=False))
    assert len(plain.plan(LINKS).launches) == len(plain.plan(REVERSED).launches) == 1
    there, back = (
        plain.with_settings(replace(plain.settings, samples=samples)).trace(REVERSED)
        for samples in ("auto", 100_000)
    )
    np.testing.assert_allclose(path_loss(there), path_loss(back), atol=1e-5)


def test_a_search_that_ends_at_the_limit_of_rays_names_the_position_and_the_remedy(
    yard: Tracer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(adaptive_sampling, "MAX_LAUNCHES", 1)
    links = SimpleNamespace(tx=LINKS.tx[:1] + 0.00042, rx=LINKS.rx[:1])
    yard.trace(links)
    assert re.search(
        r"After 250,000 rays from position \(-20\.0, 2\.0, 12\.0\) m, the last round still changed path loss by up to "
        r"\d\.\d\d dB, more than the tolerance of 0\.05 dB, so paths may be missing; if this matters, reduce",
        caplog.text,
    )


def test_a_trace_without_interactions_sends_no_rays(yard: Tracer) -> None:
    direct = yard.with_settings(replace(AUTO, max_depth=0)).trace(LINKS)
    assert direct.num_interactions == direct.settings["rays"] == 0
    assert direct.link.tolist() == [0, 2, 3]
    assert report.last_round(direct.settings, 0.5).startswith("Converged: only direct paths")


def test_diffuse_reflection_needs_a_number() -> None:
    with pytest.raises(InputError, match=r"trace\.samples = 'auto' .* give a number"):
        TraceSettings(samples="auto", diffuse_reflection=True)
    with pytest.raises(InputError, match=r"trace\.samples = 'some': must be a whole number .* or 'auto'"):
        TraceSettings(samples="some")


def test_a_path_in_a_corner_of_two_mirrors_unfolds_to_a_line() -> None:
    """Ground and wall: the image of the image is the point mirrored in the corner's axis."""
    ground = [[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]
    wall = [[5.0, -9, 0], [5, 9, 0], [5, 0, 9]]
    surfaces = Surfaces(np.array([ground, wall, wall[::-1]]))
    assert surfaces.plane[1] == surfaces.plane[2] != surfaces.plane[0]
    none = Edges(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))
    kind, triangle = np.array([[Kind.SPECULAR, Kind.REFRACTION, Kind.SPECULAR]]), np.array([[0, 0, 1]])
    unfolded = unfold(np.array([1.0, 2, 3]), kind, triangle, surfaces, none)
    np.testing.assert_allclose(unfolded.aim[0], [[1, 2, -3], [1, 2, -3], [9, 2, -3]])
    np.testing.assert_allclose(unfolded.image, [[9, 2, -3]])
    np.testing.assert_allclose(unfolded.low[0, 2], [4.9, -9.1, -0.1])
    edge = Edges(np.array([[0.0, 0, 4]]), np.array([[0.0, 0.6, 0.8]]), np.array([2.0]))
    unfolded = unfold(np.array([1.0, 2, 3]), np.array([[Kind.DIFFRACTION, Kind.SPECULAR]]), triangle[:, :2] + [[0, 1]],
                   surfaces, edge)  # fmt: skip
    np.testing.assert_allclose(unfolded.aim[0], [[0, 0, 4], [10, 0, 4]])
    np.testing.assert_allclose(unfolded.slide[0], [[0, 0.6, 0.8], [0, 0.6, 0.8]])


def test_a_rectangle_is_traced_as_the_mesh_of_its_corners(tmp_path: Path) -> None:
    """Mitsuba's rectangles have no triangles, which rays in rounds need."""
    square = [[(-40.0, -40.0, 0.0), (40.0, -40.0, 0.0), (40.0, 40.0, 0.0), (-40.0, 40.0, 0.0)]]
    scene = write_scene(tmp_path, {"ground": square})
    of_mesh = Tracer(read_scene(scene, FREQUENCY), FREQUENCY, AUTO, Antenna("iso"), Antenna("iso")).trace(
        LINKS
    )
    text = scene.read_text().replace('type="ply"', 'type="rectangle"')
    scale = '<transform name="to_world"><scale value="40"/></transform>'
    scene.write_text(re.sub(r'<string name="filename".*?/>', scale, text))
    of_rectangle = Tracer(
        read_scene(scene, FREQUENCY), FREQUENCY, AUTO, Antenna("iso"), Antenna("iso")
    ).trace(LINKS)
    assert of_rectangle.num_paths == of_mesh.num_paths == 2 * len(RECEIVERS)
    np.testing.assert_allclose(path_loss(of_rectangle), path_loss(of_mesh), atol=1e-4)
