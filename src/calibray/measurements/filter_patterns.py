"""The regular expressions that a filter may search a column for: those whose cost is bounded.

A search that may repeat several things, or a group of things, can take longer than anyone waits. So a pattern is one
or more alternatives, each a row of single characters of which one may repeat.
"""

from __future__ import annotations

import re
from typing import Final

import pandas as pd

from calibray.errors import InputError
from calibray.support.messages import shortened

MAX_LENGTH: Final = 200
"""The number of characters beyond which a pattern is refused."""

MAX_STEPS: Final = 1e9
"""The sum of the squared lengths of a column's texts beyond which it is not searched for a repetition."""

_CLASS: Final = r"\[\^?(?:\\.|[^\[\]\\])+\]"
_CHARACTER: Final = rf"(?:\\[^0-9A-Za-z]|\\[bBdDsSwW]|{_CLASS}|[^\\^$*+?{{}}\[\]()|])"
_ALTERNATIVE: Final = rf"\^?{_CHARACTER}*+(?P<repeated>[*+?])?{_CHARACTER}*+\$?"
_BRANCH: Final = re.compile(_ALTERNATIVE)
_BAR: Final = re.compile(rf"({_CLASS}|\\.|[^|\\\[]|\[)")


def check_pattern(pattern: str, column: pd.Series) -> None:
    """Refuse a pattern whose search might not end.

    Args:
        pattern: The regular expression.
        column: The texts to be searched.

    Raises:
        InputError: The pattern is malformed or not among those allowed, or the texts are too long for it.
    """
    place = f"contains({shortened(pattern)!r})"
    if len(pattern) > MAX_LENGTH:
        raise InputError(f"{place}: {len(pattern)} characters, must be at most {MAX_LENGTH}; shorten it")
    found = [_BRANCH.fullmatch(alternative) for alternative in _alternatives(pattern)]
    try:
        re.compile(pattern)
    except (re.error, OverflowError) as error:
        raise InputError(
            f"{place}: not a regular expression ({error}); say regex=False for a plain text"
        ) from None
    if not all(found):
        raise InputError(
            f"{place}: only characters, classes, ^, $, | and one *, + or ? per alternative are allowed; "
            "say regex=False for a plain text"
        )
    if any(match["repeated"] for match in found if match):
        steps = float((column.dropna().astype(str).str.len().astype(float) ** 2).sum())
        if steps > MAX_STEPS:
            raise InputError(f"{place}: the texts are too long to search for a repetition; say regex=False")


def _alternatives(pattern: str) -> list[str]:
    """The parts between the bars of a pattern, bars in classes and after a backslash apart."""
    parts, part, place = [], "", 0
    while place < len(pattern):
        if pattern[place] == "|":
            parts, part, place = [*parts, part], "", place + 1
        elif match := _BAR.match(pattern, place):
            part, place = part + match[0], match.end()
        else:
            part, place = part + pattern[place:], len(pattern)
    return [*parts, part]
