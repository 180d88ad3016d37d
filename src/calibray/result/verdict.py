"""Verdicts: what the measurements say about one parameter, as data. `wording` turns them into sentences."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

CONFIDENCE: Final = 0.95
"""Probability of the intervals that a result reports."""


class Verdict(StrEnum):
    """What the measurements say about a parameter."""

    IDENTIFIED = "identified"
    WEAKLY_IDENTIFIED = "weakly identified"
    AMBIGUOUS = "ambiguous"
    AT_BOUND = "at bound"
    NOT_IDENTIFIABLE = "not identifiable"


class ReasonKind(StrEnum):
    """Reasons for a verdict; the comments name the values of each."""

    WIDTH = "width"  # share of the range, or of a customary one; ranges outside the judged set: lower, upper, weight
    SEEN_BUILDINGS = "seen buildings"  # share of the range for the buildings that were measured
    SEPARATE_RANGES = "separate ranges"  # ranges: most probable value, weight
    AT_BOUND = "at bound"  # side and the other end of the interval
    NO_EFFECT = "no effect"  # change_db of any link over the whole range
    TRADE_OFF = "trade-off"  # the other parameter and the rank correlation
    CONFOUNDED = "confounded"  # change_db over the range, compensated by other unknowns
    NOISE = "noise"  # change_db over the range, noise_db
    OUTSIDE_INTERVAL = "outside interval"  # value of least RMSE
    TOO_FEW_LINKS = "too few links"  # links
    TOO_FEW_CALLS = "too few calls"  # calls
    NO_NOISE = "no noise"
    TOO_MANY_LINKS = "too many links"  # limit; the interval follows from the curvature


class Cause(StrEnum):
    """What can make an interval wide, besides the noise itself."""

    BUILDINGS = "buildings that differ"
    CORRELATION = "correlated errors"
    STRUCTURE = "errors that depend on obstruction, distance or angles"
    HEAVY_TAILS = "heavy-tailed errors"
    OFFSET = "undeclared offset"
    CONSTANTS = "constants that the scene fixes"


@dataclass(frozen=True)
class Reason:
    """The reason for a verdict.

    Attributes:
        kind: The kind of reason.
        values: Its numbers and names; see `ReasonKind`.
        ranges: Ranges or modes that the reason names, each with its weight last.
    """

    kind: ReasonKind
    values: dict[str, float | int | str] = field(default_factory=dict)
    ranges: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Interval:
    """How well the links determine one parameter.

    Attributes:
        standard_error: From the curvature of the sum of squares at the optimum, in the parameter's unit.
        lower: Lower end of the 95 % interval, within the bounds; of the lowest piece where there are several.
        upper: Upper end, of the highest piece.
        verdict: What the links say about the parameter.
        pieces: Lower and upper end of every piece, ascending, where the interval was computed from draws.
        reason: The reason for the verdict.
        approximate: Whether an emulator replaced an engine that gives no derivatives.
        seen: Pieces of the 95 % interval for the buildings that the links meet, which predictions use; empty where it
            does not differ from that of the mean over all such buildings.
        without: Share of the width that is left if a cause is ruled out, for the causes that matter.
    """

    standard_error: float
    lower: float
    upper: float
    verdict: Verdict
    pieces: tuple[tuple[float, float], ...] = ()
    reason: Reason | None = None
    approximate: bool = False
    seen: tuple[tuple[float, float], ...] = ()
    without: dict[Cause, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The verdict as displayed."""
        return f"{self.verdict}, approximate" if self.approximate else str(self.verdict)

    def contains(self, value: float, slack: float = 0.0) -> bool:
        """Whether a value lies in one of the pieces.

        Args:
            value: The value.
            slack: Distance outside a piece that still counts as inside.

        Returns:
            True if it does.
        """
        pieces = self.pieces or ((self.lower, self.upper),)
        return any(low - slack <= value <= high + slack for low, high in pieces)
