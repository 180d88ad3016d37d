"""The kinds of engines, one per module. A new module in this folder adds a kind of engine and its study section."""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import Field

from calibray.engines.section import EngineSection


def _sections() -> dict[str, type[EngineSection]]:
    """The engine sections that the modules in this folder define, by name."""
    modules = [import_module(f"{__name__}.{entry.name}") for entry in iter_modules(__path__)]
    sections = [
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, EngineSection)
        and value.__module__ == module.__name__
    ]
    return {section.model_fields["name"].default: section for section in sections}


KINDS: Final = _sections()
"""The sections of all kinds of engines, by name."""

DEFAULT: Final = "replay"
"""The kind of engine that a study without ``[engine]`` uses."""


def default() -> EngineSection:
    """The section of a study without ``[engine]``."""
    return KINDS[DEFAULT].model_validate({})


if TYPE_CHECKING:
    AnyEngine = EngineSection
else:
    AnyEngine = Annotated[reduce(or_, KINDS.values()), Field(discriminator="name")]
"""The section of any kind of engine; its key `name` determines the kind."""
