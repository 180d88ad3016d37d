"""Splitting a trace into launches: every ray and receiver once, within bounds; repeats are found, samples kept."""

from __future__ import annotations

import numpy as np
import pytest

from calibray.tracing.settings import TraceSettings
from calibray.tracing.trace_plan import (
    LANE_BYTES,
    find_repeats,
    lattice_directions,
    paths_that_fit,
    plan_trace,
)

MASTS = np.repeat([[0.0, 0, 10], [50, 0, 10]], [7, 4], axis=0)[[0, 7, 1, 8, 2, 9, 3, 10, 4, 5, 6]]


@pytest.mark.parametrize("samples", [1, 10, 999, 1_600_003])
@pytest.mark.parametrize("depth", [0, 1, 5])
@pytest.mark.parametrize("lanes", [100, 20_000, 10**9])
def test_every_ray_goes_to_every_receiver_once(samples, depth, lanes):
    if samples // lanes > 1000:
        lanes = 20_000_000
    settings = TraceSettings(samples=samples, max_depth=depth, seed=5)
    plan = plan_trace(MASTS, settings, lanes, 1000)
    sent = np.zeros(len(MASTS), dtype=np.int64)
    for launch in plan.launches:
        assert (MASTS[launch.links] == launch.source).all()
        assert (sent[launch.links] == launch.first).all()
        sent[launch.links] += launch.rays
        assert launch.last == (launch.first + launch.rays == samples)
        assert launch.rays * max(depth, 1) * len(launch.links) <= max(lanes, max(depth, 1)) or depth == 0
        assert (launch.seed == 5) == (launch.first == 0)
    assert (sent == samples).all()
    assert plan.lanes <= max(lanes, depth)
    assert plan.memory >= plan.lanes * LANE_BYTES


def test_launches_are_made_on_request():
    """10^12 rays to 10,000 receivers: 1.5 thousand million launches."""
    tx = np.tile([[0.0, 0, 10]], (10_000, 1))
    plan = plan_trace(tx, TraceSettings(samples=10**12, max_depth=3), 20_000_000, 1_000_000)
    assert len(plan.launches) == 10_000 * 150_000
    assert plan.lanes <= 20_000_001
    assert plan.memory < 2**31
    for share in (0, 1, 77_777, 149_999):
        launch = plan.launches[share]
        assert (launch.links.tolist(), launch.last) == ([0], share == 149_999)
        assert launch.first == 10**12 * share // 150_000
        assert launch.first + launch.rays == 10**12 * (share + 1) // 150_000
    assert plan.launches[-1].links.tolist() == [9999]
    assert [launch.first for launch in plan.launches[150_000:150_002]] == [0, 6_666_666]
    with pytest.raises(IndexError):
        plan.launches[len(plan.launches)]


def test_rays_are_split_only_if_one_receiver_is_too_much():
    settings = TraceSettings(samples=16_000_000, max_depth=3)
    assert [launch.rays for launch in plan_trace(MASTS[:1], settings, 20_000_000, 1).launches] == [
        5_333_333, 5_333_333, 5_333_334,
    ]  # fmt: skip
    few = plan_trace(MASTS, TraceSettings(samples=100, max_depth=3), 700, 1).launches
    assert all(launch.rays == 100 and launch.last for launch in few)
    assert sorted(len(launch.links) for launch in few) == [1, 2, 2, 2, 2, 2]


def test_launches_of_one_receiver_have_different_seeds():
    seeds = [
        [launch.seed for launch in plan_trace(MASTS[:1], TraceSettings(samples=100, seed=s), 30, 1).launches]
        for s in (1, 2)
    ]
    assert len(seeds[0]) == 10
    assert len({*seeds[0], *seeds[1]}) == 20


def test_directions_cover_the_square_evenly():
    """Every strip and every column of the square holds its share of the points."""
    whole = np.hstack([lattice_directions(first, 500, 2000) for first in range(0, 2000, 500)])
    for axis in whole:
        np.testing.assert_allclose(np.histogram(axis, 20, (0, 1))[0], 100, atol=3)
    np.testing.assert_array_equal(whole, lattice_directions(0, 2000, 2000))


def repeats(paths):
    """`find_repeats` for (launch, link, kinds, shapes, vertices, is_sample) of each path."""
    launch, link, kind, shape, vertex, is_sample = (np.array(column) for column in zip(*paths, strict=True))
    return find_repeats(launch, link, kind, shape, vertex.astype(float), is_sample).tolist()


def test_repeats_are_paths_through_the_same_points_of_the_same_objects():
    near, far = [[1.0, 2, 3], [4, 5, 6]], [[1.0, 2, 3.2], [4, 5, 6]]
    across = [[1.0 - 1e-4, 2 + 1e-4, 3 - 1e-4], [4, 5, 6]]  # across a cell boundary of one grid
    first = (0, 7, [1, 4], [3, 8], near, False)
    assert repeats([first, (1, 7, [1, 4], [3, 8], near, False)]) == [False, True]
    assert repeats([first, (1, 7, [1, 4], [3, 8], across, False)]) == [False, True]
    for other in (
        (1, 6, [1, 4], [3, 8], near, False),  # another link
        (1, 7, [4, 4], [3, 8], near, False),  # another kind
        (1, 7, [1, 4], [3, 9], near, False),  # another object
        (1, 7, [1, 4], [3, 8], far, False),  # another point
        (1, 7, [1, 4], [3, 8], near, True),  # a sample
        (0, 7, [1, 4], [3, 8], near, False),  # the same launch, in which the tracer finds no path twice
    ):
        assert repeats([first, other]) == [False, False]


def test_entries_beyond_the_last_interaction_do_not_count():
    one = (0, 7, [1, 0], [3, 8], [[1, 2, 3], [4, 5, 6]], False)
    assert repeats([one, (1, 7, [1, 0], [3, 9], [[1, 2, 3], [0, 0, 0]], False)]) == [False, True]


def test_direct_paths_are_found_once():
    direct = [(launch, 0, [0], [0], [[0, 0, 0]], False) for launch in range(3)]
    assert repeats(direct) == [False, True, True]


def test_paths_that_fit_grow_with_memory_and_shrink_with_depth():
    assert paths_that_fit(10**9, 2) > paths_that_fit(10**9, 5) > paths_that_fit(10**8, 5) > 0
    assert paths_that_fit(0, 3) == 0


def test_long_traces_are_announced():
    short = plan_trace(MASTS[:1], TraceSettings(samples=1000, max_depth=2), 20_000_000, 1_000_000)
    assert short.announcement(1) == ""
    long = plan_trace(MASTS, TraceSettings(samples=4_000_000, max_depth=5), 20_000_000, 1_000_000)
    assert long.announcement(11) == (
        "Tracing 11 links in 11 launches of up to 20,000,000 rays x interactions x receivers; "
        "this takes about 0.9 GiB, plus the memory of the scene and the paths, "
        "and 7 seconds on two cores"
    )
    # Ten thousand times the rays take ten thousand times as long.
    longer = plan_trace(MASTS, TraceSettings(samples=40_000_000_000, max_depth=5), 20_000_000, 1_000_000)
    assert longer.announcement(11).endswith("and 20 hours on two cores")


def test_rays_added_in_rounds_take_one_launch_per_position():
    plan = plan_trace(MASTS, TraceSettings(samples="auto", max_depth=5), 20_000_000, 1_000_000)
    assert sorted(len(launch.links) for launch in plan.launches) == [4, 7]
    assert plan.announcement(11) == (
        "Tracing 11 links from 2 positions, adding rays until path loss converges; this takes about 6 seconds on two "
        "cores, or longer if new paths are still found"
    )
