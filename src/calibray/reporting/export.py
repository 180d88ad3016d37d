"""Export: the calibrated scene as plain Sionna RT loads it, and its materials as tables for other tools."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import pandas as pd

from calibray.errors import InputError
from calibray.materials import FIELDS
from calibray.reporting.link_survey import survey
from calibray.result.record import Record
from calibray.scenes import export_scene, read_scene
from calibray.scenes.export import exported_id
from calibray.support.output_files import check_outputs, write_text
from calibray.tracing.settings import TraceSettings

FILES: Final = (
    "scene.xml", "load_scene.py", "calibration.json", "links.csv", "materials.csv", "materials.json", "materials.m",
)  # fmt: skip
SOLVER: Final = {"line_of_sight": "los", "samples": "samples_per_src"}
"""Switches that Sionna RT's path solver calls otherwise."""

MATLAB: Final = """function T = materials
%MATERIALS Calibrated materials: a table, or a structure where there are no tables.
%   Constants hold at {frequency:.9g} Hz; lower and upper are the ends of 95 % intervals, NaN where none is known.
%   For MATLAB's ray tracing: propagationModel("raytracing", "BuildingsMaterial", "custom", ...
%     "BuildingsMaterialPermittivity", T.relative_permittivity(1), "BuildingsMaterialConductivity", T.conductivity(1))
{columns}
if exist('struct2table', 'file') || exist('struct2table', 'builtin')
    T = struct2table(T);
end
end
"""


def export(
    result: Record, folder: str | Path, copy_meshes: bool = False, overwrite: bool = False
) -> tuple[str, ...]:
    """Write the calibrated scene for Sionna RT, a script that loads it, and its materials as tables.

    Args:
        result: The calibration.
        folder: Folder to write into; made if absent.
        copy_meshes: Whether meshes are copied into the folder; else the scene refers to them where they lie.

        overwrite: Replace files that Calibray did not write.

    Returns:
        Names of the files in the folder.

    Raises:
        InputError: The folder cannot be written, a file there must not be replaced, or scene or links cannot be read
            any more.
    """
    study = result.study
    target = check_outputs(folder, FILES, study.files(), overwrite)
    scene = result.scene or read_scene(
        study.scene_source, study.scene.frequency, study.overrides, study.objects
    )
    links = survey(result)
    if links is None:
        raise InputError(f"{study.path}: its links {study.links.file} cannot be read any more; put them back")
    places = {
        f"{end}_{axis}": position[:, k]
        for end, position in (("tx", links.tx), ("rx", links.rx))
        for k, axis in enumerate("xyz")
    }
    group = {} if links.group is None else {"group": links.group}
    rows = list(_rows(result))
    materials = pd.DataFrame(rows)
    script = files("calibray.reporting") / "templates" / "load_scene.py"
    content = {
        "load_scene.py": script.read_text(encoding="utf-8"),
        "calibration.json": _json(_calibration(result)),
        "links.csv": result.links.assign(**places, **group).to_csv(index=False, float_format="%.9g"),
        "materials.csv": materials.to_csv(index=False, float_format="%.9g"),
        "materials.json": _json({row["material"]: _known(row) for row in rows}),
        "materials.m": matlab(materials, study.scene.frequency),
    }
    try:
        target.mkdir(parents=True, exist_ok=True)
        export_scene(scene, result.materials, target / "scene.xml", copy_meshes, overwrite)
        for name, text in content.items():
            write_text(target / name, text)
    except OSError as error:
        raise InputError(
            f"output folder {target}: cannot be written ({error.strerror}); name another"
        ) from None
    return FILES


def matlab(materials: pd.DataFrame, frequency: float) -> str:
    """A MATLAB function that returns materials as a table; Octave, which has none, gets a structure.

    Args:
        materials: A row for each material.
        frequency: The carrier [Hz].

    Returns:
        The function's file.
    """
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
    """A row for each material: its constants, with the ends of their intervals where they were calibrated."""
    for name, material in result.materials.items():
        row: dict[str, Any] = {"material": name, "scene_name": exported_id(name).removeprefix("mat-")}
        row |= {field: getattr(material, field) for field in FIELDS}
        row["scattering_pattern"] = material.scattering_pattern
        for parameter in result.parameters:
            owner, _, constant = parameter.rpartition(".")
            interval = result.intervals.get(parameter) if owner == name else None
            row.setdefault(f"{constant}_lower", math.nan)
            row.setdefault(f"{constant}_upper", math.nan)
            row.setdefault(f"{constant}_verdict", "")
            if owner == name:
                row[f"{constant}_verdict"] = "not known" if interval is None else interval.label
            if interval is not None:
                row |= {f"{constant}_lower": interval.lower, f"{constant}_upper": interval.upper}
        if result.fit.laws:
            law = result.fit.laws.get(name, {})
            row |= {key: law.get(key, math.nan) for key in ("itu_a", "itu_b", "itu_c", "itu_d")}
        yield row


def _calibration(result: Record) -> dict[str, Any]:
    """All that the script needs beside the scene and the links."""
    study = result.study
    tx, rx = study.antenna_pair
    patterns = {
        exported_id(name).removeprefix("mat-"): {
            "name": material.scattering_pattern,
            "alpha_r": round(material.alpha_r),
            **(
                {"alpha_i": round(material.alpha_i), "lambda_": material.lambda_}
                if material.scattering_pattern == "backscattering"
                else {}
            ),
        }
        for name, material in result.materials.items()
        if material.scattering_pattern != "lambertian"
    }
    return {
        "frequency_hz": study.scene.frequency,
        "bandwidth_hz": study.scene.bandwidth,
        "combining": study.objective.combining,
        "antennas": {"tx": asdict(tx), "rx": asdict(rx)},
        "solver": {SOLVER.get(name, name): value for name, value in _numbered(study.trace).items()},
        "scattering_patterns": patterns,
        "offsets_db": result.nuisance.offsets_db,
    }


def _numbered(settings: TraceSettings) -> dict[str, object]:
    """The switches with a number of rays: Sionna RT's own solver adds none in rounds."""
    record: dict[str, object] = dict(settings.record())
    return {**record, "samples": TraceSettings.samples} if settings.adaptive else record


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """A row without its name and without what is not known, which JSON has no number for."""
    return {
        name: value
        for name, value in row.items()
        if name != "material" and value != "" and not (isinstance(value, float) and math.isnan(value))
    }


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _quoted(text: str) -> str:
    """A text as a literal of MATLAB and Octave; characters that end a line are written out."""
    shown = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
    doubled = shown.replace("'", "''")
    return f"'{doubled}'"
