"""Closed models of what comes from files: what has no meaning is refused, not ignored."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

CLOSED: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""No unknown keys, no conversions, no number that is not finite."""

Text = Annotated[str, Field(min_length=1)]


class Section(BaseModel):
    """A table of a file: closed, and never changed."""

    model_config = CLOSED | ConfigDict(frozen=True)
