"""Results side by side: what differs between their studies, and which predicts held-out blocks better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibray.result.files import read
from calibray.result.held_out import HeldOutErrors
from calibray.validation.held_out_statistics import compare


def settings(study: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The settings of a study by their dotted names.

    Example:
        >>> settings({"scene": {"frequency": 3.5e9}, "offset": {}})
        {'scene.frequency': 3500000000.0}
    """
    values: dict[str, Any] = {}
    for name, value in study.items():
        values |= (
            settings(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
        )
    return values


def changes(studies: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Settings that differ between studies: by dotted name, the value of each; None where a study lacks it."""
    tables = [settings(study) for study in studies]
    rows = {name: [table.get(name) for table in tables] for table in tables for name in table}
    return {name: values for name, values in rows.items() if any(value != values[0] for value in values)}


def predictive_errors(folder: Path) -> tuple[str, HeldOutErrors] | None:
    """The model that a result's predictions use, and its held-out errors; None without a validation of this model.

    Raises:
        InputError: The result or its validation cannot be read, or belong to different studies.
    """
    fields = read(folder, allow_changed_inputs=True)
    held_out, model = fields["held_out"], fields["prediction"].model.name
    return None if held_out is None or model not in held_out.errors else (model, held_out)


def better(first: str, second: str, folder: Path) -> str:
    """Which of two results of a folder predicts held-out blocks better, and how certainly, as a sentence.

    Raises:
        InputError: A result or its validation cannot be read.
    """
    results = {name: predictive_errors(folder / name) for name in (first, second)}
    if missing := [name for name, errors in results.items() if errors is None]:
        return f"{' and '.join(missing)}: not validated, so nothing shows which result predicts better. Validate both."
    (model, one), (other_model, other) = (errors for errors in results.values() if errors is not None)
    same = [(one.position, other.position), (one.measured_db, other.measured_db)]
    if not all(np.array_equal(*pair) for pair in same):
        return f"{first} and {second} were validated on other links, so nothing shows which predicts better."
    judged = (one.block >= 0) & (other.block >= 0)
    if not judged.any():
        return f"{first} and {second} have no held-out link in common. Validate both by the same blocks."
    errors = {first: one.errors[model][judged], second: other.errors[other_model][judged]}
    best, worst = sorted(errors, key=lambda name: float(np.mean(errors[name] ** 2)))
    judgement = compare(errors[best], {worst: errors[worst]}, one.position[judged])
    lower = sum(
        np.mean(errors[best][rows] ** 2) < np.mean(errors[worst][rows] ** 2)
        for rows in (one.block[judged] == block for block in np.unique(one.block[judged]))
    )
    certainty = "" if judgement.error_db is None else f", standard error {judgement.error_db:.2f} dB"
    blocks = len(np.unique(one.block[judged]))
    clearly = "" if judgement.helped else "not clearly "
    return (
        f"{best} predicts {clearly}better than {worst}: RMSE {judgement.rmse_db:.2f} against "
        f"{judgement.baseline_rmse_db:.2f} dB on {judgement.links} held-out links (difference "
        f"{judgement.gain_db:.2f} dB{certainty}); lower in {lower} of {blocks} blocks of {first}."
    )
