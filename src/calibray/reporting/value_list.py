"""Calibrated values as the report lists them: each with its interval drawn over its bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log

from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.result.record import Record
from calibray.result.wording import interval_text, reason_text

MARKS = {
    "identified": "●",
    "weakly identified": "◕",
    "ambiguous": "◑",
    "at bound": "◐",
    "not identifiable": "○",
}


@dataclass(frozen=True)
class Value:
    """One parameter, as text and as places on a bar over its bounds.

    Attributes:
        name: Its name.
        unit: Its unit; empty if it has none.
        before: Its value before calibration.
        after: Its calibrated value.
        interval: Its 95 % interval; empty if it is not known.
        verdict: How far the data tell it.
        bounds: Its bounds, lower and upper.
        scale: "linear" or "log".
        places: Where on the bar the values before and after stand, each 0 to 1.
        pieces: Where every piece of the interval begins and ends, each 0 to 1.
        reason: Why the verdict is what it is; empty where that is not known.
        approximate: Whether something stands in for an engine without derivatives.
    """

    name: str
    unit: str
    before: str
    after: str
    interval: str
    verdict: str
    bounds: tuple[str, str]
    scale: str
    places: dict[str, float]
    pieces: tuple[tuple[float, float], ...] = ()
    reason: str = ""
    approximate: bool = False

    @property
    def mark(self) -> str:
        """A symbol of the verdict."""
        return MARKS.get(self.verdict, "")


def values(result: Record) -> list[Value]:
    """The parameters of a calibration.

    Args:
        result: The calibration.

    Returns:
        One entry for each, in the study's order.
    """
    found = []
    for name, after in result.parameters.items():
        entry, interval = result.study.parameters[name], result.intervals.get(name)
        before, place = result.fit.initial_parameters[name], _scale(*entry.bounds, entry.scale)
        places = {"before": place(before), "after": place(after)}
        pieces = () if interval is None else interval.pieces or ((interval.lower, interval.upper),)
        unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
        found.append(
            Value(
                name,
                "" if unit == "1" else unit,
                f"{before:.4g}",
                f"{after:.4g}",
                "" if interval is None else interval_text(interval),
                "not known" if interval is None else interval.verdict,
                (f"{entry.bounds[0]:.4g}", f"{entry.bounds[1]:.4g}"),
                entry.scale,
                places,
                tuple((place(low), place(high)) for low, high in pieces),
                "" if interval is None else reason_text(interval.reason),
                interval is not None and interval.approximate,
            )
        )
    return found


def _scale(lower: float, upper: float, scale: str) -> Callable[[float], float]:
    """Where between its bounds a value stands, 0 to 1."""

    def place(value: float) -> float:
        value = min(max(value, lower), upper)
        if scale == "log":
            return log(value / lower) / log(upper / lower)
        return (value - lower) / (upper - lower)

    return place
