"""Multipath tables and impulse responses against closed forms, in every file format."""

from __future__ import annotations

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io

from calibray.errors import InputError
from calibray.measurements.multipath import Multipath, measure, read_impulse_responses, read_multipath
from calibray.measurements.observables import Statistic

TABLE = pd.DataFrame(
    {
        "id": [7, 7, 7, 7, 9],
        "rotation": [1, 1, 2, 2, 1],
        "delay_ns": [100.0, 200.0, 100.0, 300.0, 50.0],
        "azimuth_deg": [90.0, 0.0, 90.0, 0.0, 10.0],
        "path_loss_db": [80.0, 80.0, 80.0, 80.0, 90.0],
    }
)


def values(multipath, kind, **limits):
    return measure(multipath, Statistic(kind, **limits))


def test_statistics_are_means_over_rotations(tmp_path):
    TABLE.to_csv(tmp_path / "multipath.csv", index=False)
    paths = read_multipath(tmp_path / "multipath.csv", "id")
    # Two equal paths 100 ns and 200 ns apart have spreads of half of that.
    assert values(paths, "rms_delay_spread") == pytest.approx({"7": 75e-9, "9": 0.0})
    assert values(paths, "mean_excess_delay") == pytest.approx({"7": 75e-9, "9": 0.0})
    assert values(paths, "time_of_flight", path="first") == pytest.approx({"7": 100e-9, "9": 50e-9})
    assert values(paths, "round_trip_time") == pytest.approx({"7": 350e-9, "9": 100e-9})
    assert values(paths, "k_factor")["7"] == pytest.approx(0.0)
    assert np.isnan(values(paths, "k_factor")["9"])
    # sqrt(-2 ln cos 45 degrees)
    assert values(paths, "azimuth_spread_arrival")["7"] == pytest.approx(np.sqrt(np.log(2)))
    with pytest.raises(InputError, match="needs angles"):
        values(paths, "elevation_spread_arrival")


def test_limits_bins_and_sectors(tmp_path):
    table = TABLE.assign(path_loss_db=[80.0, 80.0, 80.0, 111.0, 133.0])
    table.to_csv(tmp_path / "multipath.csv", index=False)
    paths = read_multipath(tmp_path / "multipath.csv", "id", compass=True)
    limits = {"dynamic_range_db": 30.0, "floor_db": -132.0}
    # In the second rotation only the first path is within 30 dB of the strongest; link 9 is below the floor.
    assert values(paths, "rms_delay_spread", **limits) == pytest.approx({"7": 25e-9})
    assert values(paths, "rms_delay_spread", window=5e-8)["7"] == 0.0
    full, half = 10 * np.log10(1.001), 10 * np.log10(0.5 + 1e-3)
    first = values(paths, "power_delay_profile", edges=(0.0, 5e-8), **limits)
    assert first == pytest.approx({"7": (half + full) / 2})
    assert values(paths, "power_delay_profile", edges=(5e-8, 1.5e-7), **limits)["7"] == pytest.approx(
        (half - 30) / 2
    )
    # A bearing of 90 degrees is east, the x axis.
    east = values(paths, "azimuth_power_arrival", edges=(-np.pi / 4, np.pi / 4), **limits)
    assert east["7"] == pytest.approx((half + full) / 2)
    north = values(paths, "azimuth_power_arrival", edges=(np.pi / 4, 3 * np.pi / 4), **limits)
    assert north["7"] == pytest.approx((half - 30) / 2)


def test_components_at_the_end_of_a_bin_or_window_are_on_it_in_spite_of_rounding():
    # Samples at multiples of 10 ns, and azimuths in steps of 10 degrees.
    for first in range(1, 60):
        delay, azimuth = (first + np.arange(3)) / 1e8, np.radians(10.0 * (first + np.arange(3)))
        angles = {("azimuth", "arrival"): azimuth}
        paths = Multipath(np.full(3, "a"), np.full(3, ""), delay, np.zeros(3), angles)
        third = 10 * np.log10(1 / 3 + 1e-3)
        for n in range(3):
            share = values(paths, "power_delay_profile", edges=(n * 1e-8, (n + 1) * 1e-8))["a"]
            assert share == pytest.approx(third)
            edges = tuple(np.radians([10.0 * (first + n), 10.0 * (first + n + 1)]))
            assert values(paths, "azimuth_power_arrival", edges=edges)["a"] == pytest.approx(third)
        assert values(paths, "mean_excess_delay", window=1e-8)["a"] == pytest.approx(5e-9)


@pytest.mark.parametrize(
    ("name", "factor"),
    [("delay_ns", 1.0), ("Delay (ns)", 1.0), ("TOA [ns]", 1.0), ("delayNs", 1.0), ("delay_ps", 1e3)],
)
def test_the_unit_of_delays_is_that_of_their_name(tmp_path, name, factor):
    columns = {"delay_ns": name}
    TABLE.assign(delay_ns=TABLE["delay_ns"] * factor).rename(columns=columns).to_csv(
        tmp_path / "multipath.csv", index=False
    )
    assert values(read_multipath(tmp_path / "multipath.csv", "id"), "rms_delay_spread")["7"] == pytest.approx(
        75e-9
    )


@pytest.mark.parametrize(
    ("columns", "factor", "reason"),
    [
        ({"delay_ns": "delay"}, 1.0, "state the unit"),
        ({}, -1.0, "losses must be positive"),
        ({"path_loss_db": "path_gain_db"}, 1.0, "gains and powers negative"),
        ({"path_loss_db": "power_mw"}, 1e-9, "gains and powers negative"),
    ],
)
def test_delays_and_levels_of_another_unit_or_sign_are_refused(tmp_path, columns, factor, reason):
    table = TABLE.assign(path_loss_db=TABLE["path_loss_db"] * factor).rename(columns=columns)
    table.to_csv(tmp_path / "multipath.csv", index=False)
    with pytest.raises(InputError, match=reason):
        read_multipath(tmp_path / "multipath.csv", "id")


def test_of_several_levels_or_delays_the_plain_one_is_used_and_doubt_is_refused(tmp_path):
    # Constants instead of the columns of the table, so that a wrong choice changes the spread.
    for other in ("noise_power_dbm", "tx_power_dbm", "delay_bin", "gain"):
        table = TABLE.copy()
        table.insert(0, other, [-100.0, -50.0, -100.0, -50.0, -100.0])
        table.to_csv(tmp_path / "multipath.csv", index=False)
        paths = read_multipath(tmp_path / "multipath.csv", "id")
        assert values(paths, "rms_delay_spread")["7"] == pytest.approx(75e-9)
    for other in ("total path loss [dB]", "first_delay_ns"):
        TABLE.assign(**{other: 75.0}).to_csv(tmp_path / "multipath.csv", index=False)
        with pytest.raises(InputError, match=r"can all contain the (level|delay).*keep one"):
            read_multipath(tmp_path / "multipath.csv", "id")


@pytest.mark.parametrize(
    ("name", "code"),
    [("path_loss_db", 0.0), ("path_loss_db", 999.0), ("path_loss_db", -999.0), ("delay_ns", -999.0)],
)
def test_codes_among_components_are_refused_unless_the_study_states_them(tmp_path, name, code):
    table = pd.concat([TABLE, TABLE.head(1).assign(**{name: code})])
    table.to_csv(tmp_path / "multipath.csv", index=False)
    with pytest.raises(
        InputError, match=rf"multipath\.csv, row 7, column '{name}': {code:g} .*links\.missing"
    ):
        read_multipath(tmp_path / "multipath.csv", "id")
    paths = read_multipath(tmp_path / "multipath.csv", "id", missing=[code])
    assert values(paths, "rms_delay_spread") == pytest.approx({"7": 75e-9, "9": 0.0})
    # Relative to the strongest component, 0 dB is a level.
    TABLE.assign(path_loss_db=[0.0, 25.0, 0.0, 30.0, 0.0]).to_csv(tmp_path / "multipath.csv", index=False)
    assert len(read_multipath(tmp_path / "multipath.csv", "id").delay) == 5


def test_angles_are_those_of_the_end(tmp_path):
    table = TABLE.rename(columns={"azimuth_deg": "aoa_deg"})
    table.insert(0, "tx_power_dbm", [-60.0, -20.0, -20.0, -20.0, -20.0])
    table.insert(1, "aod_deg", [0.0, 60.0, 0.0, 60.0, 0.0])
    table.to_csv(tmp_path / "multipath.csv", index=False)
    paths = read_multipath(tmp_path / "multipath.csv", "id")
    # sqrt(-2 ln cos 45 degrees) and sqrt(-2 ln cos 30 degrees)
    assert values(paths, "azimuth_spread_arrival")["7"] == pytest.approx(np.sqrt(np.log(2)))
    assert values(paths, "azimuth_spread_departure")["7"] == pytest.approx(np.sqrt(np.log(4 / 3)))
    table.drop(columns="aod_deg").to_csv(tmp_path / "arrival.csv", index=False)
    with pytest.raises(InputError, match="needs angles"):
        values(read_multipath(tmp_path / "arrival.csv", "id"), "azimuth_spread_departure")


@pytest.mark.parametrize("unit", ["{}_{}", "{} [{}]", "{} ({})", "{}\n{}"])
@pytest.mark.parametrize(
    ("time", "scale", "angle"),
    [("ns", 1.0, "rad"), ("us", 1e-3, "rad"), ("\u00b5s", 1e-3, "rad"), ("\u03bcs", 1e-5, "radians")],
)
def test_units_may_be_in_brackets_or_in_a_row_below_the_names(tmp_path, unit, time, scale, angle):
    """In radians and of one end, however the unit is written."""
    radians = TABLE.assign(azimuth_deg=np.radians(TABLE["azimuth_deg"]), delay_ns=TABLE["delay_ns"] * scale)
    units = {"delay": time, "azimuth_arrival": angle, "PL": "dB"}
    names = [unit.format(*each).partition("\n") for each in units.items()]
    header = ["id,rotation," + ",".join(name for name, _, _ in names)]
    header += [",," + ",".join(below for _, _, below in names)] if names[0][2] else []
    text = "\n".join([*header, radians.to_csv(index=False, header=False)])
    (tmp_path / "multipath.csv").write_text(text)
    paths = read_multipath(tmp_path / "multipath.csv", "id")
    assert list(paths.angles) == [("azimuth", "arrival")]
    # sqrt(-2 ln cos 45 degrees)
    assert values(paths, "azimuth_spread_arrival")["7"] == pytest.approx(np.sqrt(np.log(2)))
    assert paths.level_db.max() == -80.0
    assert paths.delay.min() == pytest.approx(50.0 * scale * (1e-9 if time == "ns" else 1e-6))


def test_an_angle_of_arrival_may_be_an_elevation(tmp_path):
    table = TABLE.rename(columns={"azimuth_deg": "AoA elevation [deg]"})
    table.to_csv(tmp_path / "elevation.csv", index=False)
    assert list(read_multipath(tmp_path / "elevation.csv", "id").angles) == [("elevation", "arrival")]
    table.assign(**{"AoA azimuth [deg]": [0.0, 60.0, 0.0, 60.0, 0.0]}).to_csv(
        tmp_path / "both.csv", index=False
    )
    paths = read_multipath(tmp_path / "both.csv", "id")
    # sqrt(-2 ln cos 45 degrees) and sqrt(-2 ln cos 30 degrees)
    assert values(paths, "elevation_spread_arrival")["7"] == pytest.approx(np.sqrt(np.log(2)))
    assert values(paths, "azimuth_spread_arrival")["7"] == pytest.approx(np.sqrt(np.log(4 / 3)))


def test_snapshots_of_one_component_do_not_count_in_the_k_factor(tmp_path):
    TABLE.iloc[:3].assign(path_loss_db=[80.0, 86.0, 80.0]).to_csv(tmp_path / "multipath.csv", index=False)
    paths = read_multipath(tmp_path / "multipath.csv", "id")
    assert values(paths, "k_factor") == pytest.approx({"7": 6.0})


def test_a_table_without_delays_is_refused(tmp_path):
    TABLE.drop(columns="delay_ns").to_csv(tmp_path / "multipath.csv", index=False)
    with pytest.raises(InputError, match="no column with a delay"):
        read_multipath(tmp_path / "multipath.csv", "id")


RATE, SAMPLES = 1e8, 400


@pytest.fixture(scope="module")
def responses():
    """Responses of two links with two and one paths, noise 40 dB below them [2, samples]."""
    random = np.random.default_rng(5)
    noise = 0.01 * (random.standard_normal((2, SAMPLES)) + 1j * random.standard_normal((2, SAMPLES)))
    noise[0, 20] += 1.0
    noise[0, 50] += 1.0j
    noise[1, 30] += 2.0
    return noise


def write(folder, ending, responses):
    delay = np.arange(SAMPLES) / RATE
    file = folder / f"cir.{ending.strip('.')}"
    if ending == ".npz":
        np.savez(file, cir=responses, delay=delay)
    elif ending == ".npy":
        np.save(file, responses)
    elif ending == ".mat":
        scipy.io.savemat(file, {"h": responses, "tau": delay})
    elif ending == "v7.3.mat":
        with h5py.File(file, "w") as content:
            pairs = np.empty(responses.T.shape, [("real", "f8"), ("imag", "f8")])
            pairs["real"], pairs["imag"] = responses.T.real, responses.T.imag
            content["h"], content["tau"] = pairs, delay[:, None]
    else:
        with h5py.File(file, "w") as content:
            content["cir"], content["delays"] = responses, delay
    return file


@pytest.mark.parametrize("ending", [".npz", ".npy", ".mat", "v7.3.mat", ".h5"])
def test_impulse_responses_of_every_format(tmp_path, responses, ending):
    rate = RATE if ending == ".npy" else None
    multipath = read_impulse_responses(write(tmp_path, ending, responses), ["a", "b"], rate, margin_db=15.0)
    assert multipath.delay == pytest.approx([2e-7, 5e-7, 3e-7])
    assert values(multipath, "rms_delay_spread") == pytest.approx({"a": 150e-9, "b": 0.0}, rel=0.02)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint16, np.float32])
def test_amplitudes_may_be_small_integers(tmp_path, responses, kind):
    amplitudes = np.abs(responses[:1]) / np.abs(responses[0]).max()
    file = write(tmp_path, ".npy", np.round(amplitudes * np.iinfo(np.uint8).max).astype(kind))
    multipath = read_impulse_responses(file, ["a"], RATE, margin_db=15.0)
    assert multipath.delay == pytest.approx([2e-7, 5e-7])
    assert multipath.level_db == pytest.approx(20 * np.log10(255), abs=0.3)


@pytest.mark.parametrize("ending", [".npz", ".mat", "v7.3.mat"])
def test_impulse_responses_of_one_link(tmp_path, responses, ending):
    file = write(tmp_path, ending, responses[:1])
    multipath = read_impulse_responses(file, ["a"], margin_db=15.0)
    assert values(multipath, "rms_delay_spread") == pytest.approx({"a": 150e-9}, rel=0.02)


def test_a_folder_with_a_file_per_link(tmp_path, responses):
    for name, response in zip("ab", responses, strict=True):
        np.savez(
            tmp_path / f"{name}.npz", cir=np.stack([response, response]), delay=np.arange(SAMPLES) / RATE
        )
    multipath = read_impulse_responses(tmp_path, ["a", "b", "c"], margin_db=15.0)
    assert multipath.snapshot.tolist() == ["0", "0", "1", "1", "0", "1"]
    assert values(multipath, "time_of_flight", path="first") == pytest.approx({"a": 2e-7, "b": 3e-7})


def test_impulse_responses_that_fit_no_links_are_refused(tmp_path, responses):
    file = write(tmp_path, ".npy", responses)
    with pytest.raises(InputError, match="one row for each of 3 links"):
        read_impulse_responses(file, ["a", "b", "c"], RATE)
    with pytest.raises(InputError, match="give the sample rate"):
        read_impulse_responses(file, ["a", "b"])
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 no zip")
    with pytest.raises(InputError, match="cannot be read"):
        read_impulse_responses(tmp_path / "bad.npz", ["a"], RATE)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read"):
        read_impulse_responses(tmp_path / "objects.npy", ["a"], RATE)
    with pytest.raises(InputError, match="no file has the name of a link"):
        read_impulse_responses(tmp_path, ["x"], RATE)


def test_delays_in_another_unit_are_refused(tmp_path, responses):
    np.savez(tmp_path / "cir.npz", cir=responses, delay=np.arange(SAMPLES) / RATE * 1e9)
    np.save(tmp_path / "cir.npy", responses)
    for file, rate in (("cir.npz", None), ("cir.npy", RATE / 1e6)):
        with pytest.raises(
            InputError, match=r"has a delay of .* s, but the largest allowed delay is 0.01 s; give delays in"
        ):
            read_impulse_responses(tmp_path / file, ["a", "b"], rate)


def test_responses_in_several_arrays_or_in_decibels_are_refused(tmp_path, responses):
    np.savez(tmp_path / "parts.npz", re=responses.real, im=responses.imag)
    with pytest.raises(InputError, match="several arrays"):
        read_impulse_responses(tmp_path / "parts.npz", ["a", "b"], RATE)
    np.savez(tmp_path / "level.npz", level=20 * np.log10(np.abs(responses) / 2.1))
    with pytest.raises(InputError, match="in decibels"):
        read_impulse_responses(tmp_path / "level.npz", ["a", "b"], RATE)
    np.savez(tmp_path / "both.npz", cir=responses, snr=np.ones(responses.shape))
    multipath = read_impulse_responses(tmp_path / "both.npz", ["a", "b"], RATE, margin_db=15.0)
    assert multipath.delay == pytest.approx([2e-7, 5e-7, 3e-7])
