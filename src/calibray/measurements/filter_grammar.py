"""What there is in a row filter: its operators, functions and methods, and the tree that its text is parsed into."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from calibray.errors import InputError
from calibray.support.messages import shortened

MAX_LENGTH: Final = 10_000
"""The number of characters beyond which a filter is refused."""

MAX_PARTS: Final = 2_000
"""The number of names, values and operators beyond which a filter is refused."""

MAX_DEPTH: Final = 50
"""How deep the parts of a filter may lie in each other."""

COMPARISONS: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], Any]]] = MappingProxyType(
    {
        ast.Eq: operator.eq,
        ast.NotEq: operator.ne,
        ast.Lt: operator.lt,
        ast.LtE: operator.le,
        ast.Gt: operator.gt,
        ast.GtE: operator.ge,
    }
)
"""The comparisons."""

ARITHMETIC: Final[Mapping[type[ast.operator], Callable[[Any, Any], Any]]] = MappingProxyType(
    {
        ast.Add: operator.add,
        ast.Sub: operator.sub,
        ast.Mult: operator.mul,
        ast.Div: operator.truediv,
        ast.FloorDiv: operator.floordiv,
        ast.Mod: operator.mod,
        ast.Pow: operator.pow,
    }
)
"""The operators between numbers."""

FUNCTIONS: Final[Mapping[str, np.ufunc]] = MappingProxyType(
    {
        name: getattr(np, name)
        for name in (
            *("abs", "arctan2", "ceil", "cos", "exp", "floor"),
            *("log", "log10", "sin", "sqrt", "tan"),
        )
    }
)
"""The functions that a filter may call, over numbers."""

METHODS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {"abs": (), "between": ("left", "right", "inclusive"), "isin": ("values",), "isna": (), "notna": ()}
)
"""The methods of a column, each with its arguments in order."""

TEXT_METHODS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "contains": ("pat", "case", "regex", "na"),
        "endswith": ("pat", "na"),
        "lower": (),
        "startswith": ("pat", "na"),
        "strip": ("to_strip",),
        "upper": (),
    }
)
"""The methods after ``.str``, likewise."""

# Texts and backticked names are told from the rest, in which alone `&` and `|` are operators.
_TOKENS: Final = re.compile(
    r"""(?P<text>'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*")|`(?P<column>[^`\n]+)`|(?P<sign>[&|])"""
)


def as_python(expression: str) -> tuple[str, dict[str, str]]:
    """Write a filter as Python knows expressions.

    Args:
        expression: The filter.

    Returns:
        The expression, and the columns that its stand-ins for backticked names mean.
    """
    stem = "quoted"
    while stem in expression:
        stem += "_"
    quoted: dict[str, str] = {}

    def plain(match: re.Match[str]) -> str:
        if match["column"] is not None:
            quoted[f"{stem}{len(quoted)}"] = match["column"]
            return f" {next(reversed(quoted))} "
        return match[0] if match["text"] is not None else {"&": " and ", "|": " or "}[match["sign"]]

    return _TOKENS.sub(plain, expression).strip(), quoted


def parse(code: str, columns: Iterable[object]) -> ast.expr:
    """Parse an expression.

    Args:
        code: The expression.
        columns: The names of the columns, for messages.

    Returns:
        Its tree.

    Raises:
        InputError: It is malformed, or too large to be walked.
    """
    try:
        tree = ast.parse(code, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        fault = getattr(error, "msg", None) or str(error) or "too deep"
        names = shortened(", ".join(map(str, columns)), 200)
        raise InputError(
            f"not a valid filter ({fault}); compare as in \"x < 5 and set == 'LOS'\"; the columns are {names}"
        ) from None
    parts, level = 0, [tree]
    for _ in range(MAX_DEPTH):
        parts += len(level)
        # An operator is a node without fields; its own level would halve the depth.
        level = [
            child for node in level for child in ast.iter_child_nodes(node) if isinstance(child, ast.AST)
        ]
        if parts > MAX_PARTS:
            raise InputError(f"more than {MAX_PARTS} parts; shorten it, or add a column to filter by")
        if not level:
            return tree
    raise InputError(f"parts lie more than {MAX_DEPTH} deep in each other; shorten it")
