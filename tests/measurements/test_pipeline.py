"""The pipeline from rows to links: positions, heights, buildings, order of the steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements import (
    Averaging,
    LinkColumns,
    Preparation,
    SourceTable,
    links_from_table,
    measured_links,
)
from calibray.measurements.placement import join_track
from calibray.measurements.preparation import Track

FRAME = Frame.local(11.5755, 48.1374, height=515.0)
RX = np.array([[0.0, 0.0, 1.5], [120.0, -35.5, 2.0]])


@pytest.fixture
def log():
    """Two rows of a log with positions in degrees, one site."""
    longitude, latitude, height = FRAME.to_geographic(RX).T
    rows = {"lon": longitude, "lat": latitude, "alt": height, "above": [1.5, 2.0], "rsrp": [-80.0, -90.0]}
    return SourceTable(pd.DataFrame(rows), np.array([2, 5]), "log.csv")


def columns(height="alt", **changes):
    return LinkColumns((11.5755, 48.1374, 525.0), ("lon", "lat", height), "rsrp", "rsrp", **changes)


def test_degrees_become_metres_in_the_scene(log):
    links = measured_links(log, columns(), Preparation(frame=FRAME))
    np.testing.assert_allclose(links.rx, RX, atol=1e-3)
    np.testing.assert_allclose(links.tx[0], [0.0, 0.0, 10.0], atol=1e-3)
    np.testing.assert_array_equal(links.frame[["rx_x", "rx_y", "rx_z"]], links.rx)
    assert links.row.tolist() == [2, 5]
    # The offset absorbs the unknown transmitted power.
    assert links.path_loss_db.tolist() == [80.0, 90.0]


@pytest.mark.parametrize("frame", [FRAME, None], ids=["degrees", "metres"])
def test_heights_may_count_from_the_ground(log, frame):
    if frame is None:
        log = log.assign(lon=RX[:, 0], lat=RX[:, 1]).assign(x=RX[:, 0], y=RX[:, 1])
    described = (
        columns("above") if frame else LinkColumns((1.0, 0.0, 525.0), ("x", "y", "above"), "rsrp", "rsrp")
    )
    links = measured_links(log, described, Preparation(frame=frame, ground=lambda x, y: 0.1 * x + 3.0))
    np.testing.assert_allclose(links.rx[:, 2], [4.5, 17.0], atol=1e-3)


def test_positions_off_the_globe_name_the_file_and_the_end(log):
    with pytest.raises(InputError, match=r"log\.csv: rx: latitude of row 5 is 515, must be -90 to 90"):
        measured_links(log.assign(lat=[48.1, 515.0]), columns(), Preparation(frame=FRAME))
    with pytest.raises(InputError, match=r"log\.csv: no column 'hight'"):
        measured_links(log, columns("hight"), Preparation(frame=FRAME))


@pytest.mark.parametrize(
    ("inside", "rows", "x", "changes"),
    [
        (None, [2, 5], [0.0, 120.0], {}),
        ("drop", [2], [0.0], {"receivers inside buildings, left out": 1}),
        ("move", [2, 5], [0.0, 130.0], {"receivers inside buildings, moved out": 1}),
    ],
)
def test_receivers_inside_buildings(log, inside, rows, x, changes):
    def outside(positions):
        covered = positions[:, 0] > 100
        return positions + np.outer(covered, [10.0, 0.0, 0.0]), 10.0 * covered

    links = measured_links(log, columns(), Preparation(frame=FRAME, inside=inside, outside=outside))
    assert links.row.tolist() == rows
    np.testing.assert_allclose(links.rx[:, 0], x, atol=1e-3)
    assert links.prepared == changes


def test_receivers_deep_inside_buildings_are_left_out(log):
    def outside(positions):
        return np.where(positions[:, :1] > 100, np.nan, positions), np.where(
            positions[:, 0] > 100, np.inf, 0.0
        )

    links = measured_links(log, columns(), Preparation(frame=FRAME, inside="move", outside=outside))
    assert links.prepared == {"receivers deep inside buildings, left out": 1}


def test_averages_are_placed_before_buildings_are_cleared():
    """Two samples, one of them under a roof, whose mean position is outside."""
    table = SourceTable(pd.DataFrame({"x": [1.0, 4.0], "p": [-80.0, -80.0]}))
    steps = Preparation(
        averaging=Averaging("cell", 5.0),
        inside="drop",
        outside=lambda positions: (positions, np.where(positions[:, 0] > 3, 1.0, 0.0)),
    )
    links = measured_links(table, LinkColumns((9.0, 9.0, 9.0), ("x", 0.0, 1.5), "p", "rsrp"), steps)
    assert links.rx[:, 0].tolist() == [2.5]


def test_rows_without_another_step_than_a_filter_keep_their_columns(log):
    described = LinkColumns((9.0, 9.0, 9.0), ("above", "above", 0.0), "rsrp", "rsrp")
    links = measured_links(log, described, Preparation(where="rsrp > -85"))
    assert links.frame.columns.tolist() == log.frame.columns.tolist()
    assert links.row.tolist() == [2]


def test_censored_links_are_marked_and_limited(log):
    steps = Preparation(frame=FRAME, noise_floor_dbm=-85.0, censored=True)
    described = LinkColumns(
        (11.5755, 48.1374, 525.0), ("lon", "lat", "alt"), "rsrp", "received_power", tx_power_dbm=30.0
    )
    links = measured_links(log, described, steps)
    assert links.censored.tolist() == [False, True]
    assert links.path_loss_db.tolist() == [110.0, 115.0]
    assert links.limit_db.tolist() == [115.0, 115.0]
    assert measured_links(log, columns(), Preparation(frame=FRAME)).censored is None


def test_links_to_predict_at_are_placed_like_measured_ones(log):
    sites = SourceTable(pd.DataFrame({"site": ["a"], "up": [525.0]}))
    steps = Preparation(frame=FRAME, transmitters=sites, transmitter="site")
    links = links_from_table(
        log.assign(site="a"), "site", steps=steps, tx=(11.5755, 48.1374, "up"), rx=("lon", "lat", "alt")
    )
    np.testing.assert_allclose(links.rx, RX, atol=1e-3)
    np.testing.assert_allclose(links.tx[0], [0.0, 0.0, 10.0], atol=1e-3)
    assert links.group_names == ("a",)
    assert not links.measured


def test_a_missing_height_of_a_transmitter_is_named_in_its_own_table(log):
    sites = SourceTable(pd.DataFrame({"site": ["a", "b"], "up": [525.0, np.nan]}), source="sites.csv")
    steps = Preparation(frame=FRAME, transmitters=sites, transmitter="site")
    placed = (11.5755, 48.1374, "up")
    message = (
        r"^sites\.csv: column 'up' has missing or non-finite values for site b \(1 of 2 rows of log\.csv\)"
    )
    with pytest.raises(InputError, match=message):
        links_from_table(
            log.assign(site=["a", "b"]), "site", steps=steps, tx=placed, rx=("lon", "lat", "alt")
        )


def test_a_group_without_a_usable_row_is_named(log):
    rows = log.assign(cell=["east", "west"], rsrp=[-80.0, -130.0])
    steps = Preparation(frame=FRAME, noise_floor_dbm=-120.0)
    links = measured_links(rows, columns(group="cell"), steps)
    assert links.prepared["rows of cell west, none of which is used"] == 1
    # Rows that the user's filter leaves out are not missed.
    wanted = measured_links(rows, columns(group="cell"), replace(steps, where="cell == 'east'"))
    assert not any("none of which is used" in change for change in wanted.prepared)


@pytest.mark.parametrize("year", ["0001", "1500", "2500", "9999"])
def test_a_track_of_another_age_is_refused(tmp_path, year):
    points = "".join(
        f'<trkpt lon="11" lat="48"><time>{time}-01-01T00:00:00Z</time></trkpt>' for time in ("2020", year)
    )
    (tmp_path / "walk.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    rows = SourceTable(pd.DataFrame({"time": ["2020-01-01T00:00:01Z"]}))
    with pytest.raises(InputError, match=r"walk\.gpx: a time is not in ISO 8601 or is out of range"):
        join_track(rows, Track(str(tmp_path / "walk.gpx"), "time"))


def test_rows_of_one_transmitter_in_two_spellings_are_averaged_together():
    log = pd.DataFrame({"cell": ["A-1", "a:1", "B"], "x": [10.0, 10.0, 10.0], "loss": [80.0, 90.0, 85.0]})
    sites = SourceTable(pd.DataFrame({"name": ["A-1", "b"], "z": [20.0, 30.0]}))
    steps = Preparation(transmitters=sites, transmitter="cell", averaging=Averaging("place"))
    described = LinkColumns((0.0, 0.0, "z"), ("x", 0.0, 1.5), "loss", group="cell")
    links = measured_links(SourceTable(log), described, steps)
    assert links.path_loss_db == pytest.approx([82.596, 85.0], abs=1e-3)
    assert links.group.tolist() == ["A-1", "b"]
    assert links.prepared == {"samples averaged": 3}
