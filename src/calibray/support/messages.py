"""The words of messages: what was perhaps meant by an unknown name, and values short enough to be read."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice
from typing import Final

LONGEST: Final = 80
"""The number of characters beyond which a value is shortened in a message."""

LISTED: Final = 20
"""The number of names beyond which a message does not list them all."""

COMPARED: Final = 2_000
"""The number of names beyond which a misspelled one is not compared with the rest."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The remedy for an unknown name, as a phrase to end a message with.

    Args:
        name: The name that was given.
        known: The names there are.

    Returns:
        ``did you mean 'x'?`` when one name is close, else the names, the first twenty where there are more.

    Example:
        >>> did_you_mean("concret", ["brick", "concrete"])
        "did you mean 'concrete'?"
        >>> did_you_mean("marble", ["brick", "concrete"])
        'there are: brick, concrete'
    """
    names = [str(known_name) for known_name in known]
    compared = [each for each in islice(names, COMPARED) if len(each) <= LONGEST]
    if len(str(name)) <= LONGEST and (close := get_close_matches(str(name), compared, n=1)):
        return f"did you mean {close[0]!r}?"
    if not names:
        return "there are none"
    more = f", ... ({len(names)} in all)" if len(names) > LISTED else ""
    return f"there are: {', '.join(shortened(each) for each in names[:LISTED])}{more}"


def shortened(text: str, longest: int = LONGEST) -> str:
    """A text for a message, its middle left out where it is long.

    Args:
        text: The text.
        longest: The number of characters it may have.

    Returns:
        The text, or its beginning and its end.

    Example:
        >>> shortened("abcdefghijkl", longest=9)
        'abc...jkl'
    """
    if len(text) <= longest:
        return text
    half = (longest - 3) // 2
    return f"{text[:half]}...{text[-half:]}"


def first_line(error: Exception) -> str:
    """What a library says of a damaged file, which can break it anywhere.

    Args:
        error: What it raised.

    Returns:
        The first line of its message, or its type where it has none.

    Example:
        >>> first_line(KeyError())
        'KeyError'
    """
    return shortened((str(error).strip() or type(error).__name__).splitlines()[0], 300)


def duration(seconds: float) -> str:
    """A length of time in words, as coarse as an estimate.

    Args:
        seconds: The time [s].

    Returns:
        Seconds, minutes, hours or days.

    Example:
        >>> duration(26_700.0)
        '7 hours'
    """
    for unit, length in (("days", 86_400.0), ("hours", 3_600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:,.0f} {unit}"
    return f"{seconds:.0f} seconds"
