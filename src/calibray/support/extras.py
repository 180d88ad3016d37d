"""Optional libraries: imported when they are needed; the error for a missing one names the command that installs it."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from calibray.errors import InputError
from calibray.support.messages import first_line


def library(name: str, extra: str) -> ModuleType:
    """Import an optional module, which an extra of Calibray installs.

    Raises:
        InputError: It is not installed, or cannot be loaded.

    Example:
        >>> library("zipfile", "scenes").is_zipfile("no such file")
        False
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        if sys.modules.get(package, package) is not None and find_spec(package) is not None:
            raise InputError(
                f"{package} is installed but cannot be loaded ({first_line(error)}): memory is short, or its "
                "installation is damaged; free memory, or install it again"
            ) from None
        raise InputError(
            f"{package} is not installed ({error}); install it with: pip install 'calibray[{extra}]'"
        ) from None
