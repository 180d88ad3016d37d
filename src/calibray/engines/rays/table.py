"""A ray table: one row for each point of every path, from the transmitter via the interactions to the receiver.

`docs/reference/ray-table.md` documents the columns. Rows can be in any order, because every row states its path and the
number of its point on this path. The file extension determines the format: CSV, Parquet, JSON or HDF5.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.paths import Kind
from calibray.support.messages import did_you_mean, shortened
from calibray.support.output_files import check_file, check_space, exists, replacing, write_table, write_text
from calibray.tracing.settings import RANGES

TYPES: Final = {
    "reflection": Kind.SPECULAR,
    "diffuse": Kind.DIFFUSE,
    "transmission": Kind.REFRACTION,
    "diffraction": Kind.DIFFRACTION,
}
"""Kinds of interaction, by their names in the column `type`."""

ENDS: Final = ("transmitter", "receiver")
"""Values of the column `type` at the first and the last point of a path."""

REQUIRED: Final = ("path", "point", "type", "x", "y", "z")
POWERS: Final = ("power_db", "gain_real", "gain_imag")
OPTIONAL: Final = ("material", "object", "link", "delay", *POWERS)
"""Optional columns of a table. Unknown names are compared with these, because a misspelt column would be ignored."""

HIT_MATERIAL: Final = "hit_material"
"""Optional column with a material, which is used only where surfaces of different materials coincide."""

QUANTITIES: Final = {
    "gain_real": r"\b(re|real)\b",
    "gain_imag": r"\b(im|imag|imaginary)\b",
    "power_db": r"power|gain|loss|amplitude|magnitude|rssi|rsrp|\b(pl|pg|prx|db|dbm|dbw)\b",
    "delay": "delay",
    "material": "material",
}
"""For each column, a pattern that matches unknown names which probably refer to this column. Separators in a name are
treated as blanks."""

MISSPELT: Final = 0.8
"""Minimum similarity at which an unknown name counts as a misspelt column; `line` does not count as a misspelt
`link`."""

MOST_POINTS: Final = RANGES["max_depth"][1] + 2
"""Maximum number of points on a path: the maximum number of interactions in a trace, plus the two ends."""

NO_POWER: Final = {"power_db": "-inf (-10000 in JSON)", "gain_real": "0", "gain_imag": "0"}
"""Values of the power columns for a path without power."""

POWER_ZERO_DB: Final = -10_000.0
"""Level that replaces -inf [dB]; the corresponding power is 0 in double precision."""


@dataclass(frozen=True, eq=False)
class RayTable:
    """The P paths of an engine, padded to the largest depth D and sorted by their labels.

    Attributes:
        source: Name of the table, for messages.
        path: Number or label of every path [P].
        link: Number or label of every path's link [P]; None if each path's link is determined by its ends.
        tx: Transmitter position of every path [P, 3], [m].
        rx: Receiver position of every path [P, 3], [m].
        vertex: Interaction points [P, D, 3], [m].
        kind: Kind of every interaction [P, D]; 0 after a path's last interaction.
        material: Name of every interaction's material [P, D]; empty if not stated.
        object: Name of every interaction's object [P, D]; empty if not stated.
        hit_material: Name of the material to use where surfaces coincide [P, D]; empty if not stated.
        power: Path gain of every path [P]; 0 for an absent path; None if not stated.
        delay: Propagation delay of every path [P], [s]; None if not stated.
    """

    source: str
    path: NDArray
    link: NDArray | None
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    vertex: NDArray[np.float64]
    kind: NDArray[np.int64]
    material: NDArray[np.str_]
    object: NDArray[np.str_]
    hit_material: NDArray[np.str_]
    power: NDArray[np.float64] | None
    delay: NDArray[np.float64] | None

    @classmethod
    def of(cls, table: SourceTable, axes: str = "x y z") -> RayTable:
        """Read paths from rows; `axes` lists the table's axes that become the scene's x, y and z, such as "x -z y".

        Raises:
            InputError: A column is missing or malformed, a path is incomplete, or a value is impossible.
        """
        table = _with_known_names(_checked_rows(table))
        path, point = _names(table, "path"), table.numbers("point")
        order = np.lexsort((point, path))
        frame = table.frame.assign(path=path).iloc[order].reset_index(drop=True)
        table = SourceTable(frame, table.row[order], table.source, table.changes)
        label, first, row_path = np.unique(path[order], return_index=True, return_inverse=True)
        row_path, step = row_path.reshape(-1), np.arange(len(table)) - first[row_path.reshape(-1)]
        count = np.bincount(row_path)
        kind = _kinds(table, row_path, step, count)
        if wrong := np.flatnonzero((point[order] - point[order][first][row_path]) != step).tolist():
            raise InputError(
                f"{table.cell(wrong[0], 'point')}: the point numbers of path {label[row_path[wrong[0]]]} must "
                "increase by 1 without gaps or repetitions; complete the path"
            )
        position = _positions(table, axes)
        inner = kind != 0
        shape = len(label), max(int(count.max()) - 2, 0)
        index = row_path[inner], step[inner] - 1

        def padded(values: NDArray, fill: NDArray) -> NDArray:
            fill[index] = values[inner]
            return fill

        names = {
            name: padded(_optional_labels(table, name), np.full(shape, "", dtype=object)).astype(np.str_)
            for name in ("material", "object", HIT_MATERIAL)
        }
        return cls(
            source=table.source,
            path=label,
            link=_link(table, row_path),
            tx=position[first],
            rx=position[first + count - 1],
            vertex=padded(position, np.zeros((*shape, 3))),
            kind=padded(kind, np.zeros(shape, dtype=np.int64)),
            power=_power(table, row_path),
            delay=_per_path(table, "delay", row_path) if "delay" in table.frame else None,
            **names,
        )

    def take(self, index: NDArray[np.int64]) -> RayTable:
        """The table with the paths at the given indices [n], in the order of the indices."""
        taken = {
            item.name: value[index]
            for item in fields(self)
            if isinstance(value := getattr(self, item.name), np.ndarray)
        }
        return replace(self, **taken)

    def frame(self) -> pd.DataFrame:
        """The table as rows, one for each point."""
        number = np.arange(len(self.path))
        inner = self.kind != 0
        depth = inner.sum(axis=1)
        path = np.concatenate([number, np.nonzero(inner)[0], number])
        step = np.concatenate([0 * number, np.nonzero(inner)[1] + 1, depth + 1])
        position = np.concatenate([self.tx, self.vertex[inner], self.rx])
        names = {kind: name for name, kind in TYPES.items()}
        kinds = [names[Kind(kind)] for kind in self.kind[inner]]
        blank = np.full(len(number), "")
        columns: dict[str, NDArray] = {
            "path": self.path[path],
            "point": step,
            "type": np.array([ENDS[0]] * len(number) + kinds + [ENDS[1]] * len(number)),
            **dict(zip("xyz", position.T, strict=True)),
            "material": np.concatenate([blank, self.material[inner], blank]),
            "object": np.concatenate([blank, self.object[inner], blank]),
        }
        if self.link is not None:
            columns["link"] = self.link[path]
        if self.power is not None:
            with np.errstate(divide="ignore"):
                columns["power_db"] = 10 * np.log10(self.power)[path]
        if self.delay is not None:
            columns["delay"] = self.delay[path]
        columns = {name: values for name, values in columns.items() if not (values == "").all()}
        return pd.DataFrame(columns).iloc[np.lexsort((step, path))].reset_index(drop=True)


def _checked_rows(table: SourceTable) -> SourceTable:
    if table.frame.empty:
        raise InputError(f"{table.source}: contains no rows; a ray table needs at least one path")
    return table


def _with_known_names(table: SourceTable) -> SourceTable:
    """The table with its known columns renamed as documented; names that appear to be misspelt are refused."""
    known = (*REQUIRED, *OPTIONAL, HIT_MATERIAL)
    given = [str(name) for name in table.frame]
    names = [name if (name := _plain(text)) in known else text for text in given]
    absent = {*OPTIONAL} - {*names}
    if len(absent & {*POWERS}) < len(POWERS):
        absent -= {*POWERS}
    for text, name in zip(given, names, strict=True):
        if name in known and names.count(name) > 1:
            raise InputError(f"{table.source}: has {names.count(name)} columns {name!r}; keep one of them")
        if name not in known and (meant := _meant(text, absent)):
            raise InputError(
                f"{table.source}: column {shortened(text)!r} is unknown and would be ignored; did you mean {meant!r} "
                "(docs/reference/ray-table.md)? Use this name and its unit, or remove the column"
            )
    if missing := [name for name in REQUIRED if name not in names]:
        raise InputError(
            f"{table.source}: has no column {missing[0]!r}, which every ray table must have "
            "(docs/reference/ray-table.md); add it"
        )
    return replace(table, frame=table.frame.set_axis(names, axis=1))


def _plain(name: str) -> str:
    """A column name in lower case, with underscores instead of blanks and brackets."""
    return re.sub(r"[\s_()\[\]{}]+", "_", name.casefold()).strip("_")


def _meant(name: str, absent: set[str]) -> str | None:
    """The absent column to which an unknown name probably refers; None if there is no such column."""
    words = re.sub(r"[\W_]+", " ", name.casefold())
    for known, pattern in QUANTITIES.items():
        if known in absent and re.search(pattern, words):
            return known
    return next(iter(get_close_matches(shortened(_plain(name)), sorted(absent), n=1, cutoff=MISSPELT)), None)


def _kinds(
    table: SourceTable, row_path: NDArray[np.int64], step: NDArray[np.int64], count: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Kind of every row [rows]; 0 at the ends of a path.

    Raises:
        InputError: A type is unknown, or a path does not start at a transmitter and end at a receiver.
    """
    stated = table.labels("type")
    kinds = np.char.lower(np.char.strip(stated))
    known = [*ENDS, *TYPES]
    if (unknown := ~np.isin(kinds, known)).any():
        row = int(np.argmax(unknown))
        word = shortened(str(stated[row]))
        raise InputError(f"{table.cell(row, 'type')}: {word!r}; {did_you_mean(word, known)}")
    sources, targets = (np.bincount(row_path[kinds == end], minlength=len(count)) for end in ENDS)
    if (shared := np.minimum(sources, targets) > 1).any():
        row = int(np.argmax(shared[row_path]))
        raise InputError(
            f"{table.cell(row, 'path')}: several paths have the number {table.frame['path'].iloc[row]} "
            f"({sources[row_path[row]]} transmitters); numbers must be unique in the table, even across links: "
            "renumber all paths, or remove repeated rows"
        )
    last = step == count[row_path] - 1
    wrong = (
        ((kinds == ENDS[0]) != (step == 0)) | ((kinds == ENDS[1]) != last) | (count[row_path] > MOST_POINTS)
    )
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"{table.cell(row, 'type')}: {str(kinds[row])!r} at point {step[row]} of {count[row_path[row]]} of its "
            f"path; the first point of a path must be the transmitter and the last point the receiver, with at most "
            f"{MOST_POINTS - 2} interactions between the two"
        )
    codes = {**dict.fromkeys(ENDS, 0), **TYPES}
    return np.array([codes[name] for name in kinds.tolist()], dtype=np.int64)


def _positions(table: SourceTable, axes: str) -> NDArray[np.float64]:
    words = axes.split() if isinstance(axes, str) else []
    if sorted(word.lstrip("-") for word in words) != ["x", "y", "z"] or not re.fullmatch("[-xyz ]*", axes):
        raise InputError(
            f"axes = {axes!r}: must list the table's axes for x, y and z of the scene, such as 'x y z' or 'x -z y'"
        )
    sign = [-1.0 if word.startswith("-") else 1.0 for word in words]
    return np.stack([table.numbers(word.lstrip("-")) for word in words], axis=1) * sign


def _optional_labels(table: SourceTable, name: str) -> NDArray:
    """Labels of a column [rows]; empty where a label, or the whole column, is missing."""
    labels = np.full(len(table), "", dtype=object)
    if name in table.frame:
        present = table.frame[name].notna().to_numpy()
        labels[present] = table.select(present).labels(name)
    return labels


def _link(table: SourceTable, row_path: NDArray[np.int64]) -> NDArray | None:
    """Number or label of every path's link [P]; None if the table states no links."""
    if "link" not in table.frame:
        return None
    return _names(SourceTable(_stated(table, "link", row_path).to_frame("link"), source=table.source), "link")


def _names(table: SourceTable, name: str) -> NDArray:
    """Values of a column [rows]: integers if possible, because these sort as numbers, and otherwise labels."""
    column = table.column(name)
    if pd.api.types.is_integer_dtype(column) and not column.isna().any():
        return column.to_numpy()
    # MATLAB stores whole numbers as floats; pandas does so only if any row is empty.
    if pd.api.types.is_float_dtype(column) and ((column % 1 == 0) & (column.abs() < 2**53)).all():
        return table.numbers(name).astype(np.int64)
    return table.labels(name)


def _per_path(table: SourceTable, name: str, row_path: NDArray[np.int64]) -> NDArray[np.float64]:
    """Numbers that apply to whole paths [P]."""
    numbers = table.assign(**{name: table.numbers(name, gaps=True)})
    return _stated(numbers, name, row_path).to_numpy(np.float64)


def _stated(table: SourceTable, name: str, row_path: NDArray[np.int64]) -> pd.Series:
    """Values that apply to whole paths [P]; all rows of a path that state the value must agree."""
    groups = table.column(name).groupby(row_path)
    number = groups.nunique().to_numpy()
    row = int(np.argmax((number != 1)[row_path]))
    if number[row_path[row]] == 0:
        otherwise = f"{NO_POWER[name]} for a path without power" if name in NO_POWER else "remove the column"
        raise InputError(
            f"{table.cell(row, name)}: path {table.frame['path'].iloc[row]} states no {name}; add it, or {otherwise}"
        )
    if number[row_path[row]] > 1:
        raise InputError(
            f"{table.cell(row, name)}: all rows of a path must state the same {name}; correct these rows"
        )
    return groups.first()


def _power(table: SourceTable, row_path: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Path gain of every path [P], from `power_db` or from `gain_real` and `gain_imag`."""
    gains = [name for name in ("gain_real", "gain_imag") if name in table.frame]
    if "power_db" in table.frame:
        if gains:
            raise InputError(f"{table.source}: has both power_db and {gains[0]}; remove one of them")
        finite = table.column("power_db").replace(-np.inf, POWER_ZERO_DB)
        level = _per_path(table.assign(power_db=finite), "power_db", row_path)
        if (level > 0).any():
            raise InputError(
                f"{table.source}: power_db = {level.max():g} dB; path gain is negative: give received minus "
                "transmitted power, not path loss or watts"
            )
        return 10 ** (level / 10)
    if not gains:
        return None
    real, imaginary = (_per_path(table, name, row_path) for name in ("gain_real", "gain_imag"))
    power = real**2 + imaginary**2
    if (power > 1).any():
        raise InputError(
            f"{table.source}: gain_real and gain_imag have the magnitude {np.sqrt(power.max()):g}; it must be at most "
            "1: give the received field divided by the transmitted field, not volts or decibels"
        )
    return power


LARGEST_JSON: Final = 2**26
"""Maximum size of a JSON file [bytes]; in memory, its numbers occupy about twenty times as much."""

HDF5: Final = b"\x89HDF"
"""First bytes of an HDF5 file."""

LARGEST_ARRAYS: Final = 2**30
"""Maximum size of datasets or matrices in memory [bytes], needed because kilobytes can unpack to gigabytes.
"""


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
            f"{path}: has {size / 2**20:,.0f} MiB of JSON; it must have at most {LARGEST_JSON // 2**20} MiB; write "
            ".parquet or .h5"
        )
    return parse_rays(path.read_bytes(), str(path))


def parse_rays(content: bytes, source: str) -> SourceTable:
    """Read the rows of a table from JSON or HDF5 in memory.

    Raises:
        InputError: The content is malformed.
    """
    if content.startswith(HDF5):
        return _parsed(BytesIO(content), source)
    text = content.decode("utf-8-sig", "replace")
    header = text.lstrip().partition("\n")[0].strip()
    if re.match(r"[^\[{]*[,;\t]", header):
        raise InputError(f"{source}: begins with {shortened(header)!r}; it must be JSON or HDF5, not CSV")
    return _parsed(text, source)


def columns_table(columns: Mapping[Any, Any], source: str) -> SourceTable:
    """The rows of a table that is given in memory as one list per column.

    Raises:
        InputError: The columns have different lengths, or there are no rows.
    """
    return _parsed(columns, source)


def _parsed(content: Path | BytesIO | str | Mapping[Any, Any], source: str) -> SourceTable:
    try:
        if isinstance(content, Path | BytesIO):
            frame = _read_hdf5(content, source)
        else:
            frame = pd.DataFrame(json.loads(content) if isinstance(content, str) else content)
    except InputError:
        raise
    # JSON that is nested too deeply raises a RecursionError, which is a RuntimeError.
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        fault = shortened(str(error))
        raise InputError(f"{source}: is not a ray table ({fault}); see docs/reference/ray-table.md") from None
    return _checked_rows(SourceTable(frame, source=source))


def write_ray_file(file: str | Path, frame: pd.DataFrame, overwrite: bool = False) -> None:
    """Write the rows as .csv, .parquet, .json or .h5. An existing file is replaced only when the new file is complete.

    Raises:
        InputError: The file extension is unknown, or the file cannot be written or must not be replaced.
    """
    target = check_file(file, overwrite=overwrite)
    match target.suffix.lower():
        case ".csv" | ".parquet":
            write_table(target, frame)
        case ".json":
            # JSON has no infinity.
            finite = frame.replace(-np.inf, POWER_ZERO_DB)
            write_text(target, json.dumps({name: finite[name].tolist() for name in finite}) + "\n")
        case ".h5" | ".hdf5":
            try:
                with replacing(target) as partial:
                    check_space(partial, int(frame.memory_usage(deep=True).sum()))
                    with h5py.File(partial, "w") as content:
                        for name in frame:
                            column = frame[name].to_numpy()
                            text = column.dtype.kind not in "iuf"
                            content[str(name)] = (
                                np.array(column, dtype=h5py.string_dtype()) if text else column
                            )
            except OSError as error:
                raise InputError(
                    f"{target}: cannot be written ({error.strerror or error}); choose another folder"
                ) from None
        case suffix:
            raise InputError(
                f"{target}: cannot write {suffix or 'a file without extension'}; use .csv, .parquet, .json or .h5"
            )


def _read_hdf5(content: Path | BytesIO, source: str) -> pd.DataFrame:
    with h5py.File(content, "r") as file:
        columns: dict[str, h5py.Dataset] = {}
        groups: list[str] = []
        for name in map(str, file):
            is_here = isinstance(file.get(name, getlink=True), h5py.HardLink)
            if is_here and isinstance(item := file[name], h5py.Dataset):
                columns[name] = item
            elif is_here:
                groups.append(name)
        if groups and not columns:
            raise InputError(
                f"{source}: datasets must be at the root of the file; found group {shortened(groups[0])!r}: store "
                "one dataset per column outside groups"
            )
        for name, item in columns.items():
            if item.is_virtual or item.external is not None:
                raise InputError(
                    f"{source}: {shortened(name)!r} is stored in another file; store it in this file"
                )
        if (size := sum(item.nbytes for item in columns.values())) > LARGEST_ARRAYS:
            raise InputError(
                f"{source}: has {size / 2**20:,.0f} MiB; it must have at most {LARGEST_ARRAYS // 2**20} MiB; export "
                "fewer links"
            )
        # MATLAB writes a vector as a matrix with one row or column.
        return pd.DataFrame(
            {
                name: np.ravel(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()])
                for name, item in columns.items()
            }
        )
