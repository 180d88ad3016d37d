"""How methods are called where people read."""

from __future__ import annotations

from typing import Final

_KNOWN: Final = {
    "gwo": "GWO",
    "sgwo-im": "SGWO-IM",
    "sgwo-im-screened": "SGWO-IM, screened",
    "space-mapping": "space mapping",
    "auto": "auto (least squares)",
}


def label(method: str) -> str:
    """A method's name for people.

    Args:
        method: A method, or `METHOD@CALLS` with a budget of its own.

    Returns:
        The name.

    Example:
        >>> label("gwo@600")
        'GWO, 600 calls'
    """
    name, _, calls = method.partition("@")
    known = _KNOWN.get(name, name)
    return f"{known}, {calls} calls" if calls else known
