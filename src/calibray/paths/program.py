"""The path program: traced paths, compiled so that fields can be evaluated for any materials.

A path is a transmit field, a chain of interactions, and a receive field. Each interaction keeps what its materials
act through: which material, the cosine of the angle of incidence, the real rotation from the frame of the interaction
before into its own (first axis k x n, transverse electric), and its kind. The first rotation is absorbed in the
transmit field and the last one in the receive field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS, Material
from calibray.paths.checksum import BLOCK, stamp, verify
from calibray.paths.file_format import DATASETS, SCHEMA, SCHEMA_VERSION, SETTING, VERTEX, Content, read
from calibray.paths.interactions import Diffraction, Diffuse, Kind
from calibray.paths.summary import as_html, as_text
from calibray.paths.trial import survive
from calibray.support.output_files import exists

Table = TypeVar("Table", Diffuse, Diffraction)


@dataclass(frozen=True, repr=False)
class Paths:
    """A traced campaign as a path program.

    P paths, I interactions, L links, R receive and T transmit ports (2 for dual polarization, else 1).

    Attributes:
        frequency: Carrier frequency [Hz].
        materials: The materials by name, as traced; `material` indexes them in this order.
        tx_position: Transmitter of every link [L, 3], [m].
        rx_position: Receiver of every link [L, 3], [m].
        link: Link of every path [P], non-decreasing.
        delay: Propagation delay [P], [s].
        spreading: Amplitude spreading [P], [1/m]: 1/r, or 1/sqrt(s s' (s + s')) with a diffraction.
        departure: Zenith and azimuth of departure [P, 2], [rad].
        arrival: Zenith and azimuth of the direction towards the source [P, 2], [rad].
        tx_field: Transmit pattern in the frame of the first interaction [P, T, 2], complex.
        rx_field: Receive pattern in the frame that the last interaction leaves [P, R, 2], complex.
        first: Index of each path's first interaction [P + 1]; path p has interactions first[p] .. first[p + 1] - 1.
        kind: `Kind` of every interaction [I].
        material: Index of its material [I].
        cos_incidence: Cosine of the angle of incidence [I].
        rotation: (cos, sin) of the rotation from the frame before into the interaction's own [I, 2].
        diffuse: Further constants of the diffuse interactions.
        diffraction: Further constants of the diffractions.
        settings: How the paths were traced, for the record.
        vertex: Where the interactions happen [I, 3], [m], in single precision, for drawing; None in files that do not
            tell. No field depends on it.
    """

    frequency: float
    materials: dict[str, Material]
    tx_position: NDArray[np.float64]
    rx_position: NDArray[np.float64]
    link: NDArray[np.integer]
    delay: NDArray[np.float64]
    spreading: NDArray[np.float64]
    departure: NDArray[np.float64]
    arrival: NDArray[np.float64]
    tx_field: NDArray[np.complex128]
    rx_field: NDArray[np.complex128]
    first: NDArray[np.int64]
    kind: NDArray[np.integer]
    material: NDArray[np.integer]
    cos_incidence: NDArray[np.float64]
    rotation: NDArray[np.float64]
    diffuse: Diffuse = field(default_factory=Diffuse.empty)
    diffraction: Diffraction = field(default_factory=Diffraction.empty)
    settings: Mapping[str, object] = field(default_factory=dict)
    vertex: np.ndarray | None = None

    def __repr__(self) -> str:
        return as_text(self)

    def _repr_html_(self) -> str:
        return as_html(self)

    @property
    def num_paths(self) -> int:
        """Number of paths P."""
        return len(self.link)

    @property
    def num_interactions(self) -> int:
        """Number of interactions I over all paths."""
        return len(self.kind)

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return len(self.tx_position)

    @property
    def links_without_path(self) -> NDArray[np.int64]:
        """Indices of the links to which no path leads [links]."""
        return np.flatnonzero(np.bincount(self.link, minlength=self.num_links) == 0)

    def at(self, frequency: float, materials: Mapping[str, Material] | None = None) -> Paths:
        """The same paths at another carrier: what was traced is geometry, and holds there too.

        Of the paths found, only the share that diffuse reflection and refraction sample depends on the constants at the
        carrier of the trace; the estimate stays unbiased at others.

        Args:
            frequency: Carrier frequency [Hz].
            materials: Constants at that carrier, by name; materials not named keep theirs.

        Returns:
            The program at that carrier.

        Raises:
            InputError: The frequency is not a positive number, or a material is not among the paths'.
        """
        if not (np.isfinite(frequency) and frequency > 0):
            raise InputError(f"frequency = {frequency!r}: must be a finite number of Hz greater than 0")
        if unknown := sorted(set(materials or {}) - set(self.materials)):
            raise InputError(
                f"no material {unknown[0]!r} in the traced scene; it has {', '.join(self.materials)}"
            )
        return replace(self, frequency=float(frequency), materials={**self.materials, **(materials or {})})

    def save(self, path: str | Path) -> None:
        """Write an HDF5 file (schema in docs/path-file.md), readable by h5py and MATLAB.

        Args:
            path: File to write; replaced only once the new one is complete.

        Raises:
            InputError: The folder does not exist or cannot be written.
        """
        target = Path(path)
        partial = target.with_name(target.name + ".part")
        try:
            with h5py.File(partial, "w", userblock_size=BLOCK) as file:
                _write(self, file)
            stamp(partial)
            partial.replace(target)
        except OSError as error:
            raise InputError(
                f"{target}: cannot be written ({error}); name a file in a writable folder"
            ) from None
        finally:
            # Nothing half-written stays behind.
            with suppress(OSError):
                partial.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | Path) -> Paths:
        """Read a file that `save` wrote.

        Args:
            path: The HDF5 file.

        Returns:
            The path program, equal to the one saved.

        Raises:
            InputError: The file does not exist, is no path file, is of another schema version, or is damaged. One from
                before there were checksums is read by another process first.
        """
        source = Path(path)
        if not exists(source):
            raise InputError(f"{source}: does not exist; write one with `calibray trace STUDY -o {source}`")
        try:
            if not verify(source):
                survive(source)
            with h5py.File(source, "r") as file:
                return _program(read(file))
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
        except (OSError, KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
            raise InputError(f"{source}: is damaged or no path file ({error}); trace again") from None


def concatenate(parts: list[Paths]) -> Paths:
    """Join path programs of the same links (link indices already global) and sort their paths by link.

    Args:
        parts: At least one program; all share frequency, materials and link table.

    Returns:
        One program whose paths are ordered by link, and within a link as given.
    """
    head = parts[0]
    offsets = np.cumsum([0, *(part.num_interactions for part in parts)])
    joined = replace(
        head,
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in _PATH_ARRAYS + _INTERACTION_ARRAYS
        },
        first=np.concatenate(
            [part.first[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
            + [offsets[-1:]]
        ),
        diffuse=_join([part.diffuse for part in parts]),
        diffraction=_join([part.diffraction for part in parts]),
        vertex=_vertices([part.vertex for part in parts]),
    )
    return take(joined, np.argsort(joined.link, kind="stable"))


def join_links(parts: Sequence[tuple[NDArray[np.int64], Paths]]) -> Paths:
    """Join path programs of links that were traced apart.

    Args:
        parts: At least one program, each with the places that its links have among all; together they have every link
            once. All share frequency and materials.

    Returns:
        One program of all links, with the settings of the first.
    """
    count = sum(len(links) for links, _ in parts)
    tx, rx = np.empty((count, 3)), np.empty((count, 3))
    for links, part in parts:
        tx[links], rx[links] = part.tx_position, part.rx_position
    kind = parts[0][1].link.dtype
    return concatenate(
        [
            replace(part, link=links[part.link].astype(kind), tx_position=tx, rx_position=rx)
            for links, part in parts
        ]
    )


def take(paths: Paths, index: NDArray[np.int64]) -> Paths:
    """The program with some of its paths, in a given order.

    Args:
        paths: A path program.
        index: Paths to keep [n].

    Returns:
        The smaller program over the same links.
    """
    index = np.asarray(index, dtype=np.int64)
    depth = np.diff(paths.first)[index]
    first = np.concatenate([[0], np.cumsum(depth)]).astype(np.int64)
    interaction = np.arange(first[-1]) - np.repeat(first[:-1], depth) + np.repeat(paths.first[index], depth)
    return replace(
        paths,
        **{name: getattr(paths, name)[index] for name in _PATH_ARRAYS},
        **{name: getattr(paths, name)[interaction] for name in _INTERACTION_ARRAYS},
        first=first,
        diffuse=_rows(paths.diffuse, _ordinal(paths.kind, Kind.DIFFUSE)[interaction]),
        diffraction=_rows(paths.diffraction, _ordinal(paths.kind, Kind.DIFFRACTION)[interaction]),
        vertex=None if paths.vertex is None else paths.vertex[interaction],
    )


def take_links(paths: Paths, links: NDArray[np.int64]) -> Paths:
    """The program of some links, in a given order; a link may be taken more than once.

    Args:
        paths: A path program, its paths ordered by link.
        links: Links to take [n].

    Returns:
        A program of n links.
    """
    links = np.asarray(links, dtype=np.int64)
    start = np.searchsorted(paths.link, np.arange(paths.num_links + 1))
    count = np.diff(start)[links]
    end = np.cumsum(count)
    index = np.arange(count.sum()) + np.repeat(start[links] - (end - count), count)
    return replace(
        take(paths, index),
        link=np.repeat(np.arange(len(links)), count).astype(paths.link.dtype),
        tx_position=paths.tx_position[links],
        rx_position=paths.rx_position[links],
    )


_PATH_ARRAYS = ("link", "delay", "spreading", "departure", "arrival", "tx_field", "rx_field")
_INTERACTION_ARRAYS = ("kind", "material", "cos_incidence", "rotation")


def _ordinal(kind: NDArray[np.integer], which: Kind) -> NDArray[np.int64]:
    """Row of each interaction of one kind in that kind's table; -1 for the others [I]."""
    chosen = kind == which
    return np.where(chosen, np.cumsum(chosen) - 1, -1)


def _rows(table: Table, row: NDArray[np.int64]) -> Table:
    row = row[row >= 0]
    return type(table)(*(getattr(table, entry.name)[row] for entry in fields(table)))


def _vertices(parts: list[np.ndarray | None]) -> np.ndarray | None:
    """The interaction points of several programs; None if one does not tell them."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def _join(tables: list[Table]) -> Table:
    kind = type(tables[0])
    return kind(*(np.concatenate([getattr(table, entry.name) for table in tables]) for entry in fields(kind)))


def _write(paths: Paths, file: h5py.File) -> None:
    file.attrs.update({"schema": SCHEMA, "version": SCHEMA_VERSION, "frequency_hz": paths.frequency})
    for key, value in paths.settings.items():
        file.attrs[f"{SETTING}{key}"] = value
    materials = file.create_group("materials")
    materials["name"] = np.array(list(paths.materials), dtype=h5py.string_dtype())
    materials["scattering_pattern"] = np.array(
        [material.scattering_pattern for material in paths.materials.values()], dtype=h5py.string_dtype()
    )
    for name in FIELDS:
        materials[name] = [getattr(material, name) for material in paths.materials.values()]
    for name in DATASETS:
        if not name.startswith("materials/"):
            file[name] = _part(paths, name)
    if paths.vertex is not None:
        file[VERTEX] = paths.vertex


def _part(paths: Paths, name: str) -> NDArray[Any]:
    """The array that a dataset holds; complex ones lie apart, for MATLAB's h5read knows no complex type."""
    group, _, entry = name.partition("/")
    record = getattr(paths, group) if group in _TABLES else paths
    for suffix, part in (("_real", np.real), ("_imag", np.imag)):
        if entry.endswith(suffix):
            return part(getattr(record, entry.removesuffix(suffix)))
    return getattr(record, entry)


def _program(content: Content) -> Paths:
    arrays = content.arrays
    names, patterns = arrays["materials/name"].tolist(), arrays["materials/scattering_pattern"].tolist()
    own: dict[str, NDArray[Any]] = {}
    tables: dict[str, dict[str, NDArray[Any]]] = {group: {} for group in _TABLES}
    for name, values in arrays.items():
        group, _, entry = name.partition("/")
        if entry.endswith("_real"):
            entry, values = entry.removesuffix("_real"), values + 1j * arrays[f"{name[:-5]}_imag"]
        if group != "materials" and not entry.endswith("_imag"):
            tables.get(group, own)[entry] = values
    return Paths(
        frequency=content.frequency,
        materials={
            name: Material(
                **{key: float(arrays[f"materials/{key}"][i]) for key in FIELDS},
                scattering_pattern=patterns[i],
            )
            for i, name in enumerate(names)
        },
        **own,
        diffuse=Diffuse(**tables["diffuse"]),
        diffraction=Diffraction(**tables["diffraction"]),
        settings=content.settings,
    )


_TABLES = ("diffuse", "diffraction")
