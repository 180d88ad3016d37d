"""Measure the structure of a checkout: modules, rooms, imports, lengths, and the files that one run reads.

    python tools/structure.py [CHECKOUT] [--static]

Imports for type checking count as imports. The second half runs the demo's study on replay in another process, which
counts the files read; it needs an environment with Calibray's dependencies. `--static` omits it.
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

Graph = dict[str, set[str]]

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


def dotted(path: str) -> str:
    """The name by which a file is imported."""
    return ".".join([PACKAGE, *Path(path).with_suffix("").parts]).removesuffix(".__init__")


def imported(tree: ast.Module, path: str) -> Iterator[str]:
    """Names that a module imports at any level, including imports for type checking."""
    above = [PACKAGE, *Path(path).parent.parts]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = above[: len(above) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{origin}.{alias.name}" for alias in node.names)


def dependencies(trees: dict[str, ast.Module]) -> Graph:
    """Modules of the package that each module imports, by their paths."""
    paths = {dotted(path): path for path in trees}

    def module(name: str) -> str | None:
        """The longest leading part of a name that is a module."""
        parts = name.split(".")
        return next(
            (paths[key] for n in range(len(parts), 1, -1) if (key := ".".join(parts[:n])) in paths), None
        )

    return {
        path: {target for name in imported(tree, path) if (target := module(name)) not in (None, path)}
        for path, tree in trees.items()
    }


def rooms_graph(graph: Graph) -> Graph:
    """Rooms that each room imports."""
    rooms: Graph = {}
    for path, targets in graph.items():
        if room(path) != "__init__":
            others = {room(target) for target in targets} - {room(path), "__init__"}
            rooms.setdefault(room(path), set()).update(others)
    return rooms


def circles(graph: Graph) -> list[list[str]]:
    """Groups of nodes that import one another, directly or through others."""

    def reached(start: str) -> set[str]:
        visited: set[str] = set()
        ends = set(graph.get(start, ()))
        while ends:
            visited |= ends
            ends = set().union(*(graph.get(name, set()) for name in ends)) - visited
        return visited

    reach = {name: reached(name) for name in graph}
    groups = {
        tuple(sorted({name} | {other for other in reach[name] if name in reach.get(other, set())}))
        for name in graph
        if name in reach[name]
    }
    return [list(group) for group in sorted(groups)]


def single_importers(graph: Graph) -> int:
    """Number of modules, other than `__init__`, that exactly one other module imports."""
    importers: dict[str, set[str]] = {}
    for path, targets in graph.items():
        for target in targets:
            importers.setdefault(target, set()).add(path)
    return sum(len(by) == 1 for path, by in importers.items() if not path.endswith("__init__.py"))


WALKS = {
    "credible interval": "uncertainty/assessment.py",
    "offset": "fitting/objective.py",
    "measured row": "measurements/reading.py",
    "blocks": "validation/validate.py",
}
"""The module where each topic starts."""


def walks(graph: Graph) -> dict[str, int]:
    """Number of modules that each topic's starting module imports within its room, directly or indirectly, plus one."""
    lengths = {}
    for topic, start in WALKS.items():
        reached: set[str] = set()
        waiting = [start]
        while waiting:
            path = waiting.pop()
            if path not in reached and room(path) == room(start):
                reached.add(path)
                waiting += graph.get(path, ())
        lengths[topic] = len(reached)
    return lengths


def constants(trees: dict[str, ast.Module]) -> int:
    """Number of numeric constants at the top level of modules."""
    return sum(
        name.lstrip("_").isupper() and _numeric(value)
        for tree in trees.values()
        for name, value in _assignments(tree)
    )


def _assignments(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            yield node.target.id, node.value
        elif isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = zip(target.elts, value.elts, strict=False)
            else:
                pairs = [(target, value)]
            yield from ((name.id, each) for name, each in pairs if isinstance(name, ast.Name))


def _numeric(value: ast.expr) -> bool:
    """Whether an expression is made of numbers, signs, arithmetic and tuples alone."""
    allowed = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple, ast.operator, ast.unaryop, ast.expr_context)
    nodes = list(ast.walk(value))
    numbers = (node.value for node in nodes if isinstance(node, ast.Constant))
    return all(isinstance(node, allowed) for node in nodes) and any(type(n) in (int, float) for n in numbers)


def many_arguments(trees: dict[str, ast.Module]) -> int:
    """Number of functions with more than six arguments, not counting `self` and `cls`."""
    count = 0
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [
                    argument.arg
                    for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                ]
                count += len([name for name in names if name not in ("self", "cls")]) > 6
    return count


def comment_share(package: Path, trees: dict[str, ast.Module]) -> float:
    """Share of lines that are comments."""
    lines = [line.strip() for path in trees for line in (package / path).read_text("utf-8").splitlines()]
    return sum(line.startswith("#") for line in lines) / len(lines)


def functions(trees: dict[str, ast.Module]) -> list[tuple[int, str]]:
    """Length in lines, docstring included, and place of every function."""
    return [
        ((node.end_lineno or node.lineno) - node.lineno + 1, f"{path}:{node.name}")
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]


def environment(checkout: Path) -> dict[str, str]:
    """The environment of a process that uses a checkout's package, without a cache of traces."""
    return os.environ | {"PYTHONPATH": str(checkout / "src"), "CALIBRAY_CACHE": ""}


def counts(checkout: Path) -> dict[str, int]:
    """What one `calibray run` of the demo's study on replay reads and builds."""
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "counts.json"
        command = [sys.executable, "-c", COUNT, str(Path(folder) / "out"), str(kept)]
        subprocess.run(command, check=True, env=environment(checkout), stdout=subprocess.DEVNULL)
        return json.loads(kept.read_text())


def seconds_to_import(module: str, checkout: Path) -> float:
    """Median time [s] to import a module in a new process."""
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
        static: Whether to omit figures that need a run.

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
    graph = dependencies(trees)
    rooms_imports = rooms_graph(graph)
    rows = [
        ("modules", f"{len(trees)}"),
        ("lines", f"{sum(length for length, _ in lines):,}"),
        ("modules at the top level", f"{len(top)}: {', '.join(name.removesuffix('.py') for name in top)}"),
        ("rooms", f"{len(rooms)}: {', '.join(rooms)}"),
        ("import arrows between rooms", f"{sum(map(len, rooms_imports.values()))}"),
        ("circles of rooms", f"{len(circles(rooms_imports))}"),
        ("circles of files", f"{len(circles(graph))}"),
        *((f"modules of {topic}", f"{count}") for topic, count in walks(graph).items()),
        ("modules with one importer", f"{single_importers(graph)}"),
        ("functions with more than six arguments", f"{many_arguments(trees)}"),
        ("numeric constants", f"{constants(trees)}"),
        ("comment lines", f"{comment_share(package, trees):.1%}"),
        ("median module", f"{median(length for length, _ in lines):g} lines"),
        ("longest module", f"{lines[-1][0]} lines, {lines[-1][1]}"),
        ("median function", f"{median(length for length, _ in lengths):g} lines"),
        ("longest function", f"{lengths[-1][0]} lines, {lengths[-1][1]}"),
    ]
    if static:
        return rows
    rows += [(f"one run: {name}", str(count)) for name, count in sorted(counts(checkout).items())]
    ratio = seconds_to_import("calibray.result.record", checkout) / seconds_to_import("pandas", checkout)
    return [*rows, ("import calibray.result.record / import pandas", f"{ratio:.1f}")]


def main() -> None:
    """Print the table of the checkout given as an argument, or of this one."""
    words = [word for word in sys.argv[1:] if word != "--static"]
    checkout = Path(words[0] if words else Path(__file__).parents[1]).resolve()
    for label, figure in table(checkout, "--static" in sys.argv):
        sys.stdout.write(f"{label:<40} {figure}\n")


if __name__ == "__main__":
    main()
