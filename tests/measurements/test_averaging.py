"""Averages of samples, against closed forms."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import Averaging, LinkColumns, Preparation, SourceTable, measured_links
from calibray.measurements.reading import average_samples

TX, RX = ("tx_x", "tx_y", "tx_z"), ("rx_x", "rx_y", "rx_z")


def average(rows, by="cell", size=5.0, quantity="rsrp", time=None, **steps):
    """Averages of the column `power`; positions that the rows lack are 0."""
    frame = pd.DataFrame(dict.fromkeys((*TX, *RX), 0.0), index=range(len(next(iter(rows.values())))))
    steps = Preparation(averaging=Averaging(by, size, time), **steps)
    columns = LinkColumns(TX, RX, "power", quantity)
    return average_samples(SourceTable(frame.assign(**rows)), steps, columns)


def test_rayleigh_fading_averages_to_its_mean_power():
    """The power is exponential: mean 0 dB, mean of the decibels -2.51 dB, standard deviation 5.57 dB."""
    power = -90.0 + 10 * np.log10(np.random.default_rng(0).exponential(size=200_000))
    (mean,) = average({"power": power}).frame.to_dict("records")
    assert mean["power"] == pytest.approx(-90.0, abs=0.05)
    assert power.mean() == pytest.approx(-92.51, abs=0.05)
    assert mean["std_db"] == pytest.approx(5.57, abs=0.05)
    assert mean["count"] == 200_000


@pytest.mark.parametrize(("quantity", "sign"), [("rsrp", 1.0), ("path_gain", 1.0), ("path_loss", -1.0)])
def test_powers_and_losses_are_averaged_in_linear_power(quantity, sign):
    rows = {"rx_x": [0.0, 0.5, 7.0], "rx_z": [1.0, 2.0, 1.0], "power": sign * np.array([-80.0, -90.0, -70.0])}
    mean = average(rows, quantity=quantity).frame
    np.testing.assert_allclose(sign * mean["power"], [10 * np.log10((1e-8 + 1e-9) / 2), -70.0])
    np.testing.assert_allclose(mean["rx_x"], [0.25, 7.0])
    np.testing.assert_allclose(mean["rx_z"], [1.5, 1.0])
    np.testing.assert_allclose(mean["std_db"], [np.sqrt(50.0), np.nan])
    assert mean["count"].tolist() == [2, 1]


def test_powers_below_the_smallest_float_are_averaged():
    assert average({"power": [-5000.0, -5000.0]}).frame["power"].tolist() == [-5000.0]


def test_averages_do_not_cross_transmitters_and_kept_columns():
    rows = {"transmitter": list("baba"), "phone": [1, 1, 1, 1], "power": [-60.0, -80.0, -60.0, -90.0]}
    mean = average(rows).frame
    assert mean["transmitter"].tolist() == ["b", "a"]
    assert mean["power"].tolist() == pytest.approx([-60.0, -82.596], abs=1e-3)
    assert mean["count"].tolist() == [2, 2]
    assert len(average(rows | {"phone": [1, 1, 2, 2]}, keep=("phone",))) == 4
    with pytest.raises(InputError, match="no column 'phon'; did you mean 'phone'"):
        average(rows, keep=("phon",))


def test_averages_do_not_cross_transmitted_powers_carriers_and_groups():
    """Two samples of 100 dB path loss in one cell, sent with 20 and 10 dBm."""
    rows = pd.DataFrame({"rx_x": [0.0, 1.0], "rx_z": 30.0, "power": [-80.0, -90.0], "sent": [20.0, 10.0]})
    rows[["tx_x", "tx_y", "tx_z", "rx_y"]] = 0.0
    rows["carrier_ghz"], rows["phone"] = [0.8, 3.5], ["A", "B"]
    steps = Preparation(averaging=Averaging("cell", 5.0))
    columns = LinkColumns(TX, RX, "power", "received_power", tx_power_dbm="sent")
    np.testing.assert_allclose(measured_links(SourceTable(rows), columns, steps).path_loss_db, 100.0)
    for stated in ({"frequency": "carrier_ghz"}, {"group": "phone"}):
        columns = LinkColumns(TX, RX, "power", "rsrp", **stated)
        assert measured_links(SourceTable(rows), columns, steps).path_loss_db.tolist() == [80.0, 90.0]


@pytest.mark.parametrize(
    ("by", "size", "first_rows"),
    [
        ("cell", 10.0, [1, 2, 4]),
        ("distance", 10.0, [1, 3]),
        ("distance", 1e9, [1]),
        ("time", 5.0, [1, 3, 4]),
    ],
)
def test_cells_stretches_and_windows(by, size, first_rows):
    times = ["10:00:00Z", "10:00:04Z", "12:00:05+02:00", "10:01:00Z"]
    rows = {"rx_x": [-0.1, 0.1, 9.9, 10.1], "rx_y": 1.0, "power": -80.0}
    rows["t"] = [f"2026-05-01T{time}" for time in times]
    averages = average(rows, by, size, time="t")
    assert averages.row.tolist() == first_rows
    assert averages.changes == {"samples averaged": 4}
    if by == "time":
        seconds = [pd.Timestamp(time).timestamp() for time in rows["t"]]
        assert average(rows | {"t": seconds}, by, size, time="t").row.tolist() == first_rows
        with_fraction = [time.replace(":00Z", ":00,0Z") for time in rows["t"]]
        assert average(rows | {"t": with_fraction}, by, size, time="t").row.tolist() == first_rows


def test_each_device_has_its_own_distance_travelled():
    """The rows of two phones, 90 m apart, alternate."""
    rows = {"rx_x": [0.0, 90.0, 2.0, 92.0, 6.0, 96.0], "rx_y": 1.0, "power": -80.0, "phone": ["a", "b"] * 3}
    averages = average(rows, "distance", 5.0, keep=["phone"])
    assert averages.frame[["phone", "rx_x", "count"]].to_numpy().tolist() == [
        ["a", 1.0, 2], ["b", 91.0, 2], ["a", 6.0, 1], ["b", 96.0, 1],
    ]  # fmt: skip


@pytest.mark.parametrize("key", ["weight", "std"])
def test_weights_and_deviations_of_averages_are_means(key):
    rows = pd.DataFrame({"x": [0.0, 0.1, 9.0], "power": -80.0, "own": [1.0, 5.0, 2.0]})
    columns = LinkColumns((0.0, 0.0, 20.0), ("x", 0.0, 1.5), "power", "rsrp", **{key: "own"})
    links = measured_links(SourceTable(rows), columns, Preparation(averaging=Averaging("cell", 5.0)))
    expected = np.array([3.0, 2.0])
    assert links.weight == pytest.approx(expected if key == "weight" else 1 / expected**2)


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({}, {"size": 0.0}, "average.size = 0.0"),
        ({}, {"by": "distance", "size": -1.0}, "average.size = -1.0"),
        ({}, {"by": "time", "time": "t"}, "column 't': a time cannot be read .*; give ISO 8601, such as"),
        ({"t": [1.78e12, 1.78e12 + 9e3]}, {"by": "time", "time": "t"}, "column 't': .* give seconds"),
        ({"t": ["2026-05-01", None]}, {"by": "time", "time": "t"}, "column 't': a time is missing"),
        ({"rx_x": ["here", "there"]}, {}, "'here' is not a number"),
        ({"power": [-80.0, np.nan]}, {}, "missing or non-finite values in 1 of 2 rows"),
    ],
)
def test_samples_that_cannot_be_averaged_are_refused(changes, arguments, message):
    with pytest.raises(InputError, match=message):
        average({"t": ["noon", "one"], "power": [-80.0, -81.0]} | changes, **arguments)


def test_samples_below_the_floor_count_half_or_their_average_is_left_out():
    """One of ten samples below the floor adds between nothing and the floor; five of ten leave 1 dB open."""
    strong, weak = [-80.0] * 9, [-118.0] * 5
    frame = pd.DataFrame({"x": [0.0] * 10 + [50.0] * 10, "p": [*strong, np.nan, *weak, *[np.nan] * 5]})
    columns = LinkColumns((9.0, 9.0, 9.0), ("x", 0.0, 1.5), "p", "rsrp")
    steps = Preparation(noise_floor_dbm=-120.0, averaging=Averaging("cell", 5.0))
    links = measured_links(SourceTable(frame), columns, steps)
    assert links.path_loss_db.tolist() == pytest.approx([-10 * np.log10(0.9e-8 + 0.05e-12)])
    assert links.prepared == {
        "samples averaged": 20,
        "of them at or below the noise floor": 6,
        "averages too near the noise floor, left out": 1,
    }


def test_scans_of_one_place_are_averaged_and_small_averages_left_out():
    rows = {"rx_x": [1.0, 1.0, 1.1, 2.0], "power": [-80.0, -90.0, -70.0, -60.0]}
    places = average(rows, by="place", size=None)
    assert places.frame["rx_x"].tolist() == [1.0, 1.1, 2.0]
    assert places.frame["count"].tolist() == [2, 1, 1]
    np.testing.assert_allclose(places.frame["power"][0], 10 * np.log10((1e-8 + 1e-9) / 2))
    frame = pd.DataFrame(dict.fromkeys((*TX, *RX), 0.0), index=range(4)).assign(**rows)
    steps = Preparation(averaging=Averaging("place", minimum_count=2))
    enough = average_samples(SourceTable(frame), steps, LinkColumns(TX, RX, "power", "rsrp"))
    assert enough.frame["rx_x"].tolist() == [1.0]
    assert enough.changes["averages of fewer than 2 samples, left out"] == 2


def noted(table):
    return [change for change in table.changes if "over several values" in change]


def test_a_step_between_days_within_averages_is_noted_only_if_planted():
    """Forty places on two days; the second day is 3 dB stronger, or not. A street follows the place."""
    random, place = np.random.default_rng(3), np.repeat(np.arange(40), 2)
    rows = {
        "rx_x": 10.0 * place,
        "day": np.tile(["Monday", "Tuesday"], 40),
        "street": np.repeat(["A", "B"], 40),
    }
    power = -70.0 - place / 2 + random.normal(0, 1.5, 80)
    assert noted(average({**rows, "power": power})) == []
    power = power + 3.0 * (rows["day"] == "Tuesday")
    (change,) = noted(average({**rows, "power": power}))
    assert "several values of day" in change
    step_db = float(np.mean(power[1::2] - power[::2]))
    assert f"differs by {step_db:+.1f} dB" in change or f"differs by {-step_db:+.1f} dB" in change
    # Repeats of a link are averaged, too.
    frame = pd.DataFrame({**rows, "power": power, "rx_y": 0.0, "rx_z": 1.5})
    links = measured_links(
        SourceTable(frame), LinkColumns((5.0, 5.0, 9.0), RX, "power", "rsrp"), Preparation()
    )
    assert len(links) == 40
    assert any("several values of day" in change for change in links.prepared)
    # A group of the offset is kept apart, so that nothing is averaged.
    assert noted(average({**rows, "power": power}, keep=("day",))) == []


def test_further_observables_of_an_average_are_means_of_the_values_that_exist():
    rows = {"rx_x": [0.0, 1.0, 2.0, 9.0], "power": -80.0, "spread": [np.nan, 10.0, 30.0, 7.0]}
    mean = average(rows | {"power": [-80.0] * 4}, observables=("spread",)).frame
    assert mean["spread"].tolist() == [20.0, 7.0]
