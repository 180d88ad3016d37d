"""Observables of links against NumPy on the paths' powers, and derivatives against finite differences."""

from dataclasses import replace

import numpy as np
import pytest

import planted
from calibray import fields
from calibray.engines import Replay
from calibray.fields.channel import channel_statistics
from calibray.fields.observables import hann_pulse
from calibray.measurements.observables import DELAY_BIN, KINDS, PROFILES, SECTORS, Statistic
from calibray.parameters import Parameter, Parameters


def of(kind, **limits):
    """A statistic of a kind; one of the power in a bin takes a bin that some paths lie in."""
    if kind in PROFILES:
        limits["edges"] = (0.0, 1.2) if kind in SECTORS else (1e-8, 8e-8)
    return Statistic(kind, **limits)


ALL = tuple(of(kind) for kind in KINDS)
LIMITS = {"dynamic_range_db": 25.0, "floor_db": -95.0, "window": 9e-8}
BANDWIDTH = 2e8
BY_FORMULA = (
    "rms_delay_spread", "mean_excess_delay", "round_trip_time", "k_factor", "elevation_spread_arrival", DELAY_BIN,
    "azimuth_power_departure",
)  # fmt: skip
"""One kind for every formula; the others differ by a factor or by the angle that they read."""

LIMITED = tuple(of(kind, **LIMITS) for kind in BY_FORMULA)
BANDED = tuple(of(kind, bandwidth=BANDWIDTH, **LIMITS) for kind in BY_FORMULA)
RESOLVED = tuple(Statistic("round_trip_time", path, 25.0, bandwidth=4e7) for path in ("first", "strongest"))


@pytest.fixture(scope="module")
def replay():
    return planted.engine()


def truth(replay):
    return np.array([[planted.TRUTH[name] for name in replay.parameters.names]])


def powers(replay):
    materials = replay.parameters.materials(truth(replay)[0], replay.paths.materials)
    return np.abs(fields.path_gains(replay.paths, materials)) ** 2


def observed(replay, *wanted):
    return replay.respond(truth(replay), wanted).observed[0]


def test_values_are_those_of_the_channel_statistics(replay):
    found = dict(zip(KINDS, observed(replay, *ALL), strict=True))
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


def test_elevation_spreads_and_shares_of_power_are_sums_over_paths(replay):
    paths, power = replay.paths, powers(replay)
    found = dict(zip(KINDS, observed(replay, *ALL), strict=True))
    for link in range(paths.num_links):
        mine = paths.link == link
        weight = power[mine] / power[mine].sum()
        for end, angles in (("departure", paths.departure), ("arrival", paths.arrival)):
            zenith, azimuth = angles[mine].T
            resultant = abs(np.sum(weight * np.exp(1j * zenith)))
            assert found[f"elevation_spread_{end}"][link] == pytest.approx(np.sqrt(-2 * np.log(resultant)))
            inside = weight[(azimuth % (2 * np.pi)) < 1.2].sum()
            assert found[f"azimuth_power_{end}"][link] == pytest.approx(10 * np.log10(inside + 1e-3))
        late = paths.delay[mine] - paths.delay[mine].min()
        inside = weight[(late >= 1e-8) & (late < 8e-8)].sum()
        assert found[DELAY_BIN][link] == pytest.approx(10 * np.log10(inside + 1e-3))


@pytest.mark.parametrize(
    "limits",
    [(25.0, -95.0, 6e-8), (16.0, None, None), (None, -80.0, None), (None, None, 4e-8)],
    ids=["all", "dynamic range", "floor", "window"],
)
def test_a_receiver_sees_neither_weak_nor_late_paths(replay, limits):
    dynamic_range_db, floor_db, window = limits
    paths, power = replay.paths, powers(replay)
    (found,) = observed(replay, Statistic("rms_delay_spread", "mean", *limits))
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
    (everything,) = observed(replay, ALL[0])
    assert np.abs(everything - hard).max() > 0.1 * hard.max()


def test_paths_below_the_floor_are_no_first_paths(replay):
    paths, level_db = replay.paths, 10 * np.log10(powers(replay))
    tested = 0
    for link in range(paths.num_links):
        mine = np.flatnonzero(paths.link == link)
        first = mine[np.argmin(paths.delay[mine])]
        floor_db = level_db[first] + 1.5
        if level_db[mine].max() > floor_db + 1.5:
            (found,) = observed(replay, Statistic("time_of_flight", "first", floor_db=floor_db))
            assert found[link] == pytest.approx(paths.delay[mine][level_db[mine] > floor_db].min())
            tested += 1
        if tested == 3:  # every floor is compiled
            break
    assert tested == 3


@pytest.mark.parametrize("path", ["first", "strongest"])
def test_times_of_flight_of_one_path(replay, path):
    paths, power = replay.paths, powers(replay)
    (found,) = observed(replay, Statistic("time_of_flight", path))
    for link in range(paths.num_links):
        mine = np.flatnonzero(paths.link == link)
        chosen = mine[np.argmin(paths.delay[mine])] if path == "first" else mine[np.argmax(power[mine])]
        assert found[link] == pytest.approx(paths.delay[chosen])


def test_bandwidth_adds_the_square_of_the_pulse_width_to_that_of_the_delay_spread(replay):
    narrow, wide = observed(
        replay, Statistic("rms_delay_spread", bandwidth=BANDWIDTH), Statistic("rms_delay_spread")
    )
    # Second moment of the squared pulse of a Hann window, but for the side lobes that are left out.
    pulse = 1 / (np.sqrt(3) * BANDWIDTH)
    assert narrow == pytest.approx(np.hypot(wide, pulse), rel=0.01)
    assert (narrow > 1.05 * wide).any()


def test_the_profile_of_a_narrow_receiver_is_that_of_its_pulses(replay):
    paths, power = replay.paths, powers(replay)
    edges = (-1e-9, 3e-8)
    found, first = observed(
        replay,
        Statistic(DELAY_BIN, bandwidth=BANDWIDTH, dynamic_range_db=30.0, edges=edges),
        Statistic("mean_excess_delay", bandwidth=BANDWIDTH, dynamic_range_db=30.0),
    )
    for link in range(paths.num_links):
        mine = paths.link == link
        # The profile by convolution on the same grid of samples, with a hard limit.
        grid = np.arange(0, np.ceil(paths.delay.max() * BANDWIDTH) + 3) / BANDWIDTH
        pulse = hann_pulse((grid[:, None] - paths.delay[mine]) * BANDWIDTH)
        profile = (pulse / pulse.sum(axis=0)) @ power[mine]
        seen = np.where(profile > 1e-3 * profile.max(), profile, 0.0)
        late = grid - grid[seen > 0][0]
        share = seen[(late >= edges[0]) & (late < edges[1])].sum() / seen.sum()
        assert found[link] == pytest.approx(10 * np.log10(share + 1e-3), abs=0.05)
        assert first[link] == pytest.approx(np.sum(late * seen) / seen.sum(), rel=0.02)


def test_taps_at_the_end_of_a_bin_or_window_are_on_it_in_spite_of_rounding(replay):
    paths, power, step = replay.paths, powers(replay), 1 / BANDWIDTH
    *shares, mean = observed(
        replay,
        *(Statistic(DELAY_BIN, bandwidth=BANDWIDTH, edges=(n * step, (n + 1) * step)) for n in (1, 2, 3)),
        Statistic("mean_excess_delay", bandwidth=BANDWIDTH, window=2 * step),
    )
    for link in range(paths.num_links):
        mine = paths.link == link
        number = np.floor(paths.delay[mine] * BANDWIDTH).astype(int)
        first = number.min() - 1
        pulse = hann_pulse(
            first + np.arange(number.max() + 4 - first)[:, None] - paths.delay[mine] * BANDWIDTH
        )
        profile = (pulse / pulse.sum(axis=0)) @ power[mine]
        for n, share in zip((1, 2, 3), shares, strict=True):
            assert share[link] == pytest.approx(10 * np.log10(profile[n] / profile.sum() + 1e-3))
        assert mean[link] == pytest.approx(np.arange(3) * step @ profile[:3] / profile[:3].sum())


def test_a_path_that_is_not_resolved_shifts_the_time_of_flight(replay):
    wide, narrow, mean = observed(
        replay,
        Statistic("time_of_flight", "first"),
        Statistic("time_of_flight", "first", bandwidth=2e7),
        Statistic("time_of_flight"),
    )
    assert (narrow > wide + 1e-10).any()
    assert (wide <= narrow + 1e-15).all()
    assert (narrow <= mean + 1e-15).all()


def test_derivatives_of_every_observable_agree_with_finite_differences():
    # Every kind of constant of a material, with diffuse walls so that scattering has an effect, and a region's.
    engine, wanted = every_constant(), (*ALL, *LIMITED, *BANDED, *RESOLVED)
    value = engine.parameters.start[None]
    without = engine.respond(value, wanted)
    for index, parameter in enumerate(engine.parameters):
        step = 1e-4 * max(parameter.start, 0.01)
        at = [value + factor * step * np.eye(value.shape[1])[index] for factor in (2, 1, -1, -2, 0)]
        answer = engine.respond(np.vstack(at), wanted, derivatives=True)
        assert answer.observed[4] == pytest.approx(without.observed[0], rel=1e-12, nan_ok=True)
        slopes = answer.loss_slope[4, None], answer.observed_slope[4]
        for slope, values in zip(slopes, (answer.path_loss[:, None], answer.observed), strict=True):
            # Five-point stencil
            numeric = (-values[0] + 8 * values[1] - 8 * values[2] + values[3]) / (12 * step)
            size = np.nanmax(np.abs(numeric), axis=1, keepdims=True) + 1e-6 * np.nanmax(np.abs(values[0]))
            assert slope[..., index] / size == pytest.approx(numeric / size, abs=1e-5, nan_ok=True)


def every_constant():
    """The planted street with diffuse walls, and a parameter for every kind of constant."""
    from calibray.materials import Material

    paths = diffuse_paths()
    constants = {
        "relative_permittivity": 4.0, "conductivity": 0.05, "thickness": 0.2, "scattering_coefficient": 0.4,
        "xpd_coefficient": 0.2,
    }  # fmt: skip
    materials = {name: Material(**constants) for name in paths.materials}
    items = tuple(
        Parameter(f"{name}.{constant}", 0.5 * value, 1.5 * value, value)
        for name in ("marble", "concrete")
        for constant, value in constants.items()
    )
    woods = Parameter("region:woods.specific_attenuation", 0.0, 1.0, 0.3)
    length = np.random.default_rng(2).uniform(0.0, 20.0, paths.num_paths)
    return Replay(
        replace(paths, materials=materials),
        Parameters((*items, woods), paths.frequency),
        effects=(fields.ExtraLoss(length, 30.0, 0),),
    )


def diffuse_paths():
    from calibray import engines
    from calibray.study import Setup, Study
    from link_tables import links_from_frame

    trace = {"max_depth": 2, "samples": 400, "line_of_sight": False, "diffuse_reflection": True}
    content = planted.content("links.csv", trace=trace)
    return engines.make(
        Setup.open(Study.from_content(content), links=links_from_frame(planted.links()))
    ).paths
