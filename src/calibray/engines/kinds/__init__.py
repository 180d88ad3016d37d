"""The kinds of engines, one module each; a module that is put here is found, and its section belongs to study files."""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field

from calibray.engines.section import EngineSection


def _found() -> dict[str, type[EngineSection]]:
    """The sections by name, those of one module after another."""
    modules = [import_module(f"{__name__}.{entry.name}") for entry in iter_modules(__path__)]
    sections = [
        each
        for module in modules
        for each in vars(module).values()
        if isinstance(each, type) and issubclass(each, EngineSection) and each.__module__ == module.__name__
    ]
    return {each.model_fields["name"].default: each for each in sections}


KINDS: Final = _found()
"""The sections of all kinds of engines by name."""

DEFAULT: Final = "replay"
"""The kind that a study without ``[engine]`` uses."""


def default() -> EngineSection:
    """The section of a study without ``[engine]``."""
    return KINDS[DEFAULT].model_validate({})


if TYPE_CHECKING:
    AnyEngine = EngineSection
else:
    AnyEngine = Annotated[reduce(or_, KINDS.values()), Field(discriminator="name")]
"""The section of any kind of engine, told apart by its name."""
