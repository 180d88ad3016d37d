"""The language of row filters: its operators, functions and methods, and the regular expressions that it allows."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import pandas as pd

from calibray.errors import InputError

MAX_PATTERN_LENGTH: Final = 200
"""Largest number of characters of a regular expression."""

MAX_SEARCH_STEPS: Final = 1e9
"""Largest sum of squared text lengths in a column that is searched for a repetition; the search then takes 2 to 5 s."""

COMPARISONS: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], Any]]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}  # fmt: skip
"""The comparisons, in addition to `in` and `not in`."""

ARITHMETIC: Final[Mapping[type[ast.operator], Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow,
}  # fmt: skip
"""The operators between numbers."""

FUNCTIONS: Final[Mapping[str, np.ufunc]] = {
    name: getattr(np, name)
    for name in ("abs", "arctan2", "ceil", "cos", "exp", "floor", "log", "log10", "sin", "sqrt", "tan")
}  # fmt: skip
"""The functions of numbers."""


# The functions below are the methods of columns. Their parameters are the arguments that a filter may give.


def _between(column: pd.Series, left: Any, right: Any, inclusive: Any = "both") -> pd.Series:
    if isinstance(left, list | tuple) or isinstance(right, list | tuple):
        raise InputError("left and right must be single values or columns")
    if inclusive not in ("both", "left", "right", "neither"):
        raise InputError("inclusive must be one of both, left, right, neither")
    return column.between(left, right, inclusive)


def _isin(column: pd.Series, values: Any) -> pd.Series:
    if not isinstance(values, list | tuple):
        raise InputError("must be a list of values, as in ['A', 'B']")
    return column.isin(list(values))


def _contains(column: pd.Series, pat: Any, case: Any = True, regex: Any = True, na: Any = False) -> pd.Series:
    _check_types(bool, case=case, regex=regex, na=na)
    _check_types(str, pat=pat)
    if regex:
        _check_pattern(pat, column)
    return column.str.contains(pat, case=case, regex=regex, na=na)


def _startswith(column: pd.Series, pat: Any, na: Any = False) -> pd.Series:
    _check_prefix(pat, na)
    return column.str.startswith(pat, na=na)


def _endswith(column: pd.Series, pat: Any, na: Any = False) -> pd.Series:
    _check_prefix(pat, na)
    return column.str.endswith(pat, na=na)


def _strip(column: pd.Series, to_strip: Any = None) -> pd.Series:
    if to_strip is not None:
        _check_types(str, to_strip=to_strip)
    return column.str.strip(to_strip)


METHODS: Final[Mapping[str, Callable[..., pd.Series]]] = {
    "abs": lambda column: abs(column),
    "between": _between,
    "isin": _isin,
    "isna": lambda column: column.isna(),
    "notna": lambda column: column.notna(),
}  # fmt: skip
"""The methods of a column."""

TEXT_METHODS: Final[Mapping[str, Callable[..., pd.Series]]] = {
    "contains": _contains,
    "endswith": _endswith,
    "lower": lambda column: column.str.lower(),
    "startswith": _startswith,
    "strip": _strip,
    "upper": lambda column: column.str.upper(),
}  # fmt: skip
"""The methods of a column of texts, after ``.str``."""


def _check_types(kind: type, **values: Any) -> None:
    for name, value in values.items():
        if not isinstance(value, kind):
            raise InputError(f"{name} must be {'a text in quotes' if kind is str else 'True or False'}")


def _check_prefix(pat: Any, na: Any) -> None:
    _check_types(bool, na=na)
    for text in pat if isinstance(pat, tuple) else (pat,):
        _check_types(str, pat=text)


# A regular expression with several repetitions, or with a repeated group, can take longer than anyone waits. Allowed
# are alternatives of single characters and classes, of which one per alternative may repeat. `*+` is possessive, so
# that checking a pattern is cheap as well.
_CLASS: Final = r"\[\^?(?:\\.|[^\[\]\\])+\]"
_CHARACTER: Final = rf"(?:\\[^0-9A-Za-z]|\\[bBdDsSwW]|{_CLASS}|[^\\^$*+?{{}}\[\]()|])"
_ALTERNATIVE: Final = rf"\^?{_CHARACTER}*+[*+?]?{_CHARACTER}*+\$?"
_PATTERN: Final = re.compile(rf"{_ALTERNATIVE}(?:\|{_ALTERNATIVE})*+")
_REPETITION: Final = re.compile(rf"(?:{_CLASS}|\\.|[^*+?])*+[*+?]")


def _check_pattern(pattern: str, column: pd.Series) -> None:
    """Refuse a regular expression that is malformed or whose search in a column might not end."""
    if len(pattern) > MAX_PATTERN_LENGTH:
        raise InputError(f"{len(pattern)} characters, must be at most {MAX_PATTERN_LENGTH}; shorten it")
    try:
        re.compile(pattern)
    except (re.error, OverflowError) as error:
        raise InputError(
            f"not a regular expression ({error}); set regex=False to search for a plain text"
        ) from None
    if not _PATTERN.fullmatch(pattern):
        raise InputError(
            "only characters, classes, ^, $, | and one *, + or ? per alternative are allowed; set regex=False to "
            "search for a plain text"
        )
    # Each start of a search may run to the end of the text: the cost grows with the square of its length.
    if _REPETITION.match(pattern):
        steps = float((column.dropna().astype(str).str.len().astype(float) ** 2).sum())
        if steps > MAX_SEARCH_STEPS:
            raise InputError("the texts are too long to search for a repetition; set regex=False")
