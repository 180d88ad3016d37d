"""Drafting a study: a scene and a table of links looked at, and all that is assumed told with its reason."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import (
    TRACK_COLUMNS,
    Measurements,
    Preparation,
    Track,
    column_names,
    read_table,
    select_rows,
)
from calibray.measurements.column_names import PositionColumns, ValueColumn
from calibray.scenes import read_frame
from calibray.scenes.checks import SceneSurfaces, count_crossings
from calibray.study.draft_parameters import calibratable
from calibray.study.draft_text import toml
from calibray.study.model import BUNDLED, VERSION
from calibray.study.study import Study

RECEIVER_HEIGHT: Final = 1.5
TRANSMITTER_HEIGHT: Final = 10.0
WAVELENGTHS: Final = 40
"""Width of the cells that fading is averaged over (Lee 1985; see `calibray.measurements.averaging`)."""

_DEPTHS: Final = (3, 5)  # within which walls decide how deep is traced indoors
_LEVEL: Final = 0.5  # [m], within which the ground counts as the scene's zero
_MISS: Final = 0.05  # [m], by which a table's distances may differ from its positions


@dataclass(frozen=True)
class Assumption:
    """One thing that was assumed.

    Attributes:
        what: What it is about.
        value: What was assumed.
        reason: Why.
    """

    what: str
    value: str
    reason: str


@dataclass(frozen=True)
class Draft:
    """A study that was drafted.

    Attributes:
        text: The study file.
        study: The study in it.
        assumptions: What was assumed, in the file's order.
    """

    text: str
    study: Study
    assumptions: tuple[Assumption, ...]


def draft(
    scene: str,
    links: str | Path,
    target: str | Path,
    transmitters: str | Path | None = None,
    frequency: float | None = None,
    tx: Sequence[float] | None = None,
    track: str | Path | None = None,
) -> Draft:
    """Draft a study; nothing is written.

    Args:
        scene: Mitsuba XML file, or `sionna:NAME`.
        links: The table of links.
        target: Where the study file will stand; other files are named relative to its folder.
        transmitters: SourceTable of the transmitters' positions, if they do not stand in the links.
        frequency: Carrier frequency [Hz], if the table does not tell it.
        tx: Transmitter position (x, y, z) [m] in the scene's frame, if the table does not tell it.
        track: GPX track that tells where each row was measured, if the table does not tell it.

    Returns:
        The draft.

    Raises:
        InputError: A file cannot be read, or something cannot be told from the files and was not given.
    """
    sites, route = (Path(file) if file else None for file in (transmitters, track))
    made = _Drafting(scene, Path(links), Path(target), sites, route, frequency, tx)
    content = made.content()
    text = toml(content, {each.what: each.reason for each in made.assumed})
    study = Study.from_content(tomllib.loads(text), target)
    return Draft(text, study, tuple(made.assumed))


@dataclass
class _Drafting:
    """A study that is being drafted: its files, and what was assumed so far."""

    scene: str
    links: Path
    target: Path
    transmitters: Path | None
    track: Path | None
    given_frequency: float | None
    given_tx: Sequence[float] | None
    assumed: list[Assumption] = field(default_factory=list)
    key: str = ""

    def __post_init__(self) -> None:
        self.table = read_table(self.links)
        self.sites = None if self.transmitters is None else read_table(self.transmitters)

    @cached_property
    def overhead(self) -> SceneSurfaces:
        """What lies above and below places of the scene."""
        return SceneSurfaces.read(self.scene)

    def content(self) -> dict[str, Any]:
        """The sections of the study."""
        section: dict[str, Any] = {"file": self._relative(self.links)}
        self._tracked(section)
        self._wide(section)
        frequency = self._frequency(section)
        rx, tx = self._places()
        value = self._value(section)
        self._position(section, tx, rx)
        section |= {"value": value.column, "quantity": value.quantity}
        if value.quantity == "received_power":
            section["tx_power_dbm"] = column_names.find_transmit_power(self.table.frame)
        groups = self._groups(section, value)
        self._floor(section, value)
        self._averages(section, rx, groups, frequency)
        self._heights(section, tx, rx)
        indoors = self._indoors(section)
        if section.get("position") == "geographic" and not indoors:
            section["inside"] = "move"
            self._assume(
                "links.inside", "move", "positions of satellite receivers are metres off, some inside walls"
            )
        self._assume(
            "antennas", "iso, V, at both ends", "nothing tells them; name yours, with their orientation"
        )
        trace = {"max_depth": self._depth(section) if indoors else 3, "samples": 200_000}
        if indoors:
            trace["refraction"] = True
        return {
            "version": VERSION,
            "scene": {"file": self._scene_file(), "frequency": frequency},
            "links": section,
            "antennas": {end: {"pattern": "iso", "polarization": "V"} for end in ("tx", "rx")},
            "trace": trace,
            "parameters": self._parameters(frequency, indoors),
            "offset": {"per": groups} if groups else {},
            # Refraction is sampled by the materials: traced again once, not until every link stands still.
            **({"fidelity": {"tolerance_db": 2.0, "rounds": 1}} if indoors else {}),
            "method": {"name": "auto", "seed": 0},
        }

    def _assume(self, what: str, value: object, reason: str) -> None:
        self.assumed.append(Assumption(what, str(value), reason))

    def _relative(self, file: Path) -> str:
        return Path(os.path.relpath(file, self.target.absolute().parent)).as_posix()

    def _scene_file(self) -> str:
        return self.scene if self.scene.startswith(BUNDLED) else self._relative(Path(self.scene))

    def _tracked(self, section: dict[str, Any]) -> None:
        """The positions of a track."""
        if self.track is None:
            return
        name = column_names.find_time(self.table.frame)
        if name is None:
            raise InputError(
                f"{self.links}: no column looks like the times that {self.track} is joined by "
                f"({', '.join(map(str, self.table.frame))}); call it time"
            )
        section["track"] = {"file": self._relative(self.track), "time": name}
        rows = len(self.table)
        self.table = select_rows(self.table, Preparation(track=Track(str(self.track), name)))
        self._assume(
            "links.track",
            f"{self.track.name} by {name}",
            f"given; it covers {len(self.table)} of {rows} rows",
        )

    def _wide(self, section: dict[str, Any]) -> None:
        """One column a transmitter, if the table of transmitters says so."""
        if self.sites is None:
            return
        section["transmitters"] = self._relative(Path(str(self.transmitters)))
        name = column_names.find_shared_key(self.table.frame, self.sites.frame)
        if name is not None:
            section["transmitter"] = self.key = name
            self._assume("links.transmitter", name, "a column of both tables, and every value is known")
            return
        name = column_names.find_transmitter_names(self.sites.frame)
        columns = column_names.find_wide_columns(self.table.frame, self.sites.labels(name).tolist())
        if not columns:
            raise InputError(
                f"{self.links}: no column says which transmitter of {self.transmitters} a row belongs to, and no "
                "columns are called like them; name one alike in both tables"
            )
        self.key = name
        section |= {"wide": columns, "transmitter": name}
        self._assume(
            "links.wide", ", ".join(columns), f"called like those in {Path(str(self.transmitters)).name}"
        )
        steps = Preparation(wide=columns, transmitter=name)
        self.table = select_rows(self.table, steps, column_names.name_melted_values(columns))

    def _frequency(self, section: dict[str, Any]) -> float:
        found = column_names.find_frequency(self.table.frame)
        if self.given_frequency is not None:
            self._assume("scene.frequency", f"{self.given_frequency:g} Hz", "given")
            return float(self.given_frequency)
        if found is None:
            raise InputError(
                f"{self.links}: nothing tells the carrier frequency; give --frequency, for instance --frequency 3.5e9"
            )
        name, carriers = found
        middle = float(np.median(carriers))
        if np.ptp(carriers) < 0.01 * middle:
            self._assume("scene.frequency", f"{middle:g} Hz", f"column {name}, in its middle")
            return middle
        if np.array_equal(carriers, self.table.frame[name]):
            section["frequency"] = name
            self._assume("links.frequency", name, f"{len(np.unique(carriers))} carriers in Hz")
            return middle
        raise InputError(
            f"{self.links}: column {name!r} has several carriers, not in Hz; give it in Hz, or --frequency and a table "
            "of one carrier"
        )

    def _places(self) -> tuple[PositionColumns, PositionColumns | None]:
        if self.track is None:
            rx = column_names.find_position(self.table.frame, "rx", unnamed=True)
        else:
            rx = PositionColumns("geographic", *TRACK_COLUMNS, height=None)
        if rx is None:
            raise InputError(
                f"{self.links}: no columns look like the receivers' positions "
                f"({', '.join(map(str, self.table.frame))}); call them rx_x, rx_y, rx_z [m], or longitude and latitude"
            )
        if self.given_tx is not None:
            return rx, None
        if self.sites is not None:
            tx = column_names.find_position(self.sites.frame, "tx", unnamed=True)
            if tx is None:
                raise InputError(
                    f"{self.transmitters}: no columns look like positions ({', '.join(map(str, self.sites.frame))})"
                )
            return rx, self._renamed(tx)
        return rx, column_names.find_position(self.table.frame, "tx", unnamed=False)

    def _renamed(self, tx: PositionColumns) -> PositionColumns:
        """The columns of transmitters as links get them: under another name where links have one of that name."""
        x, y, height = (
            f"{self.key}_{each}" if each in self.table.frame else each for each in (tx.x, tx.y, tx.height)
        )
        return PositionColumns(tx.position, str(x), str(y), height)

    def _position(self, section: dict[str, Any], tx: PositionColumns | None, rx: PositionColumns) -> None:
        section["tx"] = self._transmitter(tx, rx)
        up: float | str = RECEIVER_HEIGHT
        if rx.height is not None:
            up = rx.height
        section["rx"] = [rx.x, rx.y, up]
        unit = "degrees" if rx.position == "geographic" else "metres"
        reason = f"columns called like {unit}" + ("" if rx.height else "; no height: a hand's, 1.5 m")
        self._assume("links.rx", ", ".join(map(str, section["rx"])), reason)
        if rx.position == "geographic":
            section["position"] = "geographic"
            if read_frame(self.scene) is None:
                raise InputError(
                    f"{self.links}: positions are in degrees, and {self.scene} does not say where it lies; make it "
                    "with `calibray scene`, or write scene.origin into a study of your own"
                )
            self._assume(
                "links.position", "geographic", f"degrees, placed by the frame in {Path(self.scene).name}"
            )

    def _transmitter(self, tx: PositionColumns | None, rx: PositionColumns) -> list[float | str]:
        if tx is not None:
            if tx.position != rx.position:
                raise InputError(
                    f"{self.links}: the transmitter's position ({tx.x}, {tx.y}) is in other units than the receiver's "
                    f"({rx.x}, {rx.y}); give both in degrees, or both in metres"
                )
            up = TRANSMITTER_HEIGHT if tx.height is None else tx.height
            place = [tx.x, tx.y, up]
            reason = (
                f"of {Path(str(self.transmitters)).name}" if self.sites is not None else "columns called so"
            )
            self._assume(
                "links.tx", ", ".join(map(str, place)), reason + ("" if tx.height else "; no height: 10 m")
            )
            return place
        if self.given_tx is not None:
            if rx.position == "geographic":
                raise InputError(
                    "--tx: is in metres, and receivers are in degrees; give --transmitters, a table"
                )
            self._assume("links.tx", ", ".join(f"{part:g}" for part in self.given_tx), "given")
            return [float(part) for part in self.given_tx]
        return self._at_origin(rx)

    def _at_origin(self, rx: PositionColumns) -> list[float | str]:
        """The scene's origin, if the table's distances say so."""
        frame, name = self.table.frame, column_names.find_distance(self.table.frame)
        up = column_names.find_transmitter_height(frame)
        if rx.position == "scene" and name is not None and up is not None and frame[up].nunique() == 1:
            z = frame[rx.height] if rx.height else pd.Series(np.full(len(frame), RECEIVER_HEIGHT))
            found = np.sqrt(frame[rx.x] ** 2 + frame[rx.y] ** 2 + (z - frame[up]) ** 2)
            if float(np.median(np.abs(found - frame[name]))) < _MISS:
                height = float(frame[up].iloc[0])
                self._assume("links.tx", f"0, 0, {height:g}", f"column {name} is the distance from there")
                return [0.0, 0.0, height]
        raise InputError(
            f"{self.links}: nothing tells where the transmitter stands; give --tx X,Y,Z in the scene's metres, or "
            "--transmitters FILE"
        )

    def _value(self, section: dict[str, Any]) -> ValueColumn:
        value = column_names.find_value(self.table)
        if (
            value.quantity == "rsrp"
            and (power := column_names.find_transmit_power(self.table.frame)) is not None
        ):
            value = ValueColumn(
                value.column, "received_power", f"{value.reason}; {power} tells what was transmitted"
            )
        self._assume("links.value", value.column, value.reason)
        told = (
            "what was transmitted is not known: [offset] takes it"
            if value.quantity == "rsrp"
            else "by name and sign"
        )
        self._assume("links.quantity", value.quantity, told)
        return value

    def _groups(self, section: dict[str, Any], value: ValueColumn) -> list[str]:
        """The columns of the offset."""
        if value.quantity != "rsrp":
            self._assume("offset", "one for all links", "cables and antennas' gains are in the values")
            return []
        name = section.get("transmitter")
        groups = [*([name] if name else []), *column_names.find_devices(self.table.frame)]
        groups = list(dict.fromkeys(groups))
        self._assume(
            "offset.per", ", ".join(groups) or "one", "each transmits, or receives, with its own gain"
        )
        return groups

    def _floor(self, section: dict[str, Any], value: ValueColumn) -> None:
        column = self.table.frame[value.column]
        if "wide" in section or not column.isna().any():
            return
        if value.quantity not in ("rsrp", "received_power"):
            section["where"] = f"`{value.column}`.notna()"
            self._assume("links.where", section["where"], f"{int(column.isna().sum())} values are missing")
            return
        floor = float(np.floor(column.min()))
        section["noise_floor_dbm"] = floor
        reason = f"{int(column.isna().sum())} values are missing, and none is lower"
        self._assume("links.noise_floor_dbm", f"{floor:g} dBm", reason)

    def _averages(
        self, section: dict[str, Any], rx: PositionColumns, groups: list[str], frequency: float
    ) -> None:
        frame = self.table.frame
        name = section.get("transmitter")
        keys = [rx.x, rx.y, *groups, *([name] if name and name not in groups else [])]
        keys += [each for each in section["tx"] if isinstance(each, str) and each in frame]
        places = len(frame[keys].drop_duplicates())
        copies = frame.duplicated([*keys, section["value"]]).any()
        if self.track is None and places >= len(frame) / 2 and not copies:
            return
        size = float(np.clip(round(WAVELENGTHS * speed_of_light / frequency, 1), 1.0, 10.0))
        section["average"] = {"by": "cell", "size": size, "unbiased": True}
        taken = f"{len(frame)} rows " + ("along a track" if self.track else f"at {places} places")
        reason = f"{taken}; {WAVELENGTHS} wavelengths even out fading"
        self._assume("links.average", f"cells of {size:g} m", reason)

    def _heights(self, section: dict[str, Any], tx: PositionColumns | None, rx: PositionColumns) -> None:
        """Heights above the ground, where it is not level at zero and heights can be meant so."""
        given_in_scene = any(
            place is not None and place.position == "scene" and place.height is not None for place in (tx, rx)
        )
        if given_in_scene or self.given_tx is not None:
            return
        links = self._links(section)
        try:
            ground = self.overhead.ground_height(*np.concatenate([links.tx, links.rx])[:, :2].T)
        except InputError:
            return  # somewhere the scene ends, or has no floor
        if np.abs(ground).max() > _LEVEL:
            section["heights"] = "ground"
            low, high = ground.min(), ground.max()
            self._assume(
                "links.heights", "ground", f"it lies at {low:.0f} to {high:.0f} m; heights count from it"
            )

    def _indoors(self, section: dict[str, Any]) -> bool:
        """Whether most receivers have a ceiling above them."""
        links = self._links(section)
        share = float(self.overhead.under_roof(links.rx).mean())
        indoors = share > 0.5
        told = f"{share:.0%} of the receivers have something above them"
        self._assume("trace", "through walls" if indoors else "around buildings", told)
        return indoors

    def _depth(self, section: dict[str, Any]) -> int:
        """As many interactions as the straight lines of nearly all links cross walls, and two for reflections."""
        links = self._links(section)
        walls = int(np.quantile(count_crossings(self.overhead.walls, links.tx, links.rx), 0.95))
        depth = int(np.clip(walls + 2, *_DEPTHS))
        self._assume(
            "trace.max_depth",
            depth,
            f"straight lines cross up to {walls} walls; two reflections more, {_DEPTHS[0]} to {_DEPTHS[1]}",
        )
        return depth

    def _links(self, section: dict[str, Any]) -> Measurements:
        """The links, as far as they are drafted."""
        content = {
            "version": VERSION,
            "scene": {"file": self._scene_file(), "frequency": 1e9},
            "links": section,
            "parameters": {"any.relative_permittivity": {"bounds": [1.5, 12.0]}},
            "offset": {},
        }
        return Study.from_content(content, self.target).measurements()

    def _parameters(self, frequency: float, indoors: bool) -> dict[str, dict[str, Any]]:
        names, entries = calibratable(self.scene, frequency, indoors)
        self._assume(
            "parameters", ", ".join(names), "the scene's materials that are no metal; start: the scene's"
        )
        return entries
