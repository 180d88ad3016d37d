"""Optional libraries: imported when they are needed, and missed with the command that installs them."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from calibray.errors import InputError


def library(name: str, extra: str) -> ModuleType:
    """Import a library that only some users need.

    Args:
        name: The module.
        extra: Calibray's extra that brings it.

    Returns:
        The module.

    Raises:
        InputError: It is not installed; the message names the command that installs it.

    Example:
        >>> library("zipfile", "scenes").is_zipfile("no such file")
        False
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise InputError(
            f"{package} is not installed ({error}); install it with: pip install 'calibray[{extra}]'"
        ) from None
