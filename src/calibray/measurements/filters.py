"""Row filters: a small expression language that selects rows of a table by the values in the table's columns.

Python parses a filter into a syntax tree; this module evaluates the tree on whole columns, without calling `eval`. Only
the operators, functions and methods listed below are allowed. Filters cannot contain subscripts, attributes or calls of
other functions. As in pandas queries, ``&`` and ``|`` mean ``and`` and ``or`` and have the same low precedence.
"""

from __future__ import annotations

import ast
import inspect
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from math import inf, isfinite
from typing import Any, Final, TypeGuard, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.support.messages import did_you_mean, shortened

MAX_LENGTH: Final = 10_000
"""Maximum number of characters in a filter."""

MAX_PARTS: Final = 2_000
"""Maximum number of names, values and operators in a filter."""

MAX_DEPTH: Final = 50
"""Maximum nesting depth of a filter."""

MAX_PATTERN_LENGTH: Final = 200
"""Maximum number of characters in a regular expression."""

MAX_SEARCH_STEPS: Final = 1e9
"""Limit for searching a column with a pattern that contains a repetition: maximum of the squared text lengths, summed
over the column. At this limit, a search takes 2 to 5 s."""

_MAX_INTEGER: Final = int(np.iinfo(np.int64).max)

_Value = pd.Series | bool | int | float | str
_Item = TypeVar("_Item")

COMPARISONS: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], Any]]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}  # fmt: skip
"""Comparison operators that a filter may use, in addition to `in` and `not in`."""

ARITHMETIC: Final[Mapping[type[ast.operator], Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow,
}  # fmt: skip
"""Arithmetic operators that a filter may use."""

FUNCTIONS: Final[Mapping[str, np.ufunc]] = {
    name: getattr(np, name)
    for name in ("abs", "arctan2", "ceil", "cos", "exp", "floor", "log", "log10", "sin", "sqrt", "tan")
}  # fmt: skip
"""Numeric functions that a filter may call."""


# The functions below are the methods of columns. Their parameters are the arguments that a filter may pass.


def _between(column: pd.Series, left: Any, right: Any, inclusive: Any = "both") -> pd.Series:
    if isinstance(left, list | tuple) or isinstance(right, list | tuple):
        raise InputError("left and right must be single values or columns")
    if inclusive not in ("both", "left", "right", "neither"):
        raise InputError("inclusive must be one of both, left, right, neither")
    return column.between(left, right, inclusive)


def _isin(column: pd.Series, values: Any) -> pd.Series:
    if not isinstance(values, list | tuple):
        raise InputError("must be a list of values, as in ['A', 'B']")
    _check_equality(column, values)
    return column.isin(list(values))


def _check_equality(column: pd.Series, values: Iterable[Any]) -> None:
    """Reject a comparison of a text column with numbers alone, or of a numeric column with text alone."""
    kinds = {isinstance(value, str) for value in values if value is not None}
    is_text = pd.api.types.infer_dtype(column, skipna=True) == "string"
    if kinds == {False} and is_text:
        raise InputError("the column contains text, which never equals a number; put the values in quotes")
    if kinds == {True} and pd.api.types.is_numeric_dtype(column.dtype) and column.notna().any():
        raise InputError(
            "the column contains numbers, which never equal text; remove the quotes around the values"
        )


def _contains(column: pd.Series, pat: Any, case: Any = True, regex: Any = True, na: Any = False) -> pd.Series:
    _check_types(bool, case=case, regex=regex, na=na)
    _check_types(str, pat=pat)
    if regex:
        _check_pattern(pat, column)
    return column.str.contains(pat, case=case, regex=regex, na=na)


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
"""Methods of a column that a filter may call."""

TEXT_METHODS: Final[Mapping[str, Callable[..., pd.Series]]] = {
    "contains": _contains,
    "endswith": lambda column, pat, na=False: column.str.endswith(_affix(pat, na), na=na),
    "lower": lambda column: column.str.lower(),
    "startswith": lambda column, pat, na=False: column.str.startswith(_affix(pat, na), na=na),
    "strip": _strip,
    "upper": lambda column: column.str.upper(),
}  # fmt: skip
"""Methods of a column of text that a filter may call after ``.str``."""


def _check_types(kind: type, **values: Any) -> None:
    for name, value in values.items():
        if not isinstance(value, kind):
            raise InputError(f"{name} must be {'text in quotes' if kind is str else 'True or False'}")


def _affix(pat: Any, na: Any) -> Any:
    """Check the argument of a prefix or suffix test: a string, or a tuple of strings."""
    _check_types(bool, na=na)
    for text in pat if isinstance(pat, tuple) else (pat,):
        _check_types(str, pat=text)
    return pat


# In practice, a search for a pattern with several repetitions or with a repeated group may never end. The allowed
# patterns are alternatives of single characters and classes, one of which may repeat in each alternative. `*+` is
# possessive, so checking a pattern is also cheap.
_CLASS: Final = r"\[\^?(?:\\.|[^\[\]\\])+\]"
_CHARACTER: Final = rf"(?:\\[^0-9A-Za-z]|\\[bBdDsSwW]|{_CLASS}|[^\\^$*+?{{}}\[\]()|])"
_ALTERNATIVE: Final = rf"\^?{_CHARACTER}*+[*+?]?{_CHARACTER}*+\$?"
_PATTERN: Final = re.compile(rf"{_ALTERNATIVE}(?:\|{_ALTERNATIVE})*+")
_REPETITION: Final = re.compile(rf"(?:{_CLASS}|\\.|[^*+?])*+[*+?]")


def _check_pattern(pattern: str, column: pd.Series) -> None:
    """Reject a regular expression that is malformed or could take too long to search a column."""
    if len(pattern) > MAX_PATTERN_LENGTH:
        raise InputError(
            f"{len(pattern)} characters, but at most {MAX_PATTERN_LENGTH} are allowed; shorten it"
        )
    try:
        re.compile(pattern)
    except (re.error, OverflowError) as error:
        raise InputError(
            f"not a regular expression ({error}); set regex=False to search for plain text"
        ) from None
    if not _PATTERN.fullmatch(pattern):
        raise InputError(
            "a pattern can contain only characters, classes, ^, $, | and one *, + or ? per alternative; set "
            "regex=False to search for plain text"
        )
    # The match attempt at each position may run to the end of the text, so the cost is quadratic in the text length.
    if _REPETITION.match(pattern):
        steps = float((column.dropna().astype(str).str.len().astype(float) ** 2).sum())
        if steps > MAX_SEARCH_STEPS:
            raise InputError("the text is too long for a pattern with a repetition; set regex=False")


def evaluate(expression: str, frame: pd.DataFrame) -> NDArray[np.bool_]:
    """Evaluate a filter on a table; the result is a mask [rows] of the rows that pass.

    A missing value passes only the comparisons `!=` and `not in`.

    Raises:
        InputError: The filter is malformed or too large, uses an unknown column or a forbidden construct, or does not
            give true or false for each row. The message quotes the faulty part of the filter, but does not say where
            the filter comes from.

    Example:
        >>> frame = pd.DataFrame({"x": [1, 2, 3], "my set": ["A", "B", "A"]})
        >>> evaluate("x >= 2 and `my set` == 'A'", frame).tolist()
        [False, False, True]
    """
    if len(expression) > MAX_LENGTH:
        raise InputError(f"{len(expression)} characters, but at most {MAX_LENGTH} are allowed; shorten it")
    code, backticked = _as_python(expression.strip())
    # Python warns about escapes in strings, and pandas about groups in patterns; neither warning helps the author of a
    # filter.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        result = _Interpreter(frame, code, backticked).value(_parse(code, frame))
    if not _is_column_of_truths(result):
        raise InputError("must be true or false for each row, for instance \"set == 'LOS'\"")
    return result.to_numpy(dtype=bool, na_value=False)


# Matches strings and backticked names, so that `&` and `|` are replaced only outside them.
_TOKENS: Final = re.compile(
    r"""(?P<text>'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*")|`(?P<column>[^`\n]+)`|(?P<sign>[&|])"""
)


def _as_python(expression: str) -> tuple[str, dict[str, str]]:
    """Rewrite a filter as a Python expression in which a placeholder replaces each name in backticks.

    The second return value maps each placeholder to its column.
    """
    stem = "quoted"
    while stem in expression:
        stem += "_"
    backticked: dict[str, str] = {}

    def replacement(match: re.Match[str]) -> str:
        if match["column"] is not None:
            name = f"{stem}{len(backticked)}"
            backticked[name] = match["column"]
            return f" {name} "
        return match[0] if match["text"] is not None else {"&": " and ", "|": " or "}[match["sign"]]

    return _TOKENS.sub(replacement, expression).strip(), backticked


def _parse(code: str, columns: Iterable[object]) -> ast.expr:
    """Parse an expression into a syntax tree. Malformed and excessively large expressions are rejected."""
    try:
        tree = ast.parse(code, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        fault = getattr(error, "msg", None) or str(error) or "too deep"
        names = shortened(", ".join(map(str, columns)), 200)
        raise InputError(
            f"not a valid filter ({fault}); write a comparison such as \"x < 5 and set == 'LOS'\"; the columns are "
            f"{names}"
        ) from None
    parts = 0
    level: list[ast.AST] = [tree]
    for _ in range(MAX_DEPTH):
        parts += len(level)
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if parts > MAX_PARTS:
            raise InputError(
                f"more than {MAX_PARTS} parts; shorten the filter, or add a column to the table for filtering"
            )
        if not level:
            return tree
    raise InputError(f"more than {MAX_DEPTH} nested levels; shorten the filter")


class _Interpreter:
    """Evaluates one filter on one table."""

    def __init__(self, frame: pd.DataFrame, code: str, backticked: Mapping[str, str]) -> None:
        self._frame, self._code, self._backticked = frame, code, backticked

    def value(self, node: ast.expr) -> _Value:
        """Evaluate part of a filter; the result is a column, or a single number, string or truth value."""
        try:
            match node:
                case ast.Name():
                    return self._name(node)
                case ast.Constant():
                    return self._constant(node)
                case ast.BoolOp():
                    join = operator.and_ if isinstance(node.op, ast.And) else operator.or_
                    return reduce(join, [self._truth(part) for part in node.values])
                case ast.UnaryOp(op=ast.Not() | ast.Invert()):
                    truth = self._truth(node.operand)
                    return not truth if isinstance(truth, bool) else ~truth
                case ast.UnaryOp():
                    number = self._number(node.operand)
                    return -number if isinstance(node.op, ast.USub) else number
                case ast.Compare():
                    return self._comparison(node)
                case ast.BinOp():
                    return self._arithmetic(node)
                case ast.Call():
                    return self._call(node)
        except InputError:
            raise
        except (TypeError, ValueError, AttributeError, ArithmeticError, NotImplementedError) as error:
            fault = shortened(str(error).split("\n")[0], 120)
            raise self._refusal(node, f"not a valid filter ({fault}); correct it") from None
        raise self._refusal(
            node,
            "not allowed in a filter; use comparisons, and, or, not, arithmetic, in, columns, values, and the "
            f"methods {', '.join((*METHODS, *TEXT_METHODS))}",
        )

    def _refusal(self, node: ast.AST, fault: str) -> InputError:
        """Create the error for a faulty part of the filter. The message quotes this part as the user wrote it."""
        piece = ast.get_source_segment(self._code, node) or type(node).__name__
        for name, column in self._backticked.items():
            piece = piece.replace(name, f"`{column}`")
        return InputError(f"{shortened(piece)}: {fault}")

    def _name(self, node: ast.Name) -> _Value:
        # Python normalizes identifiers: a full-width x becomes a plain x. Column names are therefore looked up as
        # written.
        written = ast.get_source_segment(self._code, node) or node.id
        name = self._backticked.get(written, written)
        if name not in self._frame:
            if name == "inf":
                return inf
            raise InputError(f"no column {shortened(name)!r}; {did_you_mean(name, map(str, self._frame))}")
        column = self._frame[name]
        if not isinstance(column, pd.Series):
            raise InputError(f"column {name!r} appears several times in the table; rename one of them")
        return column

    def _constant(self, node: ast.Constant) -> bool | int | float | str:
        if not isinstance(node.value, bool | int | float | str):
            remedy = "use isna() or notna()" if node.value is None else "use a number, text, True or False"
            raise self._refusal(node, f"not allowed in a filter; {remedy}")
        if isinstance(node.value, int) and abs(node.value) > _MAX_INTEGER:
            raise self._refusal(node, f"the number is too large; it must be at most {_MAX_INTEGER}")
        return node.value

    def _truth(self, node: ast.expr) -> pd.Series | bool:
        value = self.value(node)
        if isinstance(value, bool) or _is_column_of_truths(value):
            return value
        raise self._refusal(
            node,
            "must be true or false to be combined with and, or, not; write a comparison, or put comparisons in "
            "parentheses",
        )

    def _number(self, node: ast.expr) -> pd.Series | int | float:
        value = self.value(node)
        if isinstance(value, pd.Series):
            if pd.api.types.is_numeric_dtype(value.dtype) and not pd.api.types.is_bool_dtype(value.dtype):
                return value
        elif isinstance(value, int | float) and not isinstance(value, bool):
            return value
        raise self._refusal(node, "must be a number or a column of numbers for arithmetic")

    def _column(self, node: ast.expr) -> pd.Series:
        value = self.value(node)
        if not isinstance(value, pd.Series):
            raise self._refusal(node, "must be a column or an expression with a column")
        return value

    def _literals(self, node: ast.List | ast.Tuple) -> list[bool | int | float | str | None]:
        """Evaluate the items of a list or tuple: constants, signed numbers, and None for a missing value."""
        values: list[Any] = []
        for item in node.elts:
            negative = isinstance(item, ast.UnaryOp) and isinstance(item.op, ast.USub)
            constant = item.operand if isinstance(item, ast.UnaryOp) and negative else item
            if not isinstance(constant, ast.Constant):
                raise self._refusal(item, "must be a number, text, True or False")
            if constant.value is None and not negative:
                values.append(None)
            else:
                values.append(self._number(item) if negative else self._constant(constant))
        return values

    def _comparison(self, node: ast.Compare) -> pd.Series | bool:
        """A comparison, or a chain such as `1 < x < 3`."""
        # Each side is evaluated once, because evaluating it for both adjacent comparisons would double the cost at
        # every level.
        sides = [node.left, *node.comparators]
        values = [self.value(node.left), *(self._argument(side) for side in node.comparators)]
        results = [
            self._compare(node, type(node.ops[k]), sides[k : k + 2], values[k : k + 2])
            for k in range(len(node.ops))
        ]
        return reduce(operator.and_, results)

    def _compare(
        self, node: ast.Compare, kind: type[ast.cmpop], sides: list[ast.expr], values: list[Any]
    ) -> pd.Series | bool:
        left, right = values
        several = isinstance(right, list | tuple)
        if kind in (ast.In, ast.NotIn) or (several and kind in (ast.Eq, ast.NotEq)):
            if not isinstance(left, pd.Series):
                raise self._refusal(sides[0], "must be a column or an expression with a column")
            choices = [right] if isinstance(right, str) else right
            if not isinstance(choices, list | tuple | pd.Series):
                raise self._refusal(sides[1], "must be a list of values, as in ['A', 'B']")
            self._check_equality(node, left, choices)
            contained = left.isin(choices)
            return contained if kind in (ast.In, ast.Eq) else ~contained
        if kind not in COMPARISONS:
            raise self._refusal(node, "'is' and 'is not' are not allowed; use ==, != or isna()")
        for side, value in zip(sides, values, strict=True):
            if isinstance(value, list | tuple):
                raise self._refusal(side, "a list of values can be compared only with in, not in, == and !=")
        if kind in (ast.Eq, ast.NotEq):
            self._check_equality(node, left, [right])
            self._check_equality(node, right, [left])
        return COMPARISONS[kind](left, right)

    def _check_equality(self, node: ast.Compare, column: Any, values: Any) -> None:
        is_constant = not isinstance(values, pd.Series) and not any(
            isinstance(each, pd.Series) for each in values
        )
        if isinstance(column, pd.Series) and is_constant:
            try:
                _check_equality(column, values)
            except InputError as error:
                raise self._refusal(node, str(error)) from None

    def _arithmetic(self, node: ast.BinOp) -> _Value:
        operation: Callable[[Any, Any], Any] | None = ARITHMETIC.get(type(node.op))
        if operation is None:
            raise self._refusal(node, "only + - * / // % ** are allowed between numbers")
        left, right = self._number(node.left), self._number(node.right)
        if isinstance(node.op, ast.Pow):
            # Powers of whole numbers are computed in floating point, which is fast and does not wrap around.
            left, right = _as_floats(left), _as_floats(right)
        # Whole numbers in columns wrap around silently, and division by zero gives infinity; `_overflows` detects
        # both.
        result = operation(left, right)
        if _overflows(operation, left, right, result):
            raise self._refusal(node, "the result is too large; correct the expression")
        return result

    def _call(self, node: ast.Call) -> _Value:
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if not (ast.get_source_segment(self._code, node.func) or "").endswith(name):
            # The name contains letters that Python normalizes.
            raise self._refusal(node.func, f"write the method in ASCII letters, as {name!r}")
        match node.func:
            case ast.Name():
                function = _allowed(name, FUNCTIONS)
                if node.keywords or len(node.args) != function.nin:
                    raise self._refusal(node, f"needs exactly {function.nin} number(s)")
                return function(*(_as_floats(self._number(argument)) for argument in node.args))
            case ast.Attribute(value=ast.Attribute(value=owner, attr="str")):
                method, column = _allowed(name, TEXT_METHODS), self._column(owner)
                if not (pd.api.types.is_string_dtype(column.dtype) or column.dtype == object):
                    raise self._refusal(owner, f"must be a column of text; remove .str.{name}()")
                return self._call_method(node, name, method, column)
            case ast.Attribute(value=owner):
                method = _allowed(name, METHODS)
                column = self._number(owner) if name == "abs" else self._column(owner)
                return self._call_method(node, name, method, column)
        raise self._refusal(node, "not allowed in a filter; only methods of columns may be called")

    def _call_method(
        self, node: ast.Call, name: str, method: Callable[..., Any], column: pd.Series | int | float
    ) -> _Value:
        signature = inspect.signature(method)
        keywords = {str(keyword.arg): self._argument(keyword.value) for keyword in node.keywords}
        try:
            arguments = signature.bind(column, *map(self._argument, node.args), **keywords)
        except TypeError:
            parameters = ", ".join([*signature.parameters][1:]) or "no arguments"
            raise self._refusal(node, f"{name}() takes {parameters}; correct it") from None
        try:
            return method(*arguments.args, **arguments.kwargs)
        except InputError as error:
            raise self._refusal(node, str(error)) from None

    def _argument(self, node: ast.expr) -> Any:
        """Evaluate an argument, which can also be a list or tuple of literals."""
        if isinstance(node, ast.Tuple):
            return tuple(self._literals(node))
        return self._literals(node) if isinstance(node, ast.List) else self.value(node)


def _allowed(name: str, items: Mapping[str, _Item]) -> _Item:
    if name not in items:
        raise InputError(f"{shortened(name)}() is not allowed; {did_you_mean(name, items)}")
    return items[name]


def _is_column_of_truths(value: Any) -> TypeGuard[pd.Series]:
    return isinstance(value, pd.Series) and bool(pd.api.types.is_bool_dtype(value.dtype))


def _as_floats(number: pd.Series | int | float) -> pd.Series | np.float64:
    if not isinstance(number, pd.Series):
        return np.float64(number)
    # Extension types keep their missing values.
    return number.astype("Float64" if isinstance(number.dtype, pd.api.extensions.ExtensionDtype) else float)


def _overflows(operation: Callable[[Any, Any], Any], left: Any, right: Any, result: Any) -> bool:
    """Whether a result is infinite or has wrapped around because it exceeds the integer range of its column."""
    if not isinstance(result, pd.Series):
        return not isfinite(result) or (isinstance(result, int) and abs(result) > _MAX_INTEGER)
    if result.dtype.kind not in "iu" or not len(result):
        return False
    left, right = (
        side.to_numpy(dtype=np.float64, na_value=np.nan) if isinstance(side, pd.Series) else float(side)
        for side in (left, right)
    )
    exact = np.asarray(operation(left, right))
    dtype: Any = result.dtype
    bounds = np.iinfo(f"{dtype.kind}{dtype.itemsize}")
    return bool(((exact >= float(bounds.max) + 1) | (exact < float(bounds.min))).any())
