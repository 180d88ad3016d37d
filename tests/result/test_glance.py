"""What records show of themselves in Python and in a notebook: it fits a screen, and it is harmless."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import shown
from calibray.measurements import Measurements
from calibray.study import Study
from calibray.tables import SENTENCE, named
from changed import changed
from html_cells import Cells

LINES, CHARACTERS = 40, 120
HOSTILE = '<img src=x onerror="alert(1)">'
NAMES = [HOSTILE, "walls\x1b[2J\nand more", "x" * 4000]


def links(groups: int) -> Measurements:
    """Links in groups with hostile names among them."""
    names = [*NAMES, *(f"mast {k}" for k in range(groups))]
    rx = np.c_[np.arange(len(names)) + 1.0, np.zeros((len(names), 2))]
    loss = np.linspace(60.0, 90.0, len(names))
    return Measurements(tx=np.zeros_like(rx), rx=rx, path_loss_db=loss, group=names)


def study(count: int) -> Study:
    """A study with many parameters, of materials with hostile names."""
    names = [*NAMES, *(f"wall_{k}" for k in range(count))]
    content = shown.result().study.content()
    parameters = {f"{name}.relative_permittivity": {"bounds": [1.5, 12.0]} for name in names}
    return Study.from_content(content | {"parameters": parameters}, "study.toml")


def large_records():
    """One of each kind, far larger than a screen and with hostile names."""
    plan, found = study(300), shown.result()
    constants = {f"{name}.thickness": 0.25 for name in [*NAMES, *map(str, range(300))]}
    result = changed(
        found,
        study=plan,
        parameters=constants,
        initial_parameters=constants,
        coefficients={"offset": {name: -1.5 for name in [*NAMES, *map(str, range(500))]}},
    )
    comparison = replace(shown.comparison(), name=HOSTILE)
    demo = replace(shown.demo(), engine=HOSTILE)
    return {"study": plan, "links": links(500), "result": result, "comparison": comparison, "demo": demo}


RECORDS = large_records()


@pytest.mark.parametrize("kind", RECORDS)
def test_it_fits_a_screen(kind):
    lines = repr(RECORDS[kind]).splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= CHARACTERS + SENTENCE * (kind == "links")
    assert str(RECORDS[kind]) == repr(RECORDS[kind])


@pytest.mark.parametrize("kind", RECORDS)
def test_names_steer_no_terminal(kind):
    assert all(character.isprintable() for character in repr(RECORDS[kind]).replace("\n", ""))


@pytest.mark.parametrize("kind", RECORDS)
def test_html_is_well_formed_and_names_stay_words(kind):
    fragment = RECORDS[kind]._repr_html_()
    assert "<img" not in fragment
    cells = Cells(fragment)
    assert cells.tags <= {"p", "table", "caption", "thead", "tbody", "tr", "th", "td"}
    assert any(HOSTILE in words for words in cells.words)
    assert len(fragment) < 20_000


def test_it_says_what_matters():
    result = shown.result()
    assert "wood.conductivity [S/m]" in repr(result)
    assert "not identifiable" in repr(result)
    assert "206 RT calls" in repr(result)
    assert "rx_x > 20" in repr(result.study)
    assert "GWO, 600 calls" in repr(shown.comparison())
    assert "paper: SGWO-IM" in repr(shown.demo())


def test_links_tell_their_number_groups_and_ranges():
    some = Measurements(
        tx=np.zeros((3, 3)),
        rx=[[30, 40, 0], [3, 4, 0], [6, 8, 0]],
        path_loss_db=[90.0, 70.0, 75.5],
        group=["b", "a", "b"],
        frequency=[3.5e9, 3.5e9, 700e6],
    )
    assert repr(some) == "<3 measured links in groups a, b from links>"
    words = Cells(some._repr_html_()).words
    told = dict(zip(words[1::2], words[2::2], strict=True))
    assert told == {
        "number": "3 measured",
        "distance": "5 to 50 m",
        "path loss": "70 to 90 dB",
        "groups": "a, b",
        "carriers": "700 MHz, 3.5 GHz",
    }


def test_names_are_counted_where_they_are_many():
    assert named(f"mast {k}" for k in range(500)).endswith("mast 3 and 496 more")
