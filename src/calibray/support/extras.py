"""Optional libraries: imported when they are needed; the error for a missing one names the command that installs it."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from calibray.errors import InputError


def library(name: str, extra: str) -> ModuleType:
    """Import an optional library.

    Args:
        name: The module.
        extra: Calibray's extra that installs it.

    Returns:
        The module.

    Raises:
        InputError: It is not installed.

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
