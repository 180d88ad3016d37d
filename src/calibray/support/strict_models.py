"""Strict models of file contents: unknown keys and wrong types are refused instead of ignored."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

CLOSED: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""No unknown keys, no type conversions, only finite numbers."""

Text = Annotated[str, Field(min_length=1)]


class Section(BaseModel):
    """A table of a file: strict and immutable."""

    model_config = CLOSED | ConfigDict(frozen=True)
