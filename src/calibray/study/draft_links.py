"""Drafts the section ``[links]``: track, transmitters, carrier and positions, with a reason for each assumption."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.coordinates import Frame, find_projection
from calibray.errors import InputError
from calibray.measurements import (
    TRACK_COLUMNS,
    Measurements,
    Preparation,
    SourceTable,
    Track,
    column_names,
    read_table,
    select_rows,
    transmitter_columns,
)
from calibray.measurements.column_names import PositionColumns
from calibray.measurements.links import FEW, MAX_CARRIERS
from calibray.measurements.selection import comparison, distinct_rows, find_codes
from calibray.scenes import read_frame
from calibray.scenes.checks import SceneSurfaces
from calibray.study.content import BUNDLED, VERSION
from calibray.study.link_checks import FAR
from calibray.study.study import Study
from calibray.support.messages import counted, shortened

_LOG: Final = logging.getLogger(__name__)

RECEIVER_HEIGHT: Final = 1.5
"""Default height [m] of a receiver if there is no column of heights; typical of a handheld phone."""

ALTITUDES: Final = frozenset({"alt", "altitude", "altitud", "amsl", "asl", "msl", "nhn", "msnm"})
"""Words in the names of altitude columns. The reference of an altitude varies: satellite receivers report altitudes
above sea level, and drones also report altitudes above ground."""

TRANSMITTER_HEIGHT: Final = 10.0
"""Default height [m] of a transmitter if there is no column of heights; typical of a small cell on a mast."""

SAME_CARRIER: Final = 0.01
"""Maximum relative difference between frequencies that count as one carrier. A difference of this size changes
free-space loss by 0.09 dB."""


@dataclass(frozen=True)
class Assumption:
    """One assumption of a draft.

    Attributes:
        what: Key of the study to which the assumption applies.
        value: The assumed value.
        reason: The reason for the assumption.
    """

    what: str
    value: str
    reason: str


@dataclass(frozen=True)
class Given:
    """User input other than the scene and the table of links.

    Attributes:
        transmitters: Table of the transmitters' positions, unless the table of links contains them.
        track: GPX track with the positions of the rows, unless the table of links contains them.
        antennas: Folder of MSI files, each named after an antenna of the transmitters.
        tx: Transmitter position (x, y, z) [m] in the scene frame, unless a table contains it.
        frequency: Carrier frequency [Hz], unless a table contains it.
        origin: Longitude and latitude [deg] of the scene's origin, unless the scene file contains them.
    """

    transmitters: Path | None = None
    track: Path | None = None
    antennas: Path | None = None
    tx: Sequence[float] | None = None
    frequency: float | None = None
    origin: tuple[float, float] | None = None


@dataclass
class LinksDraft:
    """The draft of ``[links]``. Each method adds the keys of one topic and records the assumptions.

    Attributes:
        scene: Mitsuba XML file, or `sionna:NAME`.
        links: File of the table of links.
        target: The future study file.
        given: Further user input.
        section: The keys of ``[links]``.
        assumptions: The assumptions.
        frequency: The study's carrier [Hz].
        table: The table of links, without the rows that have been left out.
        sites: The table of transmitters, limited to the transmitters of the links; None if there is no such table.
        rx: Columns of the receivers' positions.
        tx: Columns of the transmitters' positions; None if there are no such columns.
        groups: The columns whose labels define the groups of the offset.
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
        self.table = read_table(self.links)
        transmitters = self.given.transmitters
        self.sites = None if transmitters is None else distinct_rows(read_table(transmitters))
        self.section["file"] = self.relative(self.links)
        self._add_track()
        self._add_transmitters()
        self.frequency = self._frequency()
        self.rx, self.tx = self._projected(*self._position_columns())
        self._leave_out_unplaced_receivers()

    @cached_property
    def overhead(self) -> SceneSurfaces:
        """Surfaces of the scene: the ground below positions and the roofs above them."""
        return SceneSurfaces.read(self.scene)

    @cached_property
    def frame(self) -> Frame | None:
        """The georeference of the scene; None if neither the user nor the scene file states one."""
        return read_frame(self.scene) if self.given.origin is None else Frame.local(*self.given.origin)

    @property
    def scene_section(self) -> dict[str, Any]:
        """The keys of ``[scene]`` other than the carrier. The file name is relative to the folder of the study file."""
        file = self.scene if self.scene.startswith(BUNDLED) else self.relative(Path(self.scene))
        return {"file": file} | ({} if self.given.origin is None else {"origin": list(self.given.origin)})

    @property
    def transmitter_table(self) -> SourceTable:
        """The table of transmitters, with columns renamed as in the links; without such a table, the table of links."""
        if self.sites is None:
            return self.table
        return replace(self.sites, frame=self.sites.frame.rename(columns=self._name_in_links))

    @property
    def transmitter_rows(self) -> pd.DataFrame:
        """The rows of `transmitter_table`."""
        return self.transmitter_table.frame

    def assume(self, what: str, value: object, reason: str) -> None:
        """Record an assumption. A second assumption about the same key replaces the value and adds a reason."""
        earlier = next((entry for entry in self.assumptions if entry.what == what), None)
        if earlier is None:
            self.assumptions.append(Assumption(what, str(value), reason))
        else:
            merged = Assumption(what, str(value), f"{earlier.reason}; {reason}")
            self.assumptions[self.assumptions.index(earlier)] = merged

    def measurements(self) -> Measurements:
        """The links, read with the keys drafted so far."""
        content = {
            "version": VERSION,
            "scene": self.scene_section | {"frequency": 1e9},
            "links": self.section,
            # The carrier and the parameters do not affect positions, but a study needs both.
            "parameters": {"any.relative_permittivity": {"bounds": [1.5, 12.0]}},
            "offset": {},
        }
        return Study.from_content(content, self.target).measurements()

    def relative(self, file: Path) -> str:
        """The name of a file relative to the study file's folder."""
        return Path(os.path.relpath(file, self.target.absolute().parent)).as_posix()

    def _columns(self) -> str:
        return ", ".join(map(str, self.table.frame))

    def _add_track(self) -> None:
        """Give each row the track position at the time of the row."""
        if self.given.track is None:
            return
        name = column_names.find_time(self.table.frame)
        if name is None:
            raise InputError(
                f"{self.links}: no column of times ({self._columns()}), but {self.given.track} states positions by "
                "time; name the column of times 'time'"
            )
        self.section["track"] = {"file": self.relative(self.given.track), "time": name}
        rows = len(self.table)
        self.table = select_rows(self.table, Preparation(track=Track(str(self.given.track), name)))
        reason = f"given; it covers {len(self.table)} of {rows} rows"
        if not re.search(r"(Z|[+-]\d\d(:?\d\d)?|^[\d.]+)$", str(self.table.frame[name].iloc[0])):
            reason += "; times without a time zone are taken as UTC"
        self.assume("links.track", f"{self.given.track.name} by {name}", reason)

    def _add_transmitters(self) -> None:
        """Match the rows to the table of transmitters, by a common column or by the columns of a wide table."""
        if self.sites is None or self.given.transmitters is None:
            return
        self.section["transmitters"] = self.relative(self.given.transmitters)
        shared = transmitter_columns.find_shared_key(self.table.frame, self.sites.frame)
        key = transmitter_columns.find_naming_key(self.table.frame, self.sites.frame)
        key = key if shared is None else (shared, shared)
        if key is not None:
            name, of_table = key
            reason = f"the values also occur in column {of_table} of {self.given.transmitters.name}"
            reason = reason if shared is None else "this column occurs in both tables, with common values"
            self.section["transmitter"] = self._transmitter_key = name
            self.assume("links.transmitter", name, reason)
            self._leave_out_unknown_transmitters(name, self.sites.frame[of_table])
            self._keep_used_transmitters(of_table, self.table.frame[name])
            return
        wide = {
            name: transmitter_columns.find_wide_columns(self.table.frame, self.sites.labels(name).tolist())
            for name in transmitter_columns.find_transmitter_names(self.sites)
        }
        name, columns = max(wide.items(), key=lambda item: len(item[1]))
        if not columns:
            raise InputError(
                f"{self.links}: no column names the transmitters of the rows, and no columns are named after the "
                f"transmitters in {self.given.transmitters}; give both tables a column with the same name"
            )
        self.section |= {"wide": columns, "transmitter": name}
        self._transmitter_key = name
        self._keep_used_transmitters(name, columns.values())
        reason = f"names as in {self.given.transmitters.name}"
        if unknown := transmitter_columns.find_unknown_wide_columns(self.table.frame, columns):
            reason += f"; without {', '.join(unknown)}, which this table lacks"
        self.assume("links.wide", ", ".join(columns), reason)
        codes = find_codes(self.table.frame[list(columns)].apply(pd.to_numeric, errors="coerce"))
        self.assume_codes(codes, ", ".join(columns))
        steps = Preparation(wide=columns, transmitter=name)
        self.table = select_rows(self.table, steps, transmitter_columns.name_melted_values(columns))

    def _keep_used_transmitters(self, key: str, names: Iterable[object]) -> None:
        """Keep only the transmitters of the links.

        The table of a network also contains other transmitters, whose antennas can differ.
        """
        if self.sites is not None:
            compared = comparison(self.sites.frame[key])
            self.sites = self.sites.select(np.isin(compared(self.sites.frame[key]), compared(names)))

    def _leave_out_unknown_transmitters(self, key: str, names_of_sites: pd.Series) -> None:
        """Draft a filter that excludes rows whose transmitter is not in the table of transmitters."""
        column, compared = self.table.frame[key], comparison(names_of_sites)
        lacking = ~np.isin(compared(column), compared(names_of_sites))
        if not lacking.any():
            return
        names = column[lacking].dropna().unique().tolist()
        # The filter lists the known names, so it also excludes rows without a name.
        self.add_filter(f"`{key}` in {column[~lacking].unique().tolist()}")
        named = ", ".join(map(str, names[:10])) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
        source = (
            "the table of transmitters" if self.given.transmitters is None else self.given.transmitters.name
        )
        self._leave_out(lacking, f"{source} lacks {named}" if names else "no transmitter is stated")
        if names:
            counts = [f"{name} ({counted(int((column == name).sum()), 'row')})" for name in names]
            _LOG.warning(
                "%s: %s lacks %s; these rows are left out; to keep the rows, add these transmitters to the table",
                self.links, source, shortened(", ".join(counts), 300),
            )  # fmt: skip

    def _leave_out_unplaced_receivers(self) -> None:
        """Draft a filter that excludes rows without a receiver position, such as rows without a satellite fix."""
        names = [name for name in (self.rx.x, self.rx.y, self.rx.height) if name is not None]
        missing = self.table.frame[names].isna()
        lacking = missing.any(axis=1).to_numpy()
        if not lacking.any() or lacking.all():
            return
        for name in missing.columns[missing.any()]:
            self.add_filter(f"`{name}`.notna()")
        self._leave_out(lacking, "no receiver position")

    def _leave_out(self, rows: NDArray[np.bool_], cause: str) -> None:
        """Remove the rows that the drafted filter excludes, and record how many there are."""
        number = int(rows.sum())
        reason = f"{cause}: {counted(number, 'row')} {'is' if number == 1 else 'are'} left out"
        self.assume("links.where", self.section["where"], reason)
        self.table = self.table.select(~rows)

    def add_filter(self, condition: str) -> None:
        """Add a condition to the row filter. A condition that contains `or` must be in parentheses."""
        where = self.section.get("where")
        self.section["where"] = condition if where is None else f"{where} and {condition}"

    def assume_codes(self, codes: Sequence[float], columns: str) -> None:
        """Record numbers that stand for missing measurements."""
        if codes:
            self.section["missing"] = list(codes)
            listed = ", ".join(f"{code:g}" for code in codes)
            self.assume(
                "links.missing",
                listed,
                f"far from all other values of {columns} and therefore treated as missing",
            )

    def _frequency(self) -> float:
        """The carrier of the study, given by the user or stated in a column of the links or of the transmitters."""
        given, stated = self.given.frequency, self._stated_frequency()
        if given is not None:
            differs = stated is not None and abs(stated[0] - given) >= SAME_CARRIER * given
            reason = f"given; the {stated[1]} is {stated[0]:g} Hz" if stated and differs else "given"
            self.assume("scene.frequency", f"{given:g} Hz", reason)
            return float(given)
        if stated is None:
            for file, rows in self._frequency_tables():
                if fault := column_names.no_frequency(rows):
                    raise InputError(f"{file}: {fault}, or give --frequency")
            raise InputError(
                f"{self.links}: no column of carrier frequencies; give --frequency, for instance --frequency 3.5e9"
            )
        self.assume("scene.frequency", f"{stated[0]:g} Hz", stated[1])
        return stated[0]

    def _frequency_tables(self) -> list[tuple[Path, pd.DataFrame]]:
        """The tables that can state carriers, each with its file, in order of priority."""
        sites = self.given.transmitters
        return [(self.links, self.table.frame), *([(sites, self.transmitter_rows)] if sites else [])]

    def _stated_frequency(self) -> tuple[float, str] | None:
        """A carrier [Hz] stated in a table, and its source. A column of several carriers becomes `links.frequency`."""
        tables = ((*table, column_names.find_frequency(table[1])) for table in self._frequency_tables())
        stated = next(((file, rows, column) for file, rows, column in tables if column is not None), None)
        if stated is None:
            return None
        file, rows, (name, values) = stated
        carriers = np.unique(values[np.isfinite(values)])
        if carriers[-1] - carriers[0] < SAME_CARRIER * carriers[0]:
            return float(np.nanmedian(values)), f"median of column {name}"
        read = rows[name].to_numpy(dtype=float) * column_names.find_frequency_unit(name)
        # The column name must state the unit of `links.frequency`, because a study has no key for a guessed unit.
        if np.array_equal(read, values, equal_nan=True) and len(carriers) <= MAX_CARRIERS:
            self.section["frequency"] = name
            self.assume("links.frequency", name, f"{len(carriers)} carriers in {file.name}")
            # The tracer samples paths through walls at the lowest carrier, because walls are most transparent at this
            # carrier.
            return float(carriers[0]), f"lowest carrier of column {name}"
        if self.given.frequency is None:
            raise InputError(
                f"{file}: column {name!r} has {len(carriers)} carriers; a study can have at most {MAX_CARRIERS} "
                "carriers, in Hz or in the unit that the column's name states, such as frequency_mhz; otherwise, give "
                "--frequency and a table with one carrier"
            )
        return float(np.nanmedian(values)), f"median of column {name}"

    def _position_columns(self) -> tuple[PositionColumns, PositionColumns | None]:
        """Columns of receiver and transmitter positions; None for the transmitters if the tables lack such columns."""
        if self.given.track is None:
            rx = column_names.find_position(self.table.frame, "rx", unnamed=True)
        else:
            rx = PositionColumns("geographic", *TRACK_COLUMNS, height=None)
        if rx is None:
            raise InputError(
                f"{self.links}: no columns of receiver positions ({self._columns()}); name these columns rx_x, rx_y, "
                "rx_z [m], or longitude and latitude"
                f"{self._position_hints(self.table.frame)}"
            )
        if self.given.tx is not None:
            return rx, None
        if self.sites is None:
            return rx, column_names.find_position(self.table.frame, "tx", unnamed=False)
        tx = column_names.find_position(self.sites.frame, "tx", unnamed=True)
        if tx is None:
            columns = ", ".join(map(str, self.sites.frame))
            raise InputError(
                f"{self.given.transmitters}: no columns of positions ({columns}); name these columns x, y, z [m], or "
                f"longitude and latitude{self._position_hints(self.sites.frame)}"
            )
        x, y, height = (self._name_in_links(name) for name in (tx.x, tx.y, tx.height))
        return rx, PositionColumns(tx.position, str(x), str(y), height)

    @staticmethod
    def _position_hints(frame: pd.DataFrame) -> str:
        text = column_names.text_instead(frame, "x", "y", "longitude", "latitude")
        return text + column_names.no_degrees(frame)

    def _projected(
        self, rx: PositionColumns, tx: PositionColumns | None
    ) -> tuple[PositionColumns, PositionColumns | None]:
        """The columns, treated as degrees or projected coordinates if most positions then lie on the scene."""
        frame = self.frame if rx.position == "scene" else None
        if frame is None or (tx is not None and tx.position != "scene"):
            return rx, tx
        placed = self.table.frame[[rx.x, rx.y]].dropna().astype(float)
        x, y = placed[rx.x], placed[rx.y]
        low, high = self.overhead.bounds[:2], self.overhead.bounds[3:5]
        # Exported geodata may use the names x and y for longitude and latitude.
        if x.abs().max() <= 180 and y.abs().max() <= 90:
            on_scene = frame.to_scene(x.to_numpy(), y.to_numpy())[:, :2]
            if ((on_scene >= low) & (on_scene <= high)).mean() > 0.5:
                return replace(rx, position="geographic"), tx and replace(tx, position="geographic")
        centre, reach = (low + high) / 2, FAR * float(np.max(high - low))
        if np.hypot(x.median() - centre[0], y.median() - centre[1]) < reach:
            return rx, tx
        crs = find_projection(x.to_numpy(), y.to_numpy(), frame, low.tolist(), high.tolist())
        if crs is None:
            return rx, tx
        self.section["crs"] = crs
        self.assume("links.crs", crs, f"in this projection, the positions {rx.x}, {rx.y} lie on the scene")
        return replace(rx, position="geographic"), tx and replace(tx, position="geographic")

    def _name_in_links(self, column: str | None) -> str | None:
        """Name of a transmitter column in the links, changed if the links already have a column with this name."""
        taken = column in self.table.frame and column != self._transmitter_key
        return f"{self._transmitter_key}_{column}" if taken else column

    def add_positions(self) -> None:
        """Draft the keys for the positions of both ends."""
        tx, rx = self.tx, self.rx
        self.section["tx"] = self._transmitter(tx, rx)
        self.section["rx"] = [rx.x, rx.y, RECEIVER_HEIGHT if rx.height is None else rx.height]
        unit = "degrees" if rx.position == "geographic" else "metres"
        unit = "metres of a projection" if "crs" in self.section else unit
        self._add_position_unit(tx, rx)
        reason = f"column names indicate {unit}" if "position_unit" not in self.section else "by their names"
        if unit == "degrees" and not column_names.matches(rx.x, "longitude"):
            reason = "the positions lie on the scene if they are in degrees"
        if rx.height is None:
            reason += f"; no height: {RECEIVER_HEIGHT} m{self._unused_altitudes(self.table.frame)}"
        self.assume("links.rx", ", ".join(map(str, self.section["rx"])), reason)
        if rx.position != "geographic":
            return
        self.section["position"] = "geographic"
        if self.frame is None:
            raise InputError(
                f"{self.links}: positions are in degrees, but {self.scene} is not georeferenced; give the longitude "
                "and latitude of its origin as --origin LON,LAT, or create the scene with `calibray scene`"
            )
        known = f"{Path(self.scene).name} has" if self.given.origin is None else "--origin states"
        reason = f"{unit}; {known} the georeference of the scene"
        self.assume("links.position", "geographic", reason)

    @staticmethod
    def _unused_altitudes(frame: pd.DataFrame) -> str:
        """Hint that an altitude column is ignored (it may be above sea level); empty if there is no such column."""
        unused = [str(name) for name in frame if column_names.words(name) & ALTITUDES]
        hint = (
            "is ignored, because altitudes may be above sea level; rename the column 'height' if they are above the "
            "ground"
        )
        return f" ({unused[0]} {hint})" if unused else ""

    def _add_position_unit(self, tx: PositionColumns | None, rx: PositionColumns) -> None:
        """Draft the unit of the position columns if their names state a unit other than the metre."""
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
        plain = [
            name for end in ends for name in (end.x, end.y) if column_names.find_length_unit([name]) == 1
        ]
        if plain and rx.position != "geographic":
            raise InputError(
                f"{self.links}: the columns {', '.join(names)} state a unit of {unit:g} m, with the exception of "
                f"{', '.join(plain)}; state the unit in the name of each column, or give all positions in metres"
            )
        if rx.position == "geographic":
            raise InputError(
                f"{self.links}: the heights ({', '.join(names)}) are not in metres; give heights in metres"
            )
        self.section["position_unit"] = unit
        self.assume("links.position_unit", f"{unit:g} m", f"stated in the column names {', '.join(names)}")

    def _transmitter(self, tx: PositionColumns | None, rx: PositionColumns) -> list[float | str]:
        if tx is not None:
            if tx.position != rx.position:
                raise InputError(
                    f"{self.links}: the transmitter's position ({tx.x}, {tx.y}) and the receiver's ({rx.x}, {rx.y}) "
                    "have different units; give both in degrees or both in metres"
                )
            positions = (
                1 if self.given.transmitters else len(self.table.frame[[tx.x, tx.y]].drop_duplicates())
            )
            moves = positions > max(FEW, len(self.table.frame) / 2)
            height = RECEIVER_HEIGHT if moves else TRANSMITTER_HEIGHT
            position = [tx.x, tx.y, height if tx.height is None else tx.height]
            reason = (
                "columns of these names"
                if self.given.transmitters is None
                else f"columns of {self.given.transmitters.name}"
            )
            if tx.height is None:
                reason += f"; no height: {height:g} m{', because they move' if moves else ''}"
                reason += "" if self.sites is None else self._unused_altitudes(self.sites.frame)
            self.assume("links.tx", ", ".join(map(str, position)), reason)
            if self.given.transmitters is None:
                self._name_transmitters(tx)
            return position
        if self.given.tx is None:
            return self._transmitter_at_origin(rx)
        if rx.position == "geographic":
            raise InputError(
                "--tx is in metres, but the receivers are in degrees; give a table with --transmitters instead"
            )
        self.assume("links.tx", ", ".join(f"{part:g}" for part in self.given.tx), "given")
        return [float(part) for part in self.given.tx]

    def _name_transmitters(self, tx: PositionColumns) -> None:
        """Draft the column of transmitter names if the table of links contains the transmitter positions."""
        if len(self.table.frame[[tx.x, tx.y]].drop_duplicates()) < 2:
            return
        name = transmitter_columns.find_transmitter_of_positions(self.table.frame, [tx.x, tx.y])
        if name is not None:
            self.section["transmitter"] = name
            self.assume("links.transmitter", name, "each name belongs to exactly one transmitter position")

    def _transmitter_at_origin(self, rx: PositionColumns) -> list[float | str]:
        """Place the transmitter above the origin of the scene if the table states distances from this point."""
        frame, name = self.table.frame, column_names.find_distance(self.table.frame)
        height = column_names.find_transmitter_height(frame)
        if (
            rx.position == "scene"
            and name is not None
            and height is not None
            and frame[height].nunique() == 1
        ):
            z = frame[rx.height] if rx.height else pd.Series(np.full(len(frame), RECEIVER_HEIGHT))
            distance = np.sqrt(frame[rx.x] ** 2 + frame[rx.y] ** 2 + (z - frame[height]) ** 2)
            if float(np.median(np.abs(distance - frame[name]))) < 0.05:
                up = float(frame[height].iloc[0])
                self.assume(
                    "links.tx", f"0, 0, {up:g}", f"column {name} states the distances from this point"
                )
                return [0.0, 0.0, up]
        raise InputError(
            f"{self.links}: the position of the transmitter is unknown; give --tx X,Y,Z [m] in the scene frame, or "
            "--transmitters FILE"
        )

    def add_heights(self) -> None:
        """Measure heights from the ground if the ground is not at z = 0 and no heights are in the scene frame."""
        in_scene_frame = any(
            columns is not None and columns.position == "scene" and columns.height is not None
            for columns in (self.tx, self.rx)
        )
        if in_scene_frame or self.given.tx is not None:
            return
        links = self.measurements()
        try:
            ground = self.overhead.ground_height(*np.concatenate([links.tx, links.rx])[:, :2].T)
        except InputError:
            return  # a link is outside the scene, or there is no ground
        if np.abs(ground).max() > 0.5:
            self.section["heights"] = "ground"
            reason = (
                f"the ground is at {ground.min():.0f} to {ground.max():.0f} m; heights are above the ground"
            )
            self.assume("links.heights", "ground", reason)
