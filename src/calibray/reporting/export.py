"""Export of the calibrated scene for use in Sionna RT without Calibray, and of its materials as tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.materials import FIELDS
from calibray.measurements import position_columns
from calibray.reporting.link_survey import Survey, survey
from calibray.reporting.wording import scene_alone_text
from calibray.result.files import changed_files
from calibray.result.record import Record
from calibray.scenes import Scene, export_scene, read_scene
from calibray.scenes.scene import exported_names
from calibray.study.setup import input_digests
from calibray.support.messages import printable
from calibray.support.output_files import check_outputs, csv_text, write_text
from calibray.tracing.protocol import LinkPositions
from calibray.tracing.settings import TraceSettings

FILES: Final = (
    "scene.xml", "load_scene.py", "calibration.json", "links.csv", "materials.csv", "materials.json", "materials.m",
)  # fmt: skip
VERIFIED_LINKS: Final = 3
"""Number of links for which the export checks the path loss of the exported scene."""

SOLVER: Final = {"line_of_sight": "los", "samples": "samples_per_src"}
"""Trace settings that have different names in Sionna RT's path solver."""

MATLAB: Final = """function T = materials
%MATERIALS Calibrated materials as a table, or as a structure in Octave.
%   Constants apply at {frequency:.9g} Hz. Columns _lower and _upper: ends of 95 % intervals, or NaN.
%   For MATLAB's ray tracing: propagationModel("raytracing", "BuildingsMaterial", "custom", ...
%     "BuildingsMaterialPermittivity", T.relative_permittivity(1), "BuildingsMaterialConductivity", T.conductivity(1))
{columns}
if exist('struct2table', 'file') || exist('struct2table', 'builtin')
    T = struct2table(T);
end
end
"""


def export(
    result: Record,
    folder: str | Path,
    copy_meshes: bool = False,
    overwrite: bool = False,
    *,
    allow_changed_inputs: bool = False,
) -> tuple[str, ...]:
    """Write the calibrated scene for Sionna RT, a script that loads it, and its materials as tables.

    Args:
        result: The calibration.
        folder: Folder to write into; a missing folder is created.
        copy_meshes: If True, copy the meshes into the folder; otherwise, the scene refers to the original files.
        overwrite: If True, also replace files that Calibray did not write.
        allow_changed_inputs: If True, export even if a scene or antenna file has changed since the calibration.

    Returns:
        Names of the files that were written to the folder. `wording.scene_alone_text` states how path loss from the
        scene alone differs from the predictions.

    Raises:
        InputError: The folder cannot be written to, a file in it must not be replaced, the scene or the links can no
            longer be read, the scene has changed, or the scene that Sionna RT loads differs from the calibrated scene.
    """
    study = result.study
    target = check_outputs(folder, FILES, study.files(), overwrite)
    scene = result.scene or read_scene(
        study.scene_source, study.scene.frequency, study.overrides, study.objects
    )
    if not allow_changed_inputs and (changed := changed_files(result, input_digests(study, scene))):
        raise InputError(
            f"{study.path}: {', '.join(changed[:5])} changed since the calibration, so the exported scene would not be "
            "the calibrated scene; calibrate again, or give --allow-changed-inputs (allow_changed_inputs=True)"
        )
    links = survey(result)
    if links is None:
        raise InputError(
            f"{study.path}: its links {study.links.file} can no longer be read; restore the file"
        )
    positions = position_columns(links.tx, links.rx)
    group = {} if links.group is None else {"group": links.group}
    rows = list(_rows(result))
    materials = pd.DataFrame(rows)
    script = files("calibray.reporting") / "templates" / "load_scene.py"
    content = {
        "load_scene.py": script.read_text(encoding="utf-8"),
        "calibration.json": _json(_calibration(result)),
        "links.csv": csv_text(_links(result).assign(**positions, **group), "%.9g"),
        "materials.csv": csv_text(materials, "%.9g"),
        "materials.json": _json({row["material"]: _without_unknown(row) for row in rows}),
        "materials.m": matlab(materials, study.scene.frequency),
    }
    try:
        target.mkdir(parents=True, exist_ok=True)
        export_scene(scene, result.scene_materials, target / "scene.xml", copy_meshes, overwrite)
        for name, text in content.items():
            write_text(target / name, text)
        _verify(scene, result, target / "scene.xml", links)
    except OSError as error:
        raise InputError(
            f"output folder {target}: cannot be written ({error.strerror}); choose another folder"
        ) from None
    return FILES


def _verify(scene: Scene, result: Record, target: Path, links: Survey) -> None:
    """Load the written scene as a user would, and compare the loaded scene with the calibrated scene."""
    # Importing Sionna RT takes seconds.
    from calibray.tracing.sionna import Tracer
    from calibray.tracing.sionna.live_scene import verify_export

    study = result.study
    few = np.unique(np.linspace(0, len(links.tx) - 1, VERIFIED_LINKS).astype(int))
    tracer = Tracer(scene, study.scene.frequency, study.trace, *study.antenna_pair)
    verify_export(tracer, result.scene_materials, target, LinkPositions(links.tx[few], links.rx[few]))


def _links(result: Record) -> pd.DataFrame:
    """Tabulate links, the nuisance that predictions add to the scene's path loss, and the reported path loss [dB]."""
    scene_db, predicted_db = (result.links[name].to_numpy(float) for name in ("scene_db", "predicted_db"))
    if result.prediction.model.parameters is None:
        return result.links.assign(nuisance_db=0.0, reported_db=scene_db)
    both = np.isfinite(scene_db) & np.isfinite(predicted_db)
    nuisance_db = np.zeros(len(both))
    nuisance_db[both] = predicted_db[both] - scene_db[both]
    return result.links.assign(nuisance_db=nuisance_db, reported_db=np.where(both, predicted_db, np.inf))


def matlab(materials: pd.DataFrame, frequency: float) -> str:
    """A MATLAB function, as text, that returns the materials as a table or, in Octave, a structure; carrier in [Hz]."""
    columns = []
    for name in materials.columns:
        cells = materials[name].tolist()
        if all(isinstance(cell, str) for cell in cells):
            columns.append(f"T.{name} = {{{'; '.join(map(_quoted, cells))}}};")
        else:
            numbers = ("NaN" if math.isnan(cell) else f"{cell:.9g}" for cell in cells)
            columns.append(f"T.{name} = [{'; '.join(numbers)}];")
    return MATLAB.format(frequency=frequency, columns="\n".join(columns))


def _rows(result: Record) -> Iterator[dict[str, Any]]:
    """One row per material: the constants used in predictions; intervals and verdicts of calibrated constants."""
    names = exported_names(result.scene_materials)
    for name, material in result.scene_materials.items():
        row: dict[str, Any] = {"material": name, "scene_name": names[name]}
        row |= {field: getattr(material, field) for field in FIELDS}
        row["scattering_pattern"] = material.scattering_pattern
        for parameter in result.parameters:
            owner, _, constant = parameter.rpartition(".")
            if owner not in names:
                continue  # the parameter belongs to an antenna or a region, not a material
            interval = result.intervals.get(parameter) if owner == name else None
            # Every row has columns for all calibrated constants.
            row.setdefault(f"{constant}_lower", math.nan)
            row.setdefault(f"{constant}_upper", math.nan)
            row.setdefault(f"{constant}_verdict", "")
            if owner == name:
                row[f"{constant}_verdict"] = "unknown" if interval is None else interval.label
            if interval is not None:
                row |= {f"{constant}_lower": interval.lower, f"{constant}_upper": interval.upper}
        if result.scene_laws:
            law = result.scene_laws.get(name, {})
            row |= {key: law.get(key, math.nan) for key in ("itu_a", "itu_b", "itu_c", "itu_d")}
        yield row


def _calibration(result: Record) -> dict[str, Any]:
    """The data that the script needs in addition to the scene and the links."""
    study = result.study
    tx, rx = study.antenna_pair
    names = exported_names(result.scene_materials)
    patterns = {
        names[name]: {
            "name": material.scattering_pattern,
            "alpha_r": round(material.alpha_r),
            **(
                {"alpha_i": round(material.alpha_i), "lambda_": material.lambda_}
                if material.scattering_pattern == "backscattering"
                else {}
            ),
        }
        for name, material in result.scene_materials.items()
        if material.scattering_pattern != "lambertian"
    }
    return {
        "frequency_hz": study.scene.frequency,
        "bandwidth_hz": study.scene.bandwidth,
        "combining": study.objective.combining,
        "antennas": {"tx": asdict(tx), "rx": asdict(rx)},
        **({"mounted": list(study.links.mountings)} if study.links.mountings else {}),
        "solver": {SOLVER.get(name, name): value for name, value in _with_samples(study.trace).items()},
        "scattering_patterns": patterns,
        "prediction_model": str(result.prediction.model.name),
        "nuisance": {term.name: term.coefficients for term in result.prediction.model.terms},
        "scene_alone": scene_alone_text(result),
    }


def _with_samples(settings: TraceSettings) -> dict[str, object]:
    """The trace settings with a fixed number of rays, because Sionna RT's solver does not add rays in rounds."""
    record: dict[str, object] = dict(settings.record())
    return {**record, "samples": TraceSettings.samples} if settings.adaptive else record


def _without_unknown(row: dict[str, Any]) -> dict[str, Any]:
    """A row without its name and without unknown values; unknown values are omitted because JSON has no NaN."""
    return {
        name: value
        for name, value in row.items()
        if name != "material" and value != "" and not (isinstance(value, float) and math.isnan(value))
    }


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _quoted(text: str) -> str:
    """Convert text to a string literal for MATLAB and Octave, with unprintable characters escaped."""
    doubled = printable(text).replace("'", "''")
    return f"'{doubled}'"
