"""Checking a trace with more rays: enough rays change nothing, too few are reported."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.reporting import scene_tables as report
from calibray.scenes import read_scene
from calibray.tables import render
from calibray.tracing import convergence
from calibray.tracing.convergence import Convergence, PathLoss, compare
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer

FREQUENCY = 3.5e9
ROUGH = {"stone": {"scattering_coefficient": 0.6}}


@pytest.fixture(scope="module")
def links():
    rx = np.array([[-10.0, 3, 2], [12, 0, 1.5], [14, 8, 2], [0, 0, 2]])  # the last one stands in the house
    return SimpleNamespace(tx=np.tile([-20.0, 2, 3], (len(rx), 1)), rx=rx)


def tracer(file, materials=None, **settings) -> Tracer:
    scene = read_scene(file, FREQUENCY, materials)
    return Tracer(scene, FREQUENCY, TraceSettings(max_depth=2, **settings), Antenna(), Antenna())


def check(tracer: Tracer, links: SimpleNamespace, before: Paths, loss: PathLoss) -> Convergence:
    return convergence.check(
        tracer.settings, lambda finer: tracer.with_settings(finer).trace(links), before, loss
    )


def test_enough_rays_change_nothing(yard_file, links):
    enough = tracer(yard_file, samples=100_000)
    before = enough.trace(links)
    change = check(enough, links, before, path_loss)
    np.testing.assert_allclose(change.change_db, 0, atol=1e-6)
    np.testing.assert_array_equal(change.paths_before, change.paths_after)
    assert change.paths_before.sum() == before.num_paths > 5
    assert (change.samples, change.gained.size, change.lost.size) == (100_000, 0, 0)
    assert change.converged(1e-3)


def test_too_few_rays_of_a_diffuse_trace_change_its_path_loss(yard_file, links):
    coarse = tracer(yard_file, ROUGH, samples=60, diffuse_reflection=True, line_of_sight=False)
    change = check(coarse, links, coarse.trace(links), path_loss)
    assert change.quantile(1) > 2
    assert not change.converged(0.5)
    assert len(change.gained)


def test_the_change_is_the_difference_to_a_trace_with_twice_the_rays(yard_file, links):
    coarse = tracer(yard_file, ROUGH, samples=500, diffuse_reflection=True)
    before = coarse.trace(links)
    finer = tracer(yard_file, ROUGH, samples=1000, seed=2, diffuse_reflection=True).trace(links)
    loss = [path_loss(paths, None, "band", 50e6)[:3] for paths in (before, finer)]
    change = check(coarse, links, before, partial(path_loss, combining="band", bandwidth=50e6))
    np.testing.assert_allclose(change.change_db, [*(loss[1] - loss[0]), 0], atol=1e-9)
    assert np.abs(change.change_db).max() > 0.01
    assert coarse.settings == TraceSettings(max_depth=2, samples=500, diffuse_reflection=True)


def test_the_largest_seed_is_followed_by_the_smallest(yard_file, links):
    last = tracer(yard_file, ROUGH, samples=500, seed=2**32 - 1, diffuse_reflection=True)
    before = last.trace(links)
    finer = tracer(yard_file, ROUGH, samples=1000, seed=0, diffuse_reflection=True).trace(links)
    expected = compare(before, finer, 500, path_loss).change_db
    np.testing.assert_array_equal(check(last, links, before, path_loss).change_db, expected)


def test_links_reached_in_one_trace_only_change_infinitely(yard_file, links):
    few, many = (tracer(yard_file, samples=n, line_of_sight=False).trace(links) for n in (3, 20_000))
    gained, lost = compare(few, many, 3, path_loss), compare(many, few, 3, path_loss)
    reached = np.bincount(many.link, minlength=4) > 0
    assert reached.tolist() == [True, False, True, False]
    only_many = reached & (gained.paths_before == 0)
    assert only_many.any()
    assert np.isneginf(gained.change_db[only_many]).all()
    assert np.isposinf(lost.change_db[only_many]).all()
    assert gained.change_db[3] == lost.change_db[3] == 0
    assert set(np.flatnonzero(only_many)) <= set(gained.gained.tolist()) == set(lost.lost.tolist())
    assert np.isinf(gained.quantile(1))


def test_quantiles_are_changes_of_links():
    change = Convergence(10, np.array([0.1, -3.0, 0.0, np.inf, -0.2]), *np.zeros((2, 5), dtype=int))
    assert [change.quantile(share) for share in (0, 0.5, 0.75, 1)] == [0, 0.2, 3, np.inf]
    assert change.largest.tolist() == [3, 1, 4, 0, 2]


def test_the_text_names_rows_and_the_remedy():
    change_db = np.array([0.0, -3.25, 0.1, -np.inf])
    convergence = Convergence(500, change_db, np.array([2, 3, 4, 0]), np.array([2, 5, 3, 1]))
    text = render(*report.convergence(convergence, np.arange(2, 6), 0.5))
    lines = [line.split() for line in text.splitlines()]
    assert lines[0][:6] == ["Change", "from", "500", "to", "1,000", "samples"]
    assert ["links", "that", "gained", "paths", "2", "rows", "3,", "5"] in lines
    assert ["links", "that", "lost", "paths", "1", "row", "4"] in lines
    assert lines[-5:-2] == [["5", "-inf", "0", "1"], ["3", "-3.25", "3", "5"], ["4", "+0.10", "4", "3"]]
    assert text.endswith(
        "Not converged: 2 of 4 links changed by more than 0.5 dB (fidelity.tolerance_db); "
        "increase trace.samples to 1000 or more and check again."
    )
    still = Convergence(500, np.full(4, 0.004), np.ones(4, dtype=int), np.ones(4, dtype=int))
    text = render(*report.convergence(still, np.arange(2, 6), 0.5))
    assert "Row" not in text
    assert text.endswith("Converged: no link changed by more than 0.5 dB (fidelity.tolerance_db).")


def test_traces_of_other_links_are_refused(yard_file, links):
    before = tracer(yard_file, samples=10).trace(links)
    moved = replace(before, rx_position=before.rx_position + 1)
    with pytest.raises(InputError, match="compare traces of the same links"):
        compare(before, moved, 10, path_loss)
