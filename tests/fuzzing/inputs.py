"""Attacks on what people write: study files, row filters, and tables of links."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements import read_measurements
from calibray.measurements.filters import evaluate
from fuzzing import world
from fuzzing.mutations import TEXTS, damage, edited, hostile, soup, toml
from fuzzing.outcome import Case, Exited
from fuzzing.world import OWN, World

DEEP = 0.15
"""Share of the studies that are run to the end; the rest is opened."""
VARIANTS: tuple[Mapping[str, Any], ...] = (
    {},
    {"objective": {"combining": "band", "no_path": "censor", "ceiling_db": 160.0}, "offset": {}},
    {"method": {"name": "gwo", "seed": 3, "options": {"population": 4, "iterations": 3}}},
    {
        "method": {
            "name": "sgwo-im",
            "options": {"population": 4, "iterations": 3, "full_iterations": 1, "elites": 2},
        }
    },
    {"holdout": {"where": "half == 'b' and not (x < 45)"}},
    {"engine": {"name": "command", "command": ["/bin/sh", "answer.sh"], "timeout": 5.0, "retries": 0}},
)
ROOMS = ("objects", "materials", "parameters")
"""Sections whose keys are names of the user's."""


def study(rng: Random, found: World, folder: Path) -> Case:
    """A study file with values, keys or bytes changed."""
    file = found.copy(folder)
    tree, notes, bad = world.content(**rng.choice(VARIANTS)), [], False
    if rng.random() < 0.15:
        file.write_bytes(damage(rng, toml(tree).encode()))
        notes.append("bytes")
    else:
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            tree, note, senseless = edited(rng, tree)
            notes.append(note)
            bad |= senseless and "method.options" not in note
            words = note.split(" ", 1)[1].split(".")
            bad |= note.startswith(("add", "rename")) and (len(words) == 1 or words[0] not in ROOMS)
        bad = bad and len(notes) == 1
        file.write_bytes(toml(tree).encode(errors="surrogatepass"))
    if rng.random() < DEEP:
        arguments = (file, "-o", folder / "out")
        return Case("study", f"run, {notes}", lambda: world.rmse(*arguments), bad, names=_NAMES, own=OWN)
    return Case("study", f"open, {notes}", lambda: world.opened(file), bad, names=_NAMES, own=OWN)


_NAMES = (
    "study.toml",
    "links.csv",
    "scene.xml",
    "horn.csv",
    "method",
    "trace",
    "engine",
    "answer.sh",
    "objects",
    "materials",
)

FRAME = pd.DataFrame(
    {
        "x": [1.0, 2.0, 3.5, -4.0],
        "y": [0.0, -1.0, 2.0, 2.0],
        "n": [1, 2, 3, 4],
        "half": ["a", "b", "a", "c"],
        "my set": ["p", "q", "q", ""],
    }
)
ESCAPES = (
    "().__class__.__base__.__subclasses__()",
    "(x.to_csv)('f')",
    "x.isin([(x.to_csv)('f')])",
    "builtins.exec('1')",
    "(x.__init__.__globals__['sys'].modules['os'].system)('id > pwned') != x",
    "__import__('os').system('id')",
    "@x",
    "@pd.read_pickle('f')",
    "x > 7**7**7**7",
    "lambda: x",
    "[i for i in x]",
    "x if x else y",
    "f'{x!r}'",
    "x := 3",
    "open('f','w')",
    "half.str.format(x)",
    "half.str.contains('(a+)+$')",
    "half.str.contains('(?:a|a)*b' * 9)",
    "x.values",
    "x.map(print)",
    "half.str.cat()",
    "'a' * 10**9 == half",
    "x << 2**40 > 1",
    "x @ y",
    "~~~~x",
    "x;y",
    "not " * 500 + "x",
    "(" * 200 + "x" + ")" * 200,
    "-" * 5000 + "x > 1",
    "x > 1" + " and x > 1" * 3000,
    "x == " + "9" * 9000,
    "half.str.pad(10**9)",
    "half.str.repeat(10**9)",
    "x > 1e999",
    "x == nan",
    "half == '\\ud800'",
    "half.str.contains('[')",
)
_TOKENS = (
    "x",
    "y",
    "n",
    "half",
    "`my set`",
    "z",
    "1",
    "2.5",
    "-",
    "+",
    "*",
    "/",
    "//",
    "%",
    "**",
    "<",
    ">",
    "==",
    "!=",
    "<=",
    "and",
    "or",
    "not",
    "in",
    "not in",
    "&",
    "|",
    "~",
    "(",
    ")",
    "[",
    "]",
    ",",
    "'a'",
    "abs",
    "sqrt",
    "log(x)",
    "True",
    "None",
    "half.str.contains('a')",
    "x.isna()",
    "x.between(1, 2)",
    "half.isin(['a'])",
    ".",
    "@",
    "=",
    ":",
    "{",
    "}",
    "0",
)


def row_filter(rng: Random, found: World, folder: Path) -> Case:
    """A filter: a sensible one, whose answer Python itself gives row by row, or anything else."""
    match rng.randrange(4):
        case 0 | 1:
            text = _condition(rng, 3)
            rows = [
                dict(zip(("x", "y", "n", "half"), row, strict=False)) for row in FRAME.itertuples(index=False)
            ]
            right = np.array([eval(text, {"__builtins__": {}, "abs": abs}, row) for row in rows], dtype=float)
            return Case("filter", text, lambda: evaluate(text, FRAME), expected=right)
        case 2:
            text = rng.choice(ESCAPES)
            if rng.random() < 0.5:
                text = damage(rng, text.encode()).decode(errors="replace")
        case _:
            text = soup(rng, _TOKENS) if rng.random() < 0.8 else soup(rng, TEXTS, 3)
    return Case("filter", text[:200], lambda: evaluate(text, FRAME))


def _condition(rng: Random, depth: int) -> str:
    if depth and rng.random() < 0.5:
        a, b = _condition(rng, depth - 1), _condition(rng, depth - 1)
        return rng.choice((f"({a}) and ({b})", f"({a}) or ({b})", f"not ({a})", f"({a}) == ({b})"))
    a, b, c = (_term(rng, 2) for _ in range(3))
    signs = ("<", "<=", ">", ">=", "==", "!=")
    return rng.choice(
        (
            f"{a} {rng.choice(signs)} {b}",
            f"{a} {rng.choice(signs)} {b} {rng.choice(signs)} {c}",
            f"half {rng.choice(('==', '!='))} 'a'",
            f"half {rng.choice(('in', 'not in'))} ['a', 'c']",
            "n in [1, 4]",
        )
    )


def _term(rng: Random, depth: int) -> str:
    if depth and rng.random() < 0.5:
        return f"({_term(rng, depth - 1)} {rng.choice('+-*')} {_term(rng, depth - 1)})"
    return rng.choice(("x", "y", "n", "abs(y)", str(rng.randint(0, 5)), f"{rng.uniform(0, 5):.3f}", "-x"))


CELLS = (
    "",
    " ",
    "nan",
    "NA",
    "n/k",
    "1e999",
    "-inf",
    "0x10",
    "1_000",
    "1,5",
    '"1,5"',
    "=1+1",
    "\uff11\uff12",
    "1e5",
    "--1",
    "TRUE",
    '"',
    "70.0 dB",
    "1e-400",
    "9" * 400,
    "\0",
    "+5",
    "5.",
    ".5",
    "1 2",
    "\u22125",
    "-70",
    "None",
    "1/2",
    "1d5",
    "1E+2",
)
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
_USED = ("x", "y", "loss", "w")


def table(rng: Random, found: World, folder: Path) -> Case:
    """A table of links, as CSV or Parquet, with cells or bytes changed; what was read is read again by other means."""
    if rng.random() < 0.3:
        return _parquet(rng, folder)
    file, text = folder / "links.csv", world.LINKS
    lines = [line.split(",") for line in text.splitlines()]
    match rng.randrange(6):
        case 0 | 1 | 2:
            row, column = rng.randrange(1, len(lines)), rng.randrange(5)
            lines[row][column] = rng.choice(CELLS)
            raw, note = (
                "\n".join(",".join(line) for line in lines).encode(),
                f"cell {row}, {column}: {lines[row][column]!r}",
            )
        case 3:
            edit = rng.choice(
                (
                    lambda t: t.replace(",", ";"),
                    lambda t: t + t,
                    lambda t: t.replace("loss", "x"),
                    lambda t: "",
                    lambda t: t[:7],
                    lambda t: t.replace("\n", "\r"),
                    lambda t: "\ufeff" + t,
                    lambda t: t.replace("\n", "\r\n"),
                    lambda t: "# hi\n" + t,
                    lambda t: t.replace("10,0", '"10","0'),
                    lambda t: t.replace("\n", ",\n"),
                    lambda t: t.replace("loss", " loss "),
                    lambda t: t.replace(",", " , "),
                    lambda t: t.replace("\n", "\n\n"),
                    lambda t: t + "70,0,80.5,a\n",
                )
            )
            raw, note = edit(text).encode(), "layout"
        case 4:
            code = rng.choice(("utf-16", "latin-1", "utf-32", "cp037"))
            raw, note = text.replace("a", "\u00e9").encode(code), code
        case _:
            raw, note = damage(rng, text.encode()), "bytes"
    file.write_bytes(raw)
    return Case("table", f"csv {note}", lambda: read(file, plain(raw)), names=("links.csv",))


def read(file: Path, plain: list[list[float]] | None) -> list[float]:
    """What the package reads, once it is certain that it is what stands in the file."""
    links = read_measurements(file, [0.0, 0.0, 2.0], ["x", "y", 1.5], "loss", group="half", weight="w")
    rows = np.stack([*links.rx[:, :2].T, links.path_loss_db], axis=1)
    if plain is None:  # what the plainest means cannot read can only be the undamaged table
        plain = [[float(cell) for cell in row.split(",")[:3]] for row in world.LINKS.splitlines()[1:]]
    if any(text.startswith("codes for missing values") for text in links.prepared):
        plain = [row for row in plain if 0 < row[2] <= 190]  # codes such as -1 or 0, left out and counted
    if len({tuple(row[:2]) for row in plain}) < len(plain):
        return rows.ravel().tolist()  # rows that repeat a link are merged
    if rows.shape != np.shape(plain) or not np.allclose(rows, plain, rtol=1e-12, atol=0):
        return [math.nan, *rows.ravel()]
    return rows.ravel().tolist()


def plain(raw: bytes) -> list[list[float]] | None:
    """The numbers of a CSV file by the plainest means; None where something is no number."""
    try:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("cp1252")
        rows = list(csv.reader(io.StringIO(text, newline=""), skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error):
        return None
    rows = [row for row in rows if len(row) > 1 or "".join(row).strip()]
    if not rows or len(set(rows[0])) != len(rows[0]) or any(len(row) != len(rows[0]) for row in rows):
        return None
    if not {*_USED, "half"} <= set(rows[0]):
        return None
    places = [rows[0].index(name) for name in _USED]
    cells = [[row[place] for place in places] for row in rows[1:]]
    if any(not _NUMBER.fullmatch(cell) or not math.isfinite(float(cell)) for row in cells for cell in row):
        return None
    return [[float(cell) for cell in row[:3]] for row in cells]


def _parquet(rng: Random, folder: Path) -> Case:
    file, frame = folder / "links.parquet", pd.read_csv(io.StringIO(world.LINKS))
    note, plain = "bytes", None
    if rng.random() < 0.5:
        frame.to_parquet(file, index=False)
        file.write_bytes(damage(rng, file.read_bytes()))
    else:
        column = rng.choice(_USED)
        value = rng.choice((None, *(hostile(rng) for _ in range(3))))
        frame[column] = frame[column].astype(object)
        frame.loc[rng.randrange(len(frame)), column] = None
        if rng.random() < 0.5:
            frame[column] = [value] * len(frame)
        note = f"{column} = {str(value)[:50]!r}"
        try:
            frame.to_parquet(file, index=False)
        except Exception:
            return Case("table", "parquet that nobody can write", lambda: None)
    try:
        again = pd.read_parquet(file)
        numbers = again[["x", "y", "loss"]].apply(pd.to_numeric).to_numpy(float)
        plain = numbers.tolist() if np.isfinite(numbers).all() else None
    except Exception:
        plain = None
    return Case("table", f"parquet {note}", lambda: read(file, plain), names=("links.parquet",))


__all__ = ["CELLS", "Exited", "InputError", "plain", "read", "row_filter", "study", "table"]
