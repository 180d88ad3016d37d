import sys
from decimal import Decimal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibray.errors import InputError
from calibray.measurements import (
    LinkColumns,
    Measurements,
    Preparation,
    SourceTable,
    links_from_table,
    measured_links,
    read_measurements,
    read_table,
    table_files,
)
from calibray.measurements.table_files import PiecedTable
from link_tables import links_from_frame

TABLE = """\
x,y,z,loss,set,spread
10,0,1.5,80.5,LOS,1
20,0,1.5,86.5,LOS,2
0,30,1.5,101.25,NLOS,4
0,40,1.5,110,NLOS,4
"""


def table_file(folder, text, name="links.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def read(folder, text=TABLE, **changes):
    arguments = {"tx": [0, 0, 10.0], "rx": ["x", "y", "z"], "value": "loss"} | changes
    return read_measurements(table_file(folder, text), **arguments)


def test_columns_and_constants_become_positions(tmp_path):
    links = read(tmp_path, rx=["x", "y", 1.75])
    np.testing.assert_array_equal(links.tx, np.tile([0, 0, 10.0], (4, 1)))
    np.testing.assert_array_equal(links.rx, [[10, 0, 1.75], [20, 0, 1.75], [0, 30, 1.75], [0, 40, 1.75]])
    np.testing.assert_array_equal(links.path_loss_db, [80.5, 86.5, 101.25, 110])
    np.testing.assert_array_equal(links.weight, 1)
    np.testing.assert_array_equal(links.row, [2, 3, 4, 5])
    np.testing.assert_allclose(links.distance[2], np.hypot(30, 8.25))
    assert links.measured
    assert links.group is None
    assert (links.group_names, links.group_index.tolist()) == (("",), [0, 0, 0, 0])


@pytest.mark.parametrize("quantity", ["path_gain", "received_power"])
def test_gains_and_received_powers_become_path_losses(tmp_path, quantity):
    frame = pd.read_csv(table_file(tmp_path, TABLE))
    frame["power"] = [30.0, 31.0, 32.0, 33.0]
    frame["measured"] = -frame["loss"] if quantity == "path_gain" else frame["power"] - frame["loss"]
    options = {"tx_power_dbm": "power"} if quantity == "received_power" else {}
    links = read(tmp_path, frame.to_csv(index=False), value="measured", quantity=quantity, **options)
    np.testing.assert_allclose(links.path_loss_db, frame["loss"], rtol=1e-15)


def test_the_transmitted_power_may_be_a_number(tmp_path):
    frame = pd.read_csv(table_file(tmp_path, TABLE)).assign(loss=lambda frame: 20 - frame["loss"])
    links = read(tmp_path, frame.to_csv(index=False), quantity="received_power", tx_power_dbm=20)
    np.testing.assert_allclose(links.path_loss_db, [80.5, 86.5, 101.25, 110])


def test_weights_and_standard_deviations(tmp_path):
    np.testing.assert_array_equal(read(tmp_path, weight="spread").weight, [1, 2, 4, 4])
    np.testing.assert_array_equal(read(tmp_path, std="spread").weight, [1, 1 / 4, 1 / 16, 1 / 16])
    np.testing.assert_array_equal(read(tmp_path, std=2.0).weight, 1 / 4)


def test_groups_are_sorted_labels_and_indices(tmp_path):
    links = read(tmp_path, group="spread")
    assert links.group_names == ("1", "2", "4")
    assert links.group_index.tolist() == [0, 1, 2, 2]
    assert read(tmp_path, group="set").group_names == ("LOS", "NLOS")


def test_a_gap_in_a_row_that_is_left_out_does_not_rename_numeric_groups(tmp_path):
    text = TABLE + "0,50,1.5,111,NLOS,\n"
    assert read(tmp_path, text, group="spread", where="y < 45").group_names == ("1", "2", "4")


def test_a_number_is_one_label_beside_fractions_and_alone():
    """Carriers of 0.9 and 26 GHz, and a table of new links at 26 GHz only."""
    every, one = (SourceTable(pd.DataFrame({"carrier [GHz]": values})) for values in ([0.9, 26.0], [26]))
    assert every.labels("carrier [GHz]").tolist() == ["0.9", "26"]
    assert one.labels("carrier [GHz]").tolist() == ["26"]


def test_labels_that_become_equal_when_joined_are_refused():
    table = SourceTable(pd.DataFrame({"g": ["a b", "a"], "k": ["c", "b c"]}), source="log.csv")
    with pytest.raises(
        InputError, match=r"log\.csv: columns g, k: \('a b', 'c'\) and \('a', 'b c'\) are .*'a b c'"
    ):
        table.labels(["g", "k"])


def test_filters_see_all_columns_and_keep_the_lines(tmp_path):
    links = read(tmp_path, where="set == 'NLOS' and spread > 3")
    assert links.row.tolist() == [4, 5]
    assert links.frame["loss"].tolist() == [101.25, 110]
    assert links.where("y == 40").tolist() == [False, True]


def test_rows_left_out_by_the_filter_may_be_faulty(tmp_path):
    text = TABLE + "0,50,1.5,broken,BAD,1\n"
    assert len(read(tmp_path, text, where="set != 'BAD'")) == 4
    with pytest.raises(InputError, match="row 6"):
        read(tmp_path, text)


def test_a_hold_out_filter_leaves_links_on_both_sides(tmp_path):
    links = read(tmp_path)
    assert links.held_out("x > 15 or y > 35").tolist() == [False, True, False, True]
    # The table names the positions x and y.
    assert links.held_out("rx_x > 15 or rx_y > 35").tolist() == [False, True, False, True]
    with pytest.raises(InputError, match="no link for the hold-out"):
        links.held_out("x > 1000")
    with pytest.raises(InputError, match="no link for calibration"):
        links.held_out("x < 1000")


@given(st.lists(st.booleans(), min_size=5, max_size=5).filter(any))
def test_selected_links_keep_all_their_values(mask):
    rng = np.random.default_rng(1)
    links = Measurements(
        rng.normal(size=(5, 3)), 9 + rng.normal(size=(5, 3)), np.arange(60, 65.0), group=list("abcab")
    )
    chosen = links.select(mask)
    indices = np.flatnonzero(mask)
    assert len(chosen) == len(indices)
    for name in ("tx", "rx", "path_loss_db", "weight", "group", "row", "distance"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(links, name)[indices])


def test_arrays_are_copied_and_read_only():
    losses = np.array([80.0])
    links = Measurements([[0, 0, 1]], [[9, 0, 1]], losses)
    losses[0] = 90.0
    assert links.path_loss_db[0] == 80.0
    with pytest.raises(ValueError, match="read-only"):
        links.path_loss_db[0] = 90.0


def test_parquet_reads_like_csv(tmp_path):
    from_csv = read(tmp_path, group="set")
    path = tmp_path / "links.parquet"
    from_csv.frame.to_parquet(path)
    links = read_measurements(path, [0, 0, 10.0], ["x", "y", "z"], "loss", group="set")
    for name in ("tx", "rx", "path_loss_db", "group"):
        np.testing.assert_array_equal(getattr(links, name), getattr(from_csv, name))
    assert links.row.tolist() == [1, 2, 3, 4]
    path.write_bytes(b"not parquet")
    with pytest.raises(InputError, match="not a Parquet file"):
        read_measurements(path, [0, 0, 10.0], ["x", "y", "z"], "loss")


def test_named_levels_of_the_index_of_a_parquet_file_are_columns(tmp_path):
    path, table = (
        tmp_path / "links.parquet",
        pd.DataFrame({"cell": ["a", "b"], "time": [7, 9], "x": [1.0, 2.0]}),
    )
    for indexed in (table.set_index("time"), table.set_index(["cell", "time"]), table.iloc[::-1], table):
        indexed.to_parquet(path)
        for read in (read_table(path), *PiecedTable.open(path).pieces(10)):
            pd.testing.assert_frame_equal(
                read.frame.sort_values("time", ignore_index=True), table, check_like=True
            )


def test_decimal_numbers_of_a_database_are_numbers(tmp_path):
    path, values = tmp_path / "links.parquet", [Decimal("1.25"), None, Decimal("-70.50")]
    pd.DataFrame({"x": values, "cell": [Decimal(5), Decimal(7), Decimal(5)]}).to_parquet(path)
    for table in (read_table(path), *PiecedTable.open(path).pieces(10)):
        np.testing.assert_array_equal(table.numbers("x", gaps=True), [1.25, np.nan, -70.5])
        assert table.labels("cell").tolist() == ["5", "7", "5"]
        assert table.where("x < 0").tolist() == [False, False, True]


def test_a_row_with_a_missing_value_does_not_pass_a_filter(tmp_path):
    frame = pd.read_csv(table_file(tmp_path, TABLE)).assign(mode=pd.array([4, None, 4, 1], dtype="Int64"))
    frame.to_parquet(tmp_path / "links.parquet")
    arguments = (tmp_path / "links.parquet", [0, 0, 10.0], ["x", "y", "z"], "loss")
    assert read_measurements(*arguments, where="mode == 4").row.tolist() == [1, 3]


def test_metadata_that_end_the_library_are_looked_at_in_another_process(tmp_path, monkeypatch):
    """Damaged histograms of levels abort pyarrow's process (fuzz suite, seed 612, case 605)."""
    path = tmp_path / "links.parquet"
    pd.DataFrame({"x": [1.0, 2.0]}).to_parquet(path)
    monkeypatch.setattr(table_files, "run_limited", lambda code, *_: "group.column" not in code)
    monkeypatch.setattr(pq, "ParquetFile", lambda *_, **__: pytest.fail("opened in this process"))
    with pytest.raises(
        InputError,
        match="the library that reads Parquet files crashes while reading this file; export it again",
    ):
        read_table(path)


@pytest.mark.parametrize("column", ["zeros", "text"])
def test_a_parquet_file_that_decompresses_to_gigabytes_is_refused_before_it_is_read(
    tmp_path, monkeypatch, column
):
    """A file of zeros, or of one word, is a thousandth of its size in memory; the limit is lower here."""
    monkeypatch.setattr("calibray.measurements.table_files.LARGEST_TABLE", 2**22)
    count = 200_000
    values = np.zeros(count) if column == "zeros" else ["word"] * count
    path = tmp_path / "links.parquet"
    pd.DataFrame({"x": values, "y": values, "z": values}).to_parquet(path, compression="zstd")
    assert path.stat().st_size < 10_000
    with pytest.raises(
        InputError, match=r"links\.parquet: the table takes 0\.0 GiB decompressed, which exceeds"
    ):
        read_table(path)
    # In pieces, a row group at a time is small enough.
    assert PiecedTable.open(path).rows == count


def test_a_row_group_that_decompresses_to_gigabytes_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "links.parquet"
    pd.DataFrame({"x": np.zeros(1000)}).to_parquet(path)
    monkeypatch.setattr("calibray.measurements.table_files.available_memory", lambda: 4000)
    with pytest.raises(InputError, match=r"a row group takes .* decompressed"):
        PiecedTable.open(path)


@pytest.mark.parametrize(
    ("read", "size", "rows"), [(read_table, 2**23, 12_000), (PiecedTable.open, 2**16, 10_000)]
)
def test_a_parquet_file_whose_rows_share_a_large_text_is_refused(tmp_path, monkeypatch, read, size, rows):
    """Kilobytes in the file, gigabytes in a piece, also of small row groups; nothing is decoded in this process."""
    index = pa.array(np.zeros(20_000, dtype=np.int32))
    column = pa.DictionaryArray.from_arrays(index, pa.array(["x" * size]))
    path = tmp_path / "links.parquet"
    pq.write_table(
        pa.table({"x": column}), path, store_schema=False, dictionary_pagesize_limit=2**30, compression="zstd",
        row_group_size=rows,
    )  # fmt: skip
    monkeypatch.setattr("calibray.measurements.table_files.DECODING_MEMORY", 2**30)
    before = pa.total_allocated_bytes()
    with pytest.raises(
        InputError, match=r"links\.parquet: the content takes more memory than the file declares"
    ):
        read(path)
    assert pa.total_allocated_bytes() - before < 2**24


def test_a_parquet_table_larger_than_its_limit_in_memory_is_refused(tmp_path, monkeypatch):
    """160 MB in memory that the file declares as 10 kB, at a limit of 64 MB."""
    column = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(20_000, dtype=np.int32)), pa.array(["x" * 2**13])
    )
    path = tmp_path / "links.parquet"
    pq.write_table(pa.table({"x": column}), path, store_schema=False, compression="zstd")
    monkeypatch.setattr("calibray.measurements.table_files.LARGEST_TABLE", 2**26)
    with pytest.raises(
        InputError, match=r"links\.parquet: the content takes more memory than the file declares"
    ):
        read_table(path)


def test_parquet_without_pyarrow_names_the_extra(tmp_path, monkeypatch):
    path = tmp_path / "links.parquet"
    path.write_bytes(b"")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'calibray\[parquet\]'"):
        read_measurements(path, [0, 0, 10.0], ["x", "y", "z"], "loss")


def test_blank_lines_and_line_breaks_in_quotes_do_not_shift_the_lines(tmp_path):
    text = 'x,y,z,loss,note\n\n10,0,1.5,80.5,"two\nlines"\n   \n20,0,1.5,86.5,\n0,30,1.5,bad,\n'
    with pytest.raises(InputError, match=r"links\.csv, row 7, column 'loss': 'bad' is not a number"):
        read(tmp_path, text)
    assert read(tmp_path, text, where="x > 0").row.tolist() == [3, 6]


def test_a_byte_order_mark_and_spaces_after_commas_are_ignored(tmp_path):
    text = "\ufeff" + TABLE.replace(",", ", ")
    np.testing.assert_array_equal(read(tmp_path, text, group="set").path_loss_db, [80.5, 86.5, 101.25, 110])


@pytest.mark.parametrize("separator", [";", "\t"])
def test_columns_may_be_separated_by_semicolons_or_tabs_with_decimal_commas(tmp_path, separator):
    plain = read(tmp_path, group="set", weight="spread")
    points = TABLE.replace(",", separator)
    for text in (points, points.replace(".", ",")):
        other = read(tmp_path, text, group="set", weight="spread")
        np.testing.assert_array_equal(other.path_loss_db, plain.path_loss_db)
        np.testing.assert_array_equal(other.rx, plain.rx)
        np.testing.assert_array_equal(other.weight, plain.weight)
    # A semicolon inside a quoted cell of a table with commas separates nothing.
    quoted = TABLE.replace("LOS", '"a;b"')
    np.testing.assert_array_equal(read(tmp_path, quoted).path_loss_db, plain.path_loss_db)


LATER = TABLE.splitlines()[1:]


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        # The file
        ("", {}, "contains no rows"),
        ("x,y,z,loss\n", {}, "contains no rows"),
        (TABLE + "1,2,3\n", {}, "row 6: 3 cells, but the header has 6"),
        (TABLE + "1,2,3,99,LOS,1,\n", {}, "row 6: 7 cells, but the header has 6"),
        (
            TABLE.replace(",", ";") + "0;50,5;1.5;99;LOS;1\n",
            {},
            r"a decimal comma in row 6 and a decimal point in row \d+; use the same mark throughout",
        ),
        (TABLE.replace("spread", "loss"), {}, "row 1: column 'loss' appears twice"),
        # Columns
        (TABLE, {"value": "los"}, "no column 'los'; did you mean 'loss'"),
        (TABLE, {"rx": ["x", "y", "hight"]}, "no column 'hight'; use one of: x, y, z, loss"),
        (TABLE, {"group": "sets"}, "no column 'sets'; did you mean 'set'"),
        (TABLE, {"weight": "wait"}, "no column 'wait'"),
        (TABLE, {"rx": ["x", "y"]}, r"rx = \['x', 'y'\]: must be x, y and z"),
        (TABLE, {"tx": "x"}, "tx = 'x': must be x, y and z"),
        (TABLE, {"tx": [0, 0, float("nan")]}, "nan must be a finite number"),
        (
            TABLE.replace("x,y", "rx_lon,rx_lat"),
            {"rx": ["rx_lon", "rx_lat", "z"]},
            "appears to be in degrees",
        ),
        # Values
        (
            TABLE + "0,50,1.5,,LOS,1\n",
            {},
            r"'loss' has missing or non-finite values in 1 of 5 rows \(row 6\).*`loss`\.notna\(\)\"$",
        ),
        (
            TABLE + "0,50,1.5,,LOS,1\n",
            {"quantity": "rsrp"},
            r"`loss`\.notna\(\)\"; .* links\.noise_floor_dbm$",
        ),
        (TABLE + "0,50,1.5,inf,LOS,1\n0,60,1.5,nan,LOS,1\n", {}, r"in 2 of 6 rows \(rows 6, 7\)"),
        (TABLE + "0,50,1.5,n.m.,LOS,1\n", {}, "row 6, column 'loss': 'n.m.' is not a number"),
        (
            TABLE + "0,50,1.5,-90,LOS,1\n",
            {},
            "row 6, column 'loss': -90 corresponds to a path loss of -90 dB.*path_gain",
        ),
        (
            TABLE + "0,50,1.5,12,LOS,1\n",
            {},
            r"12 corresponds to a path loss of 12 dB; it must be 20 to 250 dB \(1 of 5 rows\)",
        ),
        (TABLE + "0,50,1.5,251,LOS,1\n", {}, "251 corresponds to a path loss of 251 dB"),
        (TABLE, {"quantity": "path_gain"}, "row 2, .* corresponds to a path loss of -80.5 dB.*path_loss"),
        (
            "x,y,z,watts\n10,0,1.5,2e-9\n20,0,1.5,8e-11\n",
            {"quantity": "rsrp", "value": "watts"},
            "'watts' has values up to 2e-09, .* convert the values to dBm",
        ),
        (TABLE, {"quantity": "pathloss"}, "did you mean 'path_loss'"),
        (TABLE, {"quantity": "received_power"}, "'received_power' needs tx_power_dbm"),
        (TABLE, {"tx_power_dbm": 30}, "'path_loss' cannot be combined with tx_power_dbm"),
        (TABLE, {"quantity": "received_power", "tx_power_dbm": 30}, "row 2, .* check tx_power_dbm"),
        (TABLE, {"quantity": "received_power", "tx_power_dbm": float("inf")}, "inf must be a finite number"),
        (TABLE, {"value": "set"}, "row 2, column 'set': 'LOS' is not a number"),
        (TABLE + "0,50,1.5,90,,1\n", {"group": "set"}, "row 6, column 'set': the label is missing"),
        (
            TABLE.replace("NLOS,4", "NLOS,0"),
            {"weight": "spread"},
            "row 4, column 'spread': 0 must be greater than 0",
        ),
        (TABLE.replace("NLOS,4", "NLOS,-4"), {"std": "spread"}, "row 4, column 'spread': -4 must be greater"),
        (TABLE, {"std": 0}, "std: 0 must be greater than 0"),
        (TABLE, {"std": 1, "weight": "spread"}, "give only one of these"),
        # Links
        (TABLE, {"tx": [20, 0, 1.5]}, "row 3: transmitter and receiver are at the same point"),
        # Filters
        (TABLE, {"where": "x > 1000"}, r"selects no rows \(out of 4\)"),
        (TABLE, {"where": "sett == 'LOS'"}, "no column 'sett'; did you mean 'set'"),
        (TABLE, {"where": "x >"}, "not a valid filter .*the columns are x, y, z, loss, set, spread"),
        (TABLE, {"where": "x < 'a'"}, "not a valid filter"),
        (TABLE, {"where": "x"}, "must be true or false for each row"),
        (TABLE, {"where": "x = 3"}, "not a valid filter .*write a comparison such as"),
        (TABLE, {"where": "x == @tmp_path"}, "not a valid filter"),
        (TABLE, {"where": "x.to_csv('out.csv')"}, r"to_csv\(\) is not allowed"),
    ],
)
def test_faults_are_refused_with_file_row_and_column(tmp_path, text, changes, message):
    with pytest.raises(InputError, match=rf"(?s){message}"):
        read(tmp_path, text, **changes)


def test_missing_files_and_other_formats_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.csv: no such file"):
        read_measurements(tmp_path / "nowhere.csv", [0, 0, 1], [1, 1, 1], "loss")
    with pytest.raises(InputError, match=r"cannot read a \.ods table"):
        read_measurements(table_file(tmp_path, TABLE, "links.ods"), [0, 0, 1], [1, 1, 1], "loss")
    binary = tmp_path / "links.csv"
    binary.write_bytes(b"x,loss\n\xff\x01,80\n")
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_measurements(binary, [0, 0, 1], [1, 1, 1], "loss")


def test_rows_that_repeat_a_link_are_merged_in_linear_power(tmp_path):
    repeated = TABLE + LATER[1].replace("86.5", "96.5") + "\n" + LATER[1] + "\n"
    links = read(tmp_path, repeated)
    assert len(links) == 4
    assert links.prepared == {"rows that repeat a link, merged": 2}
    mean_gain = (2 * 10**-8.65 + 10**-9.65) / 3
    np.testing.assert_allclose(links.path_loss_db[1], -10 * np.log10(mean_gain))
    assert links.row.tolist() == [2, 3, 4, 5]
    # An exact copy changes no value.
    copied = read(tmp_path, TABLE + LATER[1] + "\n")
    assert copied.path_loss_db.tolist() == read(tmp_path, TABLE).path_loss_db.tolist()


def test_positions_that_differ_by_rounding_are_equal():
    """Also at the edges of any grid, in another order of rows, and with another row that is between two."""
    x = np.array([0.00005, 20.0, 0.00005 - 1e-9, 20.0 - 2e-7, 20.002, np.nan, np.nan])
    frame = pd.DataFrame({"x": x, "loss": 80.0 + 1e-7 * np.arange(7)})
    columns = LinkColumns((0, 0, 5), ("x", 0, 1), "loss")
    for rows in (frame[:5], frame[:5].iloc[[3, 4, 0, 2, 1]]):
        links = measured_links(SourceTable(rows.reset_index(drop=True)), columns)
        assert sorted(links.rx[:, 0].round(3)) == [0.0, 20.0, 20.002]
        assert links.path_loss_db == pytest.approx(80.0, abs=1e-6)
    with pytest.raises(InputError):  # what is no number is no repeat
        measured_links(SourceTable(frame), columns)


@pytest.mark.parametrize(
    ("column", "keys"),
    [
        ("set", {"group": "set"}),
        ("carrier", {"frequency": "carrier"}),
        ("sent", {"quantity": "received_power", "tx_power_dbm": "sent"}),
        ("timestamp", {}),
        ("transmitter", {}),
    ],
)
def test_rows_of_other_groups_carriers_powers_times_and_transmitters_are_no_repeats(column, keys):
    frame = pd.DataFrame({"x": 20.0, "level": 80.0, column: [1e9, 1e9, 2e9]})
    if column == "sent":
        frame["sent"], frame["level"] = [20.0, 20.0, 23.0], -80.0
    links = measured_links(SourceTable(frame), LinkColumns((0, 0, 5), ("x", 0, 1), "level", **keys))
    assert len(links) == 2
    assert links.prepared == {"rows that repeat a link, merged": 1}


@pytest.mark.parametrize("name", ["tof_ns", "time_of_flight_ns", "Round-Trip Time [ns]", "RoundTripTimeNs"])
def test_rows_of_other_flight_times_are_repeats(name):
    frame = pd.DataFrame({"x": 20.0, "level": 80.0, name: [100.0, 102.0]})
    links = measured_links(SourceTable(frame), LinkColumns((0, 0, 5), ("x", 0, 1), "level"))
    assert links.prepared == {"rows that repeat a link, merged": 1}


def test_a_repeat_below_the_noise_floor_stays_censored():
    frame = pd.DataFrame({"x": 20.0, "rsrp": [-100.0, np.nan, -130.0]})
    steps = Preparation(noise_floor_dbm=-120.0, censored=True)
    links = measured_links(SourceTable(frame), LinkColumns((0, 0, 5), ("x", 0, 1), "rsrp", "rsrp"), steps)
    assert links.path_loss_db.tolist() == [100.0, 120.0]
    assert links.censored.tolist() == [False, True]


def test_different_places_moved_to_one_corner_both_stay():
    """Two receivers inside a building are moved to the same corner; their values agree."""
    frame = pd.DataFrame({"x": [20.0, 21.0], "loss": 80.0})

    def corner(positions):
        return np.full_like(positions, 30.0), np.full(len(positions), 10.0)

    steps = Preparation(inside="move", outside=corner)
    links = measured_links(SourceTable(frame), LinkColumns((0, 0, 5), ("x", 0, 1), "loss"), steps)
    assert links.rx[:, 0].tolist() == [30.0, 30.0]
    assert "rows that repeat a link, merged" not in links.prepared


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tx": [[0, 0]]}, r"tx: shape \(1, 2\); it must be \(1, 3\)"),
        ({"path_loss_db": []}, r"path_loss_db: shape \(0,\)"),
        ({"path_loss_db": 80.0}, r"path_loss_db: shape \(\)"),
        ({"path_loss_db": [np.inf]}, "path loss is infinite"),
        ({"tx": [[0, 0, np.nan]]}, "transmitter's position is not finite"),
        ({"rx": [[np.inf, 0, 0]]}, "receiver's position is not finite"),
        ({"weight": [0.0]}, "weight must be greater than 0"),
        ({"weight": [np.nan]}, "weight must be greater than 0"),
        ({"weight": [np.inf]}, "weight must be finite"),
        ({"group": ["a", "b"]}, r"group: shape \(2,\)"),
    ],
)
def test_impossible_links_are_refused(changes, message):
    arguments = {"tx": [[0, 0, 1]], "rx": [[9, 0, 1]], "path_loss_db": [80.0]} | changes
    with pytest.raises(InputError, match=message):
        Measurements(**arguments)


def test_partly_measured_links_and_invalid_masks_are_refused():
    tx, rx = np.zeros((2, 3)), np.ones((2, 3))
    with pytest.raises(InputError, match="only some links have a path loss"):
        Measurements(tx, rx, [80.0, np.nan])
    links = Measurements(tx, rx, [80.0, 90.0])
    for mask in ([0, 1], [True], [[True, True]]):
        with pytest.raises(InputError, match="mask: "):
            links.select(mask)
    with pytest.raises(InputError, match=r"contains no links \(out of 2\)"):
        links.select([False, False])


def test_links_to_predict_at_have_no_values(tmp_path):
    frame = pd.DataFrame(
        {"tx_x": [0, 0], "tx_y": 0, "tx_z": 10, "rx_x": [5, 6], "rx_y": 1, "rx_z": 1.5, "set": ["b", "a"]},
        index=[7, 9],
    )
    links = links_from_frame(frame, group="set")
    assert not links.measured
    assert np.isnan(links.path_loss_db).all()
    assert links.group.tolist() == ["b", "a"]
    np.testing.assert_array_equal(links.rx, [[5, 1, 1.5], [6, 1, 1.5]])
    frame.to_csv(tmp_path / "links.csv", index=False)
    np.testing.assert_array_equal(links_from_table(read_table(tmp_path / "links.csv")).rx, links.rx)
    with pytest.raises(InputError, match="no column 'rx_z'"):
        links_from_frame(frame.drop(columns="rx_z"))
    with pytest.raises(InputError, match="contains no rows"):
        links_from_frame(frame.iloc[:0])
