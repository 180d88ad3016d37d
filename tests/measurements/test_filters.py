"""Row filters: what is allowed means the same as in pandas, and nothing else is evaluated."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements.filters import FUNCTIONS, METHODS, TEXT_METHODS, evaluate
from calibray.measurements.source_table import SourceTable

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "filters.md"

FRAME = pd.DataFrame(
    {
        "x": [-3, 0, 1, 4, 7, 9],
        "y": [0.5, np.nan, -2.5, 4.0, 1e3, 0.0],
        "set": ["LOS", "NLOS", None, "los", "LOS 2", " A.B"],
        "ok": [True, False, True, True, False, False],
        "mode": pd.array([4, None, 4, 1, 2, 4], dtype="Int64"),
        "my column": [1, 2, 3, 1, 2, 3],
        "a-b": list("abcabc"),
        "straße": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "day": pd.to_datetime([f"2024-01-0{k}" for k in range(1, 7)]),
    }
)

SAME_AS_PANDAS = [
    "x > 1", "x >= 1 and x < 9", "-3 <= x < 7", "0 < x <= y", "x == 4", "x != 4", "not x > 1", "~(x > 1)",
    "x > 1 & y < 5", "x > 8 | y < 0 & x < 2", "(x > 1) & (y < 5) | ok", "ok", "not ok", "~ok", "ok and x > 1",
    "ok == True", "(x < 2) == (y < 2)", "x + 1 > 2 * y - 3", "x / 2 > 1", "x // 2 == 2", "x % 2 == 1",
    "x ** 2 > 16", "x ** 2 + y ** 2 < 25", "-x < 2", "+x < 2", "x > -1.5e0", "x < inf", "x in [1, 4]",
    "x in (1, -3)", "x not in [1, 4]", "x == [1, 4]", "x != [1, 4]", "set in ['LOS', 'NLOS']", "set in 'LOS'",
    "set not in ['LOS']", "set == 'LOS'", "set != 'LOS'", "set > 'M'", "mode == 4", "mode in [4, 1]",
    "x in `my column`", "`my column` == 3", "`a-b` == 'a' or `my column` > 2", "straße > 3", "`straße` > 3",
    "y == y", "y.isna()", "y.notna()", "set.isna() or x > 4", "x.abs() > 3", "abs(x) > 3", "(x - 2).abs() < 3",
    "x.isin([1, 4])", "set.isin(['LOS', 'los'])", "x.between(0, 7)", "x.between(0, 7, 'neither')",
    "x.between(0, 7, inclusive='left')", "x.between(y, 8)", "set.str.contains('LOS')",
    "set.str.contains('N|2$')", "set.str.contains('^L[OX]S')", "set.str.contains('l.*s')",
    "set.str.contains('los', case=False)", r"set.str.contains('\\d')", "set.str.contains('A.B', regex=False)",
    "set.str.contains('OS', na=False)", "not set.str.contains('OS')", "set.str.startswith('N')",
    "set.str.endswith('S')", "set.str.lower() == 'los'", "set.str.upper() == 'LOS'", "set.str.strip() == 'A.B'",
    "set.str.strip('L') == 'OS'", "set.str.strip().str.lower() == 'a.b'", "sqrt(x ** 2 + 4) > 4", "exp(y) < 2",
    "log(x) > 0", "log10(x) > 0", "sin(x) > 0", "cos(x) > 0", "tan(x) > 0", "arctan2(y, x) > 0",
    "floor(y) == 0", "ceil(y) == 1", "day > '2024-01-03'", "set == \"it's & | `x`\"", "x>1 and(y<5)",
    "  x > 1  ", "x == 1 or x == 4 or x == 7", "(((x))) > 1",
]  # fmt: skip
NOT_IN_PANDAS_2 = {
    "(x - 2).abs() < 3": (FRAME["x"] - 2).abs() < 3,
    "not set.str.contains('OS')": ~FRAME["set"].str.contains("OS", na=False),
    "tan(x) > 0": np.tan(FRAME["x"]) > 0,
}
"""What `eval` of pandas 2 cannot evaluate, and its value."""


@pytest.mark.parametrize("expression", SAME_AS_PANDAS)
def test_filters_give_the_same_rows_as_pandas(expression):
    if (expected := NOT_IN_PANDAS_2.get(expression)) is None:
        with np.errstate(all="ignore"):
            expected = FRAME.eval(expression, engine="python", local_dict={}, global_dict={})
    mask = evaluate(expression, FRAME)
    np.testing.assert_array_equal(mask, expected.to_numpy(dtype=bool, na_value=False))
    assert mask.dtype == np.bool_


def test_filters_give_the_right_rows():
    """Independent of pandas."""
    assert np.flatnonzero(evaluate("x > 8 | y < 0 & x < 2", FRAME)).tolist() == [2, 5]
    assert np.flatnonzero(evaluate("-3 < x <= 4 and set != 'NLOS'", FRAME)).tolist() == [2, 3]
    assert np.flatnonzero(evaluate("set.str.startswith(('N', 'l'))", FRAME)).tolist() == [1, 3]
    assert np.flatnonzero(evaluate("set.str.contains('^L') and not mode == 4", FRAME)).tolist() == [4]


ESCAPES = [
    # Attributes, and what they lead to
    "x.values", "x.to_csv('pwned')", "(x.to_csv)('pwned')", "x.isin([(x.to_csv)('pwned')])",
    "x.isin(x.to_csv('pwned'))", "(x.__init__.__globals__['sys'].modules['os'].system)('id > pwned') != x",
    "x.__class__", "x.__class__.__mro__ == x", "x.pipe(print)", "x.apply('to_csv', args=('pwned',))",
    "x.map('{}'.format)", "x.eval('1')", "x.str", "x.str.join(',')", "set.str.__class__", "set.str.cat(sep='')",
    "set.str.repeat(1000000000)", "x.isna", "x.isna.__call__()", "x.isna()()", "''.join(['a'])",
    "'{0.__class__}'.format(x) == set", "set == '%s' % x", "x.abs.__func__(x)", "set.str.str.lower()",
    # Calls of anything
    "print(1)", "open('pwned', 'w')", "__import__('os').system('id > pwned')", "exec('1')", "eval('1')",
    "getattr(x, 'a')", "builtins.exec('1')", "pd.read_pickle('pwned')", "np.load('pwned')",
    "Timestamp('2024') > day", "list(x)", "sqrt(x, out=y)", "sqrt(*x)", "x.isin(**x)",
    "x.between(0, 7, 'neither', x)", "x.between(0)", "x.between(0, left=1, right=2)", "x.isna(1)",
    "(lambda: 1)()", "(x if ok else y)()",
    # Other parts of the language
    "lambda: x", "[i for i in x]", "{i for i in x}", "{1: 2}", "(i for i in x)", "(z := x) > 1",
    "f'{x}' == set", "f'{x.to_csv(\"pwned\")}' == set", "x[0]", "x[:]", "x['a'].b", "x if ok else y",
    "x is None", "x is not y", "x == None", "x == ...", "b'a' == set", "1j * x == 1", "x @ y > 1", "@x > 1",
    "@pd.read_pickle('pwned')", "x > 1; y > 2", "x = 3", "x := 3", "import os", "await x", "yield x", "*x",
    "x > 1\ny > 2", "x << 2 == 4", "x ^ y > 1", "~x > 3", "x and y", "not x", "{1, 2} == x", "x == {'a': 1}",
    "x in {1, 2}", "x in [y]", "x in [[1]]", "x in [1 + 1]", "x in 3", "3 in [3]", "'A' in set", "x and 1",
    "ok + ok == 2",
    # Bombs
    "x > 7**7**7**7", "x > 9**9**9**9**9", "x > (2**1000)**1000", "x > 10**400", "x > 1e308 * 1e308",
    "x > " + "9" * 4000, "x > " + "9" * 20, "set == 'a' * 1000000000", "set * 1000000000 == 'a'",
    "x * 9223372036854775807 > 1", "x > 1 / 0", "x % 0 == 1 or 1 % 0 == x",
    "(" * 150 + "x" + ")" * 150 + "> (" + "-" * 60 + "x)", "(" * 3000 + "x" + ")" * 3000 + " > 1",
    "-" * 9000 + "1 > x", "not " * 2000 + "ok", "x > 1" + " + 1" * 200, "x > 1" + " or x > 1" * 1000,
    "x in [" + "1," * 4000 + "]", "x > " + "1" * 20000, "set.str.contains('(a+)+$')",
    "set.str.contains('(a|a)*b')", "set.str.contains('a*a*a*b')", "set.str.contains('a?a?a?')",
    "set.str.contains('.{1000000}')", r"set.str.contains('(a)\\1')", "set.str.contains('(?:a)')",
    "set.str.contains('[')", "set.str.contains('" + "a" * 300 + "')", "set.str.contains('[z-a]')",
    "set.str.startswith(1)", "set.str.contains('a', regex='b')", "set.str.contains('a', 1)",
    "x.str.contains('a')",
    # Odd texts
    "x > 1\0", "\0", "ｘ > 1", "𝓍 > 1", "x > １", "set.ｓtr.lower()", "x.ｉsna()",
    "x.𝐭𝐨_𝐜𝐬𝐯('pwned')", "\u202ex > 1", "", "  ", "`x", "``", "`missing` > 1", "missing > 1",
    "index > 1", "quoted0 > 1 and `my column` > 1", "x >", "x > 'a'", "x", "1", "True", "1 < 2", "'LOS'",
    "x + 1", "[1, 2]", "set + 'a' == 'a'", "'" * 3 + "a", "x > 0x", "#", "x.between(0, 7, 'all')",
]  # fmt: skip


@pytest.mark.parametrize("expression", ESCAPES, ids=lambda text: ascii(text[:40]))
def test_anything_else_is_refused_without_side_effects(expression, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        SourceTable(FRAME.copy(), source="links.csv").where(expression)
    message = str(caught.value)
    assert message.startswith("links.csv: where = ")
    assert "\n" not in message
    assert len(message) < 700
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("expression", "piece", "remedy"),
    [
        ("x > 1 and x.to_csv('f')", "to_csv() is not allowed", "use one of: abs, between"),
        ("x.isin([(x.to_csv)('f')])", "(x.to_csv)('f'): must be", "a number, text"),
        ("x > 7**7**7**7", "7**7**7: the result is too large", "correct the expression"),
        ("x > 1 and sett == 'LOS'", "no column 'sett'", "did you mean 'set'"),
        ("set.str.contans('a')", "contans() is not allowed", "did you mean 'contains'"),
        ("x.values > 1", "x.values: not allowed", "use comparisons"),
        ("~x > 3", "x: must be true or false", "parentheses"),
        ("y == None", "None: not allowed", "use isna() or notna()"),
        (
            "set.str.contains('(a+)+')",
            "contains('(a+)+'): a pattern can contain only characters",
            "regex=False",
        ),
        ("`my column` + ok > 1", "ok: must be a number", "for arithmetic"),
    ],
)
def test_a_refusal_names_the_piece_and_the_remedy(expression, piece, remedy):
    with pytest.raises(InputError, match=re.escape(piece)) as caught:
        evaluate(expression, FRAME)
    assert remedy in str(caught.value)


@pytest.mark.parametrize(
    "filter_text",
    [
        "t != 5",
        "t == 5",
        "5 != t",
        "t not in [5, 6]",
        "~t.isin([5])",
        "n != '5'",
        "n not in ['5']",
        "n in '5'",
    ],
)
def test_texts_are_not_compared_with_numbers(filter_text):
    """No text equals a number, so `t != 5` would pass every row."""
    frame = pd.DataFrame({"t": ["5", None, "6"], "n": [5.0, np.nan, 6.0], "empty": [np.nan] * 3})
    with pytest.raises(InputError, match="quotes"):
        evaluate(filter_text, frame)
    assert evaluate("t != '5' and n != 5 and empty != 'bad'", frame).tolist() == [False, True, True]


def test_nested_filters_cost_no_more_than_their_length():
    """A part that was evaluated twice at every level would take 2^22 times as long."""
    frame = pd.DataFrame({"x": [1.0, -2.0]})
    comparison = "x"
    for _ in range(24):
        comparison = f"(x < {comparison} < 9)"
    assert evaluate(comparison, frame).tolist() == [False, True]
    assert evaluate("x" + ".abs()" * 22 + " > 1", frame).tolist() == [False, True]


def test_full_width_letters_are_not_taken_for_plain_ones():
    """Python normalizes a full-width x to x; a column is meant as it is written."""
    frame = FRAME.assign(**{"ｘ": 5})
    assert evaluate("ｘ == 5", frame).all()
    assert evaluate("`ｘ` == 5", frame).all()


def test_whole_numbers_do_not_wrap_around():
    frame = pd.DataFrame({"n": np.array([1, 2**62], dtype=np.int64), "b": np.array([1, 200], dtype=np.uint8)})
    assert evaluate("n * 2.0 > 4", frame).tolist() == [False, True]
    assert evaluate("n ** 3 > 4", frame).tolist() == [False, True]
    for expression in ("n * 4 > 4", "n + n + n > 4", "b * b > 4", "b - 100 > 4"):
        with pytest.raises(InputError, match="too large"):
            evaluate(expression, frame)


def test_long_texts_are_not_searched_for_repetitions():
    frame = pd.DataFrame({"note": ["a" * 40_000]})
    assert evaluate("note.str.contains('b$')", frame).tolist() == [False]
    with pytest.raises(InputError, match="too long for a pattern"):
        evaluate("note.str.contains('a*b$')", frame)


def test_a_repeated_column_name_is_refused():
    frame = pd.DataFrame([[1, 2]], columns=["x", "x"])
    with pytest.raises(InputError, match="appears several times"):
        evaluate("x > 1", frame)


def test_the_documentation_names_all_functions_and_methods():
    filters = DOCUMENT.read_text(encoding="utf-8")
    for name in FUNCTIONS:
        assert f"`{name}`" in filters, name
    for prefix, methods in ((".", METHODS), (".str.", TEXT_METHODS)):
        for name, method in methods.items():
            arguments = [*inspect.signature(method).parameters][1:]
            documented = re.search(rf"`column{re.escape(prefix)}{name}\(([^`]*)\)`", filters)
            assert documented, name
            assert [argument.split("=")[0].strip() for argument in documented[1].split(",") if argument] == [
                *arguments
            ], name
