"""What a path file holds: every dataset with its shape, type and range, checked in full when it is read.

`docs/path-file.md` says what the datasets mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import inf, isfinite, pi
from types import MappingProxyType
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS
from calibray.paths.interactions import Kind

SCHEMA: Final = "calibray/paths"
SCHEMA_VERSION: Final = 1

FREQUENCIES: Final = (1e6, 1e12)
"""The carriers [Hz] that a path file may have."""

SETTING: Final = "setting_"
"""What the names of the attributes begin with that say how the paths were traced."""

_SLACK: Final = 1e-3
"""How far beyond its range a number may lie that was rounded to single precision."""


@dataclass(frozen=True)
class Dataset:
    """One dataset of a path file.

    Attributes:
        shape: Its sizes, numbers or the letters of `docs/path-file.md`.
        kind: "f" for numbers, "i" for whole numbers, "O" for text.
        lower: Least value.
        upper: Largest value.
    """

    shape: tuple[str | int, ...]
    kind: str = "f"
    lower: float = -inf
    upper: float = inf


@dataclass(frozen=True)
class Content:
    """What was read from a path file.

    Attributes:
        frequency: Carrier frequency [Hz].
        settings: How the paths were traced.
        arrays: The datasets by name; text as str.
    """

    frequency: float
    settings: dict[str, object]
    arrays: dict[str, NDArray]


_COSINE = (-1 - _SLACK, 1 + _SLACK)
_ANGLE = (-2 * pi - _SLACK, 2 * pi + _SLACK)
# Far beyond any antenna (120 dB), scene and path, and far from where sums of powers overflow.
_FIELD = (-1e6, 1e6)
_LENGTH = 1e9  # [m]
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
        "interactions/cos_incidence": Dataset(("I",), "f", *_COSINE),
        "interactions/rotation": Dataset(("I", 2), "f", *_COSINE),
        "diffuse/rotation": Dataset(("D", 2), "f", *_COSINE),
        "diffuse/solid_angle": Dataset(("D",), "f", 0.0, 1e9),
        "diffuse/cos_scattered": Dataset(("D",), "f", *_COSINE),
        "diffuse/cos_specular": Dataset(("D",), "f", *_COSINE),
        "diffuse/cos_backward": Dataset(("D",), "f", *_COSINE),
        "diffraction/cos_incidence_n": Dataset(("W",), "f", *_COSINE),
        "diffraction/exterior_angle": Dataset(("W",), "f", 0.0, _ANGLE[1]),
        "diffraction/azimuth_in": Dataset(("W",), "f", *_ANGLE),
        "diffraction/azimuth_out": Dataset(("W",), "f", *_ANGLE),
        "diffraction/sin_edge": Dataset(("W",), "f", 0.0, _COSINE[1]),
        "diffraction/distance": Dataset(("W",), "f", 0.0, _LENGTH),
        "diffraction/rotations": Dataset(("W", 4, 2), "f", *_COSINE),
    }
)

VERTEX: Final = "interactions/vertex"
OPTIONAL: Final[Mapping[str, Dataset]] = MappingProxyType({VERTEX: Dataset(("I", 3))})
"""What a file may lack."""


def read(file: h5py.File) -> Content:
    """Read a path file and check all of it.

    Args:
        file: The open file.

    Returns:
        What it holds.

    Raises:
        InputError: It is of another kind or version, or something in it is missing, of another shape or type, or
            out of range; the message lacks the file's name.
    """
    if (schema := file.attrs.get("schema")) != SCHEMA:
        raise InputError(f"is no Calibray path file (schema {schema!r})")
    if (version := _attribute(file, "version")) != SCHEMA_VERSION:
        raise InputError(f"has schema version {version}, need {SCHEMA_VERSION}; trace again")
    frequency = _attribute(file, "frequency_hz")
    if (
        isinstance(frequency, str | bool | np.bool_)
        or not FREQUENCIES[0] <= float(frequency) <= FREQUENCIES[1]
    ):
        damage = f"frequency_hz = {frequency!r}, must lie in {FREQUENCIES[0]:g} to {FREQUENCIES[1]:g} Hz"
        refusal = _damaged(damage)
        raise refusal
    present = dict(DATASETS) | {name: entry for name, entry in OPTIONAL.items() if name in file}
    arrays = {name: _array(file, name, entry) for name, entry in present.items()}
    _check_shapes(arrays)
    _check_values(arrays)
    _check_indices(arrays)
    return Content(float(frequency), dict(_settings(file)), arrays)


def _damaged(fault: str) -> InputError:
    return InputError(f"is damaged ({fault}); trace again")


def _attribute(file: h5py.File, name: str) -> Any:
    value = file.attrs[name]
    if isinstance(value, str | np.bool_) or (
        isinstance(value, np.number) and value.dtype.kind in "iuf" and isfinite(value)
    ):
        return value
    raise _damaged(f"attribute {name} is no text and no finite number")


def _settings(file: h5py.File) -> Iterator[tuple[str, object]]:
    for key in file.attrs:
        if key.startswith(SETTING):
            value = _attribute(file, key)
            yield key.removeprefix(SETTING), value.item() if isinstance(value, np.generic) else value


def _array(file: h5py.File, name: str, entry: Dataset) -> NDArray:
    """One dataset, which lies in this file in one piece and is no larger than it."""
    item, length = file.get(name), file.id.get_filesize()
    link = file.get(name, getlink=True)
    if not isinstance(item, h5py.Dataset) or not isinstance(link, h5py.HardLink):
        raise _damaged(f"no dataset {name}")
    if item.chunks is not None or item.is_virtual or item.external is not None or item.nbytes > length:
        raise _damaged(f"dataset {name} is not stored in one piece")
    if item.ndim != len(entry.shape):
        raise _damaged(f"dataset {name} has the shape {item.shape}")
    if entry.kind == "O":
        if h5py.check_string_dtype(item.dtype) is None:
            raise _damaged(f"dataset {name} holds no text")
        return np.array(item.asstr()[()], dtype=object)
    if item.dtype.kind not in {"i": "iu", "f": "f"}[entry.kind]:
        raise _damaged(f"dataset {name} holds {item.dtype}")
    return item[()]


def _entry(name: str) -> Dataset:
    return DATASETS[name] if name in DATASETS else OPTIONAL[name]


def _check_shapes(arrays: Mapping[str, NDArray]) -> None:
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
    for name in arrays:
        entry = _entry(name)
        expected = tuple(sizes[size] if isinstance(size, str) else size for size in entry.shape)
        if arrays[name].shape != expected:
            raise _damaged(f"dataset {name} has the shape {arrays[name].shape}, must have {expected}")


def _check_values(arrays: Mapping[str, NDArray]) -> None:
    for name, values in arrays.items():
        entry = _entry(name)
        if entry.kind == "O":
            continue
        # A number that is not finite fails the first comparison, an infinite one the second.
        if not ((values >= entry.lower) & (values <= entry.upper)).all() or not np.isfinite(values).all():
            raise _damaged(f"dataset {name} has a number that is not finite or out of range")
    for name in ("interactions/rotation", "diffuse/rotation", "diffraction/rotations"):
        if (abs((arrays[name] ** 2).sum(axis=-1) - 1) > 10 * _SLACK).any():
            raise _damaged(f"dataset {name} has a pair that is no cosine and sine")
    if not np.isin(arrays["interactions/kind"], list(Kind)).all():
        raise _damaged("interactions/kind has an unknown kind")
    names = arrays["materials/name"].tolist()
    if len(set(names)) != len(names) or "" in names:
        raise _damaged("a material is without a name, or two have the same")


def _check_indices(arrays: Mapping[str, NDArray]) -> None:
    first, link = arrays["paths/first"].astype(np.int64), arrays["paths/link"].astype(np.int64)
    if first[0] != 0 or first[-1] != len(arrays["interactions/kind"]) or (np.diff(first) < 0).any():
        raise _damaged("paths/first does not part the interactions")
    if (np.diff(link) < 0).any():
        raise _damaged("paths/link is not in order")
    ranges = {"paths/link": "links/tx_position", "interactions/material": "materials/name"}
    for name, target in ranges.items():
        index, count = arrays[name], len(arrays[target])
        if not ((index >= 0) & (index < count)).all():
            raise _damaged(f"dataset {name} has an index outside 0 to {count - 1}")
