"""Write, read and check the files of a result; each file is written completely or not at all."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.parameters import is_effect
from calibray.result.held_out import HeldOutErrors, Model
from calibray.result.record import (
    Accuracy,
    Cost,
    Count,
    Digest,
    Fit,
    Nuisance,
    Prediction,
    Provenance,
    Record,
    Uncertainty,
)
from calibray.scenes import export_scene, read_scene
from calibray.study import Study
from calibray.support.messages import shortened
from calibray.support.output_files import (
    as_path,
    check_outputs,
    check_unchanged,
    csv_text,
    exists,
    file_digest,
    is_unchanged_output,
    without_formula_mark,
    write_text,
)
from calibray.support.strict_models import Section, explain

VERSION: Final = 1
"""Version of the format of `result.json`."""

FILES: Final = ("result.json", "result-links.csv", "result-history.csv", "result-scene.xml")
"""Files of a result. The prefix distinguishes these files from a user's own links.csv and scene.xml."""

RESULT_FILE, LINKS_FILE, HISTORY_FILE, SCENE_FILE = FILES
SIGNED_FILES: Final = (LINKS_FILE, HISTORY_FILE, SCENE_FILE)
"""The files for which `result.json` contains digests."""

_LOG: Final = logging.getLogger(__name__)

VALIDATION_FILE: Final = "result-validation.json"

LINKS: Final = {
    "row": "i", "measured_db": "f", "before_db": "f", "after_db": "f", "log_distance_db": "f", "has_path": "b",
    "held_out": "b", "retrace_gap_db": "f", "predicted_db": "f", "scene_db": "f",
}  # fmt: skip
HISTORY: Final = {"call": "i", "iteration": "i", "rmse_db": "f", "best_db": "f", "seconds": "f"}
COLUMNS: Final = {"result-links.csv": LINKS, "result-history.csv": HISTORY}
"""Columns of each file, with the NumPy kind of their values: integer, float or Boolean."""

OPTIONAL: Final = ("leverage", "depth", "out_of_sight", "obstruction_m", "region_m")
"""Optional numeric columns."""

FINITE: Final = ("measured_db", "log_distance_db", "best_db", "seconds")
"""Columns that contain only finite values; in other columns, the value for a link without a path can be infinite or
empty."""


class LinkCounts(Section):
    """Numbers of links, stored only for human readers; see `Record.counts`. `read` ignores this section."""

    calibrated_on: Count
    held_out: Count
    rows_without_path: tuple[int, ...]
    rows_with_enclosed_tx: tuple[int, ...] | None
    rows_with_enclosed_rx: tuple[int, ...] | None


class Stored(Section):
    """The content of `result.json`: the sections of a `Record`.

    `study_from_here` is the path of the study file relative to the result's folder, so that the study and the folder
    can be moved together.
    """

    version: Literal[1]
    study_file: str
    study_from_here: str = ""
    study: dict[str, Any]
    links: LinkCounts
    fit: Fit
    accuracy: Accuracy
    uncertainty: Uncertainty
    nuisance: Nuisance
    prediction: Prediction
    cost: Cost
    provenance: Provenance
    files: dict[str, Digest]
    sentences: tuple[str, ...] = ()


SECTIONS: Final = ("fit", "accuracy", "uncertainty", "nuisance", "prediction", "cost", "provenance")


def content(
    record: Record, sentences: tuple[str, ...] = (), files: dict[str, str] | None = None
) -> dict[str, Any]:
    """The content of `result.json`: all sections of a result except its tables, and the remarks as sentences.

    `files` contains the SHA-256 digests of the result's other files, keyed by name, if these files have already been
    written.
    """
    parts = {name: getattr(record, name) for name in SECTIONS}
    values = {name: TypeAdapter(type(part)).dump_python(part, mode="json") for name, part in parts.items()}
    return {
        "version": VERSION,
        "study_file": str(record.study.path.resolve()),
        "study": record.study.content(),
        "links": record.counts,
        **values,
        "files": files or {},
        "sentences": list(sentences),
    }


def write(
    record: Record,
    folder: str | Path,
    overwrite: bool = False,
    *,
    sentences: tuple[str, ...] = (),
    validation: dict[str, Any] | None = None,
) -> None:
    """Write `result.json`, the tables, the calibrated scene and, if there is one, the validation.

    Each file is written under a temporary name and then renamed, so every file is either complete or absent.
    `result.json` is written last and contains the digests of the other files. If a run is killed before that, `read`
    therefore rejects the resulting mixture of files from two runs. `sentences` and the numbers in `validation` are only
    for human readers; `read` ignores both.

    Raises:
        InputError: The folder cannot be written to, or a file in it must not be replaced.
    """
    target = check_outputs(folder, (*FILES, VALIDATION_FILE), record.study.files(), overwrite)
    try:
        target.mkdir(parents=True, exist_ok=True)
        study = record.study
        scene = record.scene or read_scene(
            study.scene_source, study.scene.frequency, study.overrides, study.objects
        )
        export_scene(scene, record.scene_materials, target / SCENE_FILE)
        write_text(target / LINKS_FILE, csv_text(record.links, "%.10g"))
        write_text(target / HISTORY_FILE, csv_text(record.history, "%.9g"))
        if record.held_out is None and (target / VALIDATION_FILE).exists():
            _LOG.warning(
                "%s: removed, because it belonged to an earlier result; validate again",
                target / VALIDATION_FILE,
            )
        (target / VALIDATION_FILE).unlink(missing_ok=True)
        if record.held_out is not None:
            _write_validation(record.held_out, study, target, validation or {})
        digests = {name: file_digest(target / name) for name in SIGNED_FILES}
        stored = content(record, sentences, digests)
        stored["study_from_here"] = os.path.relpath(study.path.resolve(), target.resolve())
        write_text(target / RESULT_FILE, json.dumps(stored, indent=2) + "\n")
    except OSError as error:
        raise InputError(
            f"output folder {target}: cannot be written ({error.strerror}); choose another folder"
        ) from None


def read(folder: str | Path, *, allow_changed_inputs: bool = False) -> dict[str, Any]:
    """Read the fields of a `Record` from a folder that `write` wrote.

    With `allow_changed_inputs`, files that were edited after the run are accepted.

    Raises:
        InputError: The folder contains no result, a result in a different version of the format, a damaged or edited
            result, or files from several runs.
    """
    source = as_path(folder, "result") / RESULT_FILE
    if source.parent.is_file():
        raise InputError(f"{source.parent}: is a file; give its folder")
    stored, study = _read_stored(source)
    links, history = (read_rows(source.parent, name, columns) for name, columns in COLUMNS.items())
    if not allow_changed_inputs:
        for name in (RESULT_FILE, *COLUMNS, VALIDATION_FILE):
            if (source.parent / name).exists():
                check_unchanged(source.parent / name)
    _check_one_run(source.parent, stored.files, allow_changed_inputs)
    held_out = read_validation(source.parent, study, links["measured_db"].to_numpy())
    sections = {name: getattr(stored, name) for name in SECTIONS}
    return {"study": study, "links": links, "history": history, "held_out": held_out, **sections}


def _check_one_run(folder: Path, digests: dict[str, str], allow_edits: bool) -> None:
    """Reject files that come from several runs and, unless edits are allowed, files that were edited."""
    for name in SIGNED_FILES:
        file = folder / name
        if name not in digests:
            raise InputError(f"{folder / RESULT_FILE}: files.{name} is missing; run the study again")
        # Nothing is read from the scene file, so this file may be absent.
        if not exists(file) or file_digest(file) == digests[name]:
            continue
        if is_unchanged_output(file):
            raise InputError(
                f"{file}: belongs to a different run from {RESULT_FILE}, because a run into this folder was "
                "interrupted, or because files were copied; run the study again"
            )
        if not allow_edits:
            raise InputError(
                f"{file}: has changed since {RESULT_FILE} was written; run the study again, or give "
                "--allow-changed-inputs (allow_changed_inputs=True)"
            )


def _read_stored(source: Path) -> tuple[Stored, Study]:
    try:
        values = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{source}: is not a result written by `calibray run` ({error}); give its --out folder"
        ) from None
    if not isinstance(values, dict):
        raise InputError(f"{source}: must contain a JSON object; run the study again")
    if values.get("version") != VERSION:
        raise InputError(
            f"{source}: has version {shortened(repr(values.get('version')))}, but must have version {VERSION}; run the "
            "study again"
        )
    try:
        # In JSON mode, Pydantic accepts lists as tuples but converts no other types.
        stored = Stored.model_validate_json(json.dumps(values))
    except RecursionError:
        raise InputError(f"{source}: is nested too deeply; run the study again") from None
    except ValidationError as error:
        refusal = explain(error, Stored, values, str(source))
        raise refusal from None
    # If the study was moved or copied together with the result, the copy takes precedence, because the files that it
    # refers to are next to it.
    near = Path(os.path.normpath(source.parent.resolve() / stored.study_from_here))
    study = Study.from_content(
        stored.study, near if stored.study_from_here and exists(near) else stored.study_file
    )
    _check_consistent(stored, study, source)
    return stored, study


def _check_consistent(stored: Stored, study: Study, source: Path) -> None:
    """Reject sections that contradict each other or the study."""
    names, fit = list(study.parameters), stored.fit
    for key, values in (("parameters", fit.parameters), ("initial_parameters", fit.initial_parameters)):
        if sorted(values) != sorted(names):
            different = sorted(set(names) ^ set(values))[0]
            raise InputError(
                f"{source}: fit.{key}: {shortened(repr(different))} is missing or not a parameter of the study; run "
                "the study again"
            )
    for name in names:
        if is_effect(name):
            continue
        material, _, constant = name.rpartition(".")
        if material not in fit.materials:
            raise InputError(
                f"{source}: fit.materials: {shortened(repr(material))} is missing, although it is calibrated; run the "
                "study again"
            )
        value, calibrated = getattr(fit.materials[material], constant, None), fit.parameters[name]
        # A coefficient of a law is not a constant of the material, so its `value` is None.
        if value is not None and abs(value - calibrated) > 1e-9 * max(abs(value), 1e-300):
            raise InputError(
                f"{source}: fit.materials.{material}.{constant} = {value:g}, but fit.parameters has {calibrated:g}; "
                "run the study again"
            )
    uncertainty, nuisance = stored.uncertainty, stored.nuisance
    if unknown := sorted(set(uncertainty.intervals) - set(names)):
        raise InputError(
            f"{source}: uncertainty.intervals: {shortened(repr(unknown[0]))} is not a parameter of the study; run the "
            "study again"
        )
    lengths = {len(values) for values in uncertainty.draws.values()}
    if len(lengths) > 1 or (uncertainty.draws and not set(names) <= set(uncertainty.draws)):
        raise InputError(
            f"{source}: uncertainty.draws: must have the same number of draws for every parameter; run the study again"
        )
    offset = {"offset"} if study.offset is not None else set()
    if set(nuisance.coefficients) != set(study.nuisance) | offset:
        raise InputError(
            f"{source}: nuisance.coefficients: must contain the terms of the study; run the study again"
        )
    if excessive := [value for value in nuisance.offsets_db.values() if abs(value) > 500]:
        raise InputError(
            f"{source}: nuisance.coefficients.offset: {excessive[0]:g} dB is outside -500 to 500; run the study again"
        )


def check_same_study(study: Study, folder: Path) -> None:
    """Reject a folder with a result that cannot be read or belongs to another study; accept a folder without a result.

    Raises:
        InputError: The result cannot be read or belongs to another study.
    """
    if (folder / RESULT_FILE).is_file():
        _, calibrated = _read_stored(folder / RESULT_FILE)
        if _problem_digest(study) != _problem_digest(calibrated):
            raise InputError(
                f"{folder}: the result in this folder belongs to another study; give another folder, or run the study "
                "again"
            )


def changed_files(result: Record, files: Mapping[str, str]) -> list[str]:
    """Names of the scene and antenna files that have changed since the calibration.

    `files` contains the current files with their digests, as in `Setup.files`.
    """
    if not result.provenance.files:
        return []
    # Files are compared by name and content, because the whole folder may have been moved.
    calibrated, current = (
        sorted((Path(file).name, digest) for file, digest in files.items())
        for files in (result.provenance.files, files)
    )
    return sorted({name for name, _ in set(calibrated) ^ set(current)})


def has_links(result: Record, links: Measurements) -> bool:
    """Whether a calibration used these links, judged by measured values and positions, up to rounding in files."""
    table, ends = result.links, result.ends
    pairs = [(table["measured_db"].to_numpy(float), links.path_loss_db)]
    pairs += [] if ends is None else [(ends, np.hstack([links.tx, links.rx]))]
    return len(table) == len(links) and all(
        np.allclose(calibrated, current, rtol=1e-8, atol=1e-3) for calibrated, current in pairs
    )


def write_validation(held_out: HeldOutErrors, study: Study, folder: Path, figures: dict[str, Any]) -> None:
    """Write the held-out errors of a study to a folder; the numbers in `figures` are only for human readers.

    Raises:
        InputError: The folder contains an unreadable result, or the result of another study or of different links.
    """
    check_same_study(study, folder)
    if (folder / RESULT_FILE).is_file():
        measured_db = read_rows(folder, LINKS_FILE, LINKS)["measured_db"].to_numpy()
        if not _same(held_out.measured_db, measured_db):
            raise InputError(
                f"{folder}: the result in this folder has different links ({len(measured_db)}, whereas the validation "
                f"has {len(held_out.measured_db)}); give another folder, or run the study again. If --by separates "
                "rows of one link, also set [holdout] by"
            )
    _write_validation(held_out, study, folder, figures)


def _write_validation(held_out: HeldOutErrors, study: Study, folder: Path, figures: dict[str, Any]) -> None:
    values = {
        "version": VERSION,
        **figures,
        "problem": _problem_digest(study),
        "blocks": list(held_out.labels),
        "level": held_out.level,
        "links": {
            "block": held_out.block.tolist(),
            "position": np.round(held_out.position, 4).tolist(),
            "measured_db": _rounded(held_out.measured_db),
            "errors_db": {str(name): _rounded(errors) for name, errors in held_out.errors.items()},
        },
    }
    write_text(folder / VALIDATION_FILE, json.dumps(values, indent=2) + "\n")


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    """Round values to 0.0001 dB; None replaces non-finite values, which JSON cannot represent."""
    return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]


def _problem_digest(study: Study) -> str:
    """SHA-256 digest of a study without its hold-out section, method, seed and engine, which `run` can change."""
    content = {
        key: value for key, value in study.content().items() if key not in ("method", "engine", "holdout")
    }
    # If parameters describe a population, `Setup.open` adds one parameter per transmitter.
    entries = content["parameters"].items()
    content["parameters"] = {
        name: entry for name, entry in entries if not entry.get("prior", {}).get("shared")
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _same(first_db: NDArray[np.float64], second_db: NDArray[np.float64]) -> bool:
    """Whether two arrays [links] of measured path loss [dB] agree to within the rounding of values in files."""
    return len(first_db) == len(second_db) and bool(np.abs(first_db - second_db).max() <= 1e-3)


def read_validation(folder: Path, study: Study, measured_db: NDArray[np.float64]) -> HeldOutErrors | None:
    """Read the held-out errors of a result; return None if no validation was written.

    `measured_db` is the measured path loss of the result's links [links], [dB].

    Raises:
        InputError: The file is damaged or edited, or belongs to another study or to different links.
    """
    file = folder / VALIDATION_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        held_out = _checked_validation(file, values, len(measured_db))
        belongs = values["problem"] == _problem_digest(study)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{file}: is not a validation file written by `calibray validate` ({error}); validate again"
        ) from None
    if not belongs or not _same(held_out.measured_db, measured_db):
        raise InputError(
            f"{file}: does not belong to the study and the measurements of {RESULT_FILE}; run the study again, "
            "or remove the file and validate again"
        )
    return held_out


def _checked_validation(file: Path, values: dict[str, Any], links: int) -> HeldOutErrors:
    if values["version"] != VERSION:
        raise InputError(f"{file}: has version {values['version']!r}, must be {VERSION}; validate again")
    rows = values["links"]
    held_out = HeldOutErrors(
        labels=tuple(map(str, values["blocks"])),
        block=np.array(rows["block"], dtype=np.int64),
        errors={str(name): np.array(errors, dtype=float) for name, errors in rows["errors_db"].items()},
        position=np.array(rows["position"], dtype=float),
        measured_db=np.array(rows["measured_db"], dtype=float),
        level=float(values["level"]),
    )
    block, position = held_out.block, held_out.position
    lengths = {"block": len(block), "position": len(position), "measured_db": len(held_out.measured_db)}
    lengths |= {name: len(errors) for name, errors in held_out.errors.items()}
    if wrong := [name for name, length in lengths.items() if length != links]:
        raise InputError(f"{file}: {wrong[0]} must have one value per link ({links}); validate again")
    judged = block >= 0
    if position.shape != (links, 3) or not judged.any() or block.max() >= len(held_out.labels):
        raise InputError(f"{file}: blocks or positions are invalid; validate again")
    if not all(np.isfinite(errors[judged]).all() for errors in held_out.errors.values()):
        raise InputError(f"{file}: an error of a judged link is missing; validate again")
    if not {Model.INITIAL, Model.CALIBRATED} <= set(held_out.errors):
        raise InputError(
            f"{file}: is not a validation file written by `calibray validate` (a model is missing); validate again"
        )
    if not 0 < held_out.level < 1:
        raise InputError(f"{file}: level = {held_out.level:g}: must be between 0 and 1; validate again")
    return held_out


def read_rows(folder: Path, name: str, columns: dict[str, str]) -> pd.DataFrame:
    """Read a table from a result's folder, and check that required columns have the stated kind: "i", "f" or "b".

    Raises:
        InputError: The file does not exist, lacks a column, or has invalid values in a column.
    """
    file = folder / name
    if not exists(file):
        raise InputError(f"{file}: does not exist; give the --out folder of `calibray run`")
    try:
        # Group labels such as 7 or NA must remain text.
        table = pd.read_csv(file, converters={"group": without_formula_mark})
    except (OSError, ValueError) as error:
        raise InputError(
            f"{file}: is not a table written by `calibray run` ({str(error).splitlines()[0]}); give its --out folder"
        ) from None
    for column, kind in columns.items():
        if column not in table:
            raise InputError(f"{file}: has no column {column!r}; run the study again")
        actual = table[column].dtype.kind
        # Integers are valid floats. If a table has no rows, its columns have no meaningful data type to check.
        if len(table) and actual != kind and not (kind == "f" and actual == "i"):
            raise InputError(f"{file}: column {column!r} has values of the wrong type; run the study again")
        if kind == "f":
            table[column] = table[column].astype(float)
        if column in FINITE and not np.isfinite(table[column]).all():
            raise InputError(f"{file}: column {column!r} has a value that is not finite; run the study again")
    if not len(table):
        raise InputError(f"{file}: has no rows; run the study again")
    numeric = [column for column in table if str(column)[:3] in ("tx_", "rx_") or column in OPTIONAL]
    if invalid := [column for column in numeric if table[column].dtype.kind not in "if"]:
        raise InputError(f"{file}: column {invalid[0]!r} has values of the wrong type; run the study again")
    # Columns of whole metres are read as integers and must be converted.
    return table.astype(dict.fromkeys(numeric, float))
