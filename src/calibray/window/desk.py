"""State shared by the steps of the window: the study's folder, commands, selections, and the scene in 2-D and 3-D.

In this folder, the window uses only files that the command line also reads and writes.

In 3-D, lengths are scaled so that the scene fits into a sphere of radius `RADIUS` around the origin, because the page's
camera shows distances of 0.1 to 1000 units.
"""

from __future__ import annotations

import json
import re
import tomllib
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import pandas as pd
from nicegui import run, ui
from nicegui.elements.mixins.value_element import ValueElement
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.measurements.delimited_text import SUFFIXES
from calibray.reporting.link_map import lay_out
from calibray.scenes import Scene, Triangles, read_scene, read_triangles
from calibray.scenes.checks import SceneSurfaces
from calibray.scenes.triangles import ground_heights
from calibray.study import Study
from calibray.study.link_checks import count_unknowns, examine
from calibray.study.mounting import mounting_columns
from calibray.support.lazy_imports import library
from calibray.support.messages import shortened
from calibray.support.output_files import write_text
from calibray.tracing.gain_table import TWO_CUT_SUFFIXES
from calibray.window.jobs import Jobs

STUDY: Final = "study.toml"
MAPS: Final = (".osm", ".pbf", ".geojson", ".gpkg", ".shp", ".fgb", ".dxf", ".csv")
TABLES: Final = (*SUFFIXES, ".xlsx", ".parquet")
MESHES: Final = (".ply", ".obj")
PARTS: Final = (".shx", ".dbf", ".prj", ".cpg", ".tif", ".tiff", ".gpx", ".xml", ".json")
PLACE, CANDIDATES, SUGGESTED = "place.csv", "candidates.csv", "suggested.csv"
"""Tables that the window writes: the position to predict, candidate positions for measurements, and suggested
positions."""

PREDICTED: Final = "-predicted.csv"
"""Suffix of the names of tables of predictions."""

LARGEST: Final = 2**30
"""Maximum size of an uploaded file [bytes]; larger files must be copied into the folder by other means."""

Control = TypeVar("Control", bound=ValueElement)

_NAME: Final = re.compile(r"[\w][\w .()+-]*")
_LONGEST_NAME: Final = 200
"""Maximum length of a file name [bytes]; file systems accept 255, but files derived from a scene have longer names."""


@dataclass(frozen=True)
class StudyFolder:
    """A study's folder, given by its absolute path."""

    path: Path

    @property
    def study_file(self) -> Path:
        """Path of the study file, which might not exist yet."""
        return self.path / STUDY

    def files(self, endings: tuple[str, ...]) -> list[str]:
        """Names of the files in the folder that have one of the given extensions."""
        candidates = (file for file in self.path.iterdir() if file.name.lower().endswith(endings))
        return sorted(file.name for file in candidates if file.is_file() and not file.name.startswith("."))

    def tables(self) -> list[str]:
        """Names of the tables in the folder, except for tables written by the window."""
        written = (PLACE, CANDIDATES, SUGGESTED)
        return [name for name in self.files(TABLES) if name not in written and not name.endswith(PREDICTED)]

    def scenes(self) -> list[str]:
        """The scenes in the folder and its subfolders, except for the scenes in results."""
        files = [*self.path.glob("*.xml"), *self.path.glob("*/*.xml")]
        names = (file.relative_to(self.path).as_posix() for file in files if file.name != "result-scene.xml")
        return sorted(name for name in names if not name.startswith("."))

    def results(self) -> list[str]:
        """Names of the folders that contain results, with the most recent result last."""
        written = {
            file.parent.name: file.stat().st_mtime_ns
            for file in self.path.glob("*/result.json")
            if file.is_file()
        }
        return sorted(written, key=lambda name: (written[name], name))

    def result(self, name: str) -> dict[str, Any]:
        """The record of a result.

        Raises:
            InputError: The result does not exist, or cannot be read.
        """
        if name not in self.results():
            raise InputError(f"{shortened(name)}: no such result")
        file = self.path / name / "result.json"
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{file}: cannot be read ({shortened(str(error))})") from None

    def check_upload(self, name: str) -> Path:
        """The path for an uploaded file; meshes are stored in `meshes`, where scenes expect mesh files.

        Raises:
            InputError: The name is not a plain file name, Calibray does not read this kind of file, or the file exists.
        """
        # Some systems encode an umlaut as a letter and a combining mark, and some scripts always need combining marks.
        name = unicodedata.normalize("NFC", name)
        letters = "".join(letter for letter in name if not unicodedata.category(letter).startswith("M"))
        shown = shortened(repr(name))
        if len(name.encode("utf-8", "replace")) > _LONGEST_NAME:
            raise InputError(f"{shown}: the name is too long; shorten it to {_LONGEST_NAME} bytes")
        if not _NAME.fullmatch(letters) or name.endswith((" ", ".")):
            raise InputError(
                f"{shown}: use only letters, digits, spaces and . _ - ( ) + in file names; rename the file"
            )
        ending = Path(name).suffix.lower()
        if ending not in (*MAPS, *TABLES, *PARTS, *TWO_CUT_SUFFIXES, *MESHES):
            raise InputError(
                f"{shown}: Calibray does not read this kind of file; give a map, a plan, a table or a scene"
            )
        target = (self.path / "meshes" if ending in MESHES else self.path) / name
        if target.exists() or target.is_symlink():
            raise InputError(f"{shown}: already exists; rename one of the files")
        return target

    def content(self) -> dict[str, Any]:
        """The sections of the study file; empty if there is no study file, or if it is not valid TOML."""
        try:
            return tomllib.loads(self.study_file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}

    def valid_content(self) -> dict[str, Any]:
        """The sections of the study file; empty if the file is not a valid study."""
        content = self.content()
        try:
            Study.from_content(content, self.study_file)
        except InputError:
            return {}
        return content

    def text(self) -> str:
        """The text of the study file; empty if there is no study file."""
        try:
            return self.study_file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def reasons(self) -> dict[str, str]:
        """The reasons for drafted settings, from comments in the study file, by the dotted name of a section or key."""
        from calibray.study.toml_file import reasons_in

        return reasons_in(self.text())

    def save(self, content: Mapping[str, Any]) -> None:
        """Write the study file, with the reasons for settings as comments.

        Raises:
            InputError: The content is not a valid study; the file is unchanged.
        """
        from calibray.study.toml_file import study_text

        text = study_text(content, self.reasons())
        Study.from_content(tomllib.loads(text), self.study_file)
        write_text(self.study_file, text)

    def set_aside(self) -> None:
        """Rename the study file so that another study can be drafted."""
        number = 1
        while (target := self.path / f"study-{number}.toml").exists():
            number += 1
        self.study_file.rename(target)


RADIUS: Final = 10.0


@dataclass(frozen=True, eq=False)
class Solid:
    """A scene in 3-D, in scaled units.

    Attributes:
        meshes: Corners of the faces [F, 3, 3], by material.
        tx: Transmitter positions [n, 3].
        rx: Receiver positions [n, 3].
    """

    meshes: dict[str, NDArray[np.float64]]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]

    def stl(self, material: str) -> bytes:
        """The faces of a material, as the content of an STL file."""
        corners = self.meshes[material]
        trimesh = library("trimesh", "scenes")
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        return trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False).export(file_type="stl")


def solid(folder: StudyFolder, scene: str | None) -> Solid | None:
    """The study's scene in 3-D, or the chosen scene if there is no study; None if there is no scene.

    Raises:
        InputError: The scene or the links cannot be read.
    """
    source, study = opened(folder, scene)
    if source is None:
        return None
    read, triangles = _geometry(source, study)
    low, high = triangles.vertex.min(axis=0), triangles.vertex.max(axis=0)
    # The diagonal of the scene becomes the diameter of the sphere.
    centre, scale = (low + high) / 2, 2 * RADIUS / max(float(np.linalg.norm(high - low)), 1e-6)
    names, corners = list(read.materials), (triangles.corners - centre) * scale
    meshes = {
        names[number]: corners[triangles.material == number] for number in np.unique(triangles.material)
    }
    links = None if study is None else study.measurements()
    tx, rx = (np.zeros((0, 3)),) * 2 if links is None else (links.tx, links.rx)
    return Solid(meshes, *((np.unique(ends, axis=0) - centre) * scale for ends in (tx, rx)))


def filled(control: ui.number) -> float:
    """The number entered in a field.

    Raises:
        InputError: The field is empty.
    """
    if control.value is None:
        raise InputError(f"{control.props['label']}: is empty; give a number")
    return control.value


@dataclass
class Desk:
    """The state of the page. The page has one user, so all tabs use the same state.

    Attributes:
        folder: The study's folder.
        scene: Path of the chosen scene, relative to the folder.
        point: The chosen position, x and y [m].
        area: The chosen area: west, south, east, north [m].
        sites: Transmitters of the measured links, as listed by `sites`.
        findings: Warnings about suspicious links.
        solid: The scene that is shown in 3-D.
        entered: Values that the user entered, by the label of the control.
        edits: Functions, by tab and step, that copy the values shown in a step to the study's content.
        show_again: Functions, by tab, that redraw all steps after a change in that tab.
        drawn: Content that the steps had when they were last drawn; see `page`.
    """

    folder: StudyFolder
    scene: str | None = None
    point: tuple[float, float] | None = None
    area: tuple[float, float, float, float] | None = None
    sites: list[dict[str, Any]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    solid: Solid | None = None
    entered: dict[str, Any] = field(default_factory=dict)
    edits: dict[tuple[str, str], Callable[[dict[str, Any]], None]] = field(default_factory=dict)
    show_again: dict[str, Callable[[], None]] = field(default_factory=dict)
    drawn: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.jobs = Jobs(self.folder.path)

    def start(self, words: Sequence[object]) -> None:
        """Start a command, and tell the user that it has started or why it could not start."""
        with self.messages():
            job = self.jobs.start([str(word) for word in words])
            ui.notify(f"Started: {job.command}", type="info", color="primary")
            self.refresh()

    def refresh(self) -> None:
        """Redraw the steps of all tabs, and the map and the command of this tab."""
        self.show_again[ui.context.client.id]()

    def mark(self) -> None:
        """Show the chosen position and area on the map of this tab."""
        area = dict(zip(("west", "south", "east", "north"), self.area, strict=True)) if self.area else None
        ui.run_javascript(f"plan.mark({json.dumps(self.point)}, {json.dumps(area)})")

    def keep(self, control: Control) -> Control:
        """Restore the value entered in a control before its step was redrawn, if it is still one of the options."""
        name = control.text if isinstance(control, ui.switch) else str(control.props["label"])
        if name in self.entered and self.entered[name] in getattr(control, "options", [self.entered[name]]):
            control.set_value(self.entered[name])
        control.on_value_change(lambda event: self.entered.update({name: event.value}))
        return control

    def edit(self, step: str, write: Callable[[dict[str, Any]], None]) -> None:
        """Register a function that, when the study is saved, writes the values shown in a step of this tab."""
        self.edits[ui.context.client.id, step] = write

    async def save(self) -> None:
        """Save the study with the values shown in all steps of this tab."""
        with self.messages():
            content = self.folder.content()
            for (client, _), write in self.edits.items():
                if client == ui.context.client.id:
                    write(content)
            await run.io_bound(self.folder.save, content)
            ui.notify("Saved", type="positive")
            self.refresh()

    @contextmanager
    def messages(self) -> Iterator[None]:
        """Show an input or file error as text instead of raising it."""
        try:
            yield
        except (InputError, OSError) as error:
            ui.notify(str(error), type="negative", multi_line=True, timeout=15_000, close_button="Close")


def plan(folder: StudyFolder, scene: str | None) -> dict[str, Any]:
    """The map of the study, or of a scene in the folder if there is no study.

    The map contains `west`, `north` [m], `scale` [1/m] and `height` of the outlines, and the `sites`. The map also
    contains `buildings` and `walls` as SVG path data. Each of the `links` has x, y [m], path loss [dB], and 1 if the
    link is suspicious, otherwise 0. Each of the `transmitters` has x, y, z [m].

    Raises:
        InputError: The scene or the links cannot be read.
    """
    source, study = opened(folder, scene)
    if source is None:
        return {"links": [], "transmitters": [], "sites": []}
    links = None if study is None else study.measurements()
    _, triangles = _geometry(source, study)
    corners = triangles.corners.reshape(-1, 3)
    measured = [] if links is None else [links.tx, links.rx]
    layout = lay_out(np.concatenate([corners, *measured]), triangles)
    shown: dict[str, Any] = {
        "west": layout.west, "north": layout.north, "scale": layout.scale, "height": layout.height,
        "buildings": layout.buildings, "walls": layout.walls, "links": [], "transmitters": [], "sites": [],
    }  # fmt: skip
    if study is None or links is None:
        return shown
    overhead = SceneSurfaces.read(source)
    roofed, wrong = overhead.under_roof(links.rx), overhead.outside(links.rx) | overhead.underground(links.rx)
    # If more than 80 % of the receivers are under a roof, the scene is regarded as indoors.
    suspicious = wrong if roofed.mean() > 0.8 else wrong | roofed
    rows = zip(links.rx.tolist(), links.path_loss_db.tolist(), suspicious.tolist(), strict=True)
    shown["links"] = [[round(x, 2), round(y, 2), round(loss, 1), int(mark)] for (x, y, _), loss, mark in rows]
    shown["transmitters"] = np.unique(links.tx, axis=0).round(2).tolist()
    shown["sites"] = sites(study, links)
    return shown


def sites(study: Study, links: Measurements) -> list[dict[str, Any]]:
    """The transmitters of the links, one per position, group and carrier, because a mast can carry several sectors.

    Each transmitter has a `name`, a position `tx` [m], and the values of the `columns` that a prediction requires, such
    as azimuth.
    """
    names = [study.links.transmitter, *study.offset_groups, study.links.frequency]
    key = list(dict.fromkeys(name for name in names if name is not None and name in links.frame))
    columns = links.frame[list(dict.fromkeys([*key, *mounting_columns(study)]))]
    tx = pd.DataFrame(links.tx.round(2), columns=["x", "y", "z"])
    # The first link of each mast, group and carrier frequency represents the other links.
    first = ~pd.concat([tx, columns[key].reset_index(drop=True)], axis=1).duplicated().to_numpy()
    # Convert the rows to JSON and back, because NumPy numbers and NaN cannot be sent to the page. Without columns, JSON
    # has no rows.
    rows = json.loads(columns[first].to_json(orient="records")) or [{}] * int(first.sum())
    return [
        {
            "name": " ".join(
                [*(str(row[name]) for name in key), "at", ", ".join(f"{value:g}" for value in place)]
            ),
            "tx": place,
            "columns": row,
        }
        for row, place in zip(rows, tx[first].to_numpy().tolist(), strict=True)
    ]


def opened(folder: StudyFolder, scene: str | None) -> tuple[str | None, Study | None]:
    """The scene to show (the study's scene or else the chosen scene), and the study if there is one.

    Raises:
        InputError: The study cannot be read.
    """
    if folder.study_file.is_file():
        study = Study.load(folder.study_file)
        return study.scene_source, study
    if scene is None or scene not in folder.scenes():
        return None, None
    return str(folder.path / scene), None


def _geometry(source: str, study: Study | None) -> tuple[Scene, Triangles]:
    """A scene with the study's materials, and the faces of the scene."""
    if study is None:
        # Only material names are used, and nearly all materials of ITU-R P.2040 have constants at 1 GHz.
        scene = read_scene(source, 1e9)
    else:
        scene = read_scene(source, study.scene.frequency, study.overrides, study.objects)
    return scene, read_triangles(scene)


def grid_above_ground(
    folder: StudyFolder, scene: str | None, x: NDArray[np.float64], y: NDArray[np.float64], height: float
) -> NDArray[np.float64]:
    """Points [n, 3], [m], of a grid with ascending, equally spaced x and y [m], at a given height above the ground [m].

    Raises:
        InputError: There is no scene, or the scene cannot be read.
    """
    source, study = opened(folder, scene)
    if source is None:
        raise InputError("heights above the ground require a scene; make or add a scene first")
    _, triangles = _geometry(source, study)
    # Compute the heights as for a coverage map, so that a position has the same height in both.
    z = ground_heights(triangles, x, y) + height
    return np.stack([*np.meshgrid(x, y), z], axis=-1).reshape(-1, 3)


def findings(folder: StudyFolder) -> list[str]:
    """Warnings about suspicious links of a study, as sentences; empty if there is no study.

    Raises:
        InputError: The scene or the links cannot be read.
    """
    if not folder.study_file.is_file():
        return []
    study = Study.load(folder.study_file)
    links = study.measurements()
    suspicions = [*examine(study, links), *count_unknowns(study, links)]
    return [f"{suspicion.problem}: {suspicion.remedy}" for suspicion in suspicions]
