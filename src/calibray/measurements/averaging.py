"""Averaging: many samples about one place to one value, in linear power, with their spread kept.

Samples along a street fade by several dB within a wavelength, which ray tracing from one point does not tell. What it
tells is the mean power over some tens of wavelengths (Lee, "Estimate of local average power of a mobile radio signal",
IEEE Trans. Veh. Technol. 34(1), 1985: 40 wavelengths, 36 to 50 samples). That mean is taken of powers, not of decibels:
for Rayleigh fading the mean of the decibels lies 2.5 dB too low.

The logarithm of a mean of few samples lies too low as well, by (10 / ln 10) var / (2 n mean^2) to second order (delta
method): 0.2 dB for ten samples of Rayleigh fading, and nothing where there is one path.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements.table_files import SourceTable

Sense = Literal["power", "loss"]
"""Whether more decibels are more power (received power, path gain, RSRP), or less (path loss)."""

PLACE: Final = ("rx_x", "rx_y")


def by_cell(rows: pd.DataFrame, width: float, place: Sequence[str] = PLACE) -> NDArray[np.int64]:
    """Label rows by the cell of a square grid that they lie in.

    Args:
        rows: The samples.
        width: Width of a cell [m].
        place: Columns of the coordinates [m].

    Returns:
        A number for every row [rows]: equal where the cells are.

    Raises:
        InputError: A column is missing or holds no number, or the width is not greater than 0.

    Example:
        >>> by_cell(pd.DataFrame({"rx_x": [0.1, 0.9, 1.2], "rx_y": [0.0, 0.5, 0.5]}), 1.0)
        array([0, 0, 1])
    """
    positions = _columns(rows, place)
    cells = np.floor(positions / _positive("width", width)).astype(np.int64)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)


def by_distance(rows: pd.DataFrame, length: float, place: Sequence[str] = PLACE) -> NDArray[np.int64]:
    """Label rows by the stretch of the way that they lie on, in the rows' order.

    Args:
        rows: The samples of one drive, in the order in which they were taken.
        length: Length of a stretch [m].
        place: Columns of the coordinates [m].

    Returns:
        Number of the stretch, from 0 [rows].

    Raises:
        InputError: A column is missing or holds no number, or the length is not greater than 0.

    Example:
        >>> by_distance(pd.DataFrame({"rx_x": [0.0, 3.0, 3.0, 3.0], "rx_y": [0.0, 0.0, 1.0, 4.0]}), 4.0)
        array([0, 0, 1, 1])
    """
    positions = _columns(rows, place)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.floor(np.cumsum([0.0, *steps]) / _positive("length", length)).astype(np.int64)[: len(rows)]


def by_time(rows: pd.DataFrame, seconds: float, time: str) -> NDArray[np.int64]:
    """Label rows by the window of time that they were taken in.

    Args:
        rows: The samples.
        seconds: Length of a window [s].
        time: Column of times: seconds, or texts in ISO 8601.

    Returns:
        Number of the window, from 0 at the first time [rows].

    Raises:
        InputError: There is no such column, a time cannot be read, or the length is not greater than 0.

    Example:
        >>> by_time(pd.DataFrame({"t": [10.0, 10.9, 11.2]}), 1.0, "t")
        array([0, 0, 1])
    """
    table = SourceTable(rows, source="samples")
    if pd.api.types.is_numeric_dtype(table.column(time)):
        elapsed = table.numbers(time)
    else:
        try:
            when = pd.to_datetime(table.column(time), utc=True, format="ISO8601")
        except ValueError as error:
            raise InputError(
                f"samples, column {time!r}: a time cannot be read ({error}); give ISO 8601"
            ) from None
        if when.isna().any():
            raise InputError(f"samples, column {time!r}: a time is missing; leave the row out")
        elapsed = ((when - when.min()) / pd.Timedelta(seconds=1)).to_numpy(dtype=float)
    return np.floor((elapsed - elapsed.min()) / _positive("seconds", seconds)).astype(np.int64)


def averaged(
    rows: pd.DataFrame,
    value: str,
    label: NDArray[np.int64],
    sense: Sense,
    keep: Sequence[str] = (),
    place: Sequence[str] = ("rx_x", "rx_y", "rx_z"),
) -> pd.DataFrame:
    """Average the samples of one label in linear power.

    Args:
        rows: The samples.
        value: Column of the values [dB] or [dBm].
        label: Label of every row [rows], as the functions above give it.
        sense: Whether the values are powers or losses.
        keep: Columns that no average may cross, such as the transmitter or the carrier: one row for each
            combination.
        place: Columns of coordinates [m], averaged as they are; those that the rows lack are passed by.

    Returns:
        One row a label and combination, in the order of their first sample: the kept columns, the mean coordinates,
        the value [dB], its `std_db`, the standard deviation of the samples in decibels (NaN of one sample), their
        `count`, and `low_db`, by how much the logarithm of their mean lies too low on average (0 of one sample).

    Raises:
        InputError: There is no row, a column is missing or holds no number, or there are not as many labels as rows.

    Example:
        >>> rows = pd.DataFrame({"rx_x": [0.0, 1.0], "rx_y": [0.0, 0.0], "power": [-80.0, -90.0]})
        >>> averaged(rows, "power", np.array([0, 0]), "power").round(3).to_dict("records")
        [{'rx_x': 0.5, 'rx_y': 0.0, 'power': -82.596, 'std_db': 7.071, 'count': 2, 'low_db': 1.454}]
    """
    table = SourceTable(rows, source="samples")
    if not len(rows) or np.shape(label) != (len(rows),):
        raise InputError(
            f"samples: {np.shape(label)} labels for {len(rows)} rows; give one for each, at least one"
        )
    levels = table.numbers(value) * {"power": 1.0, "loss": -1.0}[sense]
    coordinates = [name for name in place if name in rows]
    parts = {name: table.column(name).to_numpy() for name in keep}
    samples = pd.DataFrame({**parts, **{name: table.numbers(name) for name in coordinates}})
    # The strongest sample is set to 1 so that no power is lost below the smallest number.
    samples["linear"] = 10 ** ((levels - levels.max()) / 10)
    samples["level"] = levels
    samples["label"] = label
    groups = samples.groupby([*keep, "label"], sort=False, dropna=False)
    mean: pd.DataFrame = groups[[*coordinates, "linear"]].mean()  # type: ignore[assignment]
    linear, count = mean.pop("linear"), groups.size()
    power = 10 * np.log10(linear) + levels.max()
    mean[value] = power if sense == "power" else -power
    mean["std_db"] = groups["level"].std()
    mean["count"] = count
    mean["low_db"] = (5 / np.log(10) * groups["linear"].var() / (count * linear**2)).fillna(0.0)
    return mean.reset_index().drop(columns="label")


def _columns(rows: pd.DataFrame, place: Sequence[str]) -> NDArray[np.float64]:
    table = SourceTable(rows, source="samples")
    return np.stack([table.numbers(name) for name in place], axis=1)


def _positive(name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} = {value!r}: must be a finite number greater than 0")
    return float(value)
