"""Paths of a DeepMIMO scenario (version 4): a folder of matrices, `NAME_tSET_txTX_rSET.mat` or `.npz`.

For each transmitter and set of N receivers: `power` [N, P], path gain [dB]; `delay` [N, P], [s]; `inter` [N, P], one
digit for each interaction; `inter_pos` [N, P, I, 3], `tx_pos` [3] and `rx_pos` [N, 3], [m]. Missing paths are NaN.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat
from scipy.io.matlab import MatReadError

from calibray.engines.rays.polylines import Polyline, rows_of
from calibray.errors import InputError
from calibray.measurements import SourceTable
from calibray.support.messages import first_line

TYPES: Final = {"1": "reflection", "2": "diffraction", "3": "diffuse", "4": "transmission"}
OTHER_NAMES: Final = {"delay": "toa", "inter_pos": "inter_loc", "tx_pos": "tx_loc", "rx_pos": "rx_loc"}
"""Matrices and their names in earlier versions."""

LARGEST: Final = 2**30
"""Largest size of a matrix in memory [bytes]."""


def is_deepmimo(folder: Path) -> bool:
    """Whether a folder contains matrices of a scenario."""
    return any(_files(folder))


def read_deepmimo(folder: Path) -> SourceTable:
    """Read the paths of all transmitters.

    Raises:
        InputError: A matrix is missing, malformed or too large, or its shape does not match the others.
    """
    paths = [path for file in _files(folder) for path in _paths(file)]
    return rows_of(paths, str(folder))


def _files(folder: Path) -> Iterator[Path]:
    """The matrices of powers."""
    for ending in ("mat", "npz"):
        yield from sorted(folder.glob(f"power_t*.{ending}"))


def _paths(file: Path) -> Iterator[Polyline]:
    code = file.name.removeprefix("power")
    matrices = {"power": _matrix(file)}
    for name in ("delay", "inter", "inter_pos", "tx_pos", "rx_pos"):
        other = file.with_name(OTHER_NAMES.get(name, name) + code)
        matrices[name] = _matrix(other if other.exists() else file.with_name(name + code))
    power, delay, inter = (np.atleast_2d(matrices[name]) for name in ("power", "delay", "inter"))
    tx, rx = matrices["tx_pos"].reshape(-1, 3), matrices["rx_pos"].reshape(-1, 3)
    place = matrices["inter_pos"]
    if place.ndim == 3:  # one interaction at most
        place = place[:, :, None]
    if (
        not (power.shape == delay.shape == inter.shape == place.shape[:2])
        or len(rx) != len(power)
        or len(tx) != 1
    ):
        raise InputError(
            f"{file}: its matrices have the shapes {power.shape}, {delay.shape}, {inter.shape}, {place.shape}, "
            f"{tx.shape} and {rx.shape}; power, delay and inter must be [N, P], inter_pos [N, P, I, 3], tx_pos [1, 3] "
            "and rx_pos [N, 3]"
        )
    for receiver, path in np.argwhere(np.isfinite(power) & np.isfinite(inter) & (inter >= 0)).tolist():
        codes = str(int(inter[receiver, path])) if inter[receiver, path] else ""
        if unknown := set(codes) - set(TYPES):
            raise InputError(
                f"{file}: receiver {receiver}, path {path}: interaction {unknown.pop()} of {codes}; the codes are "
                f"{', '.join(f'{key} {name}' for key, name in TYPES.items())}"
            )
        points = np.vstack([tx[0], place[receiver, path, : len(codes)], rx[receiver]])
        yield Polyline(
            points, [TYPES[digit] for digit in codes], power[receiver, path], delay[receiver, path]
        )


def _matrix(file: Path) -> NDArray[np.float64]:
    """The one matrix of a file."""
    try:
        if file.suffix == ".npz":
            with ZipFile(file) as parts:
                size = sum(part.file_size for part in parts.infolist())
        else:
            size = 8 * sum(int(np.prod(shape)) for _, shape, _ in whosmat(file))
        if size > LARGEST:
            raise InputError(
                f"{file}: {size / 2**20:,.0f} MiB, must be at most {LARGEST // 2**20}; export fewer receivers"
            )
        with np.load(file, allow_pickle=False) if file.suffix == ".npz" else _Loaded(file) as content:
            (matrix,) = (content[name] for name in content if not name.startswith("__"))
            return np.asarray(matrix, dtype=float)
    except (OSError, ValueError, TypeError, NotImplementedError, BadZipFile, MatReadError) as error:
        raise InputError(f"{file}: not a matrix of a DeepMIMO scenario ({first_line(error)})") from None


class _Loaded(dict[str, NDArray]):
    """The variables of a .mat file."""

    def __init__(self, file: Path) -> None:
        super().__init__(loadmat(file))

    def __enter__(self) -> _Loaded:
        return self

    def __exit__(self, *_: object) -> None:
        pass
