"""Deferred imports: of a package's names, so that importing the package stays fast, and of optional libraries."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from calibray.errors import InputError
from calibray.support.messages import first_line


def lazy_attributes(
    package: str, modules: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Make `__all__`, `__getattr__` and `__dir__` for a package (PEP 562) from the names that its modules define.

    `modules` maps each module to its names, separated by spaces; an empty string stands for the module itself.
    """
    homes = {name: module for module, words in modules.items() for name in words.split() or [module]}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(f"{package}.{homes[name]}")
        value = getattr(module, name) if modules[homes[name]] else module
        # The value is stored as an attribute, so that Python does not call this function again for this name.
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return sorted(homes), find, names


def library(name: str, extra: str) -> ModuleType:
    """Import an optional module that one of Calibray's extras installs.

    Raises:
        InputError: The module is not installed, or cannot be loaded.

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
                f"{package} is installed but cannot be loaded ({first_line(error)}): memory is low, or the "
                "installation is damaged; free memory, or install it again"
            ) from None
        raise InputError(
            f"{package} is not installed ({error}); install it with: pip install 'calibray[{extra}]'"
        ) from None
