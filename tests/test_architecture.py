"""What no linter looks at: that every test runs, and that files are written and text is printed in one way.

That imports go one way, and who may import what, import-linter holds; that docstrings tell what is raised, and that
nothing is asserted, ruff: see `pyproject.toml` and `make lint`.
"""

from __future__ import annotations

import ast
import runpy
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parent


def uncollected_tests(source: str, file: str) -> list[str]:
    """Tests that pytest does not find: nested, hidden by a later one, or in a class or file it passes by."""
    tree = ast.parse(source)
    scopes = [
        tree,
        *(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.startswith("Test")),
    ]
    found = Counter(
        (index, node.name)
        for index, scope in enumerate(scopes)
        for node in scope.body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    )
    defined = [
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    ]
    collected = [name for _, name in found] if file.startswith("test_") else []
    return sorted((Counter(defined) - Counter(collected)).elements())


def test_every_test_is_collected():
    lost = {path.name: uncollected_tests(path.read_text(), path.name) for path in TESTS.rglob("*.py")}
    assert {name: tests for name, tests in lost.items() if tests} == {}


@pytest.mark.parametrize(
    ("source", "file", "lost"),
    [
        ("def test_a(): ...", "test_x.py", []),
        ("class TestX:\n    def test_a(self): ...", "test_x.py", []),
        ("def test_a():\n    def test_b(): ...", "test_x.py", ["test_b"]),
        ("def test_a(): ...\ndef test_a(): ...", "test_x.py", ["test_a"]),
        ("class Cases:\n    def test_a(self): ...", "test_x.py", ["test_a"]),
        ("def test_a(): ...", "helpers.py", ["test_a"]),
    ],
)
def test_a_lost_test_is_found(source, file, lost):
    assert uncollected_tests(source, file) == lost


SOURCES = TESTS.parent / "src" / "calibray"


@pytest.fixture(scope="module")
def structure() -> dict[str, Any]:
    """What the tool that measures the structure defines."""
    return runpy.run_path(str(TESTS.parent / "tools" / "structure.py"))


@pytest.fixture(scope="module")
def trees(structure) -> dict[str, ast.Module]:
    """The syntax tree of every module."""
    return structure["modules"](SOURCES)


def test_no_files_import_each_other(structure, trees):
    """Imports inside functions and for type checking count, which import-linter leaves out."""
    graph = structure["dependencies"](trees)
    assert len(graph) > 200
    assert structure["circles"](graph) == []
    assert structure["circles"]({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_numeric_constants_count_one_by_one(structure):
    source = "A = 1\nB, C = 2, (3.0, 4)\nD: int = -5\nE, F = 'a', 'b'\ng = 6\nH = len('abc')\nI, J = range(2)"
    assert structure["constants"]({"module.py": ast.parse(source)}) == 4


WRITERS = {"write_text", "write_bytes", "to_csv", "tofile", "savefig", "copyfile", "copy", "copytree"}
"""Methods and functions that write a file, or a CSV text."""

PRIVATE = (
    "support/output_files.py",
    "engines/external/",
    "engines/ledger/",
    "scenes/shapes.py",
)
"""Where files are written otherwise: the writer itself, exchange in private folders, and SQLite."""


def foreign_writes(tree: ast.Module) -> list[int]:
    """Lines that write a file by its final name, or a table without marking formulas."""
    lines = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        called = function.attr if isinstance(function, ast.Attribute) else ""
        if isinstance(function, ast.Name) and function.id in ("open", "copyfile", "copytree"):
            called = function.id
        words = [part.id for part in ast.walk(node) if isinstance(part, ast.Name)]
        modes = [part.value for part in node.args if isinstance(part, ast.Constant)]
        opens = called == "open" and any(isinstance(mode, str) and set("wax+") & set(mode) for mode in modes)
        of_an_object = called == "copy" and "shutil" not in words
        if (called in WRITERS or opens) and "partial" not in words and not of_an_object:
            lines.append(node.lineno)
    return lines


def test_files_are_written_in_one_way(trees):
    """All goes through `support.output_files`: no link followed, no foreign file replaced."""
    written = {name: foreign_writes(tree) for name, tree in trees.items()}
    assert {name: lines for name, lines in written.items() if lines and not name.startswith(PRIVATE)} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ('path.write_text("x")', 1),
        ('path.open("a")', 1),
        ('path.open("rb")', 0),
        ('table.to_csv("x")', 1),
        ("shutil.copyfile(a, b)", 1),
        ("copyfile(a, b)", 1),
        ('open("x", "w")', 1),
        ("frame.copy()", 0),
        ('partial.write_bytes(b"")', 0),
        ('write_text(path, "x")', 0),
    ],
)
def test_a_foreign_write_is_noticed(source, count):
    assert len(foreign_writes(ast.parse(source))) == count


def test_commands_print_in_one_way():
    """`console.echo` escapes control characters; data go out unchanged, as CSV."""
    printed = {
        path.name: [
            line for line in path.read_text().splitlines() if "typer.echo(" in line or " print(" in line
        ]
        for path in (SOURCES / "cli").glob("*.py")
    }
    assert {name: len(lines) for name, lines in printed.items() if lines} == {
        "console.py": 1,
        "predict.py": 1,
    }
