"""Draft of a study's ``[links]`` from a table of links, with every assumption and its reason."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from calibray.coordinates import find_projection
from calibray.errors import InputError
from calibray.measurements import (
    TRACK_COLUMNS,
    Measurements,
    Preparation,
    Track,
    column_names,
    read_table,
    select_rows,
    transmitter_columns,
)
from calibray.measurements.column_names import PositionColumns, ValueColumn
from calibray.measurements.selection import comparison, find_codes, without_codes
from calibray.measurements.transmitter_columns import find_powers
from calibray.scenes import read_frame
from calibray.scenes.checks import SceneSurfaces
from calibray.study.content import BUNDLED, VERSION
from calibray.study.link_checks import CELL_SHARE, FAR
from calibray.study.study import Study

RECEIVER_HEIGHT: Final = 1.5
"""Height of a receiver without a column of heights [m]: a phone in the hand."""

TRANSMITTER_HEIGHT: Final = 10.0
"""Height of a transmitter without a column of heights [m]: a small cell on a mast."""

AVERAGING_WAVELENGTHS: Final = 40
"""Width of the cells over which fading is averaged (Lee 1985; see `calibray.measurements.averaging`)."""

PLACE_SAMPLES: Final = 20
"""Median number of samples at one position above which samples are averaged by position: a stationary scan. The
logarithm of the mean of 20 samples of Rayleigh fading is biased by 0.1 dB."""

LEVEL_GROUND: Final = 0.5
"""Largest height of the ground that counts as z = 0 [m]."""

DISTANCE_TOLERANCE: Final = 0.05
"""Largest median difference between a table's distances and its positions [m]."""


@dataclass(frozen=True)
class Assumption:
    """One assumption of a draft.

    Attributes:
        what: Key of the study that it concerns.
        value: The assumed value.
        reason: The reason.
    """

    what: str
    value: str
    reason: str


@dataclass(frozen=True)
class Given:
    """What a user states besides the scene and the table of links.

    Attributes:
        transmitters: Table of the transmitters' positions, unless the links have them.
        track: GPX track with the position of each row, unless the links contain it.
        antennas: Folder of MSI files named after the transmitters' antennas.
        tx: Transmitter position (x, y, z) [m] in the scene's frame, unless a table contains it.
        frequency: Carrier frequency [Hz], unless the links have it.
    """

    transmitters: Path | None = None
    track: Path | None = None
    antennas: Path | None = None
    tx: Sequence[float] | None = None
    frequency: float | None = None


@dataclass
class LinksDraft:
    """The draft of ``[links]``. Each method adds the keys of its subject and records its assumptions.

    Attributes:
        scene: Mitsuba XML file, or `sionna:NAME`.
        links: The table of links.
        target: The future study file.
        given: What the user states.
        section: The keys of ``[links]``.
        assumptions: The assumptions.
        frequency: The study's carrier [Hz].
        groups: The columns that group the offset.
        observables: The sections of ``[observables]``.
    """

    scene: str
    links: Path
    target: Path
    given: Given
    section: dict[str, Any] = field(default_factory=dict)
    assumptions: list[Assumption] = field(default_factory=list)
    frequency: float = 0.0
    groups: list[str] = field(default_factory=list)
    observables: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._transmitter_key = ""
        self._table = read_table(self.links)
        self._sites = None if self.given.transmitters is None else read_table(self.given.transmitters)
        self.section["file"] = self.relative(self.links)
        self._add_track()
        self._add_transmitters()
        self.frequency = self._frequency()
        rx, tx = self._projected(*self._position_columns())
        value = self._value()
        self._add_positions(tx, rx)
        self.section |= {"value": value.column, "quantity": value.quantity}
        if value.quantity == "received_power":
            self.section |= self._powers(value)
        self.groups = self._offset_groups(value)
        self._add_noise_floor(value)
        self._add_averaging(rx)
        self._add_heights(tx, rx)
        self._add_flight_times()

    @cached_property
    def overhead(self) -> SceneSurfaces:
        """The ground below and the roofs above positions in the scene."""
        return SceneSurfaces.read(self.scene)

    @property
    def scene_file(self) -> str:
        """The scene, relative to the study file's folder."""
        return self.scene if self.scene.startswith(BUNDLED) else self.relative(Path(self.scene))

    @property
    def transmitter_rows(self) -> pd.DataFrame:
        """The table of transmitters, its columns named as in the links; the links if there is none."""
        if self._sites is None:
            return self._table.frame
        return self._sites.frame.rename(columns=self._name_in_links)

    def assume(self, what: str, value: object, reason: str) -> None:
        """Record an assumption."""
        self.assumptions.append(Assumption(what, str(value), reason))

    def measurements(self) -> Measurements:
        """The links by the keys drafted so far."""
        content = {
            "version": VERSION,
            "scene": {"file": self.scene_file, "frequency": 1e9},
            "links": self.section,
            "parameters": {"any.relative_permittivity": {"bounds": [1.5, 12.0]}},
            "offset": {},
        }
        return Study.from_content(content, self.target).measurements()

    def relative(self, file: Path) -> str:
        """A file, relative to the study file's folder."""
        return Path(os.path.relpath(file, self.target.absolute().parent)).as_posix()

    def _columns(self) -> str:
        return ", ".join(map(str, self._table.frame))

    def _add_track(self) -> None:
        """Positions from a track, by the time of each row."""
        if self.given.track is None:
            return
        name = column_names.find_time(self._table.frame)
        if name is None:
            raise InputError(
                f"{self.links}: no column of times, which {self.given.track} needs ({self._columns()}); name it time"
            )
        self.section["track"] = {"file": self.relative(self.given.track), "time": name}
        rows = len(self._table)
        self._table = select_rows(self._table, Preparation(track=Track(str(self.given.track), name)))
        reason = f"given; it covers {len(self._table)} of {rows} rows"
        self.assume("links.track", f"{self.given.track.name} by {name}", reason)

    def _add_transmitters(self) -> None:
        """Transmitters from their table, by a common column or by one column of values per transmitter."""
        if self._sites is None or self.given.transmitters is None:
            return
        self.section["transmitters"] = self.relative(self.given.transmitters)
        shared = transmitter_columns.find_shared_key(self._table.frame, self._sites.frame)
        key = transmitter_columns.find_naming_key(self._table.frame, self._sites.frame)
        key = key if shared is None else (shared, shared)
        if key is not None:
            name, of_table = key
            reason = f"its values are in column {of_table} of {self.given.transmitters.name}"
            reason = reason if shared is None else "a column of both tables with common values"
            self.section["transmitter"] = self._transmitter_key = name
            self.assume("links.transmitter", name, reason)
            self._leave_out_unknown_transmitters(name, self._sites.frame[of_table])
            return
        name = transmitter_columns.find_transmitter_names(self._sites.frame)
        columns = transmitter_columns.find_wide_columns(self._table.frame, self._sites.labels(name).tolist())
        if not columns:
            raise InputError(
                f"{self.links}: no column names the transmitter of a row, and no columns are named like the "
                f"transmitters of {self.given.transmitters}; give both tables one column of the same name"
            )
        self.section |= {"wide": columns, "transmitter": name}
        self._transmitter_key = name
        reason = f"named as in {self.given.transmitters.name}"
        if unknown := transmitter_columns.find_unknown_wide_columns(self._table.frame, columns):
            reason += f", which lacks the transmitters of {', '.join(unknown)}: left out"
        self.assume("links.wide", ", ".join(columns), reason)
        codes = find_codes(self._table.frame[list(columns)].apply(pd.to_numeric, errors="coerce"))
        self._assume_codes(codes, ", ".join(columns))
        steps = Preparation(wide=columns, transmitter=name)
        self._table = select_rows(self._table, steps, transmitter_columns.name_melted_values(columns))

    def _leave_out_unknown_transmitters(self, key: str, names_of_sites: pd.Series) -> None:
        """Draft a filter for rows whose transmitter the table of transmitters lacks."""
        column, compared = self._table.frame[key], comparison(names_of_sites)
        lacking = ~np.isin(compared(column), compared(names_of_sites))
        if not lacking.any():
            return
        names = column[lacking].dropna().unique().tolist()
        # The known ones: rows without a name are left out too.
        self._add_filter(f"`{key}` in {column[~lacking].unique().tolist()}")
        named = ", ".join(map(str, names[:10])) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
        source = (
            "the table of transmitters" if self.given.transmitters is None else self.given.transmitters.name
        )
        reason = f"{source} lacks {named or 'rows without a name'}: {lacking.sum()} rows are left out"
        self.assume("links.where", self.section["where"], reason)
        self._table = self._table.select(~lacking)

    def _add_filter(self, condition: str) -> None:
        """Add a condition to the row filter."""
        where = self.section.get("where")
        self.section["where"] = condition if where is None else f"({where}) and {condition}"

    def _assume_codes(self, codes: Sequence[float], columns: str) -> None:
        """Record numbers that mean that nothing was measured."""
        if codes:
            self.section["missing"] = list(codes)
            listed = ", ".join(f"{code:g}" for code in codes)
            self.assume("links.missing", listed, f"far from all other values of {columns}: not measured")

    def _frequency(self) -> float:
        if self.given.frequency is not None:
            self.assume("scene.frequency", f"{self.given.frequency:g} Hz", "given")
            return float(self.given.frequency)
        column = column_names.find_frequency(self._table.frame)
        if column is None:
            raise InputError(
                f"{self.links}: no column of carrier frequencies; give --frequency, for instance --frequency 3.5e9"
            )
        name, carriers = column
        median = float(np.median(carriers))
        if np.ptp(carriers) < 0.01 * median:
            self.assume("scene.frequency", f"{median:g} Hz", f"median of column {name}")
            return median
        if np.array_equal(carriers, self._table.frame[name]):
            self.section["frequency"] = name
            self.assume("links.frequency", name, f"{len(np.unique(carriers))} carriers in Hz")
            return median
        raise InputError(
            f"{self.links}: column {name!r} has several carriers, not in Hz; give it in Hz, or --frequency and a table "
            "of one carrier"
        )

    def _position_columns(self) -> tuple[PositionColumns, PositionColumns | None]:
        """Columns of the receivers' and the transmitters' positions; None if the transmitter has no columns."""
        if self.given.track is None:
            rx = column_names.find_position(self._table.frame, "rx", unnamed=True)
        else:
            rx = PositionColumns("geographic", *TRACK_COLUMNS, height=None)
        if rx is None:
            raise InputError(
                f"{self.links}: no columns of receiver positions ({self._columns()}); name them rx_x, rx_y, rx_z [m], "
                "or longitude and latitude"
                f"{column_names.text_instead(self._table.frame, 'x', 'y', 'longitude', 'latitude')}"
            )
        if self.given.tx is not None:
            return rx, None
        if self._sites is None:
            return rx, column_names.find_position(self._table.frame, "tx", unnamed=False)
        tx = column_names.find_position(self._sites.frame, "tx", unnamed=True)
        if tx is None:
            columns = ", ".join(map(str, self._sites.frame))
            raise InputError(f"{self.given.transmitters}: no columns of positions ({columns})")
        x, y, height = (self._name_in_links(name) for name in (tx.x, tx.y, tx.height))
        return rx, PositionColumns(tx.position, str(x), str(y), height)

    def _projected(
        self, rx: PositionColumns, tx: PositionColumns | None
    ) -> tuple[PositionColumns, PositionColumns | None]:
        """The columns; their numbers are on the globe if they are far from the scene, but on it in a projection."""
        frame = read_frame(self.scene) if rx.position == "scene" else None
        if frame is None or (tx is not None and tx.position != "scene"):
            return rx, tx
        x, y = (pd.to_numeric(self._table.frame[name], errors="coerce").dropna() for name in (rx.x, rx.y))
        low, high = self.overhead.bounds[:2], self.overhead.bounds[3:5]
        centre, reach = (low + high) / 2, FAR * float(np.max(high - low))
        if np.hypot(x.median() - centre[0], y.median() - centre[1]) < reach:
            return rx, tx
        crs = find_projection(x.to_numpy(), y.to_numpy(), frame, low.tolist(), high.tolist())
        if crs is None:
            return rx, tx
        self.section["crs"] = crs
        self.assume("links.crs", crs, f"{rx.x} and {rx.y} are on the scene in this projection")
        return replace(rx, position="geographic"), tx and replace(tx, position="geographic")

    def _name_in_links(self, column: str | None) -> str | None:
        """A column of transmitters is renamed if the links have a column of the same name."""
        taken = column in self._table.frame and column != self._transmitter_key
        return f"{self._transmitter_key}_{column}" if taken else column

    def _add_positions(self, tx: PositionColumns | None, rx: PositionColumns) -> None:
        self.section["tx"] = self._transmitter(tx, rx)
        self.section["rx"] = [rx.x, rx.y, RECEIVER_HEIGHT if rx.height is None else rx.height]
        unit = "degrees" if rx.position == "geographic" else "metres"
        unit = "metres of a projection" if "crs" in self.section else unit
        self._add_position_unit(tx, rx)
        reason = f"columns named as {unit}" if "position_unit" not in self.section else "by their names"
        reason += "" if rx.height else f"; no height: {RECEIVER_HEIGHT} m"
        self.assume("links.rx", ", ".join(map(str, self.section["rx"])), reason)
        if rx.position != "geographic":
            return
        self.section["position"] = "geographic"
        if read_frame(self.scene) is None:
            raise InputError(
                f"{self.links}: positions are in degrees, but {self.scene} has no position on the globe; make the "
                f"scene with `calibray scene`, or write a study yourself with scene.origin"
            )
        reason = f"{unit}; {Path(self.scene).name} has the scene's position on the globe"
        self.assume("links.position", "geographic", reason)

    def _add_position_unit(self, tx: PositionColumns | None, rx: PositionColumns) -> None:
        """The unit of the position columns, if their names state a unit other than the metre."""
        ends = [end for end in (tx, rx) if end is not None]
        if any(end.position == "geographic" for end in ends):
            names = [end.height for end in ends if end.height is not None]
        else:
            names = [name for end in ends for name in (end.x, end.y, end.height) if name is not None]
        try:
            unit = column_names.find_length_unit(names)
        except InputError as error:
            raise InputError(f"{self.links}: {error}") from None
        if unit == 1:
            return
        if rx.position == "geographic":
            raise InputError(
                f"{self.links}: heights are not in metres ({', '.join(names)}); give them in metres"
            )
        self.section["position_unit"] = unit
        self.assume("links.position_unit", f"{unit:g} m", f"named by the columns {', '.join(names)}")

    def _transmitter(self, tx: PositionColumns | None, rx: PositionColumns) -> list[float | str]:
        if tx is not None:
            if tx.position != rx.position:
                raise InputError(
                    f"{self.links}: the transmitter's position ({tx.x}, {tx.y}) is in other units than the receiver's "
                    f"({rx.x}, {rx.y}); give both in degrees, or both in metres"
                )
            position = [tx.x, tx.y, TRANSMITTER_HEIGHT if tx.height is None else tx.height]
            reason = (
                "columns of these names"
                if self.given.transmitters is None
                else f"of {self.given.transmitters.name}"
            )
            reason += "" if tx.height else f"; no height: {TRANSMITTER_HEIGHT:g} m"
            self.assume("links.tx", ", ".join(map(str, position)), reason)
            if self.given.transmitters is None:
                self._name_transmitters(tx)
            return position
        if self.given.tx is None:
            return self._transmitter_at_origin(rx)
        if rx.position == "geographic":
            raise InputError("--tx: is in metres, but receivers are in degrees; give --transmitters, a table")
        self.assume("links.tx", ", ".join(f"{part:g}" for part in self.given.tx), "given")
        return [float(part) for part in self.given.tx]

    def _name_transmitters(self, tx: PositionColumns) -> None:
        """The column that names transmitters whose positions are in the links."""
        if len(self._table.frame[[tx.x, tx.y]].drop_duplicates()) < 2:
            return
        name = transmitter_columns.find_transmitter_of_positions(self._table.frame, [tx.x, tx.y])
        if name is not None:
            self.section["transmitter"] = name
            self.assume("links.transmitter", name, "each of its names has one transmitter position")

    def _transmitter_at_origin(self, rx: PositionColumns) -> list[float | str]:
        """A transmitter at the scene's origin, if the table's distances are measured from there."""
        frame, name = self._table.frame, column_names.find_distance(self._table.frame)
        height = column_names.find_transmitter_height(frame)
        if (
            rx.position == "scene"
            and name is not None
            and height is not None
            and frame[height].nunique() == 1
        ):
            z = frame[rx.height] if rx.height else pd.Series(np.full(len(frame), RECEIVER_HEIGHT))
            distance = np.sqrt(frame[rx.x] ** 2 + frame[rx.y] ** 2 + (z - frame[height]) ** 2)
            if float(np.median(np.abs(distance - frame[name]))) < DISTANCE_TOLERANCE:
                up = float(frame[height].iloc[0])
                self.assume("links.tx", f"0, 0, {up:g}", f"column {name} is the distance from there")
                return [0.0, 0.0, up]
        raise InputError(
            f"{self.links}: no position of the transmitter; give --tx X,Y,Z in the scene's metres, or "
            "--transmitters FILE"
        )

    def _value(self) -> ValueColumn:
        value = column_names.find_value(self._table)
        codes = find_codes(self._table.frame[value.column])
        self._assume_codes(codes, value.column)
        powers = self._powers(value)
        if value.quantity == "rsrp" and powers:
            reason = f"{value.reason}; {next(iter(powers.values()))} is the transmitted power"
            value = ValueColumn(value.column, "received_power", reason)
        self.assume("links.value", value.column, value.reason)
        reason = "by name and sign"
        if value.quantity == "rsrp":
            reason = "the transmitted power is unknown, and is part of [offset]"
        self.assume("links.quantity", value.quantity, reason)
        return value

    def _powers(self, value: ValueColumn) -> dict[str, str]:
        """Column of EIRP or transmitted power by the key of ``[links]``; empty if there is none.

        Tables of transmitters state the power of the whole carrier, but a reference signal is only a part of it.
        """
        power = column_names.find_transmit_power(self._table.frame)
        if power is not None:
            return {"eirp_dbm" if column_names.matches(power, "EIRP") else "tx_power_dbm": power}
        if self._sites is None or column_names.matches(value.column, "reference signal"):
            return {}
        return find_powers(self.transmitter_rows)

    def _offset_groups(self, value: ValueColumn) -> list[str]:
        """The columns that group the offset."""
        if value.quantity != "rsrp":
            self.assume("offset", "one for all links", "the values include cables and unknown antenna gains")
            return []
        name = self.section.get("transmitter")
        groups = [*([name] if name else []), *transmitter_columns.find_devices(self._table.frame)]
        groups = list(dict.fromkeys(groups))
        reason = "each transmitter and each receiver has its own gain"
        self.assume("offset.per", ", ".join(groups) or "one", reason)
        return groups

    def _add_flight_times(self) -> None:
        flight_time = column_names.find_flight_time(self._table.frame)
        # Averages of samples keep the observables of the first one.
        if flight_time is None or "average" in self.section or "wide" in self.section:
            return
        column, kind, unit = flight_time
        transmitter = self.section.get("transmitter")
        bias = transmitter if transmitter in self._table.frame else "all"
        self.observables["flight"] = {
            "kind": kind, "column": column, "unit": unit, "bias": bias, "path": "first"
        }  # fmt: skip
        self.assume(
            "observables.flight",
            column,
            f"its name; the bias of {'each ' if bias != 'all' else ''}device is unknown",
        )

    def _add_noise_floor(self, value: ValueColumn) -> None:
        raw = self._table.frame[value.column]
        column = without_codes(raw)
        if "wide" in self.section or not column.isna().any():
            return
        missing = f"{int(column.isna().sum())} values are missing"
        if value.quantity in ("rsrp", "received_power"):
            floor = float(np.floor(column.min()))
            self.section["noise_floor_dbm"] = floor
            self.assume("links.noise_floor_dbm", f"{floor:g} dBm", f"{missing}, and none is lower")
        elif raw.isna().any():
            self._add_filter(f"`{value.column}`.notna()")
            self.assume("links.where", self.section["where"], missing)

    def _add_averaging(self, rx: PositionColumns) -> None:
        """Average along tracks, and if most positions or some values repeat; by position if scans are stationary."""
        frame, name = self._table.frame, self.section.get("transmitter")
        keys = [rx.x, rx.y, *self.groups, *([name] if name and name not in self.groups else [])]
        keys += [part for part in self.section["tx"] if isinstance(part, str) and part in frame]
        positions = len(frame[keys].drop_duplicates())
        repeated = frame.duplicated([*keys, self.section["value"]]).any()
        if self.given.track is None and positions >= len(frame) / 2 and not repeated:
            return
        rows = f"{len(frame)} rows " + ("along a track" if self.given.track else f"at {positions} positions")
        samples = int(frame.groupby(keys, dropna=False).size().median())
        if self.given.track is None and samples >= PLACE_SAMPLES:
            self.section["average"] = "place"
            self.assume("links.average", "place", f"{rows}, {samples} at each")
            return
        fading = float(np.clip(round(AVERAGING_WAVELENGTHS * speed_of_light / self.frequency, 1), 1.0, 10.0))
        bounds = self.overhead.bounds
        size = min(fading, float(f"{CELL_SHARE * min(bounds[3:5] - bounds[:2]):.2g}"))
        self.section["average"] = {"by": "cell", "size": size, "unbiased": True}
        reason = f"{AVERAGING_WAVELENGTHS} wavelengths average out fading"
        if size < fading:
            reason = f"{CELL_SHARE:.0%} of the scene, less than {AVERAGING_WAVELENGTHS} wavelengths"
        self.assume("links.average", f"cells of {size:g} m", f"{rows}; {reason}")

    def _add_heights(self, tx: PositionColumns | None, rx: PositionColumns) -> None:
        """Heights above the ground, if the ground is not at z = 0 and no height is in the scene's frame."""
        in_scene_frame = any(
            columns is not None and columns.position == "scene" and columns.height is not None
            for columns in (tx, rx)
        )
        if in_scene_frame or self.given.tx is not None:
            return
        links = self.measurements()
        try:
            ground = self.overhead.ground_height(*np.concatenate([links.tx, links.rx])[:, :2].T)
        except InputError:
            return  # a link is beyond the scene, or there is no ground
        if np.abs(ground).max() > LEVEL_GROUND:
            self.section["heights"] = "ground"
            reason = f"the ground is at {ground.min():.0f} to {ground.max():.0f} m; heights count from there"
            self.assume("links.heights", "ground", reason)
