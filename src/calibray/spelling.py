"""The tail of a message about an unknown name: what was perhaps meant, or what there is."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The remedy for an unknown name, as a phrase to end a message with.

    Args:
        name: The name that was given.
        known: The names there are.

    Returns:
        ``did you mean 'x'?`` when one name is close, else all names.

    Example:
        >>> did_you_mean("concret", ["brick", "concrete"])
        "did you mean 'concrete'?"
        >>> did_you_mean("marble", ["brick", "concrete"])
        'there are: brick, concrete'
    """
    names = [str(known_name) for known_name in known]
    if close := get_close_matches(str(name), names, n=1):
        return f"did you mean {close[0]!r}?"
    return f"there are: {', '.join(names)}" if names else "there are none"
