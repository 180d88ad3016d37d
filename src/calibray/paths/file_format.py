"""Content and checksum of a path file. The shape, type and range of every dataset are checked when a file is read.

`docs/reference/path-file.md` describes the datasets.

The seal is a checksum at the start of the file, which is verified before anything else is read. HDF5 allows a user
block in front of the content. In a path file, the user block contains the SHA-256 digest of the content as one line of
text. A damaged file can make the HDF5 library hang or crash (one hang and one crash in 3,000 files with flipped bits),
so the library reads a file only if the checksum matches. A file from another source may have been changed and sealed
again; 5 of 3,000 such files took more than a minute to read. A file from another source is therefore read first in a
process with limited memory and time. A file that Calibray wrote or validated earlier for the same user is recognized by
its checksum and read directly.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import inf, isnan, pi
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS, FREQUENCIES
from calibray.paths.interactions import Kind
from calibray.support.cache_folder import Store, cache_folder
from calibray.support.memory import run_limited
from calibray.support.output_files import PATH_SEAL, replacing

FORMAT: Final = "calibray/paths"
FORMAT_VERSION: Final = 1

_SETTING: Final = "setting_"
"""Prefix of the attributes that record the settings of the trace."""

_ROUNDING: Final = 1e-3
"""Tolerance on the ranges, because numbers may have been rounded to single precision."""


@dataclass(frozen=True)
class Dataset:
    """One dataset of a path file.

    Attributes:
        shape: Sizes of the dimensions: numbers, or the letters used in `docs/reference/path-file.md`.
        kind: "f" for floating-point numbers, "i" for integers, "O" for text.
        lower: Smallest value.
        upper: Largest value.
    """

    shape: tuple[str | int, ...]
    kind: str = "f"
    lower: float = -inf
    upper: float = inf


@dataclass(frozen=True)
class Content:
    """Content of a path file.

    Attributes:
        frequency: Carrier frequency [Hz].
        settings: How the paths were traced.
        arrays: The datasets by name; text is stored as str.
    """

    frequency: float
    settings: Mapping[str, object]
    arrays: Mapping[str, NDArray[Any]]


_COSINE = (-1 - _ROUNDING, 1 + _ROUNDING)
_TO_NORMAL = (0.0, _COSINE[1])  # normals point to the side of the wave
_ANGLE = (-2 * pi - _ROUNDING, 2 * pi + _ROUNDING)
# These limits are far above the values of any antenna (120 dB), scene or path, and far below values at which a sum of
# powers overflows.
_FIELD = (-1e6, 1e6)
_LENGTH = 1e9  # [m]
_DIVISOR = 1e-9  # a power divided by 0 is infinite
_POSITION = (-_LENGTH, _LENGTH)

DATASETS: Final[Mapping[str, Dataset]] = MappingProxyType(
    {
        "materials/name": Dataset(("M",), "O"),
        **{f"materials/{name}": Dataset(("M",)) for name in FIELDS},
        "materials/scattering_pattern": Dataset(("M",), "O"),
        "links/tx_position": Dataset(("L", 3), "f", *_POSITION),
        "links/rx_position": Dataset(("L", 3), "f", *_POSITION),
        "paths/link": Dataset(("P",), "i"),
        "paths/first": Dataset(("P + 1",), "i"),
        "paths/delay": Dataset(("P",), "f", 0.0, 1e3),
        "paths/spreading": Dataset(("P",), "f", 0.0, 1e9),
        "paths/departure": Dataset(("P", 2), "f", *_ANGLE),
        "paths/arrival": Dataset(("P", 2), "f", *_ANGLE),
        **{f"paths/tx_field_{part}": Dataset(("P", "T", 2), "f", *_FIELD) for part in ("real", "imag")},
        **{f"paths/rx_field_{part}": Dataset(("P", "R", 2), "f", *_FIELD) for part in ("real", "imag")},
        "interactions/kind": Dataset(("I",), "i"),
        "interactions/material": Dataset(("I",), "i"),
        "interactions/cos_incidence": Dataset(("I",), "f", *_TO_NORMAL),
        "interactions/rotation": Dataset(("I", 2), "f", *_COSINE),
        "interactions/vertex": Dataset(("I", 3)),
        "diffuse/rotation": Dataset(("D", 2), "f", *_COSINE),
        "diffuse/solid_angle": Dataset(("D",), "f", 0.0, 1e9),
        "diffuse/cos_scattered": Dataset(("D",), "f", *_TO_NORMAL),
        "diffuse/cos_specular": Dataset(("D",), "f", *_COSINE),
        "diffuse/cos_backward": Dataset(("D",), "f", *_COSINE),
        "diffraction/cos_incidence_n": Dataset(("W",), "f", *_TO_NORMAL),
        "diffraction/exterior_angle": Dataset(("W",), "f", _DIVISOR, _ANGLE[1]),
        "diffraction/azimuth_in": Dataset(("W",), "f", *_ANGLE),
        "diffraction/azimuth_out": Dataset(("W",), "f", *_ANGLE),
        "diffraction/sin_edge": Dataset(("W",), "f", _DIVISOR, _COSINE[1]),
        "diffraction/distance": Dataset(("W",), "f", 0.0, _LENGTH),
        "diffraction/rotations": Dataset(("W", 4, 2), "f", *_COSINE),
    }
)

# A correction of 0 would remove a path. In the engine and in the replay, the loss through each wall can amount to
# hundreds of decibels.
OPTIONAL: Final[Mapping[str, Dataset]] = MappingProxyType(
    {"paths/correction": Dataset(("P",), "f", 1e-300, 1e300)}
)
"""Datasets that a file may omit."""


def write(file: h5py.File, content: Content) -> None:
    """Write the content of a path file: all datasets of `DATASETS`, and the datasets of `OPTIONAL` that are present."""
    file.attrs.update({"format": FORMAT, "version": FORMAT_VERSION, "frequency_hz": content.frequency})
    file.attrs.update({f"{_SETTING}{key}": value for key, value in content.settings.items()})
    for name, dataset in (DATASETS | OPTIONAL).items():
        if name in OPTIONAL and name not in content.arrays:
            continue
        values = content.arrays[name]
        file[name] = np.array(values, dtype=h5py.string_dtype()) if dataset.kind == "O" else values


def read(file: h5py.File) -> Content:
    """Read a path file and check its entire content.

    Raises:
        InputError: The format or version differs, or a dataset is missing, has the wrong shape or type, or is out of
            range. The error message does not contain the file name.
    """
    if (name := file.attrs.get("format")) != FORMAT:
        raise InputError(f"is not a Calibray path file (attribute format = {name!r}; it must be {FORMAT!r})")
    if (version := _attribute(file, "version")) != FORMAT_VERSION:
        raise InputError(
            f"has version {version} of the format, but must have version {FORMAT_VERSION}; trace again"
        )
    frequency = _attribute(file, "frequency_hz")
    lower, upper = FREQUENCIES
    if isinstance(frequency, str | bool | np.bool_) or not lower <= float(frequency) <= upper:
        fault = _damaged(f"frequency_hz = {frequency!r}, must be between {lower:g} and {upper:g} Hz")
        raise fault
    present = {name: dataset for name, dataset in OPTIONAL.items() if name in file}
    arrays = {name: _array(file, name, dataset) for name, dataset in (DATASETS | present).items()}
    _check_shapes(arrays)
    _check_values(arrays)
    _check_indices(arrays)
    return Content(float(frequency), dict(_settings(file)), arrays)


def _damaged(fault: str) -> InputError:
    return InputError(f"is damaged ({fault}); trace again")


def _attribute(file: h5py.File, name: str) -> Any:
    value = file.attrs[name]
    if isinstance(value, str | np.bool_) or (
        isinstance(value, np.number) and value.dtype.kind in "iuf" and not isnan(value)
    ):
        return value
    raise _damaged(f"attribute {name} is neither text nor a number")


def _settings(file: h5py.File) -> Iterator[tuple[str, object]]:
    for key in file.attrs:
        if key.startswith(_SETTING):
            value = _attribute(file, key)
            yield key.removeprefix(_SETTING), value.item() if isinstance(value, np.generic) else value


def _array(file: h5py.File, name: str, dataset: Dataset) -> NDArray[Any]:
    """Read one dataset, which must be stored contiguously in this file and must not exceed the file size."""
    item, length = file.get(name), file.id.get_filesize()
    link = file.get(name, getlink=True)
    if not isinstance(item, h5py.Dataset) or not isinstance(link, h5py.HardLink):
        raise _damaged(f"no dataset {name}")
    # A chunked or external dataset may declare more data than the file stores.
    if item.chunks is not None or item.is_virtual or item.external is not None or item.nbytes > length:
        raise _damaged(f"dataset {name} is not stored contiguously")
    if item.ndim != len(dataset.shape):
        raise _damaged(f"dataset {name} has the shape {item.shape}")
    if dataset.kind == "O":
        if h5py.check_string_dtype(item.dtype) is None:
            raise _damaged(f"dataset {name} is not text")
        return np.array(item.asstr()[()], dtype=object)
    if item.dtype.kind not in {"i": "iu", "f": "f"}[dataset.kind]:
        raise _damaged(f"dataset {name} has the type {item.dtype}")
    # Other programs may write numbers of other sizes and byte orders, not all of which can be combined. Wedges need
    # double precision.
    native = item.dtype.newbyteorder("=")
    if dataset.kind == "i":
        return item[()].astype(native if native.itemsize < 8 else np.int64, copy=False)
    kept = name == "interactions/vertex" and native == np.float32
    return item[()].astype(native if kept else np.float64, copy=False)


def _datasets(arrays: Mapping[str, NDArray[Any]]) -> list[tuple[str, Dataset]]:
    """The datasets that a file has."""
    return [(name, dataset) for name, dataset in (DATASETS | OPTIONAL).items() if name in arrays]


def _check_shapes(arrays: Mapping[str, NDArray[Any]]) -> None:
    kinds = arrays["interactions/kind"]
    sizes = {
        "L": len(arrays["links/tx_position"]),
        "P": len(arrays["paths/link"]),
        "P + 1": len(arrays["paths/link"]) + 1,
        "I": len(kinds),
        "D": int((kinds == Kind.DIFFUSE).sum()),
        "W": int((kinds == Kind.DIFFRACTION).sum()),
        "M": len(arrays["materials/name"]),
        "T": arrays["paths/tx_field_real"].shape[1],
        "R": arrays["paths/rx_field_real"].shape[1],
    }
    for port in ("T", "R"):
        if sizes[port] not in (1, 2):
            raise _damaged(f"{sizes[port]} ports, must be 1 or 2")
    if not sizes["L"]:
        raise _damaged("no links")
    for name, dataset in _datasets(arrays):
        expected = tuple(sizes[size] if isinstance(size, str) else size for size in dataset.shape)
        if arrays[name].shape != expected:
            raise _damaged(f"dataset {name} has the shape {arrays[name].shape}; the shape must be {expected}")


def _check_values(arrays: Mapping[str, NDArray[Any]]) -> None:
    for name, dataset in _datasets(arrays):
        values = arrays[name]
        if dataset.kind == "O":
            continue
        # NaN fails the comparisons, but infinity may pass them.
        if not ((values >= dataset.lower) & (values <= dataset.upper)).all() or not np.isfinite(values).all():
            raise _damaged(f"dataset {name} contains a number that is not finite or is out of range")
    for name in ("interactions/rotation", "diffuse/rotation", "diffraction/rotations"):
        if (abs((arrays[name] ** 2).sum(axis=-1) - 1) > 10 * _ROUNDING).any():
            raise _damaged(f"dataset {name} contains a pair that is not a cosine and sine")
    if not np.isin(arrays["interactions/kind"], list(Kind)).all():
        raise _damaged("interactions/kind contains an unknown kind")
    names = arrays["materials/name"].tolist()
    if len(set(names)) != len(names) or "" in names:
        raise _damaged("a material has no name, or two materials have the same name")


def _check_indices(arrays: Mapping[str, NDArray[Any]]) -> None:
    first, link = arrays["paths/first"].astype(np.int64), arrays["paths/link"].astype(np.int64)
    if first[0] != 0 or first[-1] != len(arrays["interactions/kind"]) or (np.diff(first) < 0).any():
        raise _damaged("paths/first does not divide the interactions among the paths")
    if (np.diff(link) < 0).any():
        raise _damaged("paths/link is not in ascending order")
    indexed = {"paths/link": "links/tx_position", "interactions/material": "materials/name"}
    for name, target in indexed.items():
        index, count = arrays[name], len(arrays[target])
        if not ((index >= 0) & (index < count)).all():
            raise _damaged(f"dataset {name} contains an index outside 0 to {count - 1}")


BLOCK: Final = 512
"""Size of the user block [bytes], the smallest that HDF5 allows."""

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_CHUNK: Final = 2**20


def seal(path: str | Path) -> None:
    """Write or update the checksum of a path file that another program has written or changed.

    `Paths.save` already seals the files that it writes.

    Raises:
        InputError: The file does not exist, is not an HDF5 file, or cannot be written.
    """
    target = Path(path)
    try:
        with target.open("rb") as file:
            head = file.read(BLOCK)
            # A user block, sealed or still empty, precedes the content. Other programs do not write a user block.
            start = BLOCK if head.startswith(PATH_SEAL) or not any(head) else 0
            file.seek(start)
            if not file.read(len(_SIGNATURE)) == _SIGNATURE:
                raise InputError(f"{target}: is not an HDF5 file; only path files can be sealed")
            with replacing(target) as partial, partial.open("wb") as sealed:
                file.seek(start)
                sealed.write(_block(file))
                file.seek(start)
                while chunk := file.read(_CHUNK):
                    sealed.write(chunk)
    except OSError as error:
        raise InputError(
            f"{target}: cannot be sealed ({error.strerror}); give a writable path file"
        ) from None


def write_checksum(partial: Path) -> str:
    """Write the checksum into the empty user block of an HDF5 file, and return the checksum in hexadecimal."""
    with partial.open("r+b") as file:
        file.seek(BLOCK)
        block = _block(file)
        file.seek(0)
        file.write(block)
    return _digest(block)


def verify(path: Path) -> str:
    """Check that the content matches the seal, and return the checksum in hexadecimal.

    Raises:
        InputError: The file is not a sealed HDF5 file, or was changed after it was sealed. The error message does not
            contain the file name.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(BLOCK)
        if head.startswith(_SIGNATURE):
            raise InputError(
                "has no checksum; trace again, or call calibray.paths.seal if you trust the file"
            )
        if not head.startswith(PATH_SEAL):
            raise InputError("is damaged or not a path file; trace again")
        if _block(file) != head:
            raise InputError("is damaged (the checksum does not match); trace again")
    return _digest(head)


def _digest(block: bytes) -> str:
    return block[len(PATH_SEAL) :].split()[0].decode()


def _block(file: BinaryIO) -> bytes:
    """The user block for the content that starts at the current position in the file."""
    start, digest = file.tell(), hashlib.sha256()
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    length = os.fstat(file.fileno()).st_size - start
    return (PATH_SEAL + f"{digest.hexdigest()} {length} bytes\n".encode()).ljust(BLOCK, b"\0")


KNOWN_BYTES: Final = 2**20
"""Limit [bytes] on the total size of the entries for known files. Each entry takes 32 bytes."""

_CODE: Final = """
from calibray.errors import InputError
from calibray.paths.program import read_paths
try:
    read_paths({file!r})
except InputError as error:
    refuse(error)
"""

_known_here: Final[set[str]] = set()
"""Checksums of files that this process has accepted, with or without a cache folder."""


def remember(digest: str) -> None:
    """Record that Calibray has written or validated the file with this checksum for this user."""
    _known_here.add(digest)
    store = _known_files()
    if store is not None and store.trusted:
        store.put(digest, b"")


def validate(file: Path, digest: str) -> None:
    """Read a path file with a matching checksum in a separate process, unless the checksum is known.

    Raises:
        InputError: The file is damaged, or reading does not finish. The error message does not contain the file name.
    """
    store = _known_files()
    if digest in _known_here or (store is not None and store.trusted and store.get(digest) is not None):
        return
    size = file.stat().st_size
    try:
        is_read = run_limited(_CODE.format(file=str(file.resolve())), 4 * 2**30 + 8 * size, size)
    except TimeoutError as error:
        raise InputError(
            f"is damaged (the HDF5 library does not finish reading the file {error}); trace again"
        ) from None
    if not is_read:
        raise InputError("is damaged (the HDF5 library fails while reading the file); trace again")
    remember(digest)


def _known_files() -> Store | None:
    """The store of checksums of known files; None if caching is disabled."""
    folder = cache_folder()
    return None if folder is None else Store(folder / "known", ".h5sum", KNOWN_BYTES)
