"""Compute observables of links from the delays, powers and angles of measured multipath components.

Each observable is defined as in the model, except that components outside the receiver's dynamic range are cut off
sharply. Repeated snapshots of a link, for example from a rotated array, are averaged. Samples of impulse responses that
exceed a threshold are treated as components.
"""

from __future__ import annotations

import logging
import re
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import pandas as pd
import scipy.io
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import observables as kinds
from calibray.measurements.column_names import matches, words
from calibray.measurements.observables import Statistic
from calibray.measurements.selection import LARGEST_LEVEL, find_codes
from calibray.measurements.source_table import SourceTable
from calibray.measurements.table_files import read_table
from calibray.support.messages import shortened

_LOG: Final = logging.getLogger(__name__)

DELAY: Final = r"(^|_)(delay|tau|toa|tof)"
POWER: Final = r"(^|_)(path_?loss|pl|path_?gain|gain|power|rx_?power|level)(_|$)"
ANGLE: Final = {
    "azimuth": r"(^|_)(azimuth|azi?|ao[ad]|phi)(_|$)",
    "elevation": r"(^|_)(elevation|ele?|zenith|theta|zo[ad]|eo[ad])(_|$)",
}
END: Final = {"departure": r"(^|_)([aze]od|departure|tx)(_|$)", "arrival": r"(^|_)([aze]oa|arrival|rx)(_|$)"}
SNAPSHOT: Final = r"(^|_)(rotation|snapshot|sweep|scan|repetition|orientation)(_|$)"
ANGLES: Final = (*(kind for kind, unit in kinds.KINDS.items() if unit == "rad"), *kinds.SECTORS)
"""Kinds of statistics that require measured angles."""

SECONDS: Final = {"ps": 1e-12, "ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}

RADIANS: Final = frozenset({"rad", "radian", "radians"})
"""Words in a column name that indicate angles in radians rather than degrees."""

LEAST_LOSS_DB: Final = 40.0
"""Path loss in free space at 1 m and 2.4 GHz [dB]. A level of 0 dB is treated as a code for a missing value if the
magnitudes of all other levels exceed this loss. If levels are relative to the strongest component, 0 dB is valid, but
the other levels then have smaller magnitudes."""

LONGEST: Final = 0.01
"""Largest plausible delay [s]; light travels 3,000 km in this time."""


@dataclass(frozen=True, eq=False)
class Multipath:
    """Measured multipath components of links.

    Attributes:
        link: Label of the link to which each component belongs [n].
        snapshot: Label of the snapshot in which each component was measured [n].
        delay: Delay [n], [s].
        level_db: Power gain [n], [dB].
        angles: Azimuths (counter-clockwise from the x axis) and elevations or zenith angles [n], [rad]. The keys are a
            plane and an end, such as ("azimuth", "arrival").
    """

    link: NDArray[np.str_]
    snapshot: NDArray[np.str_]
    delay: NDArray[np.float64]
    level_db: NDArray[np.float64]
    angles: Mapping[tuple[str, str], NDArray[np.float64]] = field(default_factory=dict)


def read_multipath(
    path: str | Path, link: str, compass: bool = False, missing: Sequence[float] = ()
) -> Multipath:
    """Read a table with one row per multipath component.

    Columns are recognized by name: the delay (`delay_ns`) and the path loss, path gain or power [dB] (`path_loss_db`).
    Columns of azimuth, elevation, and rotation or snapshot number are optional. An angle is used for both ends of the
    link unless the column name specifies one end (`aoa_deg`, `azimuth_tx`).

    Args:
        path: The table.
        link: Column that contains the labels of the links.
        compass: Whether azimuths are compass bearings, clockwise from north.
        missing: Numbers that represent missing delays or levels. Components with such a number are left out.

    Raises:
        InputError: The table cannot be read, lacks a column of links, delays or powers, or has several columns of
            delays or powers. Delays or powers are implausible or do not match the unit or sign implied by the column
            name.
    """
    table = read_table(path)
    # Column names as words joined by underscores, such as delay_ns for "Delay [ns]".
    names = {
        str(name): "_".join(re.findall(r"[a-z0-9]+", str(name).lower()))
        for name in table.frame.columns
        if name != link
    }

    def find(what: str, pattern: str, other: str, units: Collection[str]) -> str | None:
        found = [name for name, plain in names.items() if re.search(pattern, plain) and other not in plain]
        # If several columns match, columns that name another quantity or state no unit are ignored.
        if len(found) > 1:
            found = [name for name in found if not matches(name, "another quantity")] or found
        if len(found) > 1:
            found = [name for name in found if words(name) & set(units)] or found
        if len(found) > 1:
            raise InputError(
                f"{path}: the columns {shortened(', '.join(found), 300)} can all contain the {what} of the components; "
                "keep one, and remove or rename the others"
            )
        return found[0] if found else None

    delay, power = find("delay", DELAY, "spread", SECONDS), find("level", POWER, "tx", {"db", "dbm"})
    snapshot = next((name for name, plain in names.items() if re.search(SNAPSHOT, plain)), None)
    if delay is None or power is None:
        wanted = "delay, such as delay_ns" if delay is None else "power, such as path_loss_db or path_gain_db"
        raise InputError(f"{path}: no column with a {wanted}; the columns are {', '.join(names)}")
    coded = table.frame[[delay, power]].isin(list(missing)).any(axis=1).to_numpy()
    if coded.any():
        table = table.keep(~coded, "links.missing")
        _LOG.info("%s: %d of %d components left out by links.missing", path, coded.sum(), len(coded))
    labels = table.labels(link)
    unit = next((unit for unit in SECONDS if unit in words(delay)), "s")
    seconds = table.numbers(delay) * SECONDS[unit]
    if seconds.max() > LONGEST:
        raise InputError(
            f"{path}: column {delay!r} has a delay of {seconds.max():g} s, but at most {LONGEST:g} s is allowed; "
            "state the unit in the column name, such as delay_ns"
        )
    level_db, is_loss = table.numbers(power), re.search(r"loss|(^|_)pl(_|$)", names[power]) is not None
    median, is_level = float(np.median(level_db)), matches(power, "decibel") and "gain" not in power.lower()
    # Received power in decibels can be positive if the receiver is not calibrated.
    if (median < 0) if is_loss else (median > 0 and not is_level):
        raise InputError(
            f"{path}: column {power!r} has values of about {median:g} dB; losses must be positive, and gains and "
            "powers negative; name the column path_loss_db or path_gain_db"
        )

    _check_plausible(table, delay, power)

    angles = {}
    for plane, pattern in ANGLE.items():
        # "AoA" means azimuth unless the name states elevation.
        of_plane = {
            name: plain
            for name, plain in names.items()
            if re.search(pattern, plain) and not (plane == "azimuth" and re.search(ANGLE["elevation"], plain))
        }
        for end, other in (("departure", END["arrival"]), ("arrival", END["departure"])):
            own = [
                name
                for name, plain in of_plane.items()
                if re.search(END[end], plain) or not re.search(other, plain)
            ]
            if len(own) == 1:
                values = table.numbers(own[0])
                values = values if words(own[0]) & RADIANS else np.radians(values)
                # Compass bearings are measured clockwise from north, the scene's azimuths counter-clockwise from east.
                angles[plane, end] = np.pi / 2 - values if compass and plane == "azimuth" else values
    return Multipath(
        labels,
        np.full(len(labels), "") if snapshot is None else table.labels(snapshot),
        seconds,
        -level_db if is_loss else level_db,
        angles,
    )


def _check_plausible(table: SourceTable, delay: str, power: str) -> None:
    """Reject components whose delay or level is implausible or could be a code for a missing value.

    Raises:
        InputError: A value is not plausible.
    """
    delays, level_db = table.numbers(delay), table.numbers(power)
    early = np.isin(delays, find_codes(delays, np.inf)) | ("excess" in delay.lower())
    nearest = np.abs(level_db[level_db != 0]).min(initial=np.inf)
    codes = [code for code in find_codes(level_db) if code or nearest > LEAST_LOSS_DB]
    wrong_level = np.isin(level_db, codes) | (np.abs(level_db) > LARGEST_LEVEL)
    for name, values, wrong in ((delay, delays, early & (delays < 0)), (power, level_db, wrong_level)):
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            what = "delay" if name == delay else f"level (at most {LARGEST_LEVEL:g} dB in magnitude)"
            raise InputError(
                f"{table.cell(row, name)}: {values[row]:g} is not a plausible {what}, or is a code for a missing "
                "value; correct it, remove the row, or add the number to links.missing"
            )


def measure(multipath: Multipath, statistic: Statistic) -> dict[str, float]:
    """Compute a statistic for each link in SI units, averaged over the snapshots; the keys are the labels of the links.

    A snapshot with a single component has no K-factor and is excluded from the mean. Links without a detectable
    component are excluded. The bandwidth of the receiver is not applied, because it has already shaped the measured
    components.

    Raises:
        InputError: The statistic requires angles that were not measured or that are in several columns.

    Example:
        >>> paths = Multipath(np.array(["a", "a"]), np.array(["", ""]), np.array([1e-7, 2e-7]), np.zeros(2))
        >>> round(1e9 * measure(paths, Statistic("rms_delay_spread"))["a"], 6)
        50.0
    """
    angle = None
    if statistic.kind in ANGLES:
        plane, _, end = statistic.kind.split("_")
        angle = multipath.angles.get((plane, end))
        if angle is None:
            raise InputError(
                f"{statistic.kind} needs angles, which are missing or in several columns; give a single column, such "
                f"as {plane}_{end}_deg"
            )
    snapshots: dict[str, list[float]] = {}
    keys = pd.DataFrame({"link": multipath.link, "snapshot": multipath.snapshot})
    for index in keys.groupby(["link", "snapshot"], sort=False).indices.values():
        seen = _seen(multipath, np.asarray(index), statistic)
        if len(seen):
            value = _value(multipath, seen, None if angle is None else angle[seen], statistic)
            snapshots.setdefault(str(multipath.link[seen[0]]), []).append(value)
    return {link: float(pd.Series(values).mean()) for link, values in snapshots.items()}


def _seen(multipath: Multipath, index: NDArray[np.int64], statistic: Statistic) -> NDArray[np.int64]:
    """Indices of the components of a snapshot that the receiver can detect."""
    delay, level_db = multipath.delay[index], multipath.level_db[index]
    seen = np.isfinite(level_db)
    if statistic.floor_db is not None:
        seen &= level_db > statistic.floor_db
    if statistic.dynamic_range_db is not None and seen.any():
        seen &= level_db > level_db[seen].max() - statistic.dynamic_range_db
    if statistic.window is not None and seen.any():
        seen &= delay - delay[seen].min() <= statistic.window + kinds.ROUNDING
    return index[seen]


def _value(
    multipath: Multipath, seen: NDArray[np.int64], angle: NDArray[np.float64] | None, statistic: Statistic
) -> float:
    """Compute the statistic of the components of one snapshot, in SI units."""
    delay, power = multipath.delay[seen], 10 ** (multipath.level_db[seen] / 10)
    weight, first = power / power.sum(), float(delay.min())
    mean, kind = float(np.sum(weight * delay)), statistic.kind
    if kind == kinds.DELAY_SPREAD:
        return float(np.sqrt(np.sum(weight * (delay - mean) ** 2)))
    if kind == kinds.EXCESS_DELAY:
        return mean - first
    if kind in kinds.FLIGHTS:
        of_path = {"mean": mean, "first": first, "strongest": float(delay[weight.argmax()])}
        return of_path[statistic.path] * (2 if kind == kinds.ROUND_TRIP else 1)
    if kind == kinds.K_FACTOR:
        strongest = float(weight.max())
        # Ratio of the strongest component to the sum of all others; undefined (NaN) for a single component.
        return 10 * float(np.log10(strongest / (1 - strongest))) if strongest < 1 else np.nan
    if statistic.edges is not None:
        low, high = statistic.bin
        # Angles are wrapped to the full turn that begins at the sector's lower edge.
        values = delay - first if angle is None else (angle - low) % (2 * np.pi) + low
        with np.errstate(divide="ignore"):
            share_db = 10 * np.log10(weight[(values >= low) & (values < high)].sum())
        return float(statistic.limited(share_db))
    # Circular angular spread as in 3GPP TR 38.901, Annex A.1; the bounds keep the logarithm finite and the root real.
    resultant = float(np.clip(abs(np.sum(weight * np.exp(1j * np.asarray(angle)))), 1e-300, 1.0))
    return float(np.sqrt(-2 * np.log(resultant)))


ENDINGS: Final = (".npz", ".npy", ".mat", ".h5", ".hdf5")
MOST_BYTES: Final = 4 << 30
"""Maximum total size of the arrays in a file [bytes]."""

DELAYS: Final = ("delay", "delays", "tau", "time", "t")
"""Recognized names of the array that contains the delays of the samples [s]."""

MARGIN_DB: Final = 10.0
"""Margin by which a sample must exceed the mean noise power to be treated as signal [dB]. The powers of noise samples
are exponentially distributed, so one noise sample in 22,000 exceeds this margin."""


def read_impulse_responses(
    source: str | Path, labels: list[str], sample_rate: float | None = None, margin_db: float = MARGIN_DB
) -> Multipath:
    """Read impulse responses, and keep the samples that clearly exceed the noise.

    NumPy (.npz, .npy), MATLAB (.mat, including version 7.3) and HDF5 files are supported.

    Noise powers are exponentially distributed, so the mean noise power of a response is the median power of its samples
    divided by ln 2. This estimate assumes that most samples of a response are noise.

    Args:
        source: A file with an array [links, samples] or [links, snapshots, samples], whose links are in the order of
            `labels`. Alternatively, a folder with one file per link, each with an array [samples] or [snapshots,
            samples].
        labels: Labels of the links.
        sample_rate: Sample rate [Hz]; None if the files contain the delays of the samples [s].
        margin_db: Margin by which a sample must exceed the mean noise power to become a component [dB].

    Returns:
        One component per sample above the threshold.

    Raises:
        InputError: A file cannot be read, or the shape of its array does not match the links.
    """
    source = Path(source)
    parts = []
    if source.is_dir():
        files = {file.stem: file for file in sorted(source.iterdir()) if file.suffix.lower() in ENDINGS}
        known = [label for label in labels if label in files]
        if not known:
            raise InputError(f"{source}: no file has the name of a link, such as {labels[0]}.npz")
        for label in known:
            response, delay = _read(files[label], sample_rate)
            parts.append(_above_noise(label, np.atleast_2d(response), delay, margin_db))
    else:
        response, delay = _read(source, sample_rate)
        # A MATLAB array with a single row is read without the row axis.
        response = response[None] if response.ndim == 1 and len(labels) == 1 else response
        if len(response) != len(labels) or response.ndim not in (2, 3):
            raise InputError(
                f"{source}: the array has shape {response.shape}, but must have one row for each of {len(labels)} links"
            )
        for label, own in zip(labels, response, strict=True):
            parts.append(_above_noise(label, np.atleast_2d(own), delay, margin_db))
    link, snapshot, delay, level_db = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Multipath(link, snapshot, delay, level_db)


def _above_noise(
    label: str, response: NDArray[Any], delay: NDArray[np.float64], margin_db: float
) -> tuple[NDArray[Any], ...]:
    """Link, snapshot, delay and level of each sample above the noise in responses [snapshots, samples] of a link."""
    # Squares of small integer types, such as converter samples, would wrap around.
    power = np.abs(response).astype(np.float64) ** 2
    noise = np.median(power, axis=1, keepdims=True) / np.log(2)
    snapshot, sample = np.nonzero(power > noise * 10 ** (margin_db / 10))
    level_db = 10 * np.log10(power[snapshot, sample])
    return np.full(len(sample), label), snapshot.astype(str), delay[sample], level_db


def _read(file: Path, sample_rate: float | None) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Read the impulse responses from a file, and the delays of their samples [s]."""
    with _explained(file):
        arrays = _arrays(file)
    delays = next((arrays.pop(name) for name in list(arrays) if name.lower() in DELAYS), None)
    numeric = {name: array for name, array in arrays.items() if array.dtype.kind in "fciu" and array.ndim}
    if not numeric:
        raise InputError(f"{file}: contains no array of numbers")
    numeric = {name: array for name, array in numeric.items() if array.dtype.kind == "c"} or numeric
    size = max(array.size for array in numeric.values())
    largest = {name: array for name, array in numeric.items() if array.size == size}
    if len(largest) > 1:
        raise InputError(
            f"{file}: contains several arrays of {size} numbers ({shortened(', '.join(largest))}); keep only one "
            f"array, of complex numbers or amplitudes, and name the array of delays {DELAYS[0]!r}"
        )
    ((name, response),) = largest.items()
    if response.dtype.kind != "c" and (response <= 0).all():
        raise InputError(
            f"{file}: {shortened(name)!r} appears to be in decibels; give complex numbers or amplitudes"
        )
    # Remove axes of length 1, such as the axis of a single transmit or receive antenna.
    response = np.squeeze(response) if response.ndim > 3 else response
    if not np.isfinite(response).all():
        raise InputError(f"{file}: {shortened(name)!r} contains values that are not finite")
    count = response.shape[-1]
    if delays is not None:
        delay = np.asarray(delays, dtype=float).reshape(-1)
        if len(delay) != count:
            raise InputError(f"{file}: {len(delay)} delays for {count} samples of {shortened(name)!r}")
    elif sample_rate is None:
        raise InputError(f"{file}: contains no delays ({', '.join(DELAYS)}); give the sample rate [Hz]")
    else:
        delay = np.arange(count) / sample_rate
    if not delay.max(initial=0.0) <= LONGEST:
        raise InputError(
            f"{file}: has a delay of {delay.max():g} s, but the largest allowed delay is {LONGEST:g} s; give delays in "
            "seconds, or the sample rate in Hz"
        )
    return response, delay


def _arrays(file: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays in a file; the keys are their names."""
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
    """Read the datasets at the root of an HDF5 file.

    MATLAB writes the axes in reverse order and complex numbers as pairs of real and imaginary parts.
    """
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
            f"{file}: the arrays take {size / 2**30:.1f} GiB, but at most 4 GiB are allowed; split the file"
        )


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    """Convert an error raised by a library to an `InputError` that names the file."""
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
