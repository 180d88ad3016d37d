"""Tables as loggers and spreadsheets write them are read as the plain table of the same numbers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import read_table

PLAIN = "x,y,cell,rssi\n1.5,2,a,-70.5\n2.5,2,b,-71\n3.5,2,a,-72.25\n"
SEMICOLONS = PLAIN.replace(",", ";").replace(".", ",")


def read(tmp_path, text, name="log.csv", encoding="utf-8"):
    file = tmp_path / name
    file.write_bytes(text.encode(encoding))
    return read_table(file)


@pytest.mark.parametrize(
    ("text", "name", "encoding"),
    [
        (PLAIN, "log.txt", "utf-8"),
        (PLAIN.replace(",", "\t"), "log.tsv", "utf-8"),
        (PLAIN.replace(",", "   "), "log.dat", "utf-8"),
        ("  " + PLAIN.replace(",", " \t ").replace("\n", "  \n  "), "log.txt", "utf-8"),
        (PLAIN, "log.csv", "utf-16"),
        (PLAIN, "log.csv", "utf-16-le"),
        (PLAIN, "log.csv", "utf-16-be"),
        (SEMICOLONS, "log.csv", "utf-8-sig"),
        ("WigleWifi-1.4,appRelease=2.26\n" + PLAIN, "log.csv", "utf-8"),
        ("# logger 3\n# walk, 4 May\n#\n" + PLAIN, "log.csv", "utf-8"),
        ("Site;12\nOperator;me\nStart, local;10:00\n\n" + SEMICOLONS, "log.csv", "utf-8"),
        (PLAIN.replace("\n", ",\n").replace("rssi,", "rssi"), "log.csv", "utf-8"),
        (SEMICOLONS.replace("\n", ";;;\n"), "log.csv", "utf-8"),
        (PLAIN.replace("\n1.5", "\n[m],[m],,(dBm)\n1.5"), "log.csv", "utf-8"),
        (SEMICOLONS.replace("\n1,5", "\nm;m;-;dBm\n1,5"), "log.csv", "utf-8"),
        (PLAIN.replace("-70.5", "-70.5 dBm").replace("-71", "-71dBm").replace("25", "25 dBm"), "log.csv", "utf-8"),
        (SEMICOLONS.replace("\n2,5", "\nx\n2,5").replace("\nx\n", "\n \n"), "log.csv", "utf-8"),
    ],
)  # fmt: skip
def test_the_same_numbers_are_read_whatever_the_layout(tmp_path, text, name, encoding):
    plain, other = read(tmp_path, PLAIN, "plain.csv"), read(tmp_path, text, name, encoding)
    columns = [column for column in other.frame if not other.frame[column].isna().all()]
    values = other.frame[columns].set_axis(list(plain.frame), axis=1)
    pd.testing.assert_frame_equal(values, plain.frame)


def test_units_below_the_header_become_part_of_the_names(tmp_path):
    table = read(tmp_path, PLAIN.replace("\n1.5", "\ncm,cm,-,dBm\n1.5").replace("rssi", "rssi (dBm)"))
    assert list(table.frame) == ["x [cm]", "y [cm]", "cell", "rssi (dBm)"]
    assert table.row.tolist() == [3, 4, 5]


def test_rows_keep_their_lines_and_the_lines_above_the_header_are_counted(tmp_path):
    table = read(tmp_path, "Logger\nv 2\n" + PLAIN)
    assert table.row.tolist() == [4, 5, 6]
    assert table.changes == {"lines above the header, skipped": 2}
    # A spreadsheet gives all lines the same number of cells.
    padded = read(tmp_path, "Logger,,,\nv 2,,,\n" + PLAIN, "padded.csv")
    pd.testing.assert_frame_equal(padded.frame, table.frame)
    assert (padded.row.tolist(), padded.changes) == (table.row.tolist(), table.changes)


def test_placeholders_are_missing_values_of_columns_of_numbers_only(tmp_path):
    table = read(tmp_path, PLAIN.replace("-71", "-").replace("b", "-"))
    np.testing.assert_array_equal(table.frame["rssi"], [-70.5, np.nan, -72.25])
    assert table.frame["cell"].tolist() == ["a", "-", "a"]


def test_a_table_in_windows_1252_is_read(tmp_path):
    table = read(tmp_path, SEMICOLONS.replace("rssi", "se\u00f1al"), encoding="cp1252")
    assert list(table.frame) == ["x", "y", "cell", "se\u00f1al"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLAIN + "4,5,6\n", "row 5: 3 cells, but the header has 4"),
        (PLAIN + "4,5,a,-70,\n", "row 5: 5 cells, but the header has 4"),
        ("x,y,cell,rssi\n1,2,3\n4,5,6\n", "row 2: 3 cells, but the header has 4"),
        (PLAIN.replace("-71", "-71 dB").replace("-70.5", "-70.5 dBm"), "'-70.5 dBm' is not a number"),
        (PLAIN.replace("-71", "-71 dBm"), "'-71 dBm' is not a number"),
        (PLAIN.replace("-71", "none"), "'none' is not a number"),
        (PLAIN.replace("-70.5", "dBm"), "'dBm' is not a number"),
        ("1,2,3\n4,5,6\n", "row 1: contains numbers; insert a line with the column names"),
        ("Logger\n" + PLAIN + "4,5,6\n", "cells, but the header has"),
        ("PK\x03\x04" + PLAIN, "a ZIP archive or an Excel file; unpack it"),
    ],
)
def test_a_fault_is_refused_and_not_taken_for_a_layout(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, text).numbers("rssi")


@pytest.mark.parametrize("mark", [";", "\t"])
def test_a_comma_that_may_separate_thousands_is_refused(tmp_path, mark):
    """Read as a decimal comma, 1,234 and 567 would be 1.234 and 567."""
    rows = ["x;rssi", "1,234;-70", "567;-71"]
    with pytest.raises(
        InputError, match=r"row 2: '1,234' can mean 1.234 or 1234, because its column also contains"
    ):
        read(tmp_path, "\n".join(rows).replace(";", mark))
    for clear in ("0,567;-71", "567,000;-71", "567,5;-71"):
        values = read(tmp_path, "\n".join([*rows[:2], clear])).frame["x"]
        assert values.tolist() == [1.234, float(clear.split(";")[0].replace(",", "."))]


@pytest.mark.parametrize("cell", ["1,234,567", "1,234.5", "1.234,5", "1'234.5"])
def test_separators_of_thousands_are_named(tmp_path, cell):
    with pytest.raises(InputError, match=r"row 2, .* is not a number; remove the thousands separators"):
        read(tmp_path, f"x;rssi\n{cell};-70\n7;-71\n").numbers("x")
