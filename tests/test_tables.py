"""Tables rendered as text, HTML and Markdown."""

from __future__ import annotations

import subprocess
import sys

import pytest

from calibray.tables import Column, Table, numbers, render, render_html, rows_text
from html_cells import Cells
from markdown_tables import render_markdown

HOSTILE = '<script>alert("x")</script>&amp;'
RMSE = Table("RMSE [dB]", (Column("links"), numbers("after", "dB")), (("held out", "0.89"), ("all", "0.55")))


def test_text_is_aligned_and_without_markup():
    names = ("[red]walls[/red]", ":warning:", "壁")
    table = Table("", (Column("Name"), numbers(unit="dB")), tuple((name, "-10.0") for name in names))
    assert render(table).splitlines()[2:] == [
        "[red]walls[/red]   -10.0",
        ":warning:          -10.0",
        "壁                 -10.0",
    ]


def test_texts_of_the_last_column_are_folded_to_the_width_of_a_terminal(monkeypatch):
    reason = "column names indicate degrees; no height: 1.5 m"
    table = Table("", (Column("what"), numbers("links"), Column("reason")), (("links.rx", "330", reason),))
    sentences = Table("", (Column(),), ((reason,), (reason,)))
    monkeypatch.setenv("COLUMNS", "40")
    lines = render(table).splitlines()
    assert max(map(len, lines)) <= 40
    assert " ".join(line[len("links.rx   links   ") :].strip() for line in lines[2:]) == reason
    # An empty line is between sentences.
    assert render(sentences).splitlines().count("") == 1
    # Too narrow for the other columns: nothing is cut.
    monkeypatch.setenv("COLUMNS", "20")
    assert reason in render(table)


@pytest.mark.parametrize("width", [40, 60, 80])
def test_no_cell_is_cut_in_a_narrow_terminal(monkeypatch, width):
    interval, columns = "1.5 to 11.74, 12.3 to 15", "Cell_Longitude, Cell_Latitude, Height [m]"
    names = ("walls.relative_permittivity", "links.tx_antenna.azimuth_deg")
    shapes = (
        (Column("value"), numbers("95 % interval"), Column("verdict")),
        (Column("key"), Column("value"), Column("why")),
    )
    rows = ((names[0], interval, "weakly identified"), (names[1], columns, "the model of predictions"))
    monkeypatch.setenv("COLUMNS", str(width))
    for head, row in zip(shapes, rows, strict=True):
        text = render(Table("", head, (row,)))
        written = "".join(text.splitlines()[2:])
        assert sorted("".join(row).replace(" ", "")) == sorted(written.replace(" ", ""))


def test_long_cells_are_not_cut():
    table = Table("", (Column("message"), Column()), (("x" * 3000, "y"),))
    assert render(table).splitlines()[-1] == "x" * 3000 + "   y"


def test_the_title_is_the_first_heading_or_above_the_table():
    over = Table("Cost", (Column(), numbers("time", "s")), (("tracing", "0.3"),))
    above = Table("Cost", (Column("what"), numbers("time", "s")), (("tracing", "0.3"),))
    assert render(over).splitlines()[0] == "Cost      time [s]"
    assert render(above).splitlines()[:2] == ["Cost", "what      time [s]"]
    assert render("before", over).startswith("before\n\nCost ")


def test_a_row_with_a_wrong_number_of_cells_is_refused():
    with pytest.raises(ValueError, match="a row has 1 cells, must be 2"):
        Table("Cost", (Column(), numbers()), (("tracing",),))


def test_only_the_first_rows_are_listed():
    assert rows_text([]) == ""
    assert rows_text([7]) == "row 7"
    assert rows_text(range(1, 15)).endswith("11, 12 and 2 more")


def test_html_contains_the_text_of_the_table():
    cells = Cells(render_html("study.toml", RMSE))
    headings = [column.heading for column in RMSE.columns]
    assert cells.words == ["study.toml", RMSE.title, *headings, *(cell for row in RMSE.rows for cell in row)]
    assert cells.tags == {"p", "table", "caption", "thead", "tbody", "tr", "th", "td"}


def test_html_escapes_all_text():
    table = Table(HOSTILE, (Column(HOSTILE, HOSTILE),), ((HOSTILE,),))
    fragment = render_html(HOSTILE, table)
    assert "<script" not in fragment
    assert Cells(fragment).words == [HOSTILE, HOSTILE, f"{HOSTILE} [{HOSTILE}]", HOSTILE]


def test_markdown_escapes_column_separators():
    table = Table("", (Column("a"), Column("b")), (("x|y", "z"),))
    assert render_markdown(table).splitlines()[-1] == r"| x\|y | z |"


def test_tables_import_no_pandas():
    code = """
import sys
import calibray.tables
print("pandas" in sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("False\n", "")
