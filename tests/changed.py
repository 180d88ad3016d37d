"""Results with some fields changed, whatever section they are in."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from calibray.calibration.result import Result

SECTIONS = ("fit", "accuracy", "uncertainty", "nuisance", "prediction", "cost", "provenance")


def changed(result: Result, **values: Any) -> Result:
    """A result with other values.

    Args:
        result: The result.
        values: The values by field, of the result itself or of one of its sections.

    Returns:
        The changed result.
    """
    for section in SECTIONS:
        part = getattr(result, section)
        names = {field.name for field in fields(part)} & set(values)
        if names:
            result = replace(result, **{section: replace(part, **{name: values.pop(name) for name in names})})
    return replace(result, **values)
