"""Row filters: a small closed language over the columns of a table.

A filter is parsed by Python's own parser and interpreted here over whole columns. What `grammar` does not name
does not exist: no attribute, no call, no subscript, nothing of the program. Precedence is that of pandas' queries,
where ``&`` and ``|`` mean ``and`` and ``or`` and bind as loosely. `docs/study-file.md` lists all that is allowed.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable, Mapping
from math import inf, isfinite
from typing import Any, Final, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.filter_grammar import (
    ARITHMETIC,
    COMPARISONS,
    FUNCTIONS,
    MAX_LENGTH,
    METHODS,
    TEXT_METHODS,
    as_python,
    parse,
)
from calibray.measurements.filter_patterns import check_pattern
from calibray.support.messages import did_you_mean, shortened

_LARGEST: Final = 2**63 - 1
_Value = pd.Series | bool | int | float | str | None

_REQUIRED: Final = ("left", "right", "values", "pat")
_SWITCHES: Final = ("case", "regex", "na")
_INCLUSIVE: Final = ("both", "left", "right", "neither")


def evaluate(expression: str, frame: pd.DataFrame) -> NDArray[np.bool_]:
    """Evaluate a row filter.

    Args:
        expression: The filter.
        frame: The table.

    Returns:
        The mask [rows] of the rows that pass; a row for which the answer is unknown does not.

    Raises:
        InputError: The filter is malformed or too large, names something that is not allowed or an unknown column,
            or gives no truth value per row; the message names the offending piece, not the place of the filter.

    Example:
        >>> frame = pd.DataFrame({"x": [1, 2, 3], "my set": ["A", "B", "A"]})
        >>> evaluate("x >= 2 and `my set` == 'A'", frame).tolist()
        [False, False, True]
    """
    if len(expression) > MAX_LENGTH:
        raise InputError(f"{len(expression)} characters, must be at most {MAX_LENGTH}; shorten it")
    code, quoted = as_python(expression.strip())
    # Python warns of escapes in texts and pandas of patterns; neither is of use to who wrote the filter.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        tree = parse(code, frame)
        result = _Interpreter(frame, code, quoted).value(tree)
    if not isinstance(result, pd.Series) or not pd.api.types.is_bool_dtype(result.dtype):
        raise InputError("must be true or false for each row, for instance \"set == 'LOS'\"")
    return result.to_numpy(dtype=bool, na_value=False)


class _Interpreter:
    """One filter over one table."""

    def __init__(self, frame: pd.DataFrame, code: str, quoted: Mapping[str, str]) -> None:
        self._frame, self._code, self._quoted = frame, code, quoted

    def value(self, node: ast.expr) -> _Value:
        """The value of a part: a column, or one number, text or truth value."""
        try:
            match node:
                case ast.Name():
                    return self._name(node)
                case ast.Constant():
                    return self._constant(node)
                case ast.BoolOp():
                    parts = [self._truth(part) for part in node.values]
                    join = operator.and_ if isinstance(node.op, ast.And) else operator.or_
                    return _joined(join, parts)
                case ast.UnaryOp():
                    return self._unary(node)
                case ast.Compare():
                    return self._compare(node)
                case ast.BinOp():
                    return self._arithmetic(node)
                case ast.Call():
                    return self._call(node)
        except InputError:
            raise
        except (TypeError, ValueError, AttributeError, ArithmeticError, NotImplementedError) as error:
            fault = shortened(str(error).split("\n")[0], 120)
            raise InputError(f"{self._piece(node)}: not a valid filter ({fault}); correct it") from None
        raise InputError(
            f"{self._piece(node)}: not allowed in a filter; use comparisons, and, or, not, arithmetic, in, columns, "
            f"values, and the methods {', '.join((*METHODS, *TEXT_METHODS))}"
        )

    def _piece(self, node: ast.AST) -> str:
        """A part as it stands in the filter."""
        piece = ast.get_source_segment(self._code, node) or type(node).__name__
        for name, column in self._quoted.items():
            piece = piece.replace(name, f"`{column}`")
        return shortened(piece)

    def _name(self, node: ast.Name) -> _Value:
        # As written: Python reads letters of another form, such as full-width ones, as their plain kin.
        written = ast.get_source_segment(self._code, node) or node.id
        name = self._quoted.get(written, written)
        if name not in self._frame:
            if name == "inf":
                return inf
            raise InputError(f"no column {shortened(name)!r}; {did_you_mean(name, map(str, self._frame))}")
        column = self._frame[name]
        if not isinstance(column, pd.Series):
            raise InputError(f"column {name!r} stands several times in the table; rename one")
        return column

    def _constant(self, node: ast.Constant) -> _Value:
        if not isinstance(node.value, bool | int | float | str):
            remedy = "use isna() or notna()" if node.value is None else "use a number, a text, True or False"
            raise InputError(f"{self._piece(node)}: not allowed in a filter; {remedy}")
        if isinstance(node.value, int) and abs(node.value) > _LARGEST:
            raise InputError(
                f"{self._piece(node)}: too large a number, must be at most {_LARGEST}; correct it"
            )
        return node.value

    def _truth(self, node: ast.expr) -> pd.Series | bool:
        value = self.value(node)
        if isinstance(value, bool) or (
            isinstance(value, pd.Series) and pd.api.types.is_bool_dtype(value.dtype)
        ):
            return value
        raise InputError(
            f"{self._piece(node)}: must be true or false to be joined by and, or, not; compare it, or put comparisons "
            "in parentheses"
        )

    def _number(self, node: ast.expr) -> pd.Series | int | float:
        value = self.value(node)
        if isinstance(value, pd.Series):
            if pd.api.types.is_numeric_dtype(value.dtype) and not pd.api.types.is_bool_dtype(value.dtype):
                return value
        elif isinstance(value, int | float) and not isinstance(value, bool):
            return value
        raise InputError(
            f"{self._piece(node)}: must be a number, or a column of numbers, to be calculated with"
        )

    def _unary(self, node: ast.UnaryOp) -> _Value:
        if isinstance(node.op, ast.Not | ast.Invert):
            truth = self._truth(node.operand)
            return not truth if isinstance(truth, bool) else ~truth
        number = self._number(node.operand)
        return -number if isinstance(node.op, ast.USub) else number

    def _compare(self, node: ast.Compare) -> pd.Series | bool:
        """A comparison, or a chain of them, each with its neighbours."""
        sides = [node.left, *node.comparators]
        found = [self._pair(node, sides[k], kind, sides[k + 1]) for k, kind in enumerate(map(type, node.ops))]
        return _joined(operator.and_, found)

    def _pair(
        self, node: ast.Compare, left: ast.expr, kind: type[ast.cmpop], right: ast.expr
    ) -> pd.Series | bool:
        several = isinstance(right, ast.List | ast.Tuple)
        if kind in (ast.In, ast.NotIn) or (several and kind in (ast.Eq, ast.NotEq)):
            column = self._column(left)
            values = self._literals(right) if several else self.value(right)
            values = [values] if isinstance(values, str) else values
            if not isinstance(values, list | pd.Series):
                raise InputError(f"{self._piece(right)}: must be a list of values, as in ['A', 'B']")
            found = column.isin(values)
            return found if kind in (ast.In, ast.Eq) else ~found
        if kind not in COMPARISONS:
            raise InputError(f"{self._piece(node)}: is and is not are not allowed; use ==, != or isna()")
        return COMPARISONS[kind](self.value(left), self.value(right))

    def _column(self, node: ast.expr) -> pd.Series:
        value = self.value(node)
        if not isinstance(value, pd.Series):
            raise InputError(f"{self._piece(node)}: must be a column, or calculated from one")
        return value

    def _literals(self, node: ast.expr) -> list[bool | int | float | str | None]:
        """The values of a list or tuple of literals."""
        if not isinstance(node, ast.List | ast.Tuple):
            raise InputError(f"{self._piece(node)}: must be a list of values, as in ['A', 'B']")
        return [self._literal(item, missing=True) for item in node.elts]

    def _literal(self, node: ast.expr, missing: bool = False) -> Any:
        constant = node.operand if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) else node
        if missing and isinstance(constant, ast.Constant) and constant.value is None:
            return None
        if not isinstance(constant, ast.Constant):
            raise InputError(f"{self._piece(node)}: must be a number, a text, True or False")
        return self._number(node) * 1 if constant is not node else self._constant(constant)

    def _arithmetic(self, node: ast.BinOp) -> _Value:
        if (operation := ARITHMETIC.get(type(node.op))) is None:
            raise InputError(f"{self._piece(node)}: only + - * / // % ** are allowed between numbers")
        left, right = self._number(node.left), self._number(node.right)
        if isinstance(node.op, ast.Pow):
            # In floating point, where a power of whole numbers neither takes long nor wraps around.
            left, right = _floats(left), _floats(right)
        result = operation(left, right)
        self._check_range(node, operation, left, right, result)
        return result

    def _check_range(self, node: ast.BinOp, operation: Any, left: Any, right: Any, result: Any) -> None:
        """Refuse a number too large to be held, which whole numbers of a column would wrap around."""
        if not isinstance(result, pd.Series):
            large = not isfinite(result) or (isinstance(result, int) and abs(result) > _LARGEST)
        elif result.dtype.kind not in "iu":
            return
        else:
            exact = np.asarray(
                operation(_array(left), _array(right)) if len(result) else [0.0], dtype=np.float64
            )
            dtype: Any = result.dtype
            bounds = np.iinfo(f"{dtype.kind}{dtype.itemsize}")
            large = bool(((exact >= float(bounds.max) + 1) | (exact < float(bounds.min))).any())
        if large:
            raise InputError(f"{self._piece(node)}: the result is too large a number; correct it")

    def _call(self, node: ast.Call) -> _Value:
        called = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if not (ast.get_source_segment(self._code, node.func) or "").endswith(called):
            raise InputError(f"{self._piece(node.func)}: write the method in plain letters, {called!r}")
        match node.func:
            case ast.Name(id=name) if name in FUNCTIONS:
                return self._function(node, FUNCTIONS[name])
            case ast.Attribute(value=ast.Attribute(value=owner, attr="str"), attr=name):
                return self._text_method(node, owner, name)
            case ast.Attribute(value=owner, attr=name):
                return self._method(node, owner, name)
            case ast.Name(id=name):
                raise InputError(f"{shortened(name)}() is not allowed; {did_you_mean(name, FUNCTIONS)}")
        raise InputError(f"{self._piece(node)}: not allowed in a filter; only columns' methods may be called")

    def _function(self, node: ast.Call, function: np.ufunc) -> _Value:
        if node.keywords or len(node.args) != function.nin:
            raise InputError(f"{self._piece(node)}: takes {function.nin} number(s), nothing else")
        return function(*(_floats(self._number(argument)) for argument in node.args))

    def _method(self, node: ast.Call, owner: ast.expr, name: str) -> _Value:
        given = self._arguments(node, name, METHODS)
        if name == "abs":
            return abs(self._number(owner))
        column = self._column(owner)
        match name:
            case "between":
                inclusive = self._choice(given.get("inclusive"))
                left, right = (self.value(given[end]) for end in ("left", "right"))
                return column.between(cast(Any, left), cast(Any, right), inclusive)
            case "isin":
                return column.isin(self._literals(given["values"]))
            case "isna":
                return column.isna()
            case _:
                return column.notna()

    def _choice(self, node: ast.expr | None) -> Any:
        if node is None:
            return "both"
        if (choice := self._literal(node)) not in _INCLUSIVE:
            raise InputError(f"{self._piece(node)}: inclusive must be one of {', '.join(_INCLUSIVE)}")
        return choice

    def _text_method(self, node: ast.Call, owner: ast.expr, name: str) -> pd.Series:
        given = self._arguments(node, name, TEXT_METHODS)
        column = self._column(owner)
        if not (pd.api.types.is_string_dtype(column.dtype) or column.dtype == object):
            raise InputError(f"{self._piece(owner)}: must be a column of texts; leave .str.{name}() out")
        switches = {key: self._literal(given[key]) for key in _SWITCHES if key in given}
        if wrong := [key for key, value in switches.items() if not isinstance(value, bool)]:
            raise InputError(f"{self._piece(node)}: {wrong[0]} must be True or False")
        match name:
            case "lower":
                return column.str.lower()
            case "upper":
                return column.str.upper()
            case "strip":
                return column.str.strip(self._text(given["to_strip"]) if "to_strip" in given else None)
        # A missing text neither contains nor begins with anything, whichever way the column holds it.
        options = {"na": False, **switches}
        if name != "contains":
            pieces = given["pat"].elts if isinstance(given["pat"], ast.Tuple) else [given["pat"]]
            return getattr(column.str, name)(tuple(map(self._text, pieces)), **options)
        pattern = self._text(given["pat"])
        if switches.get("regex", True):
            check_pattern(pattern, column)
        return column.str.contains(pattern, **options)

    def _text(self, node: ast.expr) -> str:
        if not isinstance(text := self._literal(node), str):
            raise InputError(f"{self._piece(node)}: must be a text in quotes")
        return text

    def _arguments(
        self, node: ast.Call, name: str, methods: Mapping[str, tuple[str, ...]]
    ) -> dict[str, ast.expr]:
        """The arguments of a method by name."""
        if name not in methods:
            raise InputError(f"{shortened(name)}() is not allowed; {did_you_mean(name, methods)}")
        known = methods[name]
        keywords = [(keyword.arg, keyword.value) for keyword in node.keywords]
        pairs = [*zip(known, node.args, strict=False), *keywords]
        given = dict(pairs)
        required = [key for key in known if key in _REQUIRED]
        if (
            len(node.args) > len(known)
            or len(given) != len(pairs)
            or not set(required) <= set(given) <= set(known)
        ):
            wanted = ", ".join(known) or "no arguments"
            raise InputError(f"{self._piece(node)}: {name}() takes {wanted}; correct it")
        return given


def _joined(join: Callable[[Any, Any], Any], parts: list[pd.Series | bool]) -> pd.Series | bool:
    found = parts[0]
    for part in parts[1:]:
        found = join(found, part)
    return found


def _floats(number: pd.Series | int | float) -> pd.Series | np.float64:
    if not isinstance(number, pd.Series):
        return np.float64(number)
    return number.astype("Float64" if isinstance(number.dtype, pd.api.extensions.ExtensionDtype) else float)


def _array(number: pd.Series | int | float) -> NDArray[np.float64] | float:
    return (
        number.to_numpy(dtype=np.float64, na_value=np.nan) if isinstance(number, pd.Series) else float(number)
    )
