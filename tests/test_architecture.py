"""Rules for the whole code base: imports go one way, every test runs, docstrings tell what is raised."""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SOURCE = TESTS.parent / "src" / "calibray"
MODULES = sorted(SOURCE.rglob("*.py"))

# What each module may import, and with it whatever that one may. A module that is not named here is a part of
# those that import it, and may import no more than they may. Everything may import `errors`.
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "llvm": set(),
    "materials": set(),
    "measurements": set(),
    "optimizers": set(),
    "parameter": {"materials"},
    "parameters": {"parameter"},
    "paths": {"materials"},
    "tracing": {"paths", "measurements", "llvm"},
    "fields": {"paths"},
    "scenarios": {"fields", "tracing"},
    "study": {"measurements", "parameters"},
    "compression": {"fields", "parameters"},
    "engines": {"compression", "fields", "tracing", "study"},
    "convergence": {"fields", "tracing"},
    "inference": {"measurements"},
    "calibration": {"engines", "inference", "optimizers"},
    "comparison": {"calibration"},
    "report": {"comparison"},
    "doctor": {"llvm"},
}
TRACER = {"sionna", "mitsuba", "drjit"}
LIBRARIES: dict[str, set[str]] = {
    "optimizers": {"numpy", "scipy", "cma", "dfols", "optuna", "torch", "botorch", "gpytorch"},
    "fields": {"jax", "numpy", "scipy"},
}


def imported(source: str, package: str = "calibray") -> set[str]:
    """Dotted names of all that a module in `package` imports, wherever in it the import stands."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*parents, *([node.module] if node.module else [])])
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


def top(path: Path) -> str:
    """The module of the design that a file belongs to: a package counts as one."""
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def import_graph(sources: Iterable[tuple[str, set[str]]]) -> dict[str, set[str]]:
    """Which module of the design imports which; `<root>` stands for names that the package itself offers."""
    sources = list(sources)
    known = {module for module, _ in sources}
    graph: dict[str, set[str]] = {module: set() for module in known}
    for module, names in sources:
        for name in names:
            head, _, rest = name.partition(".")
            if head == "calibray":
                target = rest.split(".")[0]
                graph[module].add(target if target in known else "<root>")
        graph[module].discard(module)
    return graph


def reached(graph: Mapping[str, set[str]], module: str) -> set[str]:
    """All modules that a module imports, directly or through others."""
    found: set[str] = set()
    open_ends = set(graph.get(module, ()))
    while open_ends:
        found |= open_ends
        open_ends = set().union(*(graph.get(name, set()) for name in open_ends)) - found
    return found


def against_the_table(graph: Mapping[str, set[str]]) -> list[str]:
    """Imports that the table of modules does not allow."""
    named = set(MAY_IMPORT) | {"<root>"}
    return [
        f"{module} reaches {other}"
        for module in sorted(set(MAY_IMPORT) & set(graph))
        for other in sorted((reached(graph, module) & named) - reached(MAY_IMPORT, module) - {"errors"})
    ]


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


def own_nodes(function: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a function, without those of functions and classes within it."""
    for node in ast.iter_child_nodes(function):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda):
            yield node
            yield from own_nodes(node)


def exceptions_raised(function: ast.AST) -> set[str]:
    """Exceptions that a function raises itself; passing one on with a bare `raise` is not counted."""
    raised = {
        node.exc for node in own_nodes(function) if isinstance(node, ast.Raise) and node.exc is not None
    }
    names = {ast.unparse(each.func if isinstance(each, ast.Call) else each) for each in raised}
    # How a command of the command line ends; its docstring is the help text.
    return names - {"typer.Exit"}


def public_definitions(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Public functions, classes and methods with their qualified names."""
    open_scopes: list[tuple[str, ast.Module | ast.ClassDef]] = [("", tree)]
    while open_scopes:
        prefix, scope = open_scopes.pop()
        for node in scope.body:
            if (
                isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
                and node.name[0] != "_"
            ):
                yield prefix + node.name, node
                if isinstance(node, ast.ClassDef):
                    open_scopes.append((f"{prefix}{node.name}.", node))


def is_stub(node: ast.AST) -> bool:
    """Whether the body is a mere `...`, as in a protocol."""
    return all(
        isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) for line in node.body
    ) and any(line.value.value is ... for line in node.body)


def docstring_faults(source: str) -> list[str]:
    """Public things without a docstring, and exceptions that the `Raises:` section leaves out."""
    tree = ast.parse(source)
    faults = [] if ast.get_docstring(tree) or not tree.body else ["the module has no docstring"]
    for name, node in public_definitions(tree):
        docstring = ast.get_docstring(node)
        if docstring is None and not is_stub(node):
            faults.append(f"{name} has no docstring")
        if not isinstance(node, ast.ClassDef):
            section = (docstring or "").partition("Raises:\n")[2]
            for raised in sorted(exceptions_raised(node)):
                # `raise explain(error)` does not name its class, so any section will do.
                if (raised if raised.split(".")[-1][0].isupper() else ":") not in section:
                    faults.append(f"{name} raises {raised}")
    return faults


def each_module(test):
    """Runs a test once for each file of the package."""
    names = [path.relative_to(SOURCE).as_posix() for path in MODULES]
    return pytest.mark.parametrize("path", MODULES, ids=names)(test)


def package_of(path: Path) -> str:
    """The dotted name of the package that a file lies in."""
    return ".".join(["calibray", *path.relative_to(SOURCE).parent.parts])


def test_imports_go_one_way():
    files = [(top(path), imported(path.read_text(), package_of(path))) for path in MODULES]
    graph = import_graph((module, names) for module, names in files if module not in {"__init__", "cli"})
    assert against_the_table(graph) == []
    # A cycle raises CycleError, which names it.
    assert set(TopologicalSorter(graph).static_order()) >= set(graph)


@each_module
def test_libraries_stay_in_their_module(path):
    libraries = {name.split(".")[0] for name in imported(path.read_text(), package_of(path))} - {"calibray"}
    if top(path) != "tracing":
        assert not libraries & TRACER
    if top(path) in LIBRARIES:
        assert libraries - LIBRARIES[top(path)] <= sys.stdlib_module_names


@each_module
def test_there_is_no_assert(path):
    tree = ast.parse(path.read_text())
    assert [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Assert)] == []


@each_module
def test_docstrings_exist_and_tell_what_is_raised(path):
    assert docstring_faults(path.read_text()) == []


def test_every_test_is_collected():
    lost = {path.name: uncollected_tests(path.read_text(), path.name) for path in TESTS.rglob("*.py")}
    assert {name: tests for name, tests in lost.items() if tests} == {}


@pytest.mark.parametrize(
    ("imports", "fault"),
    [
        ({"paths": {"calibray.fields"}, "fields": set()}, "paths reaches fields"),
        ({"paths": {"calibray.part"}, "part": {"calibray.study"}, "study": set()}, "paths reaches study"),
        ({"optimizers": {"calibray.materials.Material"}, "materials": set()}, "optimizers reaches materials"),
        ({"fields": {"calibray.Study"}, "study": set()}, "fields reaches <root>"),
    ],
)
def test_an_import_against_the_table_is_found(imports, fault):
    assert against_the_table(import_graph(imports.items())) == [fault]


def test_imports_that_the_table_allows_pass():
    imports = {
        "fields": {"calibray.paths.program.Paths", "calibray.part.tool", "jax.numpy"},
        "paths": {"calibray.materials.Material", "calibray.errors.InputError"},
        "part": {"calibray.materials"},
        "materials": set(),
        "errors": set(),
    }
    assert against_the_table(import_graph(imports.items())) == []


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import sionna.rt as rt", {"sionna.rt"}),
        ("def f():\n    from calibray import study", {"calibray.study"}),
        ("from . import box", {"calibray.optimizers.box"}),
        ("from ..errors import InputError", {"calibray.errors.InputError"}),
    ],
)
def test_imports_are_seen_wherever_they_stand(source, names):
    assert imported(source, "calibray.optimizers") == names


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


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("x = 1", ["the module has no docstring"]),
        ('"""M."""\ndef f(): return 1', ["f has no docstring"]),
        ('"""M."""\nclass C:\n    """C."""\n    def f(self): return 1', ["C.f has no docstring"]),
        ('"""M."""\ndef f():\n    """F."""\n    raise InputError("x")', ["f raises InputError"]),
        (
            '"""M."""\ndef f():\n    """F.\n\n    Raises:\n        KeyError: X.\n    """\n    raise KeyError',
            [],
        ),
        ('"""M."""\ndef f():\n    """F."""\n    raise explain("x")', ["f raises explain"]),
        ('"""M."""\ndef f():\n    """F.\n\n    Raises:\n        KeyError: X.\n    """\n    raise told()', []),
        ('"""M."""\ndef f():\n    """F."""\n    try: g()\n    except ValueError: raise', []),
        ('"""M."""\ndef f():\n    """F."""\n    def g(): raise ValueError', []),
        ('"""M."""\ndef _f(): raise ValueError', []),
    ],
)
def test_a_docstring_that_keeps_quiet_is_found(source, faults):
    assert docstring_faults(source) == faults
