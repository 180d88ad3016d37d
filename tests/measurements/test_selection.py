"""Rows become links: wide tables, tracks, filters, transmitters and the noise floor."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import Preparation, SourceTable, Track, select_rows

WIDE = pd.DataFrame({"room": ["a", "b"], "ap1": [-40.0, np.nan], "ap2": ["-50", "-61"]})


def test_a_wide_table_becomes_one_row_per_link():
    table = SourceTable(WIDE, np.array([2, 4]), "rss.csv")
    long = select_rows(table, Preparation({"ap1": "one", "ap2": "two"}), "rss")
    assert long.frame.to_dict("list") == {
        "room": ["a", "a", "b"], "transmitter": ["one", "two", "two"], "rss": [-40.0, -50.0, -61.0],
    }  # fmt: skip
    assert long.row.tolist() == [2, 2, 4]
    assert long.changes == {"cells without a value": 1}


@pytest.mark.parametrize(
    ("columns", "value", "message"),
    [
        ({"ap3": "x"}, "rss", "no column 'ap3'"),
        ({"ap1": "x", "ap2": "x"}, "rss", "two columns have the same transmitter"),
        ({"ap1": "x"}, "room", "column 'room' already exists"),
        ({"room": "x"}, "rss", "row 1, column 'room': 'a' is not a number"),
        ({"empty": "x"}, "rss", "the columns empty contain no value"),
    ],
)
def test_wide_columns_that_do_not_fit_are_refused(columns, value, message):
    with pytest.raises(InputError, match=message):
        select_rows(SourceTable(WIDE.assign(empty=None)), Preparation(columns), value)


def test_links_get_the_columns_of_their_transmitters():
    links = SourceTable(
        pd.DataFrame({"transmitter": ["one", "two", "one"], "x": [7.0, 8.0, 9.0]}), source="log.csv"
    )
    sites = pd.DataFrame({"transmitter": ["two", "one"], "x": [5.0, 1.0], "z": [20.0, 30.0]})
    joined = select_rows(links, Preparation(transmitters=SourceTable(sites))).frame
    assert joined["z"].tolist() == [30.0, 20.0, 30.0]
    # The links' own column keeps its name.
    assert joined["x"].tolist() == [7.0, 8.0, 9.0]
    assert joined["transmitter_x"].tolist() == [1.0, 5.0, 1.0]
    for rows, message in (
        (sites.iloc[1:], "log.csv: sites.csv lacks 'two', the transmitter of 1 of 3 rows; use one of: one"),
        (sites.iloc[:0], r"'one', 'two', .*where = \"`transmitter` not in \['one', 'two'\]\""),
        (
            pd.concat([sites, sites.assign(z=1.0)]),
            "sites.csv: 'two' appears in rows 1, 3 of column 'transmitter'",
        ),
        (sites.drop(columns="transmitter"), "sites.csv: no column 'transmitter'"),
    ):
        with pytest.raises(InputError, match=message):
            select_rows(links, Preparation(transmitters=SourceTable(rows, source="sites.csv")))


@pytest.mark.parametrize("table", ["log", "sites"])
def test_a_column_of_transmitters_whose_new_name_exists_is_refused(table):
    log, sites = pd.DataFrame({"cell": ["a"], "x": [7.0]}), pd.DataFrame({"cell": ["a"], "x": [5.0]})
    log, sites = (log.assign(cell_x=1.0), sites) if table == "log" else (log, sites.assign(cell_x=1.0))
    steps = Preparation(transmitters=SourceTable(sites, source="sites.csv"), transmitter="cell")
    with pytest.raises(
        InputError, match=r"sites\.csv: column 'x' would become 'cell_x', because log\.csv .* rename"
    ):
        select_rows(SourceTable(log, source="log.csv"), steps)


def test_powers_at_or_below_the_noise_floor_are_left_out_or_set_to_it():
    rows = SourceTable(pd.DataFrame({"power": [-100.0, -120.0, -119.9, np.nan, -130.0]}))
    left = select_rows(rows, Preparation(noise_floor_dbm=-120.0), "power")
    assert left.frame["power"].tolist() == [-100.0, -119.9]
    assert left.row.tolist() == [1, 3]
    assert left.changes == {"at or below the noise floor, left out": 3}
    censored = select_rows(rows, Preparation(noise_floor_dbm=-120.0, censored=True), "power")
    assert censored.frame["power"].tolist() == [-100.0, -120.0, -119.9, -120.0, -120.0]
    assert censored.changes == {"at or below the noise floor, treated as censored": 3}
    assert rows.frame["power"].isna().sum() == 1
    with pytest.raises(InputError, match="no row remains"):
        select_rows(rows, Preparation(noise_floor_dbm=-10.0), "power")


# Tracks


def gpx(points: str, head: str = "") -> str:
    return (
        f'<?xml version="1.0"?>{head}<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
        '<wpt lat="1" lon="1"/>'
        f"<trk><trkseg>{points}</trkseg></trk></gpx>"
    )


def point(longitude: float, latitude: float, seconds: int) -> str:
    return (
        f'<trkpt lat="{latitude}" lon="{longitude}"><ele>520.0</ele>'
        f"<time>2026-05-01T10:00:{seconds:02d}Z</time></trkpt>"
    )


@pytest.fixture
def join(tmp_path):
    """Join rows at times with a track; its text is written first."""

    def join(text: str, times: list, **track) -> SourceTable:
        file = tmp_path / "walk.gpx"
        file.write_bytes(text.encode("latin-1"))
        rows = SourceTable(pd.DataFrame({"time": times}), source="log.csv")
        return select_rows(rows, Preparation(track=Track(str(file), "time", **track)))

    return join


def test_rows_get_positions_between_the_points_of_a_track(join):
    track = gpx(point(11.2, 48.1, 10) + point(11.0, 48.0, 0) + point(11.4, 48.1, 40))
    times = ["2026-05-01T10:00:00Z", "2026-05-01T12:00:05+02:00", "2026-05-01T10:00:20Z", None]
    joined = join(track, times)
    # Between 10 s and 40 s the gap is longer than the 10 s allowed; the last row has no time.
    assert joined.row.tolist() == [1, 2]
    assert joined.changes == {"rows without a position on the track, left out": 2}
    np.testing.assert_allclose(
        joined.frame[["track_longitude", "track_latitude"]], [[11.0, 48.0], [11.1, 48.05]]
    )
    assert join(track, times, longest_gap=30.0).row.tolist() == [1, 2, 3]
    seconds = pd.Timestamp("2026-05-01T10:00:08Z").timestamp()
    late = join(track, [seconds], clock=3.0)
    np.testing.assert_allclose(late.frame["track_longitude"], [11.1])


def test_a_track_may_cross_180_degrees(join):
    times = ["2026-05-01T10:00:05Z", "2026-05-01T10:00:10Z"]
    joined = join(gpx(point(179.9, 0, 0) + point(-179.9, 0, 10)), times)
    np.testing.assert_allclose(np.abs(joined.frame["track_longitude"]), [180.0, 179.9])


def test_a_filter_sees_the_columns_of_a_track(tmp_path):
    (tmp_path / "walk.gpx").write_text(gpx(point(1, 1, 0) + point(3, 1, 9)))
    rows = SourceTable(pd.DataFrame({"time": ["2026-05-01T10:00:00Z", "2026-05-01T10:00:09Z"]}))
    steps = Preparation(track=Track(str(tmp_path / "walk.gpx"), "time"), where="track_longitude > 2")
    assert select_rows(rows, steps).row.tolist() == [2]


@pytest.mark.parametrize(
    ("text", "times", "message"),
    [
        (gpx(point(1, 1, 0), '<!DOCTYPE gpx [<!ENTITY a "aaaa">]>'), None, "declares a document type"),
        (gpx(point(1, 1, 0)).encode("utf-16").decode("latin-1"), None, "not UTF-8"),
        (gpx(""), None, "no track point has a time"),
        (gpx('<trkpt lat="1" lon="1"/>'), None, "no track point has a time"),
        (gpx('<trkpt lat="x" lon="1"/>'), None, "a point is malformed"),
        (gpx('<trkpt lat="1" lon="1"><time>noon</time></trkpt>'), None, "not in ISO 8601"),
        ("<gpx", None, "not well-formed"),
        (
            gpx(point(1, 1, 0) + point(1, 1, 9)),
            "2026-05-01T12:00:05",
            "no time in column 'time' lies on the track",
        ),
        (gpx(point(1, 1, 0)), "noon", "log.csv, column 'time': a time cannot be read"),
        (gpx(point(1, 1, 0) + point(1, 1, 9)), "2026-05-01", "column 'time': contains dates without times"),
    ],
)
def test_tracks_and_times_that_do_not_fit_are_refused(join, text, times, message):
    with pytest.raises(InputError, match=message):
        join(text, [times or "2026-05-01T10:00:00Z"])


def test_a_time_zone_with_which_more_rows_lie_on_the_track_is_named(join):
    minutes = pd.date_range("2026-05-01T10:00", "2026-05-01T12:00", freq="min")
    track = gpx(
        "".join(
            f'<trkpt lat="48" lon="{11 + k / 1000}"><time>{minute.isoformat()}Z</time></trkpt>'
            for k, minute in enumerate(minutes)
        )
    )
    note = "rows without a position on the track, left out"
    local = [str(minute + pd.Timedelta(minutes=45)) for minute in minutes]
    joined = join(track, local, longest_gap=60.0)
    assert joined.changes == {f"{note}; links.track.clock = 2700 would keep more of them": 45}
    # With that clock, every row has the position at its time.
    right = join(track, local, longest_gap=60.0, clock=2700.0)
    np.testing.assert_allclose(right.frame["track_longitude"], 11 + np.arange(121) / 1000)
    assert not right.changes
    # Rows before the track have no position with any clock: a recorder that started late.
    early = [str(minute - pd.Timedelta(minutes=20)) for minute in minutes]
    assert join(track, [*early, *local[-70:]], longest_gap=60.0).changes == {note: 65}
    with pytest.raises(
        InputError,
        match=r"with links\.track\.clock = 7260, some times would lie on the track; check the time zone",
    ):
        join(track, [str(minutes[-1] + pd.Timedelta(hours=2))], longest_gap=60.0, clock=60.0)


def test_the_fraction_of_a_second_may_follow_a_comma(join):
    track = gpx(point(11.0, 48.0, 0) + point(11.1, 48.0, 10))
    joined = join(track, ["2026-05-01 10:00:02,500", "2026-05-01 10:00:05"])
    np.testing.assert_allclose(joined.frame["track_longitude"], [11.025, 11.05])


def test_a_missing_track_is_named():
    steps = Preparation(track=Track("nowhere.gpx", "time"))
    with pytest.raises(InputError, match=r"nowhere\.gpx: does not exist"):
        select_rows(SourceTable(pd.DataFrame({"time": ["2026-05-01"]})), steps)
