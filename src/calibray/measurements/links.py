"""Links and their measured values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import FREQUENCIES
from calibray.measurements.placement import position_columns
from calibray.measurements.source_table import SourceTable
from calibray.support.messages import counted, first_line, shortened
from calibray.tables import Column, Table, hertz, named, short_html, short_text

MIN_DISTANCE: Final = 1e-3
"""Distance below which transmitter and receiver are treated as coincident [m]. The path loss between coincident points
is undefined."""

FEW: Final = 8
"""Smallest number of links from which a trend, noise model or prediction error is estimated."""

MAX_CARRIERS: Final = 32
"""Maximum number of carrier frequencies. A column with more distinct values probably contains a different quantity."""


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Links and their measured path losses. All arrays are read-only copies of the arguments.

    Attributes:
        tx: Transmitter positions [links, 3], [m].
        rx: Receiver positions [links, 3], [m].
        path_loss_db: Measured path losses [links], [dB]; all NaN if the links have no measured values.
        weight: Relative weights [links], [1], greater than 0; 1 by default.
        group: Group label of each link [links]; None if the links have no groups.
        frequency: Carrier frequency of each link [links], [Hz]; None if all links have the carrier of the study.
        limit_db: Largest measurable path loss of each link [links], [dB]; None if unknown.
        censored: Mask [links] of the censored links, whose `path_loss_db` is only a lower bound; None if no link is
            censored.
        table: Rows of the source table, for filters and messages; by default, one empty row per link.

    Raises:
        InputError: The shapes of the arrays disagree. A position is not finite, or a transmitter coincides with its
            receiver. A weight is not positive and finite. A carrier frequency is out of range, or there are too many
            carrier frequencies. A path loss is infinite, or only some links have a path loss.

    Example:
        >>> links = Measurements(tx=[[0, 0, 10]], rx=[[30, 40, 10]], path_loss_db=[85.0])
        >>> len(links), links.distance.tolist()
        (1, [50.0])
        >>> links
        <1 measured link from links>
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    path_loss_db: NDArray[np.float64]
    weight: NDArray[np.float64] = field(default=None)  # type: ignore[assignment]
    group: NDArray[np.str_] | None = None
    frequency: NDArray[np.float64] | None = None
    limit_db: NDArray[np.float64] | None = None
    censored: NDArray[np.bool_] | None = None
    table: SourceTable = field(default=None)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        count = np.shape(self.path_loss_db)[0] if np.ndim(self.path_loss_db) == 1 else 0
        if count < 1:
            raise InputError(
                f"path_loss_db: shape {np.shape(self.path_loss_db)}; it must be [links] with at least one link"
            )
        if self.weight is None:
            object.__setattr__(self, "weight", np.ones(count))
        for name, shape, dtype in (
            ("tx", (count, 3), np.float64),
            ("rx", (count, 3), np.float64),
            ("path_loss_db", (count,), np.float64),
            ("weight", (count,), np.float64),
            ("group", (count,), np.str_),
            ("frequency", (count,), np.float64),
            ("limit_db", (count,), np.float64),
            ("censored", (count,), np.bool_),
        ):
            if getattr(self, name) is not None:
                array = _as_array(name, getattr(self, name), dtype)
                if array.shape != shape:
                    raise InputError(f"{name}: shape {array.shape}; it must be {shape}")
                array.flags.writeable = False
                object.__setattr__(self, name, array)
        if self.table is None:
            object.__setattr__(self, "table", SourceTable(pd.DataFrame(index=range(count)), source="links"))
        if len(self.table) != count:
            raise InputError(f"table: {len(self.table)} rows; it must have one row per link ({count})")
        _check_links(self)

    def __len__(self) -> int:
        return len(self.path_loss_db)

    def __repr__(self) -> str:
        kind = "measured" if self.measured else "unmeasured"
        groups = "" if self.group is None else f" in groups {named(self.group_names)}"
        return short_text(f"<{counted(len(self), f'{kind} link')}{groups} from {self.source}>")

    def _repr_html_(self) -> str:
        return short_html(_summary(self))

    @property
    def frame(self) -> pd.DataFrame:
        """Rows of the source table, with all columns, one per link."""
        return self.table.frame

    @property
    def row(self) -> NDArray[np.int64]:
        """Line number of each link in the source file [links]."""
        return self.table.row

    @property
    def source(self) -> str:
        """Name of the source file."""
        return self.table.source

    @property
    def prepared(self) -> dict[str, int]:
        """Number of table rows affected by each change, for example by a filter or by averaging."""
        return dict(self.table.changes)

    @property
    def measured(self) -> bool:
        """Whether the links have measured values."""
        return bool(np.isfinite(self.path_loss_db[0]))

    @property
    def distance(self) -> NDArray[np.float64]:
        """Straight-line distances from transmitter to receiver [links], [m]."""
        return np.linalg.norm(self.rx - self.tx, axis=1)

    @property
    def group_names(self) -> tuple[str, ...]:
        """Sorted names of the groups; a single empty name if the links have no groups."""
        return ("",) if self.group is None else tuple(map(str, np.unique(self.group)))

    @property
    def group_index(self) -> NDArray[np.int64]:
        """Index of each link's group in `group_names` [links]."""
        if self.group is None:
            return np.zeros(len(self), dtype=np.int64)
        # Every group is among the sorted names, so the insertion point of a group is its index.
        return np.searchsorted(self.group_names, self.group)

    @property
    def carriers(self) -> tuple[tuple[float, NDArray[np.int64]], ...]:
        """Carrier frequencies [Hz], ascending, each with the indices of its links; empty if `frequency` is None."""
        if self.frequency is None:
            return ()
        return tuple(
            (float(carrier), np.flatnonzero(self.frequency == carrier))
            for carrier in np.unique(self.frequency)
        )

    def select(self, mask: ArrayLike) -> Measurements:
        """The links for which a mask [links] is true.

        Raises:
            InputError: The mask is not a Boolean array with one value per link, or selects no link.
        """
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != (len(self),):
            raise InputError(
                f"mask: {chosen.dtype} of shape {chosen.shape}; it must be bool of shape ({len(self)},)"
            )
        if not chosen.any():
            raise InputError(f"{self.source}: the selection contains no links (out of {len(self)})")
        return Measurements(
            tx=self.tx[chosen],
            rx=self.rx[chosen],
            path_loss_db=self.path_loss_db[chosen],
            weight=self.weight[chosen],
            group=None if self.group is None else self.group[chosen],
            frequency=None if self.frequency is None else self.frequency[chosen],
            limit_db=None if self.limit_db is None else self.limit_db[chosen],
            censored=None if self.censored is None else self.censored[chosen],
            table=self.table.select(chosen),
        )

    def where(self, expression: str) -> NDArray[np.bool_]:
        """Mask [links] of the links that pass a filter.

        The filter can use the columns of the source table and `POSITION_COLUMNS`.

        Raises:
            InputError: The filter is not valid (see `SourceTable.where`).
        """
        positions = position_columns(self.tx, self.rx)
        missing = {name: values for name, values in positions.items() if name not in self.table.frame}
        return self.table.assign(**missing).where(expression)

    def held_out(self, holdout: str) -> NDArray[np.bool_]:
        """Mask [links] of the links that a filter holds out: at least one link, but not all.

        Raises:
            InputError: The filter is not valid, or holds out no link or every link.
        """
        held_out = self.where(holdout)
        for part, mask in (("the hold-out", held_out), ("calibration", ~held_out)):
            if not mask.any():
                raise InputError(
                    f"{self.source}: where = {shortened(holdout)!r} leaves no link for {part}; change the filter"
                )
        return held_out


def _as_array(name: str, values: ArrayLike, dtype: type) -> NDArray[np.generic]:
    """Copy values to an array, with NaN in place of masked numbers."""
    try:
        if isinstance(values, np.ma.MaskedArray) and dtype is np.float64:
            return np.where(np.ma.getmaskarray(values), np.nan, np.ma.getdata(values).astype(dtype))
        return np.array(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}: cannot be used ({first_line(error)}); give an array of real numbers"
        ) from None


def _check_links(links: Measurements) -> None:
    """Reject links that no engine can evaluate."""
    checks = (
        (~np.isfinite(links.tx).all(axis=1), "the transmitter's position is not finite; correct it"),
        (~np.isfinite(links.rx).all(axis=1), "the receiver's position is not finite; correct it"),
        (
            links.distance < MIN_DISTANCE,
            "transmitter and receiver are at the same point; correct the positions or remove the row",
        ),
        (~(links.weight > 0), "the weight must be greater than 0; remove the row"),
        (np.isinf(links.weight), "the weight must be finite; correct it"),
        (np.isinf(links.path_loss_db), "the path loss is infinite; remove the row"),
        (
            np.isfinite(links.path_loss_db) != links.measured,
            "only some links have a path loss; give a value for all links or for none",
        ),
    )
    for wrong, fault in checks:
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{links.source}, row {links.row[first]}: {fault} ({wrong.sum()} of {len(links)} rows)"
            )
    if links.frequency is not None:
        _check_carriers(links, links.frequency)


def _check_carriers(links: Measurements, frequency: NDArray[np.float64]) -> None:
    lowest, highest = FREQUENCIES
    if (outside := ~((frequency >= lowest) & (frequency <= highest))).any():
        first = int(np.flatnonzero(outside)[0])
        raise InputError(
            f"{links.source}, row {links.row[first]}: the frequency {frequency[first]:g} must be between {lowest:g} "
            f"and {highest:g} Hz ({outside.sum()} of {len(links)} rows); write 28.5 GHz as 28.5e9"
        )
    if (count := len(np.unique(frequency))) > MAX_CARRIERS:
        raise InputError(
            f"{links.source}: {count} different frequencies, but at most {MAX_CARRIERS} are allowed; give the carrier "
            "frequency of each link, not a frequency within the measured band"
        )


def _summary(links: Measurements) -> Table:
    """Table that summarizes the links: source, number of links and ranges of values."""
    kind = "measured" if links.measured else "unmeasured"
    rows = [("number", f"{len(links):,} {kind}"), ("distance", _range(links.distance, "m"))]
    if links.measured:
        rows.append(("path loss", _range(links.path_loss_db, "dB")))
    if links.group is not None:
        rows.append(("groups", named(links.group_names)))
    if links.carriers:
        rows.append(("carriers", named(hertz(frequency) for frequency, _ in links.carriers)))
    return Table(f"Links from {links.source}", (Column(), Column()), tuple(rows))


def _range(values: NDArray[np.float64], unit: str) -> str:
    return f"{values.min():.4g} to {values.max():.4g} {unit}"
