"""Observables of links against NumPy on the paths' powers, and derivatives against finite differences."""

import numpy as np
import pytest

import planted
from calibray import fields
from calibray.fields.channel import channel_statistics
from calibray.measurements.observables import KINDS, Statistic

ALL = tuple(Statistic(kind) for kind in KINDS)
LIMITED = tuple(Statistic(kind, "mean", 25.0, -95.0, 6e-8) for kind in KINDS)


@pytest.fixture(scope="module")
def replay():
    return planted.engine()


def truth(replay):
    return np.array([[planted.TRUTH[name] for name in replay.parameters.names]])


def test_values_are_those_of_the_channel_statistics(replay):
    found = dict(zip(KINDS, replay.observe(truth(replay), ALL)[0], strict=True))
    paths = replay.paths
    expected = channel_statistics(paths, replay.parameters.materials(truth(replay)[0], paths.materials))
    first = np.array([paths.delay[paths.link == link].min() for link in range(paths.num_links)])
    assert found["rms_delay_spread"] == pytest.approx(expected.delay_spread)
    assert found["k_factor"] == pytest.approx(expected.k_factor_db)
    assert found["azimuth_spread_arrival"] == pytest.approx(expected.arrival_spread)
    assert found["azimuth_spread_departure"] == pytest.approx(expected.departure_spread)
    assert found["mean_excess_delay"] == pytest.approx(expected.mean_delay - first)
    assert found["time_of_flight"] == pytest.approx(expected.mean_delay)
    assert found["round_trip_time"] == pytest.approx(2 * expected.mean_delay)


@pytest.mark.parametrize(
    "limits",
    [(25.0, -95.0, 6e-8), (16.0, None, None), (None, -80.0, None), (None, None, 4e-8)],
    ids=["all", "dynamic range", "floor", "window"],
)
def test_a_receiver_sees_neither_weak_nor_late_paths(replay, limits):
    dynamic_range_db, floor_db, window = limits
    paths = replay.paths
    power = (
        np.abs(fields.path_gains(paths, replay.parameters.materials(truth(replay)[0], paths.materials))) ** 2
    )
    (found,) = replay.observe(truth(replay), (Statistic("rms_delay_spread", "mean", *limits),))[0]
    hard = np.empty(paths.num_links)
    for link in range(paths.num_links):
        mine = paths.link == link
        delay, own = paths.delay[mine], power[mine]
        seen = np.ones(len(own), dtype=bool)
        if dynamic_range_db is not None:
            seen &= own > own.max() * 10 ** (-dynamic_range_db / 10)
        if floor_db is not None:
            seen &= 10 * np.log10(own) > floor_db
        if window is not None:
            seen &= delay - delay.min() <= window
        weight = own * seen
        mean = np.sum(weight * delay) / weight.sum()
        hard[link] = np.sqrt(np.sum(weight * (delay - mean) ** 2) / weight.sum())
    # The soft limit differs from the hard one by little, the limits themselves by much.
    assert np.abs(found - hard).max() < 0.05 * hard.max()
    everything = replay.observe(truth(replay), ALL[:1])[0, 0]
    assert np.abs(everything - hard).max() > 0.1 * hard.max()


@pytest.mark.parametrize("path", ["first", "strongest"])
def test_times_of_flight_of_one_path(replay, path):
    paths = replay.paths
    power = (
        np.abs(fields.path_gains(paths, replay.parameters.materials(truth(replay)[0], paths.materials))) ** 2
    )
    (found,) = replay.observe(truth(replay), (Statistic("time_of_flight", path),))[0]
    for link in range(paths.num_links):
        mine = np.flatnonzero(paths.link == link)
        chosen = mine[np.argmin(paths.delay[mine])] if path == "first" else mine[np.argmax(power[mine])]
        assert found[link] == pytest.approx(paths.delay[chosen])


def test_derivatives_agree_with_finite_differences(replay):
    value, wanted = truth(replay), (ALL[0], ALL[4], ALL[6], *LIMITED[:2])
    _, jacobian = replay.observe_and_jacobian(value, wanted)
    for index in range(value.shape[1]):
        step = 1e-5 * np.eye(value.shape[1])[index]
        above, below = replay.observe(np.vstack([value + step, value - step]), wanted)
        numeric = (above - below) / 2e-5
        size = np.abs(numeric).max(axis=1, keepdims=True) + 1e-300
        assert jacobian[0, :, :, index] / size == pytest.approx(numeric / size, abs=1e-5)
