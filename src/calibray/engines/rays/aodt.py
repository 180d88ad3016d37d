"""Paths of NVIDIA's Aerial Omniverse Digital Twin, from a folder with `raypaths.parquet` and `cirs.parquet`.

Both tables name the time, the radio unit and the user equipment. `raypaths` has a row for each path, with its points in
units of the scene (centimetres unless stated) and its types of interaction. `cirs` has a row for each pair of antenna
elements, with lists of complex gains and delays [s] in the order of the paths.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.polylines import Polyline, rows_of
from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.support.messages import did_you_mean

FILES: Final = ("raypaths.parquet", "cirs.parquet")
PAIR: Final = ["ru_id", "ue_id"]
ELEMENTS: Final = ["ru_ant_el", "ue_ant_el"]
TYPES: Final = {
    "reflection": "reflection", "diffraction": "diffraction", "transmission": "transmission", "diffuse": "diffuse",
    "scattering": "diffuse",
}  # fmt: skip


def read_aodt(folder: Path, metres_per_unit: float = 0.01) -> SourceTable:
    """Read the paths of the first time step.

    Powers are summed over the antenna elements of the user equipment and averaged over those of the radio unit.

    Raises:
        InputError: A table or column is missing or malformed, or the numbers of gains and paths of a pair differ.
    """
    rays, gains = (read_table(folder / name) for name in FILES)
    for table, names in ((rays, ["points", "interaction_types"]), (gains, ["cir_re", "cir_im", "cir_delay"])):
        for name in (*PAIR, *names):
            table.column(name)
    frames = []
    for table in (rays, gains):
        time = table.frame["time_idx"].to_numpy() if "time_idx" in table.frame else np.zeros(len(table))
        frames.append(table.frame[time == time.min()])
    responses = {key: rows for key, rows in frames[1].groupby(PAIR, sort=False)}
    paths = []
    for pair, rows in frames[0].groupby(PAIR, sort=False):
        if pair not in responses:
            raise InputError(
                f"{gains.source}: has no gains of ru_id, ue_id = {pair}, which have {len(rows)} paths"
            )
        power, delay = _response(gains.source, pair, responses[pair], len(rows))
        for number, (points, types) in enumerate(zip(rows["points"], rows["interaction_types"], strict=True)):
            if power[number] > 0:
                level = 10 * np.log10(power[number])
                paths.append(
                    Polyline(metres_per_unit * _points(points), _types(rays, types), level, delay[number])
                )
    return rows_of(paths, str(folder))


def _response(
    source: str, pair: Any, rows: Any, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power and delay of every path of a pair."""
    lists = [
        [np.asarray(value, dtype=float) for value in rows[name]] for name in ("cir_re", "cir_im", "cir_delay")
    ]
    if wrong := [len(values) for column in lists for values in column if len(values) != count]:
        raise InputError(
            f"{source}: {wrong[0]} gains of ru_id, ue_id = {pair}, but raypaths has {count} paths of them; export both "
            "tables of the same run"
        )
    real, imaginary, delay = (np.array(column) for column in lists)
    transmitting = len(np.unique(rows[ELEMENTS[0]])) if ELEMENTS[0] in rows else 1
    return (real**2 + imaginary**2).sum(axis=0) / transmitting, delay[0]


def _points(points: Any) -> NDArray[np.float64]:
    """Points [n, 3] of a list of triples, or of dictionaries with the keys 1, 2 and 3."""
    try:
        return np.array(
            [list(item.values()) if isinstance(item, dict) else np.asarray(item) for item in points],
            dtype=float,
        ).reshape(-1, 3)
    except (TypeError, ValueError):
        raise InputError(
            "raypaths.parquet: points must be triples of numbers; export the table again"
        ) from None


def _types(table: SourceTable, types: Any) -> list[str]:
    names = [str(item).lower() for item in types][1:-1]
    if unknown := [name for name in names if name not in TYPES]:
        raise InputError(
            f"{table.source}: interaction_types has {unknown[0]!r}; {did_you_mean(unknown[0], TYPES)}"
        )
    return [TYPES[name] for name in names]
