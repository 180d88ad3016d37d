"""Tables as data, and the same ones as text, as HTML and in Markdown."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import shown
from calibray.comparison import comparison
from calibray.reporting import doctor_table as diagnosis
from calibray.reporting import ledger_table as ledger
from calibray.reporting import result_tables
from calibray.reporting import trace_tables as trace
from calibray.tables import Column, Table, html, markdown, numbers
from calibray.tables.text import render, rows_text
from calibray.tracing.positions import EnclosedAntennas
from changed import changed
from html_cells import Cells

HOSTILE = '<script>alert("x")</script>&amp;'


def golden(name: str) -> str:
    """What is printed of the records of `shown`: as the first version did, but for what was changed on purpose."""
    return (shown.GOLDEN / f"{name}.txt").read_text(encoding="utf-8").removesuffix("\n")


def inside(of: str) -> EnclosedAntennas:
    """Antennas inside buildings for the twelve links of the stored result: one, and most."""
    row, link, none = shown.result().links["row"].to_numpy(), np.arange(12), np.zeros(12, dtype=bool)
    return EnclosedAntennas.of(row, none, link == 5 if of == "one" else link < 11)


def test_a_result_is_printed_as_ever():
    for name, found, enclosed in (
        ("result", shown.result(), inside("one")),
        ("result-bare", shown.bare_result(), inside("most")),
    ):
        text = render(result_tables.heading(found), *result_tables.tables(changed(found, enclosed=enclosed)))
        assert text == golden(name)


def test_a_trace_and_its_check_are_printed_as_ever():
    enclosed = EnclosedAntennas.of(shown.ROWS, shown.ROWS < 4, shown.ROWS == 9)
    assert render(trace.found(shown.paths(), shown.ROWS, enclosed)) == golden("trace")
    assert render(*trace.convergence(shown.convergence(), shown.ROWS, 0.5)) == golden("convergence")


def test_a_ledger_is_printed_as_ever():
    assert render(ledger.calls(shown.calls())) == golden("ledger")
    assert render(ledger.calls(shown.calls().iloc[:0])) == golden("ledger-empty")


def test_the_demo_the_comparison_and_the_doctor_are_printed_as_ever():
    assert render(*shown.demo().tables()) == golden("demo")
    assert render(comparison.table(shown.comparison())) == golden("comparison")
    assert markdown.render(comparison.table(shown.comparison())) == golden("comparison-markdown")
    assert render(diagnosis.table(shown.diagnosis())) == golden("doctor")


def test_text_aligns_its_columns_and_takes_words_as_they_are():
    names = ("[red]walls[/red]", ":warning:", "壁")
    table = Table("", (Column("Name"), numbers(unit="dB")), tuple((name, "-10.0") for name in names))
    assert render(table).splitlines()[2:] == [
        "[red]walls[/red]   -10.0",
        ":warning:          -10.0",
        "壁                 -10.0",
    ]


def test_no_cell_is_cut_short():
    table = Table("", (Column("message"), Column()), (("x" * 3000, "y"),))
    assert render(table).splitlines()[-1] == "x" * 3000 + "   y"


def test_a_title_stands_over_the_first_column_or_above():
    over = Table("Cost", (Column(), numbers("time", "s")), (("tracing", "0.3"),))
    above = Table("Cost", (Column("what"), numbers("time", "s")), (("tracing", "0.3"),))
    assert render(over).splitlines()[0] == "Cost      time [s]"
    assert render(above).splitlines()[:2] == ["Cost", "what      time [s]"]
    assert render("before", over).startswith("before\n\nCost ")


def test_a_row_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="a row of 1 cells, must be 2"):
        Table("Cost", (Column(), numbers()), (("tracing",),))


def test_rows_are_named_while_they_are_few():
    assert rows_text([]) == ""
    assert rows_text([7]) == "row 7"
    assert rows_text(range(1, 15)).endswith("11, 12 and 2 more")


def test_html_holds_the_same_words_as_the_table():
    table = result_tables.parameters(shown.result())
    cells = Cells(html.render("study.toml", table))
    headings = [column.heading for column in table.columns]
    assert cells.words == [
        "study.toml",
        table.title,
        *headings,
        *(cell for row in table.rows for cell in row),
    ]
    assert cells.tags == {"p", "table", "caption", "thead", "tbody", "tr", "th", "td"}


def test_html_escapes_every_text():
    table = Table(HOSTILE, (Column(HOSTILE, HOSTILE),), ((HOSTILE,),))
    fragment = html.render(HOSTILE, table)
    assert "<script" not in fragment
    assert Cells(fragment).words == [HOSTILE, HOSTILE, f"{HOSTILE} [{HOSTILE}]", HOSTILE]


def test_markdown_keeps_its_columns_whatever_the_cells_hold():
    table = Table("", (Column("a"), Column("b")), (("x|y", "z"),))
    assert markdown.render(table).splitlines()[-1] == r"| x\|y | z |"


def test_what_is_shown_needs_nothing_that_traces_or_evaluates():
    code = """
import importlib, sys
tables = "display html markdown text"
for name in [f"calibray.tables.{each}" for each in tables.split()]:
    importlib.import_module(name)
assert "pandas" not in sys.modules
for name in "doctor_table ledger_table trace_tables result_tables figures".split():
    importlib.import_module(f"calibray.reporting.{name}")
heavy = ("jax", "drjit", "mitsuba", "sionna", "calibray.calibration")
print([name for name in heavy if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("[]\n", "")
