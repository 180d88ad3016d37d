"""Excel workbooks are read as CSV files of the same cells, or refused with the row at fault."""

from __future__ import annotations

import sys
import zipfile
from datetime import datetime

import numpy as np
import openpyxl
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import read_table, table_files

SHEET = [["x", "loss"], [10.0, 80.25], [20.0, 81.5], [30.0, 0.1]]


def workbook(path, rows, change=lambda sheet: None):
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    change(book.active)
    book.save(path)
    return path


def test_a_workbook_is_read_as_a_csv_file_of_the_same_cells(tmp_path):
    rows = [["x ", "loss", "note"], [1, 80.1, "NA"], [], [2, None, 'a\nb, "c"'], [3.5, "81.5", True]]
    table = read_table(workbook(tmp_path / "links.xlsx", rows))
    (tmp_path / "links.csv").write_text('x ,loss,note\n1,80.1,NA\n\n2,,"a\nb, ""c"""\n3.5,81.5,True\n')
    pd.testing.assert_frame_equal(table.frame, read_table(tmp_path / "links.csv").frame)
    assert table.row.tolist() == [2, 4, 5]


def test_faulty_workbooks_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "links.xlsx"
    with pytest.raises(InputError, match="column 'x' appears twice"):
        read_table(workbook(path, [["x", "x"], [1, 2]]))
    path.write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="not an Excel file"):
        read_table(path)
    workbook(path, SHEET)
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(InputError, match=r"pip install 'calibray\[excel\]'"):
        read_table(path)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (datetime(2026, 5, 1), r"row 3, column 'loss': '2026-05-01 00:00:00' is not a number"),
        ("=B2+1", r"row 3, column 'loss': '=B2\+1' is not a number"),
        ("#DIV/0!", r"row 3, column 'loss': '#DIV/0!' is not a number"),
        (None, r"column 'loss' has missing or non-finite values in 1 of 3 rows \(row 3\)"),
    ],
    ids=["date", "formula", "error", "gap"],
)
def test_a_cell_that_is_not_a_number_is_named(tmp_path, cell, message):
    """A formula without a computed value must not count as a missing value, which means below the noise floor."""
    path = workbook(tmp_path / "links.xlsx", SHEET, lambda sheet: setattr(sheet["B3"], "value", cell))
    with pytest.raises(InputError, match=message):
        read_table(path).numbers("loss")


def test_values_outside_the_named_columns_are_refused(tmp_path):
    for change in (
        lambda sheet: sheet.cell(1_048_576, 16_384, 1.0),
        lambda sheet: sheet.cell(3, 4, "remark"),
        lambda sheet: (sheet.insert_rows(1), sheet.cell(1, 1, "Monday")),
    ):
        with pytest.raises(InputError, match=r"row \d+: .* is in column \d+, which has no name in row 1"):
            read_table(workbook(tmp_path / "links.xlsx", SHEET, change))


def test_a_row_far_below_is_read(tmp_path):
    path = workbook(tmp_path / "links.xlsx", SHEET, lambda sheet: sheet.cell(50_000, 1, 40.0))
    assert read_table(path).row.tolist() == [2, 3, 4, 50_000]


@pytest.mark.parametrize("row", [b"99999999999", b"2", b"1e3", b"0"])
def test_rows_out_of_order_are_refused(tmp_path, row):
    """openpyxl would fill the gap with rows for hours, or drop the row whose number repeats."""
    path = workbook(tmp_path / "links.xlsx", SHEET)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    parts[sheet] = parts[sheet].replace(b'<row r="3"', b'<row r="%s"' % row)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    with pytest.raises(
        InputError, match=r"links\.xlsx: the file is not an Excel file \(row '.*' follows row 2\)"
    ):
        read_table(path)


def test_a_workbook_beyond_the_limits_is_refused(tmp_path, monkeypatch):
    path = workbook(tmp_path / "links.xlsx", SHEET)
    monkeypatch.setattr(table_files, "MAX_UNPACKED", 1000)
    with pytest.raises(InputError, match="MiB unpacked"):
        read_table(path)
    monkeypatch.setattr(table_files, "MAX_UNPACKED", 2**28)
    monkeypatch.setattr(table_files, "MAX_CELLS", 5)
    with pytest.raises(InputError, match="more than 5 cells"):
        read_table(path)


def test_gaps_and_blank_rows_keep_their_numbers(tmp_path):
    path = tmp_path / "links.xlsx"
    pd.DataFrame({"x": [1.0, np.nan, 3.0], "loss": [80.0, np.nan, 82.5]}).to_excel(path, index=False)
    table = read_table(path)
    assert table.frame.to_dict("list") == {"x": [1.0, 3.0], "loss": [80.0, 82.5]}
    assert table.row.tolist() == [2, 4]
