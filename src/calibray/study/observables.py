"""``[observables.NAME]``: a further measured quantity of the links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import SourceTable
from calibray.measurements.multipath import MARGIN_DB
from calibray.measurements.observables import FLIGHTS, KINDS, PROFILES, SECTORS, Statistic, Wanted
from calibray.support.strict_models import Section, Text

UNITS: Final = {
    # A distance stands for the time that light takes to travel it.
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12, "m": 1 / speed_of_light},
    "dB": {"dB": 1.0},
    "rad": {"rad": 1.0, "deg": float(np.pi / 180)},
}
"""Accepted units of each dimension, with their values in SI units."""

FILTERED: Final = "{column} [{name}]"
"""Name of the column with the values of an observable that pass the filter of this observable."""

Positive = Annotated[float, Field(gt=0)]


class ObservableSection(Section):
    """``[observables.NAME]``: a statistic of each link's paths, measured in addition to path loss.

    Attributes:
        kind: The measured quantity.
        column: Column of the measured values. Links without a value do not have this observable.
        columns: Columns of a profile, one per bin; an alternative to `column`.
        file: File of measured multipath components or impulse responses from which the values are computed; an
            alternative to columns.
        id: Column of link labels, in the table of links and in a multipath table.
        where: Row filter that selects the links with this observable. If absent, all links have the observable.
        compass: Whether azimuths in the file are compass bearings, measured clockwise from north.
        sample_rate: Sample rate [Hz] of impulse responses that are stored without delays.
        margin_db: Margin [dB] by which a sample of an impulse response must exceed the noise to be used.
        unit: Unit of the values: "s", "ms", "us", "ns", "ps" or "m" for times ("m" is the distance travelled at the
            speed of light), "dB" for levels, "rad" or "deg" for angles.
        std: Standard deviation of the error of a value, in `unit`; estimated if absent.
        bias: "all" for one unknown bias of all values, or a column of labels for one bias per label. If absent, there
            is no bias.
        path: Path that determines a time of flight: "mean" (the mean over all paths), "first" or "strongest".
        dynamic_range_db: Power range [dB] below the strongest path within which the receiver detects paths. If absent,
            the receiver detects all paths.
        floor_db: Path gain [dB] below which the receiver detects no paths; no limit if absent.
        window: Longest delay [s] after the first path; no limit if absent.
        bandwidth: Bandwidth of the receiver [Hz]. If absent, the receiver resolves all paths.
        edges: Bin edges of a power delay profile, as delays [s] after the first path. N bins have N + 1 edges.
        edges_deg: Edges of angular sectors, as azimuths [deg] measured counter-clockwise from the x axis.
    """

    kind: Literal[
        "rms_delay_spread",
        "mean_excess_delay",
        "time_of_flight",
        "round_trip_time",
        "k_factor",
        "azimuth_spread_departure",
        "azimuth_spread_arrival",
        "elevation_spread_departure",
        "elevation_spread_arrival",
        "power_delay_profile",
        "azimuth_power_departure",
        "azimuth_power_arrival",
    ]
    column: Text | None = None
    columns: tuple[Text, ...] = ()
    file: Text | None = None
    id: Text = "id"
    where: Text | None = None
    compass: bool = False
    sample_rate: Positive | None = None
    margin_db: Positive = MARGIN_DB
    unit: Text
    std: Positive | None = None
    bias: Text | None = None
    path: Literal["mean", "first", "strongest"] = "mean"
    dynamic_range_db: Positive | None = None
    floor_db: Annotated[float, Field(lt=0)] | None = None
    window: Positive | None = None
    bandwidth: Positive | None = None
    edges: tuple[float, ...] = ()
    edges_deg: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        allowed = UNITS[KINDS[self.kind]]
        if self.unit not in allowed:
            raise InputError(f"unit = {self.unit!r}: a {self.kind} must be given in {' or '.join(allowed)}")
        if self.path != "mean" and self.kind not in FLIGHTS:
            raise InputError(
                f"path = {self.path!r}: applies only to a time of flight or a round-trip time; remove the key"
            )
        if (self.column is not None) + bool(self.columns) + (self.file is not None) != 1:
            raise InputError(
                "give exactly one of column (for the measured values), columns (one per bin) and file"
            )
        self._check_bins()
        return self

    def _check_bins(self) -> None:
        needed = {
            "edges": self.kind in PROFILES and self.kind not in SECTORS,
            "edges_deg": self.kind in SECTORS,
        }
        for key, wanted in needed.items():
            if bool(getattr(self, key)) != wanted:
                raise InputError(
                    f"{key}: the kind {self.kind!r} "
                    f"{'needs this key, the edges of the bins' if wanted else 'does not use this key; remove it'}"
                )
        edges = np.array(self.edges or self.edges_deg)
        bins = len(edges) - 1 if self.file is not None else max(len(self.columns), 1)
        if self.kind not in PROFILES:
            if len(self.columns) > 1:
                raise InputError(f"columns: a {self.kind} has only one column; use the key column instead")
            return
        if len(edges) != bins + 1 or bins < 1 or not (np.diff(edges) > 0).all():
            raise InputError(
                f"edges: {edges.tolist()}, must be {max(bins, 1) + 1} increasing numbers, one more than there are bins"
            )
        if self.kind in SECTORS and edges[-1] - edges[0] > 360:
            raise InputError(f"edges_deg: span {edges[-1] - edges[0]:g} degrees, must span at most 360")

    @property
    def scale(self) -> float:
        """Value of one unit in SI units."""
        return UNITS[KINDS[self.kind]][self.unit]

    @property
    def statistic(self) -> Statistic:
        """The statistic that is computed from the modelled paths."""
        edges = None
        if self.kind in PROFILES:
            low, high = self.edges or np.radians(self.edges_deg).tolist()
            edges = (float(low), float(high))
        return Statistic(
            self.kind, self.path, self.dynamic_range_db, self.floor_db, self.window, self.bandwidth, edges
        )

    def wanted(self, name: str) -> Wanted:
        """The request for this observable that an external program receives."""
        return Wanted(name, self.statistic, self.unit, self.scale)


def by_column(sections: Mapping[str, ObservableSection]) -> dict[str, ObservableSection]:
    """The sections. A section with several bins is split into one section per bin, named NAME_1, NAME_2, ...

    Raises:
        InputError: Two sections have the same name.
    """
    split: dict[str, ObservableSection] = {}
    for name, section in sections.items():
        if len(section.columns) == 1:
            section = section.model_copy(update={"column": section.columns[0], "columns": ()})
        parts = {name: section}
        bins = max(len(section.edges), len(section.edges_deg)) - 1
        if bins > 1:
            columns = section.columns or (None,) * bins
            parts = {
                f"{name}_{number}": section.model_copy(update={
                    "column": column, "columns": (),
                    # These are the two edges of the bin; the key that does not apply to this kind stays empty.
                    "edges": section.edges[number - 1 : number + 1],
                    "edges_deg": section.edges_deg[number - 1 : number + 1],
                })
                for number, column in enumerate(columns, start=1)
            }  # fmt: skip
        if double := sorted(set(parts) & set(split)):
            raise InputError(f"observables: {double[0]!r} is also the name of a bin; choose another name")
        split |= parts
    return split


def filtered_values(section: ObservableSection, table: SourceTable) -> NDArray[np.float64] | None:
    """Values of an observable [rows] in the unit of the study; NaN for rows that the filter of the observable excludes.

    The result is None if the filter cannot be applied to the rows, for example because one of its columns is added
    later.

    Raises:
        InputError: The column of values cannot be used.
    """
    values = table.numbers(str(section.column), gaps=True)
    try:
        return np.where(table.where(str(section.where)), values, np.nan)
    except InputError:
        return None
