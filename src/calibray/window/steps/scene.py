"""The first step: a map, footprints or a floor plan becomes a scene, or a scene is chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from nicegui import events, ui

from calibray.materials import DEFAULT_REVISION, ITU_MATERIALS
from calibray.window.desk import LARGEST, MAPS, Desk

ITU: Final = [name for name in ITU_MATERIALS[DEFAULT_REVISION] if name != "vacuum"]
COMMANDS: Final = {".osm": "osm", ".pbf": "osm", ".csv": "plan", ".dxf": "plan"}
"""How files are converted to scenes; files of other kinds may be footprints or plans."""


def upload(desk: Desk, label: str) -> None:
    """Take files into the folder."""

    async def take(event: events.UploadEventArguments) -> None:
        with desk.messages():
            target = desk.folder.check_upload(event.file.name)
            target.parent.mkdir(exist_ok=True)
            await event.file.save(target)
            ui.notify(f"Added: {target.name}", type="positive")
        # The list of files changes when all of them have come.
        ui.timer(0.3, desk.refresh, once=True)

    button = ui.button(label).props("outline")
    ui.label("Or drop files here:").classes("quiet")
    files = ui.upload(on_upload=take, multiple=True, auto_upload=True, max_file_size=LARGEST).classes("wide")
    # The header of Quasar's uploader, which is hidden, has buttons without names.
    button.on("click", js_handler=f"() => getElement({files.id}).pickFiles()")


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    upload(desk, "Add maps, plans, scenes, height models")
    sources, terrain = desk.folder.files(MAPS), desk.folder.files((".tif", ".tiff"))
    if sources:
        with ui.row():
            source = ui.select(sources, label="Map, footprints or plan", value=_likely(sources)).classes(
                "wide"
            )
            kind = ui.select(["osm", "footprints", "plan"], label="Kind", value=_kind(source.value))
            source.on_value_change(lambda event: kind.set_value(_kind(event.value)))
        with ui.expansion("Settings of the scene").classes("wide"), ui.row():
            height = ui.input("Height: a column, or metres", value="3")
            wall = ui.select(ITU, label="Walls (ITU-R P.2040)", value="concrete")
            thickness = ui.number("Thickness of walls [m]", value=0.3, min=0.001, max=10, step=0.01)
            ground = ui.select(ITU, label="Ground", value="concrete")
            unit = ui.number("Unit of a plan [m]", value=1.0, min=1e-6)
            relief = ui.select(["", *terrain], label="Height model of the ground", value="")
            apart = ui.switch("One mesh per building")

        def make() -> None:
            words: list[object] = ["scene", kind.value, source.value, "--out", "scene"]
            if kind.value == "plan":
                words += ["--unit", unit.value]
                words += [f"--height={height.value}"] if _number(height.value) else []
            else:
                words += ["--wall", f"{wall.value}:{thickness.value}", "--ground", f"{ground.value}:1.0"]
                words += ["--terrain", relief.value] if relief.value else []
                words += ["--per-building"] if apart.value else []
            if kind.value == "footprints":
                words += [f"--height={height.value}"]
            desk.scene = "scene/scene.xml"
            desk.start(words)

        ui.button("Make the scene", on_click=make)
    scenes = desk.folder.scenes()
    if desk.scene not in scenes:
        desk.scene = scenes[0] if scenes else None
    if scenes:

        def choose(event: events.ValueChangeEventArguments) -> None:
            desk.scene = event.value
            desk.refresh()

        ui.select(scenes, label="Scene", value=desk.scene, on_change=choose).classes("wide")


def _likely(sources: list[str]) -> str:
    """The file that is most likely a map; tables are seldom plans."""
    ranked = sorted(sources, key=lambda name: (name.endswith(".csv"), "plan" not in name.lower()))
    return ranked[0]


def _kind(source: str) -> str:
    return COMMANDS.get(Path(source).suffix.lower(), "plan" if "plan" in source.lower() else "footprints")


def _number(text: str | None) -> bool:
    try:
        float(text or "")
    except ValueError:
        return False
    return True
