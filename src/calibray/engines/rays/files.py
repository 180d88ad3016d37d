"""Files of ray tables: CSV, Parquet, JSON and HDF5, distinguished by their extension."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Final

import h5py
import numpy as np
import pandas as pd

from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.support.messages import shortened
from calibray.support.output_files import check_file, exists, replacing, write_text
from calibray.support.output_tables import write_table

LARGEST_JSON: Final = 2**26
"""Largest JSON file [bytes]; in memory, its numbers take about twenty times as much."""

HDF5: Final = b"\x89HDF"
"""First bytes of an HDF5 file."""

LARGEST_HDF5: Final = 2**30
"""Largest size of the datasets in memory [bytes]; kilobytes may decompress to gigabytes."""


def read_ray_file(file: str | Path) -> SourceTable:
    """Read the rows of a .csv, .parquet, .json or .h5 file.

    Raises:
        InputError: The file does not exist, has another extension, or is malformed.
    """
    path = Path(file)
    suffix = path.suffix.lower()
    if suffix not in (".json", ".h5", ".hdf5"):
        return read_table(path)
    if not exists(path):
        raise InputError(f"{path}: no such file")
    if suffix != ".json":
        return _parsed(path, str(path))
    if (size := path.stat().st_size) > LARGEST_JSON:
        raise InputError(
            f"{path}: {size / 2**20:,.0f} MiB of JSON, must be at most {LARGEST_JSON // 2**20}; write .parquet or .h5"
        )
    return parse_rays(path.read_bytes(), str(path))


def parse_rays(content: bytes, source: str) -> SourceTable:
    """Read the rows of a table in memory, in JSON or HDF5.

    Raises:
        InputError: The content is malformed.
    """
    return _parsed(
        BytesIO(content) if content.startswith(HDF5) else content.decode("utf-8", "replace"), source
    )


def _parsed(content: Path | BytesIO | str, source: str) -> SourceTable:
    try:
        is_json = isinstance(content, str)
        frame = pd.DataFrame(json.loads(content)) if is_json else _read_hdf5(content, source)
    except InputError:
        raise
    # A text nested too deeply is a RuntimeError.
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        fault = shortened(str(error))
        raise InputError(f"{source}: not a ray table ({fault}); see docs/reference/ray-table.md") from None
    if frame.empty:
        raise InputError(f"{source}: contains no rows; a ray table needs at least one path")
    return SourceTable(frame, source=source)


def write_ray_file(file: str | Path, frame: pd.DataFrame, overwrite: bool = False) -> None:
    """Write the rows as .csv, .parquet, .json or .h5; an existing file is replaced only once the new one is complete.

    Raises:
        InputError: The file extension is unknown, or the file cannot be written or must not be replaced.
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


def _read_hdf5(content: Path | BytesIO, source: str) -> pd.DataFrame:
    with h5py.File(content, "r") as file:
        columns: dict[str, h5py.Dataset] = {}
        for name in map(str, file):
            is_here = isinstance(file.get(name, getlink=True), h5py.HardLink)
            if is_here and isinstance(item := file[name], h5py.Dataset):
                columns[name] = item
        for name, item in columns.items():
            if item.is_virtual or item.external is not None:
                raise InputError(
                    f"{source}: {shortened(name)!r} is stored in another file; store it in this one"
                )
        if (size := sum(item.nbytes for item in columns.values())) > LARGEST_HDF5:
            raise InputError(
                f"{source}: {size / 2**20:,.0f} MiB, must be at most {LARGEST_HDF5 // 2**20}; export fewer links"
            )
        # MATLAB writes a vector as a matrix with one row or column.
        return pd.DataFrame(
            {
                name: np.ravel(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()])
                for name, item in columns.items()
            }
        )
