"""Parts of messages: suggestions for unknown names, shortened values, durations and the like."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from typing import Final

MAX_LENGTH: Final = 80
"""Number of characters above which a value is shortened in a message."""
MAX_LISTED: Final = 20
"""Maximum number of names or errors that a message lists."""
MAX_COMPARED: Final = 2_000
"""Maximum number of valid names with which an unknown name is compared."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Suggest a remedy for an unknown name: a similar valid name, or otherwise the first `MAX_LISTED` valid names.

    Example:
        >>> did_you_mean("concret", ["brick", "concrete"])
        "did you mean 'concrete'?"
        >>> did_you_mean("marble", ["brick", "concrete"])
        'use one of: brick, concrete'
    """
    names = [str(known_name) for known_name in known]
    compared = [known_name for known_name in islice(names, MAX_COMPARED) if len(known_name) <= MAX_LENGTH]
    if len(str(name)) <= MAX_LENGTH and (close := get_close_matches(str(name), compared, n=1)):
        return f"did you mean {close[0]!r}?"
    if not names:
        return "there are none"
    more = f", ... ({len(names)} in all)" if len(names) > MAX_LISTED else ""
    return f"use one of: {', '.join(shortened(known_name) for known_name in names[:MAX_LISTED])}{more}"


def shortened(text: str, longest: int = MAX_LENGTH) -> str:
    """Shorten a text to its beginning and end if it has more than `longest` characters.

    Example:
        >>> shortened("abcdefghijkl", longest=9)
        'abc...jkl'
    """
    if len(text) <= longest:
        return text
    half = (longest - 3) // 2
    return f"{text[:half]}...{text[-half:]}"


def printable(text: str, keep: str = "") -> str:
    r"""Escape all characters that a terminal or an editor would interpret, because a text may quote names from files.

    Each of these characters becomes a Python escape sequence, except the characters in `keep`, such as line breaks.

    Example:
        >>> printable("RSS\x1b[2J\n[engine]")
        'RSS\\x1b[2J\\n[engine]'
    """
    if text.isprintable():
        return text
    return "".join(
        character
        if character.isprintable() or character in keep
        else character.encode("unicode_escape", "surrogatepass").decode()
        for character in text
    )


def first_line(error: Exception) -> str:
    """The first line of an error's message, or the error's type if the message is empty.

    Example:
        >>> first_line(KeyError())
        'KeyError'
    """
    return shortened((str(error).strip() or type(error).__name__).splitlines()[0], 300)


def type_name(value: object) -> str:
    """The name of a value's type, preceded by its package unless the type is built in.

    Example:
        >>> type_name(None), type_name(ValueError()), type_name(get_close_matches)
        ('NoneType', 'ValueError', 'function')
    """
    package = type(value).__module__.partition(".")[0]
    return type(value).__name__ if package == "builtins" else f"{package}.{type(value).__name__}"


def counted(number: int, noun: str) -> str:
    """A number followed by a noun; an s is appended to the noun for the plural.

    Example:
        >>> counted(1, "link"), counted(1200, "link")
        ('1 link', '1,200 links')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def command(*words: object) -> str:
    """Format a command for a terminal, with quotes where a shell requires them.

    Example:
        >>> command("report", "my result")
        "calibray report 'my result'"
    """
    return shlex.join(["calibray", *map(str, words)])


def percent(share: float) -> str:
    """Format a fraction as a whole percentage.

    Example:
        >>> percent(0.954), percent(0.001)
        ('95 %', 'less than 1 %')
    """
    return "less than 1 %" if 0 < share < 0.005 else f"{100 * share:.0f} %"


def duration(seconds: float) -> str:
    """Format an estimated duration [s] as a rounded number of seconds, minutes, hours or days.

    Example:
        >>> duration(26_700.0)
        '7 hours'
    """
    for unit, length in (("days", 86_400.0), ("hours", 3_600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:,.0f} {unit}"
    return counted(round(seconds), "second")
