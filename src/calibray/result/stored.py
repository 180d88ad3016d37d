"""What `result.json` may hold: a closed model, so that a damaged or edited file never becomes a number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass as checked

from calibray.errors import InputError
from calibray.materials import Material
from calibray.result.chosen import Chosen
from calibray.result.residuals import ResidualField
from calibray.study import Study
from calibray.study.validation_errors import explain
from calibray.support.messages import shortened
from calibray.support.strict_models import CLOSED, Section
from calibray.uncertainty.intervals import Interval

VERSION = 1
"""The version of `result.json` that is written and read."""

if TYPE_CHECKING:
    _Interval = Interval
    _Material = Material
    _Chosen = Chosen
    _Field = ResidualField
else:
    _Interval = checked(Interval, config=CLOSED, frozen=True)
    _Material = checked(Material, config=CLOSED, frozen=True)
    _Chosen = checked(Chosen, config=CLOSED, frozen=True)
    _Field = checked(ResidualField, config=CLOSED, frozen=True)

Count = Annotated[int, Field(ge=0)]
Error = Annotated[float, Field(ge=0)]
Seconds = Annotated[float, Field(ge=0)]
Offset = Annotated[float, Field(ge=-500, le=500)]
Share = Annotated[float, Field(ge=0, le=1.000001)]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Counts(Section):
    """The links of a calibration in numbers; see `Result.counts`."""

    calibrated_on: Count
    held_out: Count
    rows_without_path: tuple[int, ...]
    rows_with_enclosed_tx: tuple[int, ...] | None
    rows_with_enclosed_rx: tuple[int, ...] | None


class Stored(Section):
    """The content of `result.json`; the attributes are those of `Result`, and what was added since has a default."""

    version: Literal[1]
    study_file: str
    study: dict[str, Any]
    rmse_db: Error
    initial_rmse_db: Error
    offset_only_rmse_db: Error | None
    holdout_rmse_db: Error | None
    initial_holdout_rmse_db: Error | None
    offset_only_holdout_rmse_db: Error | None
    log_distance_rmse_db: Error
    log_distance_holdout_rmse_db: Error | None
    retrace_gap_db: Error | None
    rt_calls: Count
    ledger_hits: Count
    seconds: Seconds
    trace_seconds: Seconds
    parameters: dict[str, float]
    initial_parameters: dict[str, float]
    intervals: dict[str, _Interval]
    offsets_db: dict[str, Offset]
    materials: dict[str, _Material]
    laws: dict[str, dict[str, float]] = Field(default_factory=dict)
    groups_without_path: tuple[str, ...] = ()
    links: Counts | None = None
    antennas_indoors: bool | None = None
    files: dict[str, Digest] = Field(default_factory=dict)
    prepared: dict[str, Count] = Field(default_factory=dict)
    nuisances: dict[str, dict[str, float]] = Field(default_factory=dict)
    nuisance_centres: dict[str, float] = Field(default_factory=dict)
    draws: dict[str, list[float]] = Field(default_factory=dict)
    noise: dict[str, Share] = Field(default_factory=dict)
    free_offset_db: float | None = None
    free_offset_error_db: Error | None = None
    remarks: tuple[str, ...] = ()
    power_shares: dict[str, dict[str, Annotated[float, Field(ge=0, le=1.000001)]]] = Field(
        default_factory=dict
    )
    profile_calls: Count = 0
    profile_seconds: Seconds = 0.0
    cheap_calls: Count = 0
    cheap_seconds: Seconds = 0.0
    residual_db: Error | None = None
    residual_basis: str = ""
    chosen: _Chosen | None = None
    residual_field: _Field | None = None


def read_stored(source: Path) -> tuple[Stored, Study]:
    """Read `result.json` and check all of it.

    Args:
        source: The file.

    Returns:
        Its content, and the study that it holds.

    Raises:
        InputError: The file cannot be read, is of another version, has a key or value that none has, or its parts
            contradict each other.
    """
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{source}: is no result of `calibray run` ({error}); name its --out folder"
        ) from None
    if not isinstance(content, dict):
        raise InputError(f"{source}: holds no table; run the study again")
    if content.get("version") != VERSION:
        raise InputError(
            f"{source}: has version {shortened(repr(content.get('version')))}, need {VERSION}; run the study again"
        )
    try:
        # By way of JSON, where lists pass for tuples and nothing is converted.
        stored = Stored.model_validate_json(json.dumps(content))
    except RecursionError:
        raise InputError(f"{source}: is nested too deep; run the study again") from None
    except ValidationError as error:
        refusal = explain(error, Stored, content, str(source))
        raise refusal from None
    study = Study.from_content(stored.study, stored.study_file)
    _check(stored, study, source)
    return stored, study


def _check(stored: Stored, study: Study, source: Path) -> None:
    """Refuse parts that contradict each other: what is missing would otherwise pass for what was not calibrated."""
    names = list(study.parameters)
    for key, found in (("parameters", stored.parameters), ("initial_parameters", stored.initial_parameters)):
        if sorted(found) != sorted(names):
            odd = sorted(set(names) ^ set(found))[0]
            raise InputError(
                f"{source}: {key}: {shortened(repr(odd))} is missing or not among the study's parameters; run the "
                "study again"
            )
    for name in names:
        material, _, constant = name.rpartition(".")
        if material not in stored.materials:
            raise InputError(
                f"{source}: materials: {shortened(repr(material))} is calibrated and missing; run the study again"
            )
        value, found = getattr(stored.materials[material], constant, None), stored.parameters[name]
        # A coefficient of a law is no constant of its own.
        if value is not None and abs(value - found) > 1e-9 * max(abs(value), 1e-300):
            raise InputError(
                f"{source}: materials.{material}.{constant} = {value:g}, but parameters has {found:g}; run the study "
                "again"
            )
    if unknown := sorted(set(stored.intervals) - set(names)):
        raise InputError(f"{source}: intervals: {shortened(repr(unknown[0]))} is no parameter of the study")
    if sorted(stored.nuisances) != sorted(study.nuisance):
        raise InputError(f"{source}: nuisances: are not those of the study; run the study again")
    lengths = {len(values) for values in stored.draws.values()}
    if len(lengths) > 1 or (stored.draws and not set(names) <= set(stored.draws)):
        raise InputError(f"{source}: draws: are not one of each parameter; run the study again")
    if (study.offset is None) != (not stored.offsets_db and not stored.groups_without_path):
        state = "missing" if study.offset else "there, and the study has none"
        raise InputError(f"{source}: offsets_db: are {state}; run the study again")
