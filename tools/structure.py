"""Measure how a checkout of Calibray is built: modules, rooms, arrows, lengths, and what one run reads.

    python tools/structure.py [CHECKOUT] [--static]

The second half runs the demo's study on replay in a process of its own, with counting put in front of what opens files,
and needs an environment with Calibray's dependencies; `--static` leaves it out.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median

PACKAGE = "calibray"
IMPORTS = 5

COUNT = """
import collections, functools, json, sys
from pathlib import Path

counts = collections.Counter({"links.csv read": 0, "scene.xml read": 0})
out, kept = sys.argv[1:]

def opened(event, arguments):
    if event == "open" and isinstance(arguments[0], str) and "r" in (arguments[1] or ""):
        path = Path(arguments[0])
        if path.name in ("links.csv", "scene.xml") and not path.is_relative_to(out):
            counts[f"{path.name} read"] += 1

def counted(owner, name, label):
    function = getattr(owner, name)
    counts[label] = 0

    @functools.wraps(function)
    def count(*arguments, **settings):
        counts[label] += 1
        return function(*arguments, **settings)

    setattr(owner, name, count)

import sionna.rt

from calibray.cli import main
from calibray.scenarios import demo_study_path
from calibray.study import Study

counted(sionna.rt.Scene, "__init__", "Sionna scenes loaded")
counted(Study, "parameter_set", "parameters made")
study = demo_study_path()
sys.addaudithook(opened)
sys.argv = ["calibray", "run", str(study), "--out", out]
try:
    main()
except SystemExit as end:
    if end.code:
        raise
with open(kept, "w") as file:
    json.dump(counts, file)
"""


def modules(package: Path) -> dict[str, ast.Module]:
    """The syntax tree of every module by its path inside the package."""
    return {
        path.relative_to(package).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(package.rglob("*.py"))
    }


def room(path: str) -> str:
    """The room or top-level module that a file belongs to."""
    return Path(path).parts[0].removesuffix(".py")


def run(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a module, without what only type checkers look at."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from run(node)


def targets(tree: ast.Module, path: str) -> Iterator[str]:
    """Rooms and top-level modules that a module imports when it runs, wherever in it the import stands."""
    above = [PACKAGE, *Path(path).parent.parts]
    for node in run(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = above[: len(above) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == PACKAGE and len(parts) > 1:
                yield parts[1]


def arrows(trees: dict[str, ast.Module]) -> set[tuple[str, str]]:
    """Imports between rooms and top-level modules, as pairs of importer and imported."""
    known = {room(path) for path in trees} - {"__init__"}
    found = {(room(path), target) for path, tree in trees.items() for target in targets(tree, path)}
    return {(a, b) for a, b in found if a != b and a in known and b in known}


def circles(pairs: set[tuple[str, str]]) -> list[list[str]]:
    """Groups of rooms that import one another, directly or around corners."""
    graph: dict[str, set[str]] = {}
    for a, b in pairs:
        graph.setdefault(a, set()).add(b)

    def reached(start: str) -> set[str]:
        found: set[str] = set()
        ends = set(graph.get(start, ()))
        while ends:
            found |= ends
            ends = set().union(*(graph.get(name, set()) for name in ends)) - found
        return found

    reach = {name: reached(name) for name in graph}
    groups = {
        tuple(sorted({name} | {other for other in reach[name] if name in reach.get(other, set())}))
        for name in graph
        if name in reach[name]
    }
    return [list(group) for group in sorted(groups)]


def functions(trees: dict[str, ast.Module]) -> list[tuple[int, str]]:
    """Length in lines and place of every function, docstring included."""
    return [
        ((node.end_lineno or node.lineno) - node.lineno + 1, f"{path}:{node.name}")
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def environment(checkout: Path) -> dict[str, str]:
    """The environment of a process that uses a checkout's package; no trace is kept from run to run."""
    return os.environ | {"PYTHONPATH": str(checkout / "src"), "CALIBRAY_CACHE": ""}


def counts(checkout: Path) -> dict[str, int]:
    """What one `calibray run` of the demo's study on replay reads and builds."""
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "counts.json"
        command = [sys.executable, "-c", COUNT, str(Path(folder) / "out"), str(kept)]
        subprocess.run(command, check=True, env=environment(checkout), stdout=subprocess.DEVNULL)
        return json.loads(kept.read_text())


def seconds_to_import(module: str, checkout: Path) -> float:
    """Median time [s] to import a module, of fresh processes."""
    code = f"import time; start = time.perf_counter(); import {module}; print(time.perf_counter() - start)"
    command = [sys.executable, "-c", code]
    times = [
        float(subprocess.run(command, check=True, env=environment(checkout), capture_output=True).stdout)
        for _ in range(IMPORTS)
    ]
    return median(times)


def table(checkout: Path, static: bool = False) -> list[tuple[str, str]]:
    """The figures of a checkout.

    Args:
        checkout: Root of the checkout.
        static: Whether to leave out what has to be run.

    Returns:
        Rows of a label and a figure.
    """
    package = checkout / "src" / PACKAGE
    trees = modules(package)
    lines = sorted((len((package / path).read_text(encoding="utf-8").splitlines()), path) for path in trees)
    lengths = sorted(functions(trees))
    top = sorted(
        path.name for path in package.iterdir() if path.suffix == ".py" and path.name != "__init__.py"
    )
    rooms = sorted(path.parent.name for path in package.glob("*/__init__.py"))
    pairs = arrows(trees)
    rings = circles(pairs)
    rows = [
        ("modules", f"{len(trees)}"),
        ("modules at the top level", f"{len(top)}: {', '.join(name.removesuffix('.py') for name in top)}"),
        ("rooms", f"{len(rooms)}: {', '.join(rooms)}"),
        ("import arrows between rooms", f"{len(pairs)}"),
        ("circles", "; ".join(" - ".join(ring) for ring in rings) or "none"),
        ("median module", f"{median(length for length, _ in lines):g} lines"),
        ("longest module", f"{lines[-1][0]} lines, {lines[-1][1]}"),
        ("median function", f"{median(length for length, _ in lengths):g} lines"),
        ("longest function", f"{lengths[-1][0]} lines, {lengths[-1][1]}"),
    ]
    if static:
        return rows
    rows += [(f"one run: {name}", str(count)) for name, count in sorted(counts(checkout).items())]
    ratio = seconds_to_import("calibray.result", checkout) / seconds_to_import("pandas", checkout)
    return [*rows, ("import calibray.result / import pandas", f"{ratio:.1f}")]


def main() -> None:
    """Print the table of the checkout named, or of this one."""
    words = [word for word in sys.argv[1:] if word != "--static"]
    checkout = Path(words[0] if words else Path(__file__).parents[1]).resolve()
    for label, figure in table(checkout, "--static" in sys.argv):
        sys.stdout.write(f"{label:<40} {figure}\n")


if __name__ == "__main__":
    main()
