"""The files exchanged with an external program: the request of one RT call and the response, in JSON or HDF5.

`docs/reference/program-files.md` documents the formats for authors of programs.
"""

from __future__ import annotations

import json
import os
import reprlib
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from calibray.engines.section import RadioSettings
from calibray.errors import InputError
from calibray.materials import Material

SCHEMA: Final = "calibray.request"
VERSION: Final = 1
ANSWER: Final = "path_loss_db"
OBSERVABLES: Final = "observables"
RESPONSE: Final = "the response"
"""Name of the response in messages."""

RAY_COLUMNS: Final = ("path", "point")
"""Columns that distinguish a ray table from a response with path loss."""
PATH_LOSS_DB: Final = (20.0, 300.0)  # range of plausible path loss [dB]
RESPONSE_BYTES: Final = (
    16 << 20,
    4 << 10,
)  # maximum size of a response [bytes]: fixed part, and part per link
RAYS_BYTES: Final = (
    16 << 20,
    64 << 10,
)  # maximum size of a response with rays, for a few hundred paths per link
_WITHOUT_PATH: Final = (None, "inf", "Infinity")


class Unusable(ValueError):
    """The response is missing or malformed, has the wrong length, or contains a value that is not a number."""


@dataclass(frozen=True, eq=False)
class Request:
    """One RT call, as sent to a program.

    Attributes:
        radio: Carrier, bandwidth, combining and antennas.
        tx: Transmitter position of every link [L, 3], [m].
        rx: Receiver position of every link [L, 3], [m].
        materials: All materials of the scene by name, with the candidate's values at the study's carrier.
        parameters: The candidate's values by parameter name, in the parameters' units.
        link_frequency: Carrier of every link [L], [Hz]; None if all links have the study's carrier.
        carriers: For each carrier [Hz] of the links, the materials at this carrier; empty if all links have the study's
            carrier.
    """

    radio: RadioSettings
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    materials: Mapping[str, Material] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    link_frequency: NDArray[np.float64] | None = None
    carriers: Mapping[float, Mapping[str, Material]] = field(default_factory=dict)

    def write(self, path: Path, file_format: str) -> None:
        """Write the request as "json" or "hdf5"."""
        if file_format == "json":
            path.write_text(json.dumps(self._json()) + "\n", encoding="utf-8")
        else:
            self._write_hdf5(path)

    def _head(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "frequency": self.radio.frequency,
            "bandwidth": self.radio.bandwidth,
            "combining": self.radio.combining,
        }

    @property
    def _wanted(self) -> list[dict[str, Any]]:
        return [wanted.record() for wanted in self.radio.observables]

    def _json(self) -> dict[str, Any]:
        # Materials and parameters are written as lists, because MATLAB converts the keys of an object to identifiers,
        # which would alter names such as "walls.relative_permittivity".
        links = {"tx": self.tx.tolist(), "rx": self.rx.tolist()}
        if self.link_frequency is not None:
            links["frequency"] = self.link_frequency.tolist()
        content = self._head() | {
            "antennas": {
                end: asdict(antenna) for end, antenna in zip(("tx", "rx"), self.radio.antennas, strict=True)
            },
            "links": links,
            "materials": _list_materials(self.materials),
            "parameters": [{"name": name, "value": value} for name, value in self.parameters.items()],
        }
        if self._wanted:
            content["observables"] = self._wanted
        if self.carriers:
            content["carriers"] = [
                {"frequency": frequency, "materials": _list_materials(materials)}
                for frequency, materials in self.carriers.items()
            ]
        return content

    def _write_hdf5(self, path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.attrs.update({key: value for key, value in self._head().items() if value is not None})
            for end, antenna in zip(("tx", "rx"), self.radio.antennas, strict=True):
                file.create_group(f"antennas/{end}").attrs.update(asdict(antenna))
            file["links/tx"], file["links/rx"] = self.tx, self.rx
            if self.link_frequency is not None:
                file["links/frequency"] = self.link_frequency
            _write_materials(file.create_group("materials", track_order=True), self.materials)
            for number, (frequency, materials) in enumerate(self.carriers.items()):
                group = file.create_group(f"carriers/{number}")
                group.attrs["frequency"] = frequency
                _write_materials(group.create_group("materials", track_order=True), materials)
            for number, wanted in enumerate(self._wanted):
                file.create_group(f"observables/{number}").attrs.update(wanted)
            file["parameters/names"] = list(self.parameters)
            file["parameters/values"] = list(self.parameters.values())


def _list_materials(materials: Mapping[str, Material]) -> list[dict[str, Any]]:
    return [{"name": name, **asdict(material)} for name, material in materials.items()]


def _write_materials(group: h5py.Group, materials: Mapping[str, Material]) -> None:
    for number, (name, material) in enumerate(materials.items()):
        key = name.replace("/", "_")
        if key in ("", ".") or key in group:
            key = f"{key}{number}"  # not a valid group name, or the name of another material
        group.create_group(key).attrs.update({"name": name, **asdict(material)})


def read_answer(
    path: Path, file_format: str, num_links: int, num_observables: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read a program's response: path loss [L], [dB], and further observables [K, L] in their own units.

    For a link without a path, path loss is +inf; for a link without a value, an observable is NaN.

    Raises:
        Unusable: The file is missing or malformed, or does not contain one number per link.
    """
    read = _read_json if file_format == "json" else _read_hdf5
    response = _read_bytes(path, RESPONSE_BYTES[0] + RESPONSE_BYTES[1] * num_links)
    values = read(response, ANSWER, num_links)
    if values.size == max(
        values.shape, default=1
    ):  # MATLAB writes a vector as a matrix with one row or column
        values = values.reshape(-1)
    if values.shape != (num_links,):
        raise Unusable(
            f"the response contains {ANSWER} of shape {values.shape}; it must be ({num_links},): one value per link"
        )
    lower, upper = PATH_LOSS_DB
    wrong = ~((values >= lower) & (values <= upper) | np.isposinf(values))
    if wrong.any():
        link = int(np.argmax(wrong))
        hint = "; path loss is positive; does the program return gains?" if -upper <= values[link] < 0 else ""
        raise Unusable(
            f"the response contains {ANSWER}[{link}] = {values[link]:g}; it must be a number between {lower:g} and "
            f"{upper:g} dB, or infinite if the link has no path{hint}"
        )
    shape = num_observables, num_links
    if not num_observables:
        return values, np.empty(shape)
    observed = read(response, OBSERVABLES, num_observables * num_links)
    if 1 in shape and observed.size == num_observables * num_links:
        observed = observed.reshape(shape)
    if observed.shape != shape:
        raise Unusable(
            f"the response contains {OBSERVABLES} of shape {observed.shape}; it must be {shape}: a list with one value "
            "per link for each observable, in the order of the request"
        )
    return values, np.where(np.isfinite(observed), observed, np.nan)


def read_rays(path: Path, num_links: int) -> bytes:
    """Read a program's response, and check that it is a ray table.

    Raises:
        Unusable: The file is missing, not a regular file, or too large, or contains no ray table.
    """
    from calibray.engines.rays.table import RayTable, parse_rays

    response = _read_bytes(path, RAYS_BYTES[0] + RAYS_BYTES[1] * num_links)
    try:
        table = parse_rays(response, RESPONSE)
        if ANSWER in table.frame and RAY_COLUMNS[0] not in table.frame:
            raise Unusable(
                f"{RESPONSE} contains path loss ({ANSWER}) instead of a ray table; remove rays = true from "
                "[engine], or return a ray table"
            )
        RayTable.of(table)
    except InputError as error:
        raise Unusable(str(error)) from None
    return response


def _read_bytes(path: Path, limit: int) -> bytes:
    """The bytes of a response. Only a regular file is read, because a program can leave any type of file."""
    try:
        # With O_NOFOLLOW, `open` does not follow a link; with O_NONBLOCK, `open` does not wait for the writer of a
        # FIFO.
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        raise Unusable("the program wrote no response file") from None
    except OSError as error:
        raise Unusable(
            f"the response cannot be read ({error.strerror}); it must be a regular file, not a link"
        ) from None
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        os.close(handle)
        raise Unusable("the response is a folder, a FIFO or a device; it must be a regular file")
    with os.fdopen(handle, "rb") as file:
        if status.st_size > limit:
            raise Unusable(f"the response has {status.st_size:,} bytes; it must have {limit:,} or fewer")
        return file.read(limit)


def _read_json(response: bytes, name: str, _: int) -> NDArray[np.float64]:
    try:
        content = json.loads(response.decode("utf-8-sig"))  # some programs begin with a byte order mark
    except ValueError as error:
        raise Unusable(f"the response is not JSON ({error})") from None
    except RecursionError:
        raise Unusable("the response nests lists or objects too deeply") from None
    if not isinstance(content, dict) or name not in content:
        rows = content[0] if isinstance(content, list) and content else content
        raise Unusable(f"the response has no key {name!r}{_rays_hint(rows)}")
    entries = content[name]
    # MATLAB writes a list of one number as a plain number.
    entries = entries if isinstance(entries, list) else [entries]
    if name == OBSERVABLES and all(isinstance(entry, list) for entry in entries):
        rows = [[_number(entry, name) for entry in row] for row in entries]
        if len({len(row) for row in rows}) > 1:
            raise Unusable(
                f"the response contains {name} with lists of different lengths; each list must have one value per link"
            )
        return np.array(rows)
    return np.array([_number(entry, name) for entry in entries])


def _rays_hint(names: Any) -> str:
    """The remedy to append to a message if a response with these columns is a ray table; otherwise an empty string."""
    is_table = isinstance(names, dict | list) and all(name in names for name in RAY_COLUMNS)
    return "; the response is a ray table: set rays = true in [engine]" if is_table else ""


def _number(entry: Any, name: str) -> float:
    if entry in _WITHOUT_PATH:
        return np.inf
    if isinstance(entry, bool) or not isinstance(entry, int | float):
        text = json.dumps(entry) if isinstance(entry, str | bool) else reprlib.repr(entry)
        raise Unusable(f"the response contains {text[:80]} in {name}, which is not a number")
    try:
        return float(entry)
    except OverflowError:
        raise Unusable(f"the response contains a number in {name} that is too large") from None


def _read_hdf5(response: bytes, name: str, size: int) -> NDArray[np.float64]:
    try:
        with h5py.File(BytesIO(response), "r") as file:
            link = file.get(name, getlink=True)
            if link is None:
                raise Unusable(f"the response has no dataset {name!r}{_rays_hint(list(file))}")
            if not isinstance(link, h5py.HardLink):
                raise Unusable(
                    f"the response links {name!r} to another object; write the numbers instead of the link"
                )
            dataset = file[name]
            if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf":
                raise Unusable(f"the response contains {name!r}, which is not a dataset of numbers")
            if dataset.is_virtual or dataset.external:
                raise Unusable(
                    f"the response stores {name!r} in other files; write the numbers into the response file"
                )
            # The size is checked before the dataset is read, because a small compressed file may unpack to any size.
            if dataset.size != size:
                raise Unusable(
                    f"the response contains {name} of shape {dataset.shape}; it must contain {size} numbers"
                )
            return np.asarray(dataset[()], dtype=float)
    except Unusable:
        raise
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise Unusable(
            f"the response is not an HDF5 file with a numeric dataset {name!r} ({error})"
        ) from None
