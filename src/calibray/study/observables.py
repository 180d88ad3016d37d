"""``[observables.NAME]``: a further measured quantity of the links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements.multipath import MARGIN_DB
from calibray.measurements.observables import FLIGHTS, KINDS, PROFILES, SECTORS, Statistic, Wanted
from calibray.support.strict_models import Section, Text

UNITS: Final = {
    # A distance is the time in which light travels it.
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12, "m": 1 / speed_of_light},
    "dB": {"dB": 1.0},
    "rad": {"rad": 1.0, "deg": float(np.pi / 180)},
}
"""Units in which values of each dimension may be given, with their values in SI units."""

Positive = Annotated[float, Field(gt=0)]


class ObservableSection(Section):
    """``[observables.NAME]``: a statistic of the paths of each link, measured in addition to its path loss.

    Attributes:
        kind: What was measured.
        column: Column of the measured values; links without a value lack this observable.
        columns: Columns of the bins of a profile, in place of `column`.
        file: Measured multipath or impulse responses, from which the values are computed, in place of columns.
        id: Column of the links' labels, also in a multipath table.
        where: Row filter that selects the links with this observable; all links if absent.
        compass: Whether azimuths in the file are bearings, clockwise from north.
        sample_rate: Sample rate of impulse responses without delays [Hz].
        margin_db: Level above the noise from which a sample of an impulse response is used [dB].
        unit: Unit of the values: "s", "ms", "us" or "ns"; "dB"; "rad" or "deg".
        std: Standard deviation of a value's error, in the unit; estimated if absent.
        bias: "all" for one unknown bias of all values, or a column of labels for one bias per label; none if absent.
        path: Path of a time of flight: "mean" of all paths, "first" or "strongest".
        dynamic_range_db: Range below the strongest path in which the receiver detects paths [dB]; all paths if absent.
        floor_db: Path gain below which the receiver detects no paths [dB]; no limit if absent.
        window: Longest delay after the first path [s]; no limit if absent.
        bandwidth: Bandwidth of the receiver [Hz]; if absent, the receiver resolves all paths.
        edges: Edges of the bins of a power delay profile, one more than the number of bins: delays after the first
            path [s].
        edges_deg: Edges of angular sectors: azimuths, counter-clockwise from the x axis [deg].
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
                f"path = {self.path!r}: only for a time of flight or a round-trip time; remove it"
            )
        if (self.column is not None) + bool(self.columns) + (self.file is not None) != 1:
            raise InputError(
                "give exactly one of column, the measured values; columns, one for each bin; and file"
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
                    f"{key}: a {self.kind} {'needs' if wanted else 'takes no'} {key}, the ends of its bins"
                )
        edges = np.array(self.edges or self.edges_deg)
        bins = len(edges) - 1 if self.file is not None else max(len(self.columns), 1)
        if self.kind not in PROFILES:
            if len(self.columns) > 1:
                raise InputError(f"columns: a {self.kind} has one column; name it with column")
            return
        if len(edges) != bins + 1 or bins < 1 or not (np.diff(edges) > 0).all():
            raise InputError(
                f"edges: {max(bins, 1)} bin(s) need {max(bins, 1) + 1} increasing ends, not {edges.tolist()}"
            )
        if self.kind in SECTORS and edges[-1] - edges[0] > 360:
            raise InputError(f"edges_deg: span {edges[-1] - edges[0]:g} degrees, must span 360 or fewer")

    @property
    def scale(self) -> float:
        """Value of the unit in SI units."""
        return UNITS[KINDS[self.kind]][self.unit]

    @property
    def statistic(self) -> Statistic:
        """The statistic to compute from the modelled paths."""
        edges = None
        if self.kind in PROFILES:
            low, high = self.edges or np.radians(self.edges_deg).tolist()
            edges = (float(low), float(high))
        return Statistic(
            self.kind, self.path, self.dynamic_range_db, self.floor_db, self.window, self.bandwidth, edges
        )

    def wanted(self, name: str) -> Wanted:
        """The request to an external program."""
        return Wanted(name, self.statistic, self.unit, self.scale)


def by_column(sections: Mapping[str, ObservableSection]) -> dict[str, ObservableSection]:
    """The sections, with each section of several columns split into one per column, named NAME_1, NAME_2, ...

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
                    # Both edges of this bin; the unused key of the two stays empty.
                    "edges": section.edges[number - 1 : number + 1],
                    "edges_deg": section.edges_deg[number - 1 : number + 1],
                })
                for number, column in enumerate(columns, start=1)
            }  # fmt: skip
        if double := sorted(set(parts) & set(split)):
            raise InputError(f"observables: {double[0]!r} is also the name of a bin; choose another")
        split |= parts
    return split
