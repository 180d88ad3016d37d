"""Remarks: warnings and advice about a calibration, as data. `wording` turns them into sentences."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


class RemarkKind(StrEnum):
    """Kinds of remarks; the comments name the values of each."""

    CORRELATED_NOISE = "correlated noise"  # weight, gaussian_weight
    HEAVY_TAILS = "heavy tails"  # weight, gaussian_weight
    STRUCTURED_NOISE = "structured noise"  # weight, gaussian_weight
    # observables, names, path_loss, further, standard_errors; slope and slope_error of measured over modelled values
    CONFLICT = "conflict"
    HETEROGENEITY = "heterogeneity"  # weight, gaussian_weight
    UNDECLARED_OFFSET = "undeclared offset"  # offset_db, error_db, rmse_db, rmse_without_db
    MISSED_OPTIMUM = "missed optimum"  # draws_db, found_db
    OUTSIDE_INTERVAL = (
        "outside interval"  # names, values, pieces (ends in a row), most_probable, cause, odds, blocks
    )
    FEW_DRAWS = "few draws"
    APPROXIMATE_INTERVALS = "approximate intervals"  # engine, calls, error_db, replay
    # understood, misfit_db, gap_db, calls, changed (paths) and changed_db, half_space; names and values of constants
    RAY_MAPPING = "ray mapping"
    NO_CHEAP_MODEL = "no cheap model"  # cause
    NOT_JUDGED = "not judged"
    # transmitters; azimuth_deg and downtilt_deg, what to add to their stated angles, and azimuth_error_deg,
    # downtilt_error_deg
    ANTENNA_DIRECTIONS = "antenna directions"
    UNREACHED_LINKS = (
        "unreached links"  # links, of (all), sample, switches, reached (links of the sample by switch)
    )


Value = float | int | bool | str | list[str] | list[float] | list[list[float]]
"""Types of a remark's values, all of which JSON can express."""


@dataclass(frozen=True)
class Remark:
    """One warning or piece of advice.

    Attributes:
        kind: The kind of remark.
        values: Its numbers and names; see `RemarkKind`.
    """

    kind: RemarkKind
    values: dict[str, Value] = field(default_factory=dict)
