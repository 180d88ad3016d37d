"""Files of ray tables: CSV, Parquet, JSON and HDF5, by their ending."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.support.output_files import check_file, exists, replacing, write_table, write_text


def read_ray_file(file: str | Path) -> SourceTable:
    """Read the rows of a .csv, .parquet, .json or .h5 file.

    Raises:
        InputError: The file does not exist, has another ending, or is malformed.
    """
    path = Path(file)
    suffix = path.suffix.lower()
    if suffix not in (".json", ".h5", ".hdf5"):
        return read_table(path)
    if not exists(path):
        raise InputError(f"{path}: no such file")
    try:
        frame = _read_json(path) if suffix == ".json" else _read_hdf5(path)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: not a ray table ({error}); see docs/reference/ray-table.md") from None
    if frame.empty:
        raise InputError(f"{path}: holds no rows; a ray table needs at least one path")
    return SourceTable(frame, source=str(path))


def write_ray_file(file: str | Path, frame: pd.DataFrame, overwrite: bool = False) -> None:
    """Write the rows as .csv, .parquet, .json or .h5; a file there is replaced only once the new one is complete.

    Raises:
        InputError: The ending is unknown, or the file cannot be written or must not be replaced.
    """
    target = check_file(file, overwrite=overwrite)
    match target.suffix.lower():
        case ".csv" | ".parquet":
            write_table(target, frame)
        case ".json":
            write_text(target, json.dumps({name: frame[name].tolist() for name in frame}) + "\n")
        case ".h5" | ".hdf5":
            with replacing(target) as partial, h5py.File(partial, "w") as content:
                for name in frame:
                    column = frame[name].to_numpy()
                    text = column.dtype.kind not in "iuf"
                    content[str(name)] = np.array(column, dtype=h5py.string_dtype()) if text else column
        case suffix:
            raise InputError(
                f"{target}: cannot write {suffix or 'no ending'}; use .csv, .parquet, .json or .h5"
            )


def _read_json(path: Path) -> pd.DataFrame:
    return pd.DataFrame(json.loads(path.read_text(encoding="utf-8")))


def _read_hdf5(path: Path) -> pd.DataFrame:
    with h5py.File(path, "r") as file:
        columns = {name: item for name, item in file.items() if isinstance(item, h5py.Dataset)}
        # MATLAB writes a vector as a matrix with one row or column.
        return pd.DataFrame(
            {
                name: np.ravel(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()])
                for name, item in columns.items()
            }
        )
