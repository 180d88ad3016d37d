"""The steps of the page from a map to a study: scene, measurements and parameters."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from nicegui import events, ui

from calibray.errors import InputError
from calibray.materials import DEFAULT_REVISION, ITU_MATERIALS
from calibray.measurements import read_table
from calibray.measurements.column_names import find_position, find_value
from calibray.measurements.transmitter_columns import find_transmitter_names
from calibray.window.desk import LARGEST, MAPS, STUDY, Desk, StudyFolder, filled

ITU: Final = [name for name in ITU_MATERIALS[DEFAULT_REVISION] if name != "vacuum"]
COMMANDS: Final = {".osm": "osm", ".pbf": "osm", ".csv": "plan", ".dxf": "plan"}
"""How a file is converted to a scene, by file extension; files with other extensions can be footprints or plans."""


def upload(desk: Desk, label: str) -> None:
    """Draw the control that adds files to the folder."""

    async def take(event: events.MultiUploadEventArguments) -> None:
        for file in event.files:
            with desk.messages():
                target = desk.folder.check_upload(file.name)
                target.parent.mkdir(exist_ok=True)
                await file.save(target)
                ui.notify(f"Added: {target.name}", type="positive")
        desk.refresh()

    def refuse() -> None:
        ui.notify(
            f"The file is larger than {LARGEST // 2**30} GiB; copy it into the folder instead.",
            type="negative",
        )

    button = ui.button(label).props("outline")
    ui.label("Or drop files here:").classes("quiet")
    files = ui.upload(
        on_multi_upload=take, on_rejected=refuse, multiple=True, auto_upload=True, max_file_size=LARGEST
    )
    # The header of Quasar's uploader is hidden, because its buttons have no names.
    uploader = f"getElement({files.id}).$refs.qRef"
    files.classes("wide").on("uploaded", js_handler=f"() => {uploader}.removeUploadedFiles()")
    button.on("click", js_handler=f"() => {uploader}.pickFiles()")


@ui.refreshable
def show_scene(desk: Desk) -> None:
    """Draw the step for the scene: convert a map, footprints or a floor plan to a scene, or choose a scene."""
    sources, terrain = desk.folder.files(MAPS), desk.folder.files((".tif", ".tiff"))
    if sources:
        # A table is rarely a plan.
        likely = min(sources, key=lambda name: (name.endswith(".csv"), "plan" not in name.lower()))
        with ui.row():
            source = desk.keep(
                ui.select(sources, label="Map, footprints or plan", value=likely).classes("wide")
            )
            kind = desk.keep(
                ui.select(["osm", "footprints", "plan"], label="Kind", value=_kind(source.value))
            )
            source.on_value_change(lambda event: kind.set_value(_kind(event.value)))
        with ui.expansion("Settings of the scene").classes("wide"), ui.row():
            height = desk.keep(ui.input("Height: a column, or metres", value=""))
            wall = desk.keep(ui.select(ITU, label="Walls (ITU-R P.2040)", value="concrete"))
            thickness = desk.keep(
                ui.number("Thickness of walls [m]", value=0.3, min=0.001, max=10, step=0.01)
            )
            ground = desk.keep(ui.select(ITU, label="Ground", value="concrete"))
            unit = desk.keep(ui.number("Unit of a plan [m]", min=1e-6))
            materials = desk.keep(
                ui.input("Materials of a plan", placeholder="outer=brick:0.3, inner=plasterboard", value="")
            )
            relief = desk.keep(ui.select(["", *terrain], label="Height model of the ground", value=""))
            apart = desk.keep(ui.switch("One mesh per building"))
            # Only settings of the chosen kind of conversion are shown.
            height.bind_visibility_from(kind, "value", lambda value: value != "osm")
            for setting in (wall, thickness, ground, relief, apart):
                setting.bind_visibility_from(kind, "value", lambda value: value != "plan")
            for setting in (unit, materials):
                setting.bind_visibility_from(kind, "value", value="plan")

        def make() -> None:
            with desk.messages():
                words: list[object] = ["scene", kind.value, source.value, "--out", "scene"]
                if kind.value == "plan":
                    if height.value and not _is_number(height.value):
                        raise InputError(f"Height {height.value}: must be a number [m]")
                    words += ["--unit", unit.value] if unit.value else []
                    stated = filter(None, map(str.strip, (materials.value or "").split(",")))
                    words += [f"--material={material}" for material in stated]
                else:
                    words += [
                        "--wall",
                        f"{wall.value}:{filled(thickness)}",
                        "--ground",
                        f"{ground.value}:1.0",
                    ]
                    words += ["--terrain", relief.value] if relief.value else []
                    words += ["--per-building"] if apart.value else []
                if kind.value != "osm":
                    words += [f"--height={height.value}"] if height.value else []
                desk.scene = "scene/scene.xml"
                desk.start(words)

        ui.button("Make the scene", on_click=make)
    scenes = desk.folder.scenes()
    if of_study := desk.folder.valid_content().get("scene", {}).get("file", ""):
        ui.label(f"Scene of the study: {of_study}")
        ui.label(
            "To change the scene, edit the section 'scene' under Measurements, or select 'Draft again'."
        ).classes("quiet")
        return
    if desk.scene not in scenes:
        desk.scene = scenes[0] if scenes else None
    if scenes:

        def choose(event: events.ValueChangeEventArguments) -> None:
            desk.scene = event.value
            desk.refresh()

        ui.select(scenes, label="Scene", value=desk.scene, on_change=choose).classes("wide")


def _kind(source: str) -> str:
    return COMMANDS.get(Path(source).suffix.lower(), "plan" if "plan" in source.lower() else "footprints")


def _is_number(text: str | None) -> bool:
    try:
        float(text or "")
    except ValueError:
        return False
    return True


SECTIONS = ("scene", "links", "antennas", "trace", "offset")
"""Sections whose assumptions are listed in the step for measurements; parameters have a separate step."""


@ui.refreshable
def show_measurements(desk: Desk) -> None:
    """Draw the step for measurements: draft a study from tables of links, and change its assumptions."""
    if desk.folder.study_file.is_file():
        _assumptions(desk)
        findings(desk)
        with ui.expansion("The study file").classes("wide"):
            ui.label(desk.folder.text()).classes("log")
        return
    tables, tracks = desk.folder.tables(), desk.folder.files((".gpx",))
    if not tables:
        ui.label(
            "Add a table of measured links: a CSV or other text file, an Excel file or a Parquet file."
        ).classes("quiet")
        return
    likely_links, likely_sites = likely_tables(desk.folder, tables)
    with ui.row():
        links = desk.keep(ui.select(tables, label="Table of links", value=likely_links).classes("wide"))
        sites = desk.keep(
            ui.select(["", *tables], label="Table of transmitters", value=likely_sites).classes("wide")
        )
        track = desk.keep(
            ui.select(["", *tracks], label="Track", value=tracks[0] if tracks else "").classes("wide")
        )
        frequency = desk.keep(ui.input("Carrier frequency [Hz]", placeholder="3.5e9, unless in a column"))
        tx = desk.keep(ui.input("Transmitter x,y,z [m]", placeholder="unless in a table"))

    def draft() -> None:
        if desk.scene is None:
            ui.notify("Make or add a scene first.", type="negative")
            return
        if frequency.value and not _is_number(frequency.value):
            wrong = f"Carrier frequency [Hz]: {frequency.value}: must be a number such as 2.44e9"
            ui.notify(wrong, type="negative")
            return
        words: list[object] = ["init", desk.scene, links.value, "--out", STUDY]
        options = {
            "--transmitters": sites.value, "--track": track.value, "--frequency": frequency.value, "--tx": tx.value
        }  # fmt: skip
        # Each option is joined to its value, so that a negative value of x is not mistaken for an option.
        words += [f"{option}={value}" for option, value in options.items() if value]
        desk.start(words)

    ui.button("Draft the study", on_click=draft)


@ui.refreshable
def findings(desk: Desk) -> None:
    """Draw the warnings about suspicious links, which are orange on the map."""
    for finding in desk.findings:
        ui.label(finding).classes("warning").props("role=note")


def _assumptions(desk: Desk) -> None:
    content, reasons = desk.folder.valid_content(), desk.folder.reasons()
    columns = _columns(desk, content)
    edits: list[tuple[str, str, Callable[[], Any]]] = []
    for section in SECTIONS:
        table = content.get(section)
        if not isinstance(table, dict) or not table:
            continue
        with ui.expansion(section, value=section == "links").classes("wide"):
            if section in reasons:
                ui.label(reasons[section]).classes("quiet")
            for key, value in table.items():
                with ui.element("div").classes("setting"):
                    edits.append((section, key, _control(key, value, columns)))
                    if reason := reasons.get(f"{section}.{key}"):
                        ui.label(reason).classes("quiet")

    def write(changed: dict[str, Any]) -> None:
        for section, key, read in edits:
            changed.setdefault(section, {})[key] = read()

    desk.edit("measurements", write)

    def again() -> None:
        with desk.messages():
            desk.folder.set_aside()
            desk.edits.clear()
            desk.refresh()

    with ui.row():
        ui.button("Save changes", on_click=desk.save)
        ui.button("Draft again", on_click=again).props("outline").tooltip(
            "This study is kept under another name"
        )


def _control(key: str, value: Any, columns: list[str]) -> Callable[[], Any]:
    """Draw a control for a value of the study, and return a function that reads the control."""
    if isinstance(value, bool):
        switch = ui.switch(key, value=value)
        return lambda: switch.value
    if isinstance(value, str) and value in columns:
        select = ui.select(columns, label=key, value=value).classes("wide")
        return lambda: select.value
    if isinstance(value, str):
        text = ui.input(key, value=value).classes("wide")
        return lambda: text.value
    shown = ui.input(key, value=_toml(value)).classes("wide")

    def read() -> Any:
        try:
            return tomllib.loads(f"value = {shown.value}")["value"]
        except ValueError as error:
            raise InputError(
                f"{key} = {shown.value}: is not a valid value ({error}); put text in quotes"
            ) from None

    return read


def _toml(value: Any) -> str:
    """A value, written in the syntax of the study file."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _columns(desk: Desk, content: dict[str, Any]) -> list[str]:
    """The names of the columns in the table of links."""
    try:
        return [str(name) for name in read_table(desk.folder.path / str(content["links"]["file"])).frame]
    except (InputError, KeyError, TypeError, OSError):
        return []


def likely_tables(folder: StudyFolder, tables: Sequence[str]) -> tuple[str, str]:
    """The tables that most likely contain the links and the transmitters, judged first by columns, then by file names.

    The second name is empty if no table looks like a table of transmitters.
    """
    content = {name: _content(folder.path / name, (folder.path / name).stat().st_mtime_ns) for name in tables}
    named = {name for name in tables if any(word in name.lower() for word in SITES)}
    sites = [name for name in tables if content[name] == "transmitters"]
    sites += [name for name in tables if not content[name] and name in named]
    links = min(
        tables,
        key=lambda name: (
            content[name] != "links", name in sites, name in named, "plan" in name.lower(), Path(name).suffix
        ),
    )  # fmt: skip
    return links, next((name for name in sites if name != links), "")


SITES: Final = ("cell", "site", "mast", "access", "transmitter", "station")
"""Words that occur in the file names of transmitter tables."""


@lru_cache(maxsize=100)
def _content(file: Path, changed: int) -> str:
    """The content of a table, judged by its columns: "links" or "transmitters"; empty if the columns show neither.

    `changed` is the file's modification time, so that a modified file is read again.
    """
    del changed
    try:
        table = read_table(file)
    except (InputError, OSError):
        return ""
    with suppress(InputError):
        find_value(table)
        return "links"
    with suppress(InputError):
        find_transmitter_names(table)
        return "transmitters" if find_position(table.frame, "tx", unnamed=True) else ""
    return ""


@ui.refreshable
def show_parameters(desk: Desk) -> None:
    """Draw the step for parameters: the choice of calibrated parameters, and their bounds and priors."""
    parameters = desk.folder.valid_content().get("parameters")
    if not isinstance(parameters, dict):
        missing = "Draft the study first."
        if desk.folder.study_file.is_file():
            missing = f"{STUDY} has an error, which is shown under Measurements. Correct the error in a text editor."
        ui.label(missing).classes("quiet")
        return
    edits = {name: _entry(name, entry) for name, entry in parameters.items()}

    def write(changed: dict[str, Any]) -> None:
        shown = {name: read() for name, read in edits.items()}
        changed["parameters"] = {name: entry for name, entry in shown.items() if entry is not None}

    desk.edit("parameters", write)
    ui.button("Save parameters", on_click=desk.save)


def _entry(name: str, entry: dict[str, Any]) -> Callable[[], dict[str, Any] | None]:
    """Draw the controls of a parameter; return a function that reads its entry (None if it is not calibrated)."""
    low, high = map(float, entry["bounds"])
    prior = entry.get("prior", {})
    stated = prior.get("itu", "")
    # The study may state a revision or a material that is not in the list, such as "concrete@P.2040-1".
    materials = list(dict.fromkeys(["", stated, *ITU]))
    with ui.element("fieldset"):
        with ui.element("legend"):
            ui.label(name)
        with ui.row():
            chosen = ui.switch("Calibrate", value=True)
            lower = ui.number("Lowest", value=low, format="%.6g")
            upper = ui.number("Highest", value=high, format="%.6g")
            itu = ui.select(materials, label="Prior: ITU-R P.2040", value=stated)
            spread = ui.number(
                "Spread of the prior", value=prior.get("spread", 0.3), min=0.01, max=10, step=0.05
            )
        if entry.get("scale") != "log":
            with ui.row():
                for bound, which in ((lower, "lowest"), (upper, "highest")):
                    # Parameters such as antenna errors can have negative bounds.
                    slider = ui.slider(min=min(2 * low, 0.0), max=max(2 * high, 20.0), step=0.1)
                    slider.bind_value(bound).classes("bound").props(
                        f'label aria-label="{safe(name)} {which}, slider"'
                    )

    def number(control: ui.number) -> float:
        try:
            return filled(control)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None

    def read() -> dict[str, Any] | None:
        if not chosen.value:
            return None
        changed = {**entry, "bounds": [number(lower), number(upper)]}
        if itu.value:
            changed["prior"] = {"itu": itu.value, "spread": number(spread)}
        elif "itu" in prior:
            del changed["prior"]
        elif "spread" in prior:
            changed["prior"] = {**prior, "spread": number(spread)}
        return changed

    return read


def safe(name: str) -> str:
    """The name without quotes, because a quote would end a property string."""
    return "".join(letter for letter in name if letter.isalnum() or letter in " ._-")
