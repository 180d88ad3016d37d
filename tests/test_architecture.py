"""What no linter looks at: that every test runs.

That imports go one way, and who may import what, import-linter holds; that docstrings tell what is raised, and that
nothing is asserted, ruff: see `pyproject.toml` and `make lint`.
"""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

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
