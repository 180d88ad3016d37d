"""Converts impulse responses of links to multipath components: the samples above a stated threshold.

They are read from NumPy (.npz, .npy), MATLAB (.mat, also version 7.3) and HDF5 files: one array with one row per link
(and one or more snapshots), or a folder with one file per link, named after the link.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import scipy.io
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.multipath import Multipath
from calibray.support.messages import shortened

ENDINGS: Final = (".npz", ".npy", ".mat", ".h5", ".hdf5")
MOST_BYTES: Final = 4 << 30
"""Largest size of the arrays of a file."""

DELAYS: Final = ("delay", "delays", "tau", "time", "t")
"""Names of an array of the delays of the samples [s]."""

MARGIN_DB: Final = 10.0
"""Distance from the noise above which a sample counts as signal. The power of noise samples is exponentially
distributed, so one in 22,000 exceeds its mean by this distance."""


def read_impulse_responses(
    source: str | Path,
    labels: list[str],
    sample_rate: float | None = None,
    margin_db: float = MARGIN_DB,
) -> Multipath:
    """Read impulse responses, and keep the samples of each that exceed its noise.

    The noise of a response is that of the median sample; the mean of exponentially distributed powers is the median
    over ln 2. Most samples of a response must therefore be noise.

    Args:
        source: A file with one response per link, in the order of the labels, [links, samples] or
            [links, snapshots, samples]; or a folder with a file per link, [samples] or [snapshots, samples].
        labels: Labels of the links.
        sample_rate: Samples per second [Hz]; None if the files state delays [s].
        margin_db: Distance above the noise from which a sample counts [dB].

    Returns:
        The samples above the threshold as components; powers are those of the samples.

    Raises:
        InputError: A file cannot be read, or its array matches no link.
    """
    source = Path(source)
    parts = []
    if source.is_dir():
        files = {file.stem: file for file in sorted(source.iterdir()) if file.suffix.lower() in ENDINGS}
        known = [label for label in labels if label in files]
        if not known:
            raise InputError(f"{source}: no file is named like a link, such as {labels[0]}.npz")
        for label in known:
            response, delay = _read(files[label], sample_rate)
            parts.append(_above_noise(label, np.atleast_2d(response), delay, margin_db))
    else:
        response, delay = _read(source, sample_rate)
        if len(response) != len(labels) or response.ndim not in (2, 3):
            raise InputError(
                f"{source}: an array of shape {response.shape}, must have one row for each of {len(labels)} links"
            )
        for label, own in zip(labels, response, strict=True):
            parts.append(_above_noise(label, np.atleast_2d(own), delay, margin_db))
    return Multipath(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _above_noise(
    label: str, response: NDArray[Any], delay: NDArray[np.float64], margin_db: float
) -> tuple[NDArray[Any], ...]:
    """Link, snapshot, delay and level of the samples of a link's responses [snapshots, samples] above the noise."""
    power = np.abs(response) ** 2
    noise = np.median(power, axis=1, keepdims=True) / np.log(2)
    snapshot, sample = np.nonzero(power > noise * 10 ** (margin_db / 10))
    level_db = 10 * np.log10(power[snapshot, sample])
    return np.full(len(sample), label), snapshot.astype(str), delay[sample], level_db


def _read(file: Path, sample_rate: float | None) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """The array of responses of a file, and the delays of its samples [s]."""
    with _explained(file):
        arrays = _arrays(file)
    delays = next((arrays.pop(name) for name in list(arrays) if name.lower() in DELAYS), None)
    numeric = {name: array for name, array in arrays.items() if array.dtype.kind in "fciu" and array.ndim}
    if not numeric:
        raise InputError(f"{file}: contains no array of numbers")
    name, response = max(numeric.items(), key=lambda item: item[1].size)
    response = np.squeeze(response) if response.ndim > 3 else response
    if not np.isfinite(response).all():
        raise InputError(f"{file}: {shortened(name)!r} contains values that are not finite")
    count = response.shape[-1]
    if delays is not None:
        delay = np.asarray(delays, dtype=float).reshape(-1)
        if len(delay) != count:
            raise InputError(f"{file}: {len(delay)} delays for {count} samples of {shortened(name)!r}")
        return response, delay
    if sample_rate is None:
        raise InputError(f"{file}: states no delays ({', '.join(DELAYS)}); give the sample rate [Hz]")
    return response, np.arange(count) / sample_rate


def _arrays(file: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name."""
    ending = file.suffix.lower()
    if ending == ".npy":
        array = np.load(file, mmap_mode="r", allow_pickle=False)
        _check_size(file, array.nbytes)
        return {file.stem: np.array(array)}
    if ending == ".npz":
        with zipfile.ZipFile(file) as packed:
            _check_size(file, sum(entry.file_size for entry in packed.infolist()))
        with np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    if ending == ".mat" and not h5py.is_hdf5(file):
        _check_size(file, sum(16 * int(np.prod(shape)) for _, shape, _ in scipy.io.whosmat(file)))
        content = scipy.io.loadmat(file)
        arrays = {name: value for name, value in content.items() if isinstance(value, np.ndarray)}
        return {
            name: value.reshape(-1) if 1 in value.shape and value.ndim == 2 else value
            for name, value in arrays.items()
        }
    if ending in ENDINGS:
        return _hdf5_arrays(file, reverse=ending == ".mat")
    raise InputError(f"{file}: impulse responses are read from {', '.join(ENDINGS)}")


def _hdf5_arrays(file: Path, reverse: bool) -> dict[str, NDArray[Any]]:
    """The datasets at the root of an HDF5 file; MATLAB writes axes in reverse order, and complex numbers as pairs."""
    arrays = {}
    with h5py.File(file, "r") as content:
        datasets = {name: item for name in content if isinstance(item := content.get(name), h5py.Dataset)}
        datasets = {name: item for name, item in datasets.items() if not (item.is_virtual or item.external)}
        _check_size(file, sum(item.size * item.dtype.itemsize for item in datasets.values()))
        for name, item in datasets.items():
            values = item[()]
            if values.dtype.names == ("real", "imag"):
                values = values["real"] + 1j * values["imag"]
            arrays[name] = np.asarray(values).T if reverse else np.asarray(values)
            if reverse and 1 in arrays[name].shape and arrays[name].ndim == 2:
                arrays[name] = arrays[name].reshape(-1)
    return arrays


def _check_size(file: Path, size: int) -> None:
    if size > MOST_BYTES:
        raise InputError(
            f"{file}: its arrays take {size / 2**30:.1f} GiB, must take 4 or fewer; split the file"
        )


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    """Convert errors of libraries to errors with the file's name."""
    try:
        yield
    except InputError:
        raise
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        zipfile.BadZipFile,
        NotImplementedError,
    ) as error:
        raise InputError(f"{file}: cannot be read ({' '.join(str(error).split())[:200]})") from None
