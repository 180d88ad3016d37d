"""What an external program is asked and what it answers: the files of the command engine, in JSON or HDF5.

The formats are documented for programs' authors in `docs/command-engine.md`.
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

from calibray.materials import Material
from calibray.tracing.settings import Antenna

SCHEMA: Final = "calibray.request"
VERSION: Final = 1
FORMATS: Final = ("json", "hdf5")
ANSWER: Final = "path_loss_db"
PATH_LOSS_DB: Final = (20.0, 300.0)  # what a program's answers must lie within
RESPONSE_BYTES: Final = (16 << 20, 4 << 10)  # that a response may have, and more for each link
_WITHOUT_PATH: Final = (None, "inf", "Infinity")


class Unusable(ValueError):
    """An answer that is missing, malformed, of the wrong length, or no number."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is the same for all candidates of a study.

    Attributes:
        frequency: Carrier frequency [Hz].
        bandwidth: Bandwidth [Hz], or None.
        combining: How a link's paths combine: "power", "coherent" or "band".
        antennas: Transmit and receive antenna.
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        link_frequency: Carrier of every link [L], [Hz], or None where all have `frequency`.
    """

    frequency: float
    bandwidth: float | None
    combining: str
    antennas: tuple[Antenna, Antenna]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    link_frequency: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """One RT call asked of a program.

    Attributes:
        surroundings: What is the same for all candidates.
        materials: All materials of the scene with the candidate's values at `frequency`, by name.
        parameters: The candidate's values by parameter name, in the fields' units.
        carriers: The same materials at each carrier of the links [Hz]; none where all links have `frequency`.
    """

    surroundings: Surroundings
    materials: Mapping[str, Material]
    parameters: Mapping[str, float]
    carriers: Mapping[float, Mapping[str, Material]] = field(default_factory=dict)

    def write(self, path: Path, file_format: str) -> None:
        """Write the request.

        Args:
            path: The file.
            file_format: "json" or "hdf5".
        """
        if file_format == "json":
            path.write_text(json.dumps(self._content()) + "\n", encoding="utf-8")
        else:
            self._write_hdf5(path)

    def _head(self) -> dict[str, Any]:
        around = self.surroundings
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "frequency": around.frequency,
            "bandwidth": around.bandwidth,
            "combining": around.combining,
        }

    def _content(self) -> dict[str, Any]:
        # Materials and parameters are lists: MATLAB turns the keys of an object into identifiers, and so would
        # garble names such as "walls.relative_permittivity".
        around = self.surroundings
        return (
            self._head()
            | {
                "antennas": {
                    end: asdict(antenna) for end, antenna in zip(("tx", "rx"), around.antennas, strict=True)
                },
                "links": {"tx": around.tx.tolist(), "rx": around.rx.tolist()}
                | ({} if around.link_frequency is None else {"frequency": around.link_frequency.tolist()}),
                "materials": _listed(self.materials),
                "parameters": [{"name": name, "value": value} for name, value in self.parameters.items()],
            }
            | (
                {
                    "carriers": [
                        {"frequency": frequency, "materials": _listed(materials)}
                        for frequency, materials in self.carriers.items()
                    ]
                }
                if self.carriers
                else {}
            )
        )

    def _write_hdf5(self, path: Path) -> None:
        around = self.surroundings
        with h5py.File(path, "w") as file:
            file.attrs.update({key: value for key, value in self._head().items() if value is not None})
            for end, antenna in zip(("tx", "rx"), around.antennas, strict=True):
                file.create_group(f"antennas/{end}").attrs.update(asdict(antenna))
            file["links/tx"], file["links/rx"] = around.tx, around.rx
            if around.link_frequency is not None:
                file["links/frequency"] = around.link_frequency
            _write_materials(file.create_group("materials", track_order=True), self.materials)
            for place, (frequency, materials) in enumerate(self.carriers.items()):
                group = file.create_group(f"carriers/{place}")
                group.attrs["frequency"] = frequency
                _write_materials(group.create_group("materials", track_order=True), materials)
            file["parameters/names"] = list(self.parameters)
            file["parameters/values"] = list(self.parameters.values())


def _listed(materials: Mapping[str, Material]) -> list[dict[str, Any]]:
    return [{"name": name, **asdict(material)} for name, material in materials.items()]


def _write_materials(group: h5py.Group, materials: Mapping[str, Material]) -> None:
    for name, material in materials.items():
        group.create_group(name.replace("/", "_")).attrs.update({"name": name, **asdict(material)})


def read_answer(path: Path, file_format: str, num_links: int) -> NDArray[np.float64]:
    """Read the path loss that a program answered.

    Args:
        path: The file.
        file_format: "json" or "hdf5".
        num_links: Number of links L.

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.

    Raises:
        Unusable: The file is missing or malformed, or its values are not one path loss per link.
    """
    content = _content(path, num_links)
    values = _read_json(content) if file_format == "json" else _read_hdf5(content, num_links)
    if values.shape != (num_links,):
        raise Unusable(
            f"its response holds {ANSWER} of shape {values.shape}, must be ({num_links},): one per link"
        )
    lower, upper = PATH_LOSS_DB
    wrong = ~((values >= lower) & (values <= upper) | np.isposinf(values))
    if wrong.any():
        link = int(np.argmax(wrong))
        sign = "; path loss is positive: does it answer gains?" if -upper <= values[link] < 0 else ""
        raise Unusable(
            f"its response holds {ANSWER}[{link}] = {values[link]:g}; must be a number between {lower:g} and "
            f"{upper:g} dB, or infinite without a path{sign}"
        )
    return values


def _content(path: Path, num_links: int) -> bytes:
    """The bytes of a response; of a plain file alone, for a program may leave anything there."""
    try:
        # Neither follows a link nor waits for the other end of a FIFO.
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        raise Unusable("it wrote no response file") from None
    except OSError as error:
        raise Unusable(
            f"its response cannot be read ({error.strerror}); it must be a file, and no link to one"
        ) from None
    status, limit = os.fstat(handle), RESPONSE_BYTES[0] + RESPONSE_BYTES[1] * num_links
    if not stat.S_ISREG(status.st_mode):
        os.close(handle)
        raise Unusable("its response is no file but a folder, a FIFO or a device")
    with os.fdopen(handle, "rb") as file:
        if status.st_size > limit:
            raise Unusable(f"its response has {status.st_size:,} bytes, must have {limit:,} or fewer")
        return file.read(limit)


def _read_json(response: bytes) -> NDArray[np.float64]:
    try:
        content = json.loads(response.decode("utf-8"))
    except ValueError as error:
        raise Unusable(f"its response is no JSON ({error})") from None
    except RecursionError:
        raise Unusable("its response nests lists or objects too deeply") from None
    if not isinstance(content, dict) or ANSWER not in content:
        raise Unusable(f"its response has no key {ANSWER!r}")
    entries = content[ANSWER]
    # MATLAB writes a list of one number as that number.
    return np.array([_number(entry) for entry in (entries if isinstance(entries, list) else [entries])])


def _number(entry: Any) -> float:
    if entry in _WITHOUT_PATH:
        return np.inf
    if isinstance(entry, bool) or not isinstance(entry, int | float):
        text = json.dumps(entry) if isinstance(entry, str | bool) else reprlib.repr(entry)
        raise Unusable(f"its response holds {text[:80]} in {ANSWER}, which is no number")
    try:
        return float(entry)
    except OverflowError:
        raise Unusable(f"its response holds a number in {ANSWER} that is too large") from None


def _read_hdf5(response: bytes, num_links: int) -> NDArray[np.float64]:
    try:
        with h5py.File(BytesIO(response), "r") as file:
            link = file.get(ANSWER, getlink=True)
            if link is None:
                raise Unusable(f"its response has no dataset {ANSWER!r}")
            if not isinstance(link, h5py.HardLink):
                raise Unusable(
                    f"its response has {ANSWER!r} by a link to elsewhere; write the numbers themselves"
                )
            dataset = file[ANSWER]
            if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf":
                raise Unusable(f"its response has {ANSWER!r}, which is no dataset of numbers")
            if dataset.is_virtual or dataset.external:
                raise Unusable(f"its response has {ANSWER!r} in other files; write the numbers themselves")
            if dataset.size != num_links:  # looked at before it is read: a small file may unfold to any size
                raise Unusable(
                    f"its response holds {ANSWER} of shape {dataset.shape}, must be ({num_links},): one per link"
                )
            values = np.asarray(dataset[()], dtype=float)
    except Unusable:
        raise
    except (OSError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise Unusable(f"its response is no HDF5 file with the numbers {ANSWER!r} ({error})") from None
    return values.reshape(-1) if values.size == max(values.shape, default=1) else values
