"""The record of links and their measured values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.measurements.summary import summary
from calibray.measurements.table_files import SourceTable
from calibray.support.messages import shortened
from calibray.tables import display as glance
from calibray.tables.display import named

COINCIDENCE: Final = 1e-3
"""The distance [m] below which transmitter and receiver stand at the same place."""

FREQUENCIES: Final = (1e6, 1e12)
"""The carrier frequencies [Hz] taken as meant; one outside was probably given in another unit."""

MAX_CARRIERS: Final = 32
"""The number of carriers beyond which a column of frequencies is taken for another quantity."""


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Links, each with one measured path loss; arrays are copies and read-only.

    Attributes:
        tx: Transmitter positions [links, 3], [m].
        rx: Receiver positions [links, 3], [m].
        path_loss_db: Measured path losses [links], [dB]; all NaN for links that were not measured.
        weight: Relative weights [links], [1], greater than 0; 1 unless given.
        group: Labels [links] of the group each link belongs to, or None.
        frequency: Carrier of each link [links], [Hz], or None where all have the study's.
        limit_db: Path loss [links], [dB], beyond which a link could not have been measured, or None where none is
            known.
        censored: Mask [links] of the links below the noise floor, whose path loss is at least `path_loss_db`; None if
            no link is censored.
        table: The rows of the source table, for filters and messages; one empty row per link unless given.
        prepared: What was left out, averaged or moved before the rows were links, and how many of them.

    Raises:
        InputError: Shapes disagree, a position is not finite, a transmitter and its receiver coincide, a
            weight is not positive, a carrier or their number is implausible, or only some path losses are finite.

    Example:
        >>> links = Measurements(tx=[[0, 0, 10]], rx=[[30, 40, 10]], path_loss_db=[85.0])
        >>> len(links), links.distance.tolist()
        (1, [50.0])
        >>> links
        <1 measured links from links>
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
    prepared: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = np.shape(self.path_loss_db)[:1][0] if np.ndim(self.path_loss_db) == 1 else -1
        if count < 1:
            raise InputError(
                f"path_loss_db: shape {np.shape(self.path_loss_db)}, must be [links], one or more"
            )
        set_field = object.__setattr__
        set_field(self, "tx", _array("tx", self.tx, (count, 3)))
        set_field(self, "rx", _array("rx", self.rx, (count, 3)))
        set_field(self, "path_loss_db", _array("path_loss_db", self.path_loss_db, (count,)))
        weight = np.ones(count) if self.weight is None else self.weight
        set_field(self, "weight", _array("weight", weight, (count,)))
        if self.group is not None:
            set_field(self, "group", _array("group", self.group, (count,), np.str_))
        if self.frequency is not None:
            set_field(self, "frequency", _array("frequency", self.frequency, (count,)))
        if self.limit_db is not None:
            set_field(self, "limit_db", _array("limit_db", self.limit_db, (count,)))
        if self.censored is not None:
            set_field(self, "censored", _array("censored", self.censored, (count,), np.bool_))
        if self.table is None:
            set_field(self, "table", SourceTable(pd.DataFrame(index=range(count)), source="links"))
        if len(self.table) != count:
            raise InputError(f"table: {len(self.table)} rows, must be {count}, one per link")
        _check_links(self)

    def __len__(self) -> int:
        return len(self.path_loss_db)

    def __repr__(self) -> str:
        kind = "measured" if self.measured else "unmeasured"
        groups = "" if self.group is None else f" in groups {named(self.group_names)}"
        return glance.text(f"<{len(self)} {kind} links{groups} from {self.source}>")

    def _repr_html_(self) -> str:
        return glance.html(*summary(self))

    @property
    def frame(self) -> pd.DataFrame:
        """The rows of the source table, one per link, with all its columns."""
        return self.table.frame

    @property
    def row(self) -> NDArray[np.int64]:
        """The line [links] of each link in the source file."""
        return self.table.row

    @property
    def source(self) -> str:
        """The source file."""
        return self.table.source

    @property
    def measured(self) -> bool:
        """Whether the links carry measured values."""
        return bool(np.isfinite(self.path_loss_db[0]))

    @property
    def distance(self) -> NDArray[np.float64]:
        """The straight distance [links], [m] from transmitter to receiver."""
        return np.linalg.norm(self.rx - self.tx, axis=1)

    @property
    def group_names(self) -> tuple[str, ...]:
        """The groups, sorted; one nameless group when there are none."""
        return ("",) if self.group is None else tuple(map(str, np.unique(self.group)))

    @property
    def group_index(self) -> NDArray[np.int64]:
        """The place [links] of each link's group in `group_names`."""
        if self.group is None:
            return np.zeros(len(self), dtype=np.int64)
        return np.searchsorted(self.group_names, self.group)

    @property
    def carriers(self) -> tuple[tuple[float, NDArray[np.int64]], ...]:
        """The carriers [Hz], ascending, each with the links measured there; none where all have the study's."""
        if self.frequency is None:
            return ()
        return tuple(
            (float(each), np.flatnonzero(self.frequency == each)) for each in np.unique(self.frequency)
        )

    def select(self, mask: ArrayLike) -> Measurements:
        """The links where a mask [links] is true.

        Raises:
            InputError: The mask is not one truth value per link, or selects none.
        """
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != (len(self),):
            raise InputError(
                f"mask: {chosen.dtype} of shape {chosen.shape}, must be bool of shape ({len(self)},)"
            )
        if not chosen.any():
            raise InputError(f"{self.source}: the selection leaves none of {len(self)} links")
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
            prepared=self.prepared,
        )

    def where(self, expression: str) -> NDArray[np.bool_]:
        """The mask [links] of the links that pass a filter over the source table's columns.

        Raises:
            InputError: The filter is not valid (see `SourceTable.where`).
        """
        return self.table.where(expression)

    def split(self, holdout: str) -> tuple[Measurements, Measurements]:
        """Part the links into those to calibrate on and those to judge by.

        Args:
            holdout: Filter over the source table's columns; the links that pass are held out.

        Returns:
            The links to calibrate on, and those held out.

        Raises:
            InputError: The filter is not valid, or one of the parts would be empty.
        """
        held_out = self.held_out(holdout)
        return self.select(~held_out), self.select(held_out)

    def held_out(self, holdout: str) -> NDArray[np.bool_]:
        """The mask [links] of the links that a filter holds out.

        Args:
            holdout: Filter over the source table's columns.

        Returns:
            The mask [links], true for some links and not for all.

        Raises:
            InputError: The filter is not valid, or one of the parts would be empty.
        """
        held_out = self.where(holdout)
        for part, mask in (("the hold-out", held_out), ("calibration", ~held_out)):
            if not mask.any():
                raise InputError(
                    f"{self.source}: where = {shortened(holdout)!r} leaves no link for {part}; change the filter"
                )
        return held_out


def _array(name: str, values: ArrayLike, shape: tuple[int, ...], dtype: type = np.float64) -> NDArray:
    """A read-only copy of values, of a given shape."""
    array = np.array(values, dtype=dtype)
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}, must be {shape}")
    array.flags.writeable = False
    return array


def _check_links(links: Measurements) -> None:
    """Refuse links that no engine could evaluate."""
    checks = (
        (~np.isfinite(links.tx).all(axis=1), "the transmitter's position is not finite; correct it"),
        (~np.isfinite(links.rx).all(axis=1), "the receiver's position is not finite; correct it"),
        (
            links.distance < COINCIDENCE,
            "transmitter and receiver stand at the same place; move or remove one",
        ),
        (~(links.weight > 0), "the weight must be greater than 0; leave the row out"),
        (np.isinf(links.weight), "the weight must be finite; correct it"),
        (np.isinf(links.path_loss_db), "the path loss is infinite; leave the row out"),
        (
            np.isfinite(links.path_loss_db) != links.measured,
            "only some links have a path loss; give all or none",
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
    if (strange := ~((frequency >= lowest) & (frequency <= highest))).any():
        first = int(np.flatnonzero(strange)[0])
        raise InputError(
            f"{links.source}, row {links.row[first]}: the frequency {frequency[first]:g} must lie in {lowest:g} to "
            f"{highest:g} Hz ({strange.sum()} of {len(links)} rows); 28.5 GHz is written 28.5e9"
        )
    if (count := len(np.unique(frequency))) > MAX_CARRIERS:
        raise InputError(
            f"{links.source}: {count} different frequencies, must be at most {MAX_CARRIERS}; give the carrier of each "
            "link, not what was measured around it"
        )
