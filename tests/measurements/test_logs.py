"""Logs as they come: averages in closed form, tracks joined by time, wide tables, RSRP, noise floors, Excel."""

from __future__ import annotations

import sys
import zipfile
from datetime import datetime

import numpy as np
import openpyxl
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import excel as workbooks
from calibray.measurements.averaging import averaged, by_cell, by_distance, by_time
from calibray.measurements.geographic import joined_by_time, read_track
from calibray.measurements.received_power import (
    LTE_RESOURCE_BLOCKS,
    long_table,
    marked_censored,
    noise_floor_dbm,
    total_power_dbm,
    with_transmitters,
)
from calibray.measurements.table_files import read_table

# Averages


def test_rayleigh_fading_averages_to_its_mean_power():
    """Power is exponential: mean 1 by its power, -2.51 dB by its decibels, standard deviation 5.57 dB."""
    power = -90.0 + 10 * np.log10(np.random.default_rng(0).exponential(size=200_000))
    rows = pd.DataFrame({"rx_x": np.zeros(len(power)), "rx_y": 0.0, "power": power})
    (mean,) = averaged(rows, "power", by_cell(rows, 5.0), "power").to_dict("records")
    assert mean["power"] == pytest.approx(-90.0, abs=0.05)
    assert power.mean() == pytest.approx(-92.51, abs=0.05)
    assert mean["std_db"] == pytest.approx(5.57, abs=0.05)
    assert mean["count"] == 200_000


def test_powers_and_losses_average_alike():
    rows = pd.DataFrame(
        {"rx_x": [0.0, 0.5, 7.0], "rx_y": 0.0, "rx_z": [1.0, 2.0, 1.0], "power": [-80.0, -90.0, -70.0]}
    )
    rows["loss"] = 30.0 - rows["power"]
    cells = by_cell(rows, 5.0)
    power, loss = averaged(rows, "power", cells, "power"), averaged(rows, "loss", cells, "loss")
    expected = 10 * np.log10((1e-8 + 1e-9) / 2)
    np.testing.assert_allclose(power["power"], [expected, -70.0])
    np.testing.assert_allclose(loss["loss"], 30.0 - power["power"])
    np.testing.assert_allclose(power["rx_x"], [0.25, 7.0])
    np.testing.assert_allclose(power["rx_z"], [1.5, 1.0])
    np.testing.assert_allclose(power["std_db"], [np.sqrt(50.0), np.nan])
    assert power["count"].tolist() == [2, 1]


def test_powers_below_the_smallest_number_still_average():
    rows = pd.DataFrame({"rx_x": [0.0, 0.0], "rx_y": 0.0, "power": [-5000.0, -5000.0]})
    assert averaged(rows, "power", by_cell(rows, 1.0), "power")["power"].tolist() == [-5000.0]


def test_no_average_crosses_transmitters():
    rows = pd.DataFrame(
        {"rx_x": [0.0] * 4, "rx_y": 0.0, "cell": ["b", "a", "b", "a"], "power": [-60.0, -80, -60, -90]}
    )
    mean = averaged(rows, "power", by_cell(rows, 5.0), "power", keep=["cell"])
    assert mean["cell"].tolist() == ["b", "a"]
    assert mean["power"].tolist() == pytest.approx([-60.0, -82.596], abs=1e-3)
    assert mean["count"].tolist() == [2, 2]


def test_cells_stretches_and_windows():
    times = ["10:00:00Z", "10:00:04Z", "12:00:05+02:00", "10:01:00Z"]
    rows = pd.DataFrame(
        {"rx_x": [-0.1, 0.1, 9.9, 10.1], "rx_y": 1.0, "t": [f"2026-05-01T{time}" for time in times]}
    )
    assert by_cell(rows, 10.0).tolist() == [0, 1, 1, 2]
    assert by_distance(rows, 10.0).tolist() == [0, 0, 1, 1]
    assert by_time(rows, 5.0, "t").tolist() == [0, 0, 1, 12]
    for label in (by_cell(rows, np.float64(3.0)), by_distance(rows, 1e9)):
        assert len(label) == 4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda rows: by_cell(rows, 0.0), "width = 0.0"),
        (lambda rows: by_distance(rows, -1.0), "length = -1.0"),
        (lambda rows: by_time(rows, 1.0, "t"), "a time cannot be read"),
        (lambda rows: by_cell(rows, 1.0, ("x", "rx_y")), "no column 'x'"),
        (lambda rows: averaged(rows, "power", np.zeros(3), "power"), "labels for 2 rows"),
        (lambda rows: averaged(rows, "rsrp", np.zeros(2), "power"), "no column 'rsrp'"),
        (lambda rows: averaged(rows.assign(power=[-80, np.nan]), "power", np.zeros(2), "power"), "missing"),
    ],
)
def test_what_cannot_be_averaged_is_refused(call, message):
    rows = pd.DataFrame(
        {"rx_x": [0.0, 1.0], "rx_y": [0.0, 1.0], "t": ["noon", "one"], "power": [-80.0, -81.0]}
    )
    with pytest.raises(InputError, match=message):
        call(rows)


# Tracks


def gpx(points: str, head: str = "") -> str:
    return (
        f'<?xml version="1.0"?>{head}<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
        '<wpt lat="1" lon="1"/>'
        f"<trk><trkseg>{points}</trkseg></trk></gpx>"
    )


def point(longitude: float, latitude: float, seconds: int, height: str = "") -> str:
    return (
        f'<trkpt lat="{latitude}" lon="{longitude}">{height}'
        f"<time>2026-05-01T10:00:{seconds:02d}Z</time></trkpt>"
    )


def test_a_log_is_joined_with_its_track(tmp_path):
    path = tmp_path / "walk.gpx"
    height = "<ele>520.0</ele>"
    path.write_text(
        gpx(point(11.2, 48.1, 10, height) + point(11.0, 48.0, 0, height) + point(11.4, 48.1, 40, height))
    )
    track = read_track(path)
    assert track["longitude"].tolist() == [11.0, 11.2, 11.4]
    log = pd.DataFrame(
        {
            "time": ["2026-05-01T10:00:00Z", "2026-05-01T12:00:05+02:00", "2026-05-01T10:00:20Z", None],
            "rsrp": [-80.0, -81.0, -82.0, -83.0],
        }
    )
    joined, lost = joined_by_time(log, track, "time")
    # Ten to forty is a gap of 30 s, longer than the 10 s allowed; the last row has no time.
    assert lost == 2
    np.testing.assert_allclose(joined[["track_longitude", "track_latitude"]], [[11.0, 48.0], [11.1, 48.05]])
    assert joined["rsrp"].tolist() == [-80.0, -81.0]
    assert joined["track_height"].tolist() == [520.0, 520.0]
    assert joined_by_time(log, track, "time", longest_gap=30.0)[1] == 1
    seconds = pd.DataFrame({"time": [pd.Timestamp("2026-05-01T10:00:08Z").timestamp()]})
    late, _ = joined_by_time(seconds, track, "time", clock=3.0)
    np.testing.assert_allclose(late["track_longitude"], [11.1])


def test_a_track_across_the_date_line(tmp_path):
    path = tmp_path / "sail.gpx"
    path.write_text(gpx(point(179.9, 0, 0) + point(-179.9, 0, 10)))
    log = pd.DataFrame({"time": ["2026-05-01T10:00:05Z", "2026-05-01T10:00:10Z"]})
    joined, _ = joined_by_time(log, read_track(path), "time")
    np.testing.assert_allclose(np.abs(joined["track_longitude"]), [180.0, 179.9])
    assert joined["track_height"].isna().all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (gpx(point(1, 1, 0), '<!DOCTYPE gpx [<!ENTITY a "aaaa">]>'), "declares a document type"),
        (gpx(point(1, 1, 0)).encode("utf-16").decode("latin-1"), "not UTF-8|document type"),
        (gpx(""), "no track point"),
        (gpx('<trkpt lat="1" lon="1"/>'), "no track point"),
        (gpx('<trkpt lat="x" lon="1"/>'), "a point is malformed"),
        (gpx('<trkpt lat="1" lon="1"><time>noon</time></trkpt>'), "not ISO 8601"),
        ("<gpx", "not well-formed"),
    ],
)
def test_a_track_that_cannot_be_used_is_refused(tmp_path, text, message):
    path = tmp_path / "walk.gpx"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=message):
        read_track(path)


def test_a_log_beside_its_track_is_refused(tmp_path):
    path = tmp_path / "walk.gpx"
    path.write_text(gpx(point(1, 1, 0) + point(1, 1, 9)))
    track = read_track(path)
    with pytest.raises(InputError, match="none of 1 times lies on the track"):
        joined_by_time(pd.DataFrame({"time": ["2026-05-01T12:00:05"]}), track, "time")
    with pytest.raises(InputError, match="a time cannot be read"):
        joined_by_time(pd.DataFrame({"time": ["noon"]}), track, "time")
    with pytest.raises(InputError, match="does not exist"):
        read_track(tmp_path / "nowhere.gpx")


# Tables and powers


def test_a_wide_table_gets_its_transmitters():
    wide = pd.DataFrame({"room": ["a", "b"], "ap1": [-40.0, np.nan], "ap2": ["-50", "-61"]})
    long = long_table(wide, {"ap1": "one", "ap2": "two"}, "rss")
    assert long.to_dict("list") == {
        "room": ["a", "a", "b"], "transmitter": ["one", "two", "two"], "rss": [-40.0, -50.0, -61.0],
    }  # fmt: skip
    places = pd.DataFrame({"transmitter": ["two", "one"], "tx_x": [5.0, 1.0]})
    assert with_transmitters(long, places)["tx_x"].tolist() == [1.0, 5.0, 5.0]
    with pytest.raises(InputError, match="transmitter 'two' is not known"):
        with_transmitters(long, places.iloc[1:])
    with pytest.raises(InputError, match="stands twice"):
        with_transmitters(long, pd.concat([places, places]))


@pytest.mark.parametrize(
    ("columns", "value", "message"),
    [
        ({"ap3": "x"}, "rss", "no column 'ap3'"),
        ({"ap1": "x", "ap2": "x"}, "rss", "two columns have one transmitter"),
        ({"ap1": "x"}, "room", "has a column 'room' already"),
        ({"room": "x"}, "rss", "'a' is not a number"),
        ({"ap2": "x"}, "rss", "no value"),
    ],
)
def test_a_wide_table_that_does_not_fit_is_refused(columns, value, message):
    wide = pd.DataFrame({"room": ["a"], "ap1": [-40.0], "ap2": [np.nan]})
    with pytest.raises(InputError, match=message):
        long_table(wide, columns, value)


def test_rsrp_is_the_power_of_one_resource_element():
    # 20 MHz: 1200 resource elements of one power.
    elements = np.full(1200, 10 ** (-95.0 / 10))
    assert total_power_dbm(-95.0, LTE_RESOURCE_BLOCKS[20e6]) == pytest.approx(10 * np.log10(elements.sum()))
    with pytest.raises(InputError, match="must be 1 or more"):
        total_power_dbm(-95.0, 0)


def test_the_noise_floor_is_minus_174_dbm_a_hertz():
    assert noise_floor_dbm(1.0, 0.0) == pytest.approx(-173.975, abs=1e-3)
    assert noise_floor_dbm(20e6, 7.0) == pytest.approx(-173.975 + 73.0103 + 7.0, abs=1e-3)
    with pytest.raises(InputError, match="greater than 0"):
        noise_floor_dbm(0.0, 7.0)


def test_values_at_the_floor_are_marked():
    rows = pd.DataFrame({"power": [-100.0, -120.0, -119.9, np.nan]})
    marked = marked_censored(rows, "power", -120.0)
    assert marked["censored"].tolist() == [False, True, False, True]
    assert marked["power"].tolist() == [-100.0, -120.0, -119.9, -120.0]
    assert rows["power"].isna().sum() == 1
    with pytest.raises(InputError, match="finite"):
        marked_censored(rows, "power", np.nan)


def test_an_excel_sheet_is_read_like_a_table(tmp_path, monkeypatch):
    path = tmp_path / "links.xlsx"
    pd.DataFrame({"x": [1.0, np.nan, 3.0], "loss": [80.0, np.nan, 82.5]}).to_excel(path, index=False)
    table = read_table(path)
    assert table.frame.to_dict("list") == {"x": [1.0, 3.0], "loss": [80.0, 82.5]}
    assert table.row.tolist() == [2, 4]
    pd.DataFrame([[1, 2]], columns=["x", "x"]).to_excel(path, index=False)
    with pytest.raises(InputError, match="column 'x' stands twice"):
        read_table(path)
    path.write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="not an Excel file"):
        read_table(path)
    path.unlink()
    pd.DataFrame({"x": [1.0]}).to_excel(path, index=False)
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(InputError, match=r"pip install 'calibray\[excel\]'"):
        read_table(path)


def workbook(path, rows, change=lambda sheet: None):
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    change(book.active)
    book.save(path)
    return path


SHEET = [["x", "loss"], [10.0, 80.25], [20.0, 81.5], [30.0, 0.1]]


def test_a_workbook_is_read_as_a_csv_file_of_the_same_cells(tmp_path):
    rows = [["x ", "loss", "note"], [1, 80.1, "NA"], [], [2, None, 'a\nb, "c"'], [3.5, "81.5", True]]
    table = read_table(workbook(tmp_path / "links.xlsx", rows))
    (tmp_path / "links.csv").write_text('x ,loss,note\n1,80.1,NA\n\n2,,"a\nb, ""c"""\n3.5,81.5,True\n')
    plain = read_table(tmp_path / "links.csv")
    pd.testing.assert_frame_equal(table.frame, plain.frame)
    assert table.row.tolist() == [2, 4, 5]


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (datetime(2026, 5, 1), r"row 3, column 'loss': '2026-05-01 00:00:00' is not a number"),
        ("=B2+1", r"row 3, column 'loss': '=B2\+1' is not a number"),
        ("#DIV/0!", r"row 3, column 'loss': '#DIV/0!' is not a number"),
        (None, r"column 'loss' is missing or not finite in 1 of 3 rows \(row 3\)"),
    ],
    ids=["date", "formula", "error", "gap"],
)
def test_a_cell_that_is_no_number_is_told(tmp_path, cell, message):
    """A formula that no spreadsheet computed has no value: in a log, it must not count as not heard."""
    path = workbook(tmp_path / "links.xlsx", SHEET, lambda sheet: setattr(sheet["B3"], "value", cell))
    with pytest.raises(InputError, match=message):
        read_table(path).numbers("loss")


def test_a_value_far_out_or_beside_the_table_is_told(tmp_path):
    for change in (
        lambda sheet: sheet.cell(1_048_576, 16_384, 1.0),
        lambda sheet: sheet.cell(3, 4, "remark"),
        lambda sheet: (sheet.insert_rows(1), sheet.cell(1, 1, "Monday")),
    ):
        with pytest.raises(InputError, match=r"row \d+: .* stands in column \d+, which has no name in row 1"):
            read_table(workbook(tmp_path / "links.xlsx", SHEET, change))


def test_a_row_far_below_is_read(tmp_path):
    path = workbook(tmp_path / "links.xlsx", SHEET, lambda sheet: sheet.cell(1_048_576, 1, 40.0))
    assert read_table(path).row.tolist() == [2, 3, 4, 1_048_576]


@pytest.mark.parametrize("row", [b"99999999999", b"2", b"1e3", b"0"])
def test_rows_out_of_order_are_refused(tmp_path, row):
    """openpyxl would fill the gap with rows for hours, or leave out the row whose number comes again."""
    path = workbook(tmp_path / "links.xlsx", SHEET)
    with zipfile.ZipFile(path) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    parts[sheet] = parts[sheet].replace(b'<row r="3"', b'<row r="%s"' % row)
    with zipfile.ZipFile(path, "w") as new:
        for name, content in parts.items():
            new.writestr(name, content)
    with pytest.raises(InputError, match=r"links\.xlsx: not an Excel file \(row '.*' follows row 2\)"):
        read_table(path)


def test_a_workbook_that_unpacks_to_more_than_can_be_read_is_refused(tmp_path, monkeypatch):
    path = workbook(tmp_path / "links.xlsx", SHEET)
    monkeypatch.setattr(workbooks, "UNPACKED", 1000)
    with pytest.raises(InputError, match="MiB unpacked"):
        read_table(path)
    monkeypatch.setattr(workbooks, "UNPACKED", 2**28)
    monkeypatch.setattr(workbooks, "CELLS", 5)
    with pytest.raises(InputError, match="more than 5 cells"):
        read_table(path)
