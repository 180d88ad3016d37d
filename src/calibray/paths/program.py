"""The path program: traced paths in a form that allows fields to be evaluated for any materials.

A path is a transmit field, a chain of interactions, and a receive field. An interaction has a material, a kind, a
cosine of the angle of incidence, and a real rotation from the frame of the previous interaction into its own frame. The
first axis of each frame is k x n (transverse electric). The first rotation is part of the transmit field, and the last
rotation is part of the receive field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from html import escape
from pathlib import Path
from textwrap import shorten
from typing import Any, Final, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import FIELDS, Material, check_frequency, constants_matrix
from calibray.paths import file_format
from calibray.paths.interactions import Diffraction, Diffuse, Kind
from calibray.support.messages import first_line
from calibray.support.output_files import as_path, check_file, check_space, exists, replacing

_WIDTH: Final = 80
"""Maximum length [characters] of a line in the summary."""


@dataclass(frozen=True, repr=False)
class Paths:
    """A traced campaign as a path program.

    There are P paths, I interactions, L links, R receive and T transmit ports (2 for dual polarization, otherwise 1).

    Attributes:
        frequency: Carrier frequency [Hz].
        materials: The materials of the trace by name, in the order to which the indices in `material` refer.
        tx_position: Transmitter of every link [L, 3], [m].
        rx_position: Receiver of every link [L, 3], [m].
        link: Link of every path [P], non-decreasing.
        delay: Propagation delay [P], [s].
        spreading: Amplitude spreading [P], [1/m]: 1/r, or 1/sqrt(s s' (s + s')) with a diffraction.
        departure: Zenith and azimuth of departure [P, 2], [rad].
        arrival: Zenith and azimuth [P, 2], [rad], of the direction of arrival, which points from the receiver towards
            the source.
        tx_field: Complex transmit pattern [P, T, 2] in the frame of the first interaction.
        rx_field: Complex receive pattern [P, R, 2] in the frame after the last interaction.
        first: Index [P + 1] of each path's first interaction; path p has the interactions first[p] to first[p + 1] - 1.
        kind: `Kind` of every interaction [I].
        material: Material index [I] of every interaction.
        cos_incidence: Cosine [I] of the angle of incidence.
        rotation: (cos, sin) [I, 2] of the rotation from the previous frame into the frame of the interaction.
        vertex: Points of interaction [I, 3], [m], for plots; stored in single precision, or in double precision far
            from the origin. The computed fields do not depend on the points of interaction.
        diffuse: Additional constants of the diffuse interactions.
        diffraction: Additional constants of the diffractions.
        settings: Settings of the trace, stored only for documentation.
        correction: Ratio [P] of each path's power in the engine that found the path to its replayed power with the same
            constants. The replayed power is multiplied by this ratio. None if there is no correction.
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
    vertex: NDArray[np.float32] | NDArray[np.float64]
    diffuse: Diffuse = field(default_factory=Diffuse.empty)
    diffraction: Diffraction = field(default_factory=Diffraction.empty)
    settings: Mapping[str, object] = field(default_factory=dict)
    correction: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        rows = (f"  {name:<13}{shorten(text, _WIDTH - 15)}" for name, text in _summary(self).items())
        return "\n".join(["Paths", *rows])

    def _repr_html_(self) -> str:
        rows = (
            f"<tr><th style='text-align:left'>{name}</th><td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in _summary(self).items()
        )
        return f"<table><caption>Paths</caption>{''.join(rows)}</table>"

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
        """Indices of the links without a path."""
        return np.flatnonzero(np.bincount(self.link, minlength=self.num_links) == 0)

    def at(self, frequency: float, materials: Mapping[str, Material] | None = None) -> Paths:
        """The same paths at another carrier frequency; the traced geometry is unchanged.

        With diffuse reflection and refraction, the sampling probabilities of paths depend on the constants at the
        traced carrier. The estimate remains unbiased at other carriers.

        Args:
            frequency: Carrier frequency [Hz].
            materials: Constants at this carrier, by material name. Materials that are not named keep their constants.

        Returns:
            The program at that carrier.

        Raises:
            InputError: The frequency is outside the range `calibray.materials.FREQUENCIES`, or a named material is not
                a material of the paths.
        """
        return replace(self, frequency=check_frequency(frequency), materials=self._with_materials(materials))

    def material_table(self, materials: Mapping[str, Material] | None = None) -> NDArray[np.float64]:
        """Matrix [M, 8] of material constants. Materials that are not named keep the constants of the trace.

        Rows are in the order of `Paths.materials`, and columns in the order of `calibray.materials.FIELDS`.

        Raises:
            InputError: A name is not a material of the paths, or a scattering pattern differs from that of the trace.
        """
        combined = self._with_materials(materials)
        for name, material in combined.items():
            traced = self.materials[name].scattering_pattern
            if material.scattering_pattern != traced:
                raise InputError(
                    f"material {name!r}: scattering_pattern {material.scattering_pattern!r} differs from {traced!r} in "
                    "the trace; state it in [materials] and trace again"
                )
        return constants_matrix(combined)

    def _with_materials(self, materials: Mapping[str, Material] | None) -> dict[str, Material]:
        if unknown := sorted(set(materials or {}) - set(self.materials)):
            raise InputError(
                f"no material {unknown[0]!r} in the traced scene, which has {', '.join(self.materials)}"
            )
        for name, material in (materials or {}).items():
            if not isinstance(material, Material):
                raise InputError(
                    f"material {name!r}: is {material!r}; it must be a Material with all constants, for instance "
                    f"dataclasses.replace(paths.materials[{name!r}], relative_permittivity=5.0)"
                )
        return {**self.materials, **(materials or {})}

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Write an HDF5 file (format in docs/reference/path-file.md) that h5py and MATLAB can read.

        Args:
            path: File to write. An existing path file is replaced only once the new file is complete.
            overwrite: Whether to replace a file that Calibray did not write.

        Raises:
            InputError: The folder does not exist or cannot be written to, or an existing file must not be replaced.
        """
        target = check_file(path, overwrite=overwrite)
        try:
            with replacing(target, signed=False) as partial:
                content = _content(self)
                check_space(partial, sum(np.asarray(values).nbytes for values in content.arrays.values()))
                with h5py.File(partial, "w", userblock_size=file_format.BLOCK) as file:
                    file_format.write(file, content)
                digest = file_format.write_checksum(partial)
            file_format.remember(digest)
        except OSError as error:
            raise InputError(
                f"{target}: cannot be written ({error}); name a file in a writable folder"
            ) from None

    @classmethod
    def load(cls, path: str | Path) -> Paths:
        """Read a file that `save` wrote.

        Args:
            path: The HDF5 file.

        Returns:
            The path program, equal to the saved program.

        Raises:
            InputError: The file does not exist, is not a path file, has a different version, or is damaged.
        """
        source = as_path(path, "path file")
        if not exists(source):
            raise InputError(
                f"{source}: does not exist; create this file with `calibray trace STUDY -o {source}`"
            )
        try:
            file_format.validate(source, file_format.verify(source))
            return read_paths(source)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
        except OSError as error:
            raise InputError(f"{source}: cannot be read ({error}); check the file") from None


def read_paths(file: str | Path) -> Paths:
    """Read the path program from an HDF5 file without verifying its checksum.

    Raises:
        InputError: The file is not a path file, has a different version, or is damaged. The error message does not
            contain the file name.
    """
    try:
        with h5py.File(file, "r") as stream:
            return _paths(file_format.read(stream))
    except InputError:
        raise
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        raise InputError(f"is damaged or not a path file ({first_line(error)}); trace again") from None


Table = TypeVar("Table", Diffuse, Diffraction)

_PATH_ARRAYS = ("link", "delay", "spreading", "departure", "arrival", "tx_field", "rx_field")
_INTERACTION_ARRAYS = ("kind", "material", "cos_incidence", "rotation", "vertex")


def _numbers(index: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """Convert indices or a mask to indices [n]."""
    return np.flatnonzero(index) if np.asarray(index).dtype == np.bool_ else np.asarray(index, dtype=np.int64)


def take(paths: Paths, index: NDArray[np.int64] | NDArray[np.bool_]) -> Paths:
    """Select paths [n] by index, in the given order, or by a mask. The links are unchanged."""
    index = _numbers(index)
    depth = np.diff(paths.first)[index]
    first = np.concatenate([[0], np.cumsum(depth)]).astype(np.int64)
    # Consecutive indices, starting from the first interaction of each selected path.
    interaction = np.arange(first[-1]) - np.repeat(first[:-1], depth) + np.repeat(paths.first[index], depth)
    return replace(
        paths,
        **{name: getattr(paths, name)[index] for name in _PATH_ARRAYS},
        **{name: getattr(paths, name)[interaction] for name in _INTERACTION_ARRAYS},
        first=first,
        correction=None if paths.correction is None else paths.correction[index],
        diffuse=_rows(paths.diffuse, paths.kind == Kind.DIFFUSE, interaction),
        diffraction=_rows(paths.diffraction, paths.kind == Kind.DIFFRACTION, interaction),
    )


def take_links(paths: Paths, links: NDArray[np.int64] | NDArray[np.bool_]) -> Paths:
    """Select links [n] by index, in the given order, or by a mask. A link can be selected more than once."""
    links = _numbers(links)
    start = np.searchsorted(paths.link, np.arange(paths.num_links + 1))
    count = np.diff(start)[links]
    end = np.cumsum(count)
    # The paths of the first selected link, then those of the second, and so on.
    index = np.arange(count.sum()) + np.repeat(start[links] - (end - count), count)
    return replace(
        take(paths, index),
        link=np.repeat(np.arange(len(links)), count).astype(paths.link.dtype),
        tx_position=paths.tx_position[links],
        rx_position=paths.rx_position[links],
    )


def concatenate(parts: Sequence[Paths]) -> Paths:
    """Join path programs of the same links and sort the paths by link. Within a link, the order is that of `parts`.

    All parts have the same frequency, materials and links.
    """
    offsets = np.cumsum([0, *(part.num_interactions for part in parts)])
    first = [part.first[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    joined = replace(
        parts[0],
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in _PATH_ARRAYS + _INTERACTION_ARRAYS
        },
        first=np.concatenate([*first, offsets[-1:]]),
        correction=_joined_corrections(parts),
        diffuse=_joined([part.diffuse for part in parts]),
        diffraction=_joined([part.diffraction for part in parts]),
    )
    return take(joined, np.argsort(joined.link, kind="stable"))


def join_links(parts: Sequence[tuple[NDArray[np.int64], Paths]]) -> Paths:
    """Join path programs of different links. Each part comes with the indices of its links in the joined program.

    Together, the parts contain every link once. All parts have the same frequency and materials. The joined program has
    the settings of the first part.
    """
    num_links = sum(len(links) for links, _ in parts)
    tx, rx = np.empty((num_links, 3)), np.empty((num_links, 3))
    for links, part in parts:
        tx[links], rx[links] = part.tx_position, part.rx_position
    return concatenate(
        [
            replace(part, link=links[part.link].astype(part.link.dtype), tx_position=tx, rx_position=rx)
            for links, part in parts
        ]
    )


def _rows(table: Table, has_row: NDArray[np.bool_], interaction: NDArray[np.int64]) -> Table:
    """The rows of a table for the given interactions; `has_row` [I] marks the interactions that have a row."""
    # The row index of an interaction is the number of earlier interactions of the same kind.
    row = (np.cumsum(has_row) - 1)[interaction[has_row[interaction]]]
    return type(table)(*(getattr(table, field.name)[row] for field in fields(table)))


def _joined_corrections(parts: Sequence[Paths]) -> NDArray[np.float64] | None:
    """Corrections of all paths; None if no part has corrections."""
    if all(part.correction is None for part in parts):
        return None
    return np.concatenate(
        [np.ones(part.num_paths) if part.correction is None else part.correction for part in parts]
    )


def _joined(tables: Sequence[Table]) -> Table:
    table_type = type(tables[0])
    return table_type(
        *(np.concatenate([getattr(table, field.name) for table in tables]) for field in fields(table_type))
    )


def _content(paths: Paths) -> file_format.Content:
    """The path program as the content of a path file."""
    materials = paths.materials.values()
    arrays: dict[str, Any] = {
        "materials/name": list(paths.materials),
        "materials/scattering_pattern": [material.scattering_pattern for material in materials],
    }
    for name in file_format.DATASETS:
        group, _, attribute = name.partition("/")
        if group == "materials" and attribute in FIELDS:
            arrays[name] = [getattr(material, attribute) for material in materials]
        elif group in ("diffuse", "diffraction"):
            arrays[name] = getattr(getattr(paths, group), attribute)
        # Complex fields are two datasets, because MATLAB's h5read has no complex type.
        elif attribute.endswith("_real"):
            arrays[name] = np.real(getattr(paths, attribute.removesuffix("_real")))
        elif attribute.endswith("_imag"):
            arrays[name] = np.imag(getattr(paths, attribute.removesuffix("_imag")))
        elif group != "materials":
            arrays[name] = getattr(paths, attribute)
    if paths.correction is not None:
        arrays["paths/correction"] = paths.correction
    return file_format.Content(paths.frequency, paths.settings, arrays)


def _paths(content: file_format.Content) -> Paths:
    """The path program from the content of a path file."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, values in content.arrays.items():
        group, _, attribute = name.partition("/")
        if attribute.endswith("_real"):
            imaginary = content.arrays[name.removesuffix("_real") + "_imag"]
            attribute, values = attribute.removesuffix("_real"), values + 1j * imaginary
        if not attribute.endswith("_imag"):
            groups.setdefault(group, {})[attribute] = values
    table = groups["materials"]
    materials = {
        name: Material(
            **{key: float(table[key][index]) for key in FIELDS},
            scattering_pattern=table["scattering_pattern"][index],
        )
        for index, name in enumerate(table["name"])
    }
    return Paths(
        frequency=content.frequency,
        materials=materials,
        **groups["links"],
        **groups["paths"],
        **groups["interactions"],
        diffuse=Diffuse(**groups["diffuse"]),
        diffraction=Diffraction(**groups["diffraction"]),
        settings=content.settings,
    )


def _summary(paths: Paths) -> dict[str, str]:
    """Summary of the paths for a terminal or notebook, as text by heading."""
    num_unreached = len(paths.links_without_path)
    counts = np.bincount(paths.kind, minlength=max(Kind) + 1)
    kinds = [f"{counts[kind]:,} {kind.name.lower()}" for kind in Kind if counts[kind]]
    size = sum(
        value.nbytes
        for record in (paths, paths.diffuse, paths.diffraction)
        for entry in fields(record)
        if isinstance(value := getattr(record, entry.name), np.ndarray)
    )
    return {
        "links": f"{paths.num_links:,}" + (f", {num_unreached:,} without a path" if num_unreached else ""),
        "paths": f"{paths.num_paths:,}",
        "interactions": f"{paths.num_interactions:,}" + (f": {', '.join(kinds)}" if kinds else ""),
        "materials": f"{len(paths.materials)}: {', '.join(paths.materials)}",
        "frequency": f"{paths.frequency / 1e9:g} GHz",
        "memory": _size_text(size),
    }


def _size_text(num_bytes: int) -> str:
    """A size in bytes, formatted in a suitable unit.

    Example:
        >>> _size_text(512), _size_text(3_500_000)
        ('512 B', '3.3 MiB')
    """
    if num_bytes < 1024:
        return f"{num_bytes} B"
    power = min(int(np.log2(num_bytes) // 10), 4)
    return f"{num_bytes / 1024**power:.1f} {('KiB', 'MiB', 'GiB', 'TiB')[power - 1]}"
