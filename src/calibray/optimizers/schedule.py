"""How a method keeps to a budget of evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Schedule:
    """How a method keeps to a budget.

    Attributes:
        settings: From a number of evaluations to the arguments of its constructor that keep to it.
        least: Smallest budget that it can run on.
    """

    settings: Callable[[int], dict[str, int]]
    least: int = 1


def _as_given(budget: int) -> dict[str, int]:
    return {"budget": budget}


AS_GIVEN: Final = Schedule(_as_given)
"""The schedule of a method that takes any budget as its setting `budget`."""
