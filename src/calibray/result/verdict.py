"""Verdicts on parameters, as data; the module `wording` converts verdicts to sentences."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

CONFIDENCE: Final = 0.95
"""Nominal probability that an interval in a result contains the true value."""


class Verdict(StrEnum):
    """The verdict on a parameter."""

    IDENTIFIED = "identified"
    WEAKLY_IDENTIFIED = "weakly identified"
    AMBIGUOUS = "ambiguous"
    AT_BOUND = "at bound"
    NOT_IDENTIFIABLE = "not identifiable"


class ReasonKind(StrEnum):
    """Reasons for a verdict; the comments list the values of each kind."""

    WIDTH = "width"  # share of the range or of a usual range; ranges, other parts of the interval: lower, upper, weight
    SEEN_BUILDINGS = "seen buildings"  # share of the range for the buildings that were measured
    SEPARATE_RANGES = "separate ranges"  # ranges: most probable value, weight
    AT_BOUND = "at bound"  # side, "lower" or "upper"; value, the other end of the interval
    NO_EFFECT = "no effect"  # change_db, the largest change in path loss of a link over the whole range
    TRADE_OFF = "trade-off"  # the other parameter and the rank correlation
    CONFOUNDED = "confounded"  # change_db over the range, compensated by other unknowns
    NOISE = "noise"  # change_db over the range, noise_db
    OUTSIDE_INTERVAL = "outside interval"  # value with the lowest RMSE
    TOO_FEW_LINKS = "too few links"  # links
    # calls; error_db of predicting a call from the others, and rmse_db of the best call, if such predictions were made
    TOO_FEW_CALLS = "too few calls"
    NO_NOISE = "no noise"
    TOO_MANY_LINKS = "too many links"  # limit; the interval follows from the curvature


class Cause(StrEnum):
    """Possible causes of a wide interval, other than noise."""

    BUILDINGS = "buildings that differ"
    CORRELATION = "correlated errors"
    MISSING_PATHS = "larger errors out of sight"
    HEAVY_TAILS = "heavy-tailed errors"
    OFFSET = "undeclared offset"
    CONSTANTS = "constants that the scene fixes"


@dataclass(frozen=True)
class Reason:
    """The reason for a verdict.

    Attributes:
        kind: The kind of reason.
        values: Numbers and names that appear in the sentence; see `ReasonKind`.
        ranges: Ranges or modes that appear in the sentence; the last number of each range or mode is its weight.
    """

    kind: ReasonKind
    values: dict[str, float | int | str] = field(default_factory=dict)
    ranges: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Interval:
    """The 95 % interval of a parameter, with the verdict on the parameter.

    Attributes:
        standard_error: Standard error from the curvature of the sum of squares at the optimum, in the parameter's unit.
        lower: Lower end of the 95 % interval, within the bounds; if the interval consists of several separate ranges,
            the lower end of the lowest range.
        upper: Upper end of the 95 % interval, within the bounds; if there are several ranges, the upper end of the
            highest range.
        verdict: The verdict on the parameter.
        pieces: Lower and upper ends of all separate ranges that make up the interval, in ascending order; empty if the
            interval was not computed from draws.
        reason: The reason for the verdict.
        approximate: Whether the interval was computed with an emulator, because the engine provides no derivatives.
        seen: The same as `pieces`, but for only the buildings on the links' paths; these ranges apply to predictions.
            The tuple is empty if they equal the ranges for the mean over all buildings of this material.
        without: Share of the interval's width that would remain if a cause were ruled out, by cause; causes with little
            effect are omitted.
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
        """Whether a value lies in the interval, or within a distance `slack` of it."""
        pieces = self.pieces or ((self.lower, self.upper),)
        return any(low - slack <= value <= high + slack for low, high in pieces)


class RemarkKind(StrEnum):
    """Kinds of remarks; the comments list the values of each kind."""

    CORRELATED_NOISE = "correlated noise"  # weight, gaussian_weight
    HEAVY_TAILS = "heavy tails"  # weight, gaussian_weight
    # weight, gaussian_weight; lacking, settings of [trace] that would find further paths
    ERRORS_OUT_OF_SIGHT = "errors out of sight"
    # observables, names, path_loss, further, standard_errors; slope and slope_error of measured versus modelled values
    CONFLICT = "conflict"
    # probability; settings of [trace] with which the paths were traced; rmse_db with these paths, rmse_without_db;
    # outside, names of the parameters whose values lie outside their intervals
    RICHER_PATHS = "richer paths"
    HETEROGENEITY = "heterogeneity"  # weight, gaussian_weight
    UNDECLARED_OFFSET = "undeclared offset"  # offset_db, error_db, rmse_db, rmse_without_db
    MISSED_OPTIMUM = "missed optimum"  # draws_db, found_db, method: its name
    WORSE_THAN_START = "worse than start"  # start_db, found_db, method: its name, kept
    # found_db, mean_db, log_distance_db; program: whether an external program computes path loss
    WORSE_THAN_MEAN = "worse than mean"
    # names, values, pieces (lower and upper ends in turn), most_probable, cause, odds, blocks
    OUTSIDE_INTERVAL = "outside interval"
    FEW_DRAWS = "few draws"
    APPROXIMATE_INTERVALS = "approximate intervals"  # engine, calls, error_db, replay
    # understood, reached, meets_calibrated (any path), calls, changed (paths), changed_db and lost (links), lost_rows
    # (of links without a path in some calls), excluded (whether such links are), half_space (all surfaces), half_spaces
    # (materials); names and values of constants; misfit_db, gap_db, remaining_db, moved_db if paths are in common
    RAY_MAPPING = "ray mapping"
    NO_CHEAP_MODEL = "no cheap model"  # cause
    # when traced again: links that change by more than tolerance_db, of (all), largest_db; lost, the number of links
    # with a path in one trace only
    RETRACED = "retraced"
    LOST_PATHS = "lost paths"  # calls, of (all), rows of the links without a path in these calls
    GIVEN_ENGINE = "given engine"  # engine: its class; differentiable; used, the name of the study's engine
    NOT_JUDGED = "not judged"
    MISSING_REGION = "missing region"  # west, south, east, north, height, attenuation, links, share, chance
    # transmitters; azimuth_deg and downtilt_deg, the corrections of their stated angles, and azimuth_error_deg,
    # downtilt_error_deg
    ANTENNA_DIRECTIONS = "antenna directions"
    # column, labels, differences_db, errors_db, others (columns that also explain residuals), per, chance
    DIFFERING_GROUPS = "differing groups"
    # links, of (all), sample, switches, reached (links of the sample by switch)
    UNREACHED_LINKS = "unreached links"


Value = float | int | bool | str | list[str] | list[float] | list[list[float]]
"""Types that the values of a remark can have; JSON can express all these types."""


@dataclass(frozen=True)
class Remark:
    """A warning or a piece of advice; `RemarkKind` describes the values of each kind."""

    kind: RemarkKind
    values: dict[str, Value] = field(default_factory=dict)
