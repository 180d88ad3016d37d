"""Attacks on Excel tables: cells of other types, sheets laid out otherwise, damaged and swollen files."""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Callable
from datetime import date, datetime, time
from pathlib import Path
from random import Random
from typing import Any
from xml.etree import ElementTree

import numpy as np
import openpyxl
from openpyxl.chart import LineChart

from fuzzing import world
from fuzzing.inputs import CELLS, plain, read
from fuzzing.mutations import damage
from fuzzing.outcome import Case
from fuzzing.world import World

Change = Callable[[Any, Any], None]
"""What is done to a workbook and its sheet."""

TYPED: tuple[Any, ...] = (
    datetime(2026, 5, 1, 12), date(1899, 12, 31), time(1, 5), True, False, 0, -1, 1e300, -70.5, 2**63, 1e-300,
    "=1+1", "=B2", '=HYPERLINK("file:///etc/passwd")', "=1/0", "#DIV/0!", "#N/A", "#REF!", "'5", "  70  ", "x" * 32_000,
)  # fmt: skip
LAYOUTS: dict[str, Change] = {
    "merged loss": lambda _, sheet: sheet.merge_cells("C2:C5"),
    "merged header": lambda _, sheet: sheet.merge_cells("A1:B1"),
    "merged everything": lambda _, sheet: sheet.merge_cells("A1:E9"),
    "title above": lambda _, sheet: (sheet.insert_rows(1, 2), sheet.cell(1, 1, "Monday")),
    "blank above": lambda _, sheet: sheet.insert_rows(1, 3),
    "blank between": lambda _, sheet: sheet.insert_rows(4, 2),
    "blank column": lambda _, sheet: sheet.insert_cols(2),
    "header twice": lambda _, sheet: sheet.cell(1, 1, "loss"),
    "no header": lambda _, sheet: sheet.delete_rows(1),
    "header alone": lambda _, sheet: sheet.delete_rows(2, 20),
    "number as header": lambda _, sheet: sheet.cell(1, 3, 3.5),
    "remark beside": lambda _, sheet: sheet.cell(3, 9, "checked"),
    "sums below": lambda _, sheet: sheet.append([None, None, "=SUM(C2:C9)"]),
    "far corner": lambda _, sheet: sheet.cell(1_048_576, 16_384, 1),
    "far row": lambda _, sheet: sheet.cell(1_048_576, 1, 5),
    "hidden": lambda book, sheet: (book.create_sheet("other"), setattr(sheet, "sheet_state", "hidden")),
    "an empty sheet first": lambda book, _: book.create_sheet("empty", 0),
    "another sheet first": lambda book, _: book.create_sheet("other", 0).append(["a", "b"]),
    "a chart first": lambda book, _: book.create_chartsheet("chart", 0).add_chart(LineChart()),
    "a chart alone": lambda book, sheet: (book.create_chartsheet("c").add_chart(LineChart()), book.remove(sheet)),
    "styled rows below": lambda _, sheet: [setattr(cell, "number_format", "0.0") for cell in sheet[400]],
}  # fmt: skip
SHEET, STRINGS = "xl/worksheets/sheet1.xml", "xl/sharedStrings.xml"
MAIN = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"
TYPES, RELATIONS = "[Content_Types].xml", "xl/_rels/workbook.xml.rels"
PARTS = (SHEET, SHEET, STRINGS, "xl/workbook.xml", "xl/styles.xml", TYPES, RELATIONS)
SHARED_TYPE = (
    b'<Override PartName="/xl/sharedStrings.xml" '
    b'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.sharedStrings+xml"/>'
)
SHARED_RELATION = (
    b'<Relationship Id="shared" Target="sharedStrings.xml" '
    b'Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/sharedStrings"/>'
)
ENTITIES = (
    b'<!DOCTYPE x [<!ENTITY a "'
    + b"a" * 1000
    + b'">'
    + b"".join(b'<!ENTITY %c "' % (98 + k) + b"&%c;" % (97 + k) * 20 + b'">' for k in range(8))
    + b"]>"
)
SWOLLEN = (
    (STRINGS, b"<t>", b"<t>", b"a", 2**28),
    (STRINGS, b"<t>", b"<t>", b"a", 2**26),
    (STRINGS, b"<sst", ENTITIES + b"<sst", b"", 0),
    (STRINGS, b"<t>", b"<t>&i;", b"", 0),
    (SHEET, b"<sheetData>", b"<sheetData>", b"<row></row>", 500_000),
    (SHEET, b'<row r="3"', b'<row r="99999999999"', b"", 0),
    (SHEET, b'<c r="A3"', b'<c r="ZZZZZZZ3"', b"", 0),
    (SHEET, b"<dimension ref=", b'<dimension ref="A1:XFD1048576" x=', b"", 0),
    (
        SHEET,
        b"<pageMargins",
        b'<mergeCells><mergeCell ref="A1:XFD1048576"/></mergeCells><pageMargins',
        b"",
        0,
    ),
    (SHEET, b"<v>", b"<v>", b"9", 10**6),
)
"""A part of the file, what is replaced once, by what, and what follows that many times."""


def as_it_is(_: Any, __: Any) -> None:
    """Change nothing."""


def workbook(rng: Random, found: World, folder: Path) -> Case:
    """A table of links as a workbook: cells, layout, bytes or parts of it changed."""
    file, note, right = folder / "links.xlsx", "", None
    cells = [_typed(row) for row in csv.reader(io.StringIO(world.LINKS))]
    match rng.randrange(8):
        case 0 | 1 | 2:
            row, column = rng.randrange(len(cells)), rng.randrange(5)
            cells[row][column] = value = rng.choice((*TYPED, *CELLS))
            note = f"cell {row}, {column}: {str(value)[:40]!r}"
            if not _written(file, cells):
                return Case("workbook", f"{note} that nobody can write", lambda: None)
            right = _numbers(cells)
        case 3 | 4:
            note = rng.choice(list(LAYOUTS))
            _written(file, cells, LAYOUTS[note])
            right = _again(file)
        case 5:
            _written(file, cells)
            file.write_bytes(damage(rng, file.read_bytes()))
            note, right = "bytes", _again(file)
        case 6:
            part = rng.choice(PARTS)
            _written(file, cells)
            _repacked(file, part, lambda raw: damage(rng, raw))
            note, right = f"bytes of {part}", _again(file)
        case _:
            part, old, new, piece, times = rng.choice(SWOLLEN)
            _written(file, cells)
            _repacked(file, part, lambda raw: raw.replace(old, new + piece * times, 1))
            note, right = f"{part}: {new[:40]!r} {piece!r} {times} times", plain(world.LINKS.encode())
    return Case("workbook", note, lambda: read(file, right), names=("links.xlsx",))


def _typed(row: list[str]) -> list[Any]:
    return [float(cell) if cell.replace(".", "").replace("-", "").isdigit() else cell for cell in row]


def _written(file: Path, cells: list[list[Any]], change: Change = as_it_is) -> bool:
    """Write the table; whether it can be."""
    book = openpyxl.Workbook()
    try:
        for row in cells:
            book.active.append(row)
        change(book, book.active)
        book.save(file)
        if change is as_it_is:
            _with_shared_strings(file)
    except (ValueError, OverflowError, openpyxl.utils.exceptions.IllegalCharacterError):
        return False
    return True


def _with_shared_strings(file: Path) -> None:
    """Move the texts of the sheet to where Excel itself keeps them."""
    texts: list[bytes] = []

    def moved(found: re.Match[bytes]) -> bytes:
        texts.append(found[1])
        return b't="s"><v>%d</v>' % (len(texts) - 1)

    parts = _parts(file)
    parts[SHEET] = re.sub(rb't="inlineStr"><is><t[^>]*>(.*?)</t></is>', moved, parts[SHEET], flags=re.DOTALL)
    entries = b"".join(b"<si><t>%s</t></si>" % text for text in texts)
    parts[STRINGS] = b'<sst xmlns="%s">%s</sst>' % (MAIN[1:-1].encode(), entries)
    parts[TYPES] = parts[TYPES].replace(b"</Types>", SHARED_TYPE + b"</Types>")
    parts[RELATIONS] = parts[RELATIONS].replace(b"</Relationships>", SHARED_RELATION + b"</Relationships>")
    _pack(file, parts)


def _parts(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def _pack(file: Path, parts: dict[str, bytes]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for name, content in parts.items():
            packed.writestr(name, content)


def _repacked(file: Path, part: str, change: Callable[[bytes], bytes]) -> None:
    """Change one part of a workbook, whose checksums are right again."""
    parts = _parts(file)
    _pack(file, parts | {part: change(parts[part])})


def _numbers(cells: list[list[Any]]) -> list[list[float]] | None:
    """The numbers of the cells by the plainest means; None where something is no number."""
    text = io.StringIO()
    csv.writer(text).writerows([str(cell).strip() for cell in row] for row in cells)
    return plain(text.getvalue().encode())


def _again(file: Path) -> list[list[float]] | None:
    """The numbers of the sheet as it stands in the file; None where something is no number."""
    try:
        parts = _parts(file)
        sheet = next(
            content for name, content in sorted(parts.items()) if name.startswith("xl/worksheets/sheet")
        )
        strings = ["".join(each.itertext()) for each in ElementTree.fromstring(parts.get(STRINGS, b"<sst/>"))]
        rows = []
        for row in ElementTree.fromstring(sheet).iter(f"{MAIN}row"):
            cells = {}
            for cell in row.iter(f"{MAIN}c"):
                value = cell.findtext(f"{MAIN}v")
                text = strings[int(value)] if cell.get("t") == "s" and value is not None else value
                text = "".join(cell.itertext()) if cell.get("t") == "inlineStr" else text
                cells[cell.get("r", "").rstrip("0123456789")] = (text or "").strip()
            if any(cells.values()):
                rows.append(cells)
        place = {name: column for column, name in rows[0].items()}
        found = [[float(cells[place[name]]) for name in ("x", "y", "loss", "w")][:3] for cells in rows[1:]]
    except Exception:
        return None
    return found if np.isfinite(found).all() else None
