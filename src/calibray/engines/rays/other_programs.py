"""Conversion of other programs' paths to rows of a ray table: Wireless InSite, AODT, DeepMIMO and Sionna RT."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Final, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat
from scipy.io.matlab import MatReadError

from calibray.engines.rays.table import (
    ENDS,
    HIT_MATERIAL,
    LARGEST_ARRAYS,
    TYPES,
    columns_table,
    read_ray_file,
)
from calibray.errors import InputError
from calibray.measurements import SourceTable, read_table
from calibray.paths import Paths
from calibray.support.messages import counted, did_you_mean, first_line, shortened


class Polyline(NamedTuple):
    """One path.

    Attributes:
        points: Points from the transmitter to the receiver [n, 3], [m].
        types: Types of the n - 2 interactions, named as in the column `type`.
        power_db: Path gain [dB].
        delay: Propagation delay [s]; NaN if not stated.
        materials: Names of the materials at the interactions, as in the column `hit_material`; empty if not stated.
    """

    points: NDArray[np.floating]
    types: Sequence[str]
    power_db: float
    delay: float = np.nan
    materials: Sequence[str | None] = ()


def rows_of(paths: Iterable[Polyline], source: str) -> SourceTable:
    """A ray table with the given paths, in the given order.

    Raises:
        InputError: The list is empty, a power is NaN, or a path does not have exactly two more points than
            interactions.
    """
    paths = list(paths)
    if not paths:
        raise InputError(f"{source}: contains no path; export the rays of at least one link")
    for number, path in enumerate(paths):
        if len(path.points) != len(path.types) + 2:
            raise InputError(
                f"{source}: path {number} has {len(path.points)} points and {len(path.types)} interactions; it must "
                "have two more points than interactions, for its transmitter and its receiver"
            )
        if np.isnan(path.power_db):
            ends = " to ".join(np.array2string(path.points[end], precision=3) for end in (0, -1))
            raise InputError(
                f"{source}: the power of path {number}, from {ends} m, is NaN; check the constants of the materials "
                "on the path, and compute the power again"
            )
    count = [len(path.points) for path in paths]
    per_path = {
        "path": np.arange(len(paths)),
        "power_db": [path.power_db for path in paths],
        "delay": [path.delay for path in paths],
    }
    frame = pd.DataFrame({name: np.repeat(values, count) for name, values in per_path.items()})
    frame["point"] = np.concatenate([np.arange(number) for number in count])
    frame["type"] = [name for path in paths for name in (ENDS[0], *path.types, ENDS[1])]
    frame[HIT_MATERIAL] = [
        name for path in paths for name in (None, *(path.materials or [None] * len(path.types)), None)
    ]
    frame[["x", "y", "z"]] = np.concatenate([np.asarray(path.points, dtype=float) for path in paths])
    return SourceTable(frame.dropna(axis=1, how="all"), source=source)


def ray_rows(rays: Any, tx_power_dbm: float | None) -> SourceTable:
    """The rows of a ray table, given as a table, as a file, or as the paths of another program.

    Raises:
        InputError: The file or folder is malformed or of an unknown type, or the transmitted power is missing, is not a
            finite number, or does not apply to these rays.
    """
    if tx_power_dbm is not None and not (isinstance(tx_power_dbm, Real) and np.isfinite(tx_power_dbm)):
        raise InputError(f"tx_power_dbm = {tx_power_dbm!r}: must be a finite number, in dBm")
    insite = _insite_files(rays)
    if tx_power_dbm is not None and not insite:
        raise InputError(
            f"tx_power_dbm = {tx_power_dbm:g}: applies only to Wireless InSite files (.p2m); in a table, subtract it "
            "from the received power, so that power_db is the path gain"
        )
    if insite:
        return read_insite(insite, tx_power_dbm)
    if isinstance(rays, pd.DataFrame):
        return SourceTable(rays)
    if isinstance(rays, Mapping):
        return columns_table(rays, "table")
    if is_sionna_paths(rays):
        return read_sionna_paths(rays)
    if isinstance(rays, Paths):
        raise InputError("rays: these are already Paths of Calibray; use them without read_rays")
    if not isinstance(rays, str | Path):
        raise InputError(
            f"rays: is a {type(rays).__name__}; it must be a DataFrame, a dict with one list per column, the name of a "
            "file or folder, a list of .p2m files, or the Paths of Sionna RT"
        )
    path = Path(rays)
    if not path.is_dir():
        return read_ray_file(path)
    if is_deepmimo(path):
        return read_deepmimo(path)
    if (path / AODT_FILES[0]).is_file():
        return read_aodt(path)
    raise InputError(
        f"{path}: a folder must contain {' and '.join(AODT_FILES)} (AODT), power_t*.mat (DeepMIMO) or {INSITE_NAMES} "
        "(Wireless InSite); otherwise give a file"
    )


INSITE_TYPES: Final = {"R": "reflection", "D": "diffraction", "DS": "diffuse", "T": "transmission"}
"""Types of interactions by letter; foliage (F, X) is refused, because foliage is not a surface with a material."""


INSITE_NAMES: Final = "*.paths.*.p2m"
"""Names of the files with paths; the other files in an export folder contain powers or delays of links."""


def _insite_files(rays: Any) -> list[Path]:
    """The files of Wireless InSite, given as a file, a list of files or their folder; empty for other rays."""
    if isinstance(rays, str | Path):
        if (path := Path(rays)).is_dir():
            others = is_deepmimo(path) or (path / AODT_FILES[0]).is_file()
            return [] if others else sorted(path.glob(INSITE_NAMES))
        rays = [path]
    given = rays if isinstance(rays, list | tuple) else []
    files = [Path(item) for item in given if isinstance(item, str | Path)]
    return files if len(files) == len(given) and all(file.suffix.lower() == ".p2m" for file in files) else []


def read_insite(files: Sequence[Path], tx_power_dbm: float | None) -> SourceTable:
    """Read the paths from text files `*.paths.*.p2m` of Remcom Wireless InSite, each of which has one transmitter.

    Lines that begin with # are comments. The first line contains the number of receivers. Each receiver has a line with
    its index and its number of paths, followed by a line of totals if it has any paths. Each path has a line of nine
    numbers (index, number of interactions, received power [dBm], phase [deg], time of arrival [s], four angles [deg]),
    or of eight numbers without the phase. The line of numbers is followed by a line with the path's interactions, such
    as Tx-R-D-Rx, and by one line for each point.

    Raises:
        InputError: The transmitted power is missing, a file does not exist or is malformed, or a path crosses foliage.
    """
    if tx_power_dbm is None:
        raise InputError(
            f"{files[0]}: contains received power in dBm; give tx_power_dbm, the transmitted power of the project"
        )
    others = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return rows_of(
        (path for file in files for path in _insite_file(file, tx_power_dbm)), f"{files[0]}{others}"
    )


def _insite_file(file: Path, tx_power_dbm: float) -> list[Polyline]:
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    lines = [
        (number, line.strip())
        for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    rest = iter(lines)
    try:
        paths = _insite_paths(file, rest, tx_power_dbm)
    except StopIteration:
        raise InputError(
            f"{file}: ends within a path; export it again, or check that it is a paths file"
        ) from None
    for number, text in rest:
        raise InputError(
            f"{file}, line {number}: {shortened(text)!r} follows the last receiver, according to the number of "
            f"receivers in line {lines[0][0]}; correct this number, or give the separate files as a list"
        )
    return paths


def _insite_paths(file: Path, rest: Iterator[tuple[int, str]], tx_power_dbm: float) -> list[Polyline]:
    paths = []
    (receivers,) = _insite_numbers(file, next(rest), 1)
    for _ in range(int(receivers)):
        _, count = _insite_numbers(file, next(rest), 2)
        # The line of totals.
        if count:
            next(rest)
        for _ in range(int(count)):
            _, depth, power, *_, delay, _, _, _, _ = _insite_numbers(file, next(rest), 8, 9)
            number, text = next(rest)
            names = text.split("-")[1:-1]
            if unknown := [name for name in names if name not in INSITE_TYPES]:
                raise InputError(
                    f"{file}, line {number}: {shortened(text)!r} has the interaction {shortened(unknown[0])!r}; "
                    f"Calibray reads {', '.join(INSITE_TYPES)}, so export the paths without foliage"
                )
            points = np.array([_insite_numbers(file, next(rest), 3) for _ in range(int(depth) + 2)])
            paths.append(
                Polyline(points, [INSITE_TYPES[name] for name in names], power - tx_power_dbm, delay)
            )
    return paths


def _insite_numbers(file: Path, line: tuple[int, str], *counts: int) -> list[float]:
    number, text = line
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) not in counts or not np.isfinite(values).all():
        raise InputError(
            f"{file}, line {number}: {shortened(text)!r}; the line must contain {' or '.join(map(str, counts))} "
            "numbers, so this is not a paths file of Wireless InSite (project.paths.t001_01.r002.p2m)"
        )
    return values


AODT_FILES: Final = ("raypaths.parquet", "cirs.parquet")
AODT_UNIT: Final = 0.01
"""Unit of length in an export, in metres."""

AODT_PAIR: Final = ["ru_id", "ue_id"]
AODT_ELEMENT: Final = "ru_ant_el"
AODT_TYPES: Final = {
    "reflection": "reflection", "diffraction": "diffraction", "transmission": "transmission", "diffuse": "diffuse",
    "scattering": "diffuse",
}  # fmt: skip


def read_aodt(folder: Path) -> SourceTable:
    """Read an export folder of NVIDIA's Aerial Omniverse Digital Twin, at the first time step that has paths.

    The folder contains two tables, both of which state the time, the radio unit and the user equipment. `raypaths` has
    a row for each path, with the path's points in units of the scene (centimetres) and the types of its interactions.
    `cirs` has a row for each pair of antenna elements, with lists of complex gains and delays [s] in the order of the
    paths.

    Powers are summed over the antenna elements of the user equipment and averaged over the antenna elements of the
    radio unit.

    Raises:
        InputError: A table or column is missing or malformed, or the number of gains of a pair differs from its number
            of paths.
    """
    rays, gains = (read_table(folder / name) for name in AODT_FILES)
    for table, names in ((rays, ["points", "interaction_types"]), (gains, ["cir_re", "cir_im", "cir_delay"])):
        for name in (*AODT_PAIR, *names):
            table.column(name)
    times = [
        table.frame["time_idx"].to_numpy() if "time_idx" in table.frame else np.zeros(len(table))
        for table in (rays, gains)
    ]
    # The step is chosen from raypaths, because cirs can also have rows for a step without paths.
    frames = [table.frame[time == times[0].min()] for table, time in zip((rays, gains), times, strict=True)]
    responses = {key: rows for key, rows in frames[1].groupby(AODT_PAIR, sort=False)}
    paths = []
    for pair, rows in frames[0].groupby(AODT_PAIR, sort=False):
        if pair not in responses:
            raise InputError(
                f"{gains.source}: has no gains for ru_id, ue_id = {pair}, but raypaths has {counted(len(rows), 'path')}"
            )
        power, delay = _aodt_response(gains.source, pair, responses[pair], len(rows))
        with np.errstate(divide="ignore"):
            level = 10 * np.log10(power)
        for number, (points, types) in enumerate(zip(rows["points"], rows["interaction_types"], strict=True)):
            paths.append(
                Polyline(
                    AODT_UNIT * _aodt_points(points), _aodt_types(rays, types), level[number], delay[number]
                )
            )
    return rows_of(paths, str(folder))


def _aodt_response(
    source: str, pair: Any, rows: Any, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power and delay of every path between one radio unit and one user equipment."""
    lists = [
        [_aodt_numbers(source, name, value) for value in rows[name]]
        for name in ("cir_re", "cir_im", "cir_delay")
    ]
    if wrong := [len(values) for column in lists for values in column if len(values) != count]:
        raise InputError(
            f"{source}: has {counted(wrong[0], 'gain')} for ru_id, ue_id = {pair}, but raypaths has "
            f"{counted(count, 'path')}; export both tables from the same run"
        )
    real, imaginary, delay = (np.array(column) for column in lists)
    transmitting = len({_aodt_element(item) for item in rows[AODT_ELEMENT]}) if AODT_ELEMENT in rows else 1
    return (real**2 + imaginary**2).sum(axis=0) / transmitting, delay[0]


def _aodt_numbers(source: str, name: str, values: Any) -> NDArray[np.float64]:
    """The numbers in a list that has one entry for each path."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.zeros(())
    if numbers.ndim != 1:
        raise InputError(
            f"{source}: {name} = {shortened(repr(values))}: must be a list of numbers, one for each path; export the "
            "table again"
        )
    return numbers


def _aodt_element(element: Any) -> Any:
    """An antenna element in hashable form; exports state it as a number, a list or a dictionary (row, column, port)."""
    if isinstance(element, dict):
        return tuple(element.values())
    return tuple(element) if np.ndim(element) else element


def _aodt_points(points: Any) -> NDArray[np.float64]:
    """Points [n, 3] from a list of triples, or from a list of dictionaries with the keys 1, 2 and 3."""
    try:
        return np.array(
            [list(item.values()) if isinstance(item, dict) else np.asarray(item) for item in points],
            dtype=float,
        ).reshape(-1, 3)
    except (TypeError, ValueError):
        raise InputError(
            "raypaths.parquet: points must be triples of numbers; export the table again"
        ) from None


def _aodt_types(table: SourceTable, types: Any) -> list[str]:
    if np.ndim(types) != 1:
        raise InputError(
            f"{table.source}: interaction_types = {shortened(repr(types))}: must be a list of names; export the table "
            "again"
        )
    names = [str(item).lower() for item in types][1:-1]
    if unknown := [name for name in names if name not in AODT_TYPES]:
        raise InputError(
            f"{table.source}: interaction_types has {unknown[0]!r}; {did_you_mean(unknown[0], AODT_TYPES)}"
        )
    return [AODT_TYPES[name] for name in names]


DEEPMIMO_TYPES: Final = {"1": "reflection", "2": "diffraction", "3": "diffuse", "4": "transmission"}
DEEPMIMO_OLD_NAMES: Final = {"delay": "toa", "inter_pos": "inter_loc", "tx_pos": "tx_loc", "rx_pos": "rx_loc"}
"""Older names of matrices, by their present names."""


def is_deepmimo(folder: Path) -> bool:
    """Whether a folder contains the power matrices of a DeepMIMO scenario."""
    return any(_deepmimo_files(folder))


def read_deepmimo(folder: Path) -> SourceTable:
    """Read the paths of all transmitters of a DeepMIMO scenario (version 4): `NAME_tSET_txTX_rSET.mat` or `.npz`.

    For each transmitter and set of N receivers, there are six matrices: `power` [N, P], path gain [dB]; `delay` [N, P],
    [s]; `inter` [N, P], one digit for each interaction; `inter_pos` [N, P, I, 3], `tx_pos` [3] and `rx_pos` [N, 3],
    [m]. In all matrices, NaN stands for a missing path.

    Raises:
        InputError: A matrix is missing, malformed or too large, or the shapes of the matrices are inconsistent.
    """
    paths = [path for file in _deepmimo_files(folder) for path in _deepmimo_paths(file)]
    return rows_of(paths, str(folder))


def _deepmimo_files(folder: Path) -> Iterator[Path]:
    """The files that contain the power matrices."""
    for ending in ("mat", "npz"):
        yield from sorted(folder.glob(f"power_t*.{ending}"))


def _deepmimo_paths(file: Path) -> Iterator[Polyline]:
    code = file.name.removeprefix("power")
    matrices = {"power": _matrix(file)}
    for name in ("delay", "inter", "inter_pos", "tx_pos", "rx_pos"):
        other = file.with_name(DEEPMIMO_OLD_NAMES.get(name, name) + code)
        matrices[name] = _matrix(other if other.exists() else file.with_name(name + code))
    power, delay, inter = (np.atleast_2d(matrices[name]) for name in ("power", "delay", "inter"))
    tx, rx = matrices["tx_pos"].reshape(-1, 3), matrices["rx_pos"].reshape(-1, 3)
    place = matrices["inter_pos"]
    if place.ndim == 3:  # at most one interaction
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
    # A path with a delay and interactions but a power of NaN also counts, so that it is refused later.
    exists = np.isfinite(inter) & (inter >= 0) & (np.isfinite(power) | np.isnan(power) & np.isfinite(delay))
    for receiver, path in np.argwhere(exists).tolist():
        codes = str(int(inter[receiver, path])) if inter[receiver, path] else ""
        if unknown := set(codes) - set(DEEPMIMO_TYPES):
            raise InputError(
                f"{file}: receiver {receiver}, path {path}: interaction {unknown.pop()} of {codes}; the codes are "
                f"{', '.join(f'{key} {name}' for key, name in DEEPMIMO_TYPES.items())}"
            )
        points = np.vstack([tx[0], place[receiver, path, : len(codes)], rx[receiver]])
        yield Polyline(
            points, [DEEPMIMO_TYPES[digit] for digit in codes], power[receiver, path], delay[receiver, path]
        )


def _matrix(file: Path) -> NDArray[np.float64]:
    """The only matrix in a file."""
    if not file.is_file():
        raise InputError(f"{file}: no such file; export the scenario again, with all of its matrices")
    try:
        if file.suffix == ".npz":
            with ZipFile(file) as parts:
                size = sum(part.file_size for part in parts.infolist())
        else:
            size = 8 * sum(int(np.prod(shape)) for _, shape, _ in whosmat(file))
        if size > LARGEST_ARRAYS:
            raise InputError(
                f"{file}: has {size / 2**20:,.0f} MiB; it must have at most {LARGEST_ARRAYS // 2**20} MiB; export "
                "fewer receivers"
            )
        if file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as packed:
                content = {name: packed[name] for name in packed}
        else:
            content = loadmat(file)
        (matrix,) = (values for name, values in content.items() if not name.startswith("__"))
        return np.asarray(matrix, dtype=float)
    except (OSError, ValueError, TypeError, NotImplementedError, BadZipFile, MatReadError) as error:
        raise InputError(f"{file}: not a matrix of a DeepMIMO scenario ({first_line(error)})") from None


SIONNA_PATHS: Final = "the paths of Sionna RT"


def is_sionna_paths(value: object) -> bool:
    """Whether a value is Sionna's `Paths`."""
    return type(value).__module__.startswith("sionna.rt") and hasattr(value, "interactions")


def check_carrier(rays: Any, frequency: float) -> None:
    """Refuse paths of Sionna RT solved at a carrier other than `frequency` [Hz]; no other rays state their carrier.

    Raises:
        InputError: The carriers differ.
    """
    solved = (
        float(np.array(getattr(rays, "_frequency", frequency)).item()) if is_sionna_paths(rays) else frequency
    )
    # Sionna RT stores the carrier in single precision.
    if not np.isclose(solved, frequency, rtol=1e-6):
        raise InputError(
            f"{SIONNA_PATHS}: were solved at {solved / 1e9:g} GHz, but must be solved at {frequency / 1e9:g} GHz, the "
            "carrier of the study or of the argument frequency; set scene.frequency and solve again"
        )


def read_sionna_paths(paths: Any) -> SourceTable:
    """Read paths of Sionna RT in memory, as its `PathSolver` returns them, for arrays with a single antenna position.

    Vertices and interactions have the shape [D, R, T, P] with synthetic arrays, and otherwise [D, R, Ra, T, Ta, P],
    where Ra and Ta are the numbers of antennas in the arrays. The gains `a` are a pair of arrays [R, Ra, T, Ta, P], the
    real and the imaginary parts.

    Powers are summed over the ports of a receiver and averaged over the ports of a transmitter.

    Raises:
        InputError: An array has antennas at several positions, or there is no path.
    """
    for array in (paths.tx_array, paths.rx_array):
        if array.array_size != 1:
            raise InputError(
                f"{SIONNA_PATHS}: an array has {array.array_size} antennas, whose paths are summed; trace with one "
                "antenna per array"
            )
    return rows_of(_sionna_polylines(paths), SIONNA_PATHS)


def _sionna_polylines(paths: Any) -> Iterator[Polyline]:
    from calibray.tracing.sionna.live_scene import (
        materials_of_shapes,
    )  # the import takes seconds, and only these paths need it

    real, imaginary = (np.array(part, dtype=float) for part in paths.a)
    with np.errstate(divide="ignore"):
        level = 10 * np.log10((real**2 + imaginary**2).sum(axis=1).mean(axis=2))  # [R, T, P]
    shape = level.shape
    kinds, vertices = np.array(paths.interactions), np.array(paths.vertices, dtype=float)
    objects = np.array(paths.objects)
    if not paths.synthetic_array:  # ports at one position have the same paths
        kinds, vertices, objects = (each[:, :, 0, :, 0] for each in (kinds, vertices, objects))
    delay = np.array(paths.tau, dtype=float)
    delay = delay if delay.shape == shape else delay[:, 0, :, 0]
    sources, targets = (
        _sionna_positions(ends, count)
        for ends, count in ((paths.sources, shape[1]), (paths.targets, shape[0]))
    )
    names = {int(kind): name for name, kind in TYPES.items()}
    materials = materials_of_shapes(np.unique(objects[kinds > 0]).tolist())
    for rx, tx, path in np.argwhere(delay >= 0).tolist():
        kind = [int(code) for code in kinds[:, rx, tx, path] if code]
        inner = vertices[: len(kind), rx, tx, path]
        points = np.vstack([sources[tx], inner, targets[rx]])
        hit = [materials.get(number) for number in objects[: len(kind), rx, tx, path].tolist()]
        yield Polyline(points, [names[code] for code in kind], level[rx, tx, path], delay[rx, tx, path], hit)


def _sionna_positions(ends: Any, count: int) -> NDArray[np.float64]:
    """Positions of the links' ends [count, 3]; Sionna RT lists the ports at one position consecutively."""
    positions = np.array(ends, dtype=float).T
    return positions[:: len(positions) // count]
