"""Attacks on what radio planners and other engines write: antennas of two cuts, regions, observables and ray tables."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from random import Random

import h5py
import numpy as np
import pandas as pd

import calibray as cb
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.tracing.gain_table import read_two_cuts
from fuzzing import world
from fuzzing.mutations import damage, edited, hostile, toml
from fuzzing.outcome import Case
from fuzzing.world import OWN, World

SQUARE = (
    '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"top": 6.0}, "geometry": '
    '{"type": "Polygon", "coordinates": [[[15, -3], [25, -3], [25, 3], [15, 3], [15, -3]]]}}]}'
)
SECTIONS = {
    "regions": {
        "trees": {"boxes": [[15.0, -3.0, 25.0, 3.0]], "bottom": 0.0, "top": 6.0, "specific_attenuation": 0.3},
        "park": {"file": "park.geojson", "position": "scene", "top": "top", "specific_attenuation": 0.1},
    },
    "noise": {"std_db": 1.0},
    "observables": {
        "spread": {"kind": "rms_delay_spread", "column": "w", "unit": "ns", "dynamic_range_db": 30.0},
        "flight": {"kind": "time_of_flight", "column": "loss", "unit": "ns", "bias": "half", "std": 5.0},
    },
    "antennas": {
        "tx": {"pattern": "iso"}, "rx": {"pattern": "dipole"},
        "types": {"a": {"pattern": "sector.msi"}, "b": {"pattern": "dipole", "orientation": [0.0, 0.0, 0.0]}},
    },
    "links": {key: value for key, value in world.content()["links"].items() if key != "weight"} | {
        "transmitter": "half", "position_error_m": 1.0,
        "tx_antenna": {"type": "half", "azimuth_deg": 90.0, "downtilt_deg": 4.0, "electrical_downtilt_deg": 0.0},
    },
    "parameters": world.content()["parameters"] | {
        "region:trees.specific_attenuation": {"bounds": [0.0, 3.0]},
        "tx:a.azimuth": {"bounds": [-20.0, 20.0], "prior": {"std": 5.0}},
        "tx:*.gain": {"bounds": [-6.0, 6.0]},
    },
}  # fmt: skip
"""Each of them, put into the harmless study, makes a study that runs."""


def cuts() -> str:
    """An antenna in MSI format."""
    turn = [f"{angle} {20 * (1 - np.cos(np.radians(angle))):.2f}" for angle in range(0, 360, 5)]
    return "\n".join(["NAME sector", "GAIN 17.5 dBi", "HORIZONTAL 72", *turn, "VERTICAL 72", *turn, ""])


def section(rng: Random, found: World, folder: Path) -> Case:
    """A study with regions, observables, antennas per transmitter and poses, with values or keys changed."""
    file = found.copy(folder)
    (folder / "sector.msi").write_text(cuts())
    (folder / "park.geojson").write_text(SQUARE)
    tree, runs = copy.deepcopy(world.content(**SECTIONS)), rng.random() < 0.3
    if runs:
        tree["observables"] = {}  # compiling their derivatives takes longer than a case may
    notes, bad = [], False
    names = [name for name in SECTIONS if name not in ("links", "parameters")] + ["links.tx_antenna"]
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice([name for name in names if tree.get(name, True)])
        parent, key = (tree["links"], "tx_antenna") if "." in name else (tree, name)
        parent[key], note, senseless = edited(rng, parent[key])
        notes.append(f"{name}: {note}")
        bad = senseless and len(notes) == 1
    if rng.random() < 0.2:
        park = folder / "park.geojson"
        park.write_bytes(damage(rng, park.read_bytes()))
        notes.append("park.geojson: bytes")
    file.write_bytes(toml(tree).encode(errors="surrogatepass"))
    named = ("study.toml", "park.geojson", "sector.msi", "links.", "region", "observables", "antennas")
    if runs:
        arguments = (file, "-o", folder / "out")
        return Case("section", f"run, {notes}", lambda: world.rmse(*arguments), bad, names=named, own=OWN)
    return Case("section", f"open, {notes}", lambda: world.opened(file), bad, names=named, own=OWN)


def pattern(rng: Random, found: World, folder: Path) -> Case:
    """An antenna of two cuts with lines or bytes changed."""
    file = folder / "sector.msi"
    lines, bad = cuts().splitlines(), True
    row = rng.choice((1, 2, 75, rng.randrange(3, 75), rng.randrange(76, len(lines))))
    match rng.randrange(5):
        case 0 | 1:
            words = lines[row].split()
            value = rng.choice(("nan", "x", "1e999", "-inf", "1e9", "0x1", "\xb2", "\xbd", "9" * 400, "\0"))
            words[rng.randrange(words[0].isalpha(), len(words))] = value
            lines[row], note = " ".join(words), f"line {row + 1}: {value[:9]!r}"
            bad = row not in (1,) or words[1] == value
        case 2:
            del lines[row]
            note = f"without line {row + 1}"
        case 3:
            lines.insert(row, lines[row])
            note, bad = f"line {row + 1} twice", row != 1
        case _:
            file.write_bytes(damage(rng, "\n".join(lines).encode("latin-1")))
            return Case("pattern", "bytes", lambda: read_two_cuts(file).gain(0, 0), names=("sector.msi",))
    file.write_text("\n".join(lines), encoding="latin-1")
    return Case("pattern", note, lambda: read_two_cuts(file).gain(0, 0), bad, names=("sector.msi",))


def rays(rng: Random, found: World, folder: Path) -> Case:
    """A ray table in any format with cells, columns, rows or bytes changed: the right path loss, or a refusal."""
    shutil.copyfile(found.base / "paths.h5", folder / "paths.h5")
    found.copy(folder)
    file = folder / f"rays.{rng.choice(('csv', 'json', 'h5', 'parquet'))}"
    cb.write_rays(Paths.load(folder / "paths.h5"), folder / "sound.csv")
    table = pd.read_csv(folder / "sound.csv", dtype=object, keep_default_na=False)
    change = rng.choice((_cell, _cell, _rows, _columns))
    bad = False
    if rng.random() < 0.75:
        table, note, bad = change(rng, table)
    else:
        note = "bytes"
    _write(file, table)
    if note == "bytes":
        file.write_bytes(damage(rng, file.read_bytes()))

    def act() -> list[float]:
        study = cb.Study.load(folder / "study.toml")
        return np.asarray(path_loss(cb.read_rays(file, study))).tolist()

    right = found.right["path_loss"] if note.startswith("shuffled") else None
    case = f"{file.suffix}: {note}"
    return Case("rays", case, act, bad, right, names=(file.name, "path", "ray", "column"), own=("*.csv",))


def _write(file: Path, table: pd.DataFrame) -> None:
    text = table.apply(lambda column: column.map(str))
    match file.suffix:
        case ".csv":
            table.to_csv(file, index=False)
        case ".parquet":
            text.to_parquet(file)
        case ".json":
            file.write_text(json.dumps(text.to_dict("list")))
        case _:
            with h5py.File(file, "w") as content:
                for name in text:
                    content[str(name) or "none"] = [value.replace("\0", "") for value in text[name]]


Change = Callable[[Random, pd.DataFrame], tuple[pd.DataFrame, str, bool]]


def _cell(rng: Random, table: pd.DataFrame) -> tuple[pd.DataFrame, str, bool]:
    row, name = rng.randrange(len(table)), rng.choice(("point", "type", "x", "y", "z", "power_db", "delay"))
    value = rng.choice(("nan", "x", "1e999", "-inf", "", "1e9", "-5.5", str(hostile(rng))[:500]))
    table.loc[row, name] = value
    # A column of the whole path may be empty in a row.
    bad = value in ("x", "1e999", "-inf", "1e9") or (name in "xyz" and value in ("", "nan"))
    return table, f"{name} of row {row} = {value[:30]!r}", bad


def _rows(rng: Random, table: pd.DataFrame) -> tuple[pd.DataFrame, str, bool]:
    match rng.randrange(3):
        case 0:
            order = rng.sample(range(len(table)), len(table))
            return table.iloc[order].reset_index(drop=True), "shuffled", False
        case 1:
            row = rng.randrange(len(table))
            return table.drop(index=row).reset_index(drop=True), f"without row {row}", True
        case _:
            row = rng.randrange(len(table))
            return pd.concat([table, table.iloc[[row]]], ignore_index=True), f"row {row} twice", True


def _columns(rng: Random, table: pd.DataFrame) -> tuple[pd.DataFrame, str, bool]:
    name = rng.choice(("path", "point", "type", "x", "y", "z"))
    match rng.randrange(3):
        case 0:
            return table.drop(columns=name), f"without {name}", True
        case 1:
            other = rng.choice([column for column in ("x", "y", "z") if column != name])
            table[[name, other]] = table[[other, name]].to_numpy()
            return table, f"{name} and {other} exchanged", True
        case _:
            return table.rename(columns={name: f"{name} "}), f"{name!r} with a blank", False
