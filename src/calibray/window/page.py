"""The page: the map, the steps from a map to a prediction, and a dialog with the scene in 3-D."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from nicegui import events, run, ui

from calibray.window.desk import MAPS, RADIUS, Desk, Solid, solid
from calibray.window.jobs import Job, stages
from calibray.window.result_steps import show_commands, show_prediction, show_result, show_run
from calibray.window.study_steps import findings, show_measurements, show_parameters, show_scene, upload

STEPS: Final = (
    ("Map or plan", show_scene),
    ("Measurements", show_measurements),
    ("Parameters", show_parameters),
    ("Run", show_run),
    ("Result", show_result),
    ("Predict and use", show_prediction),
)
UPLOADS: Final = {
    "Map or plan": "Add maps, plans, scenes, height models",
    "Measurements": "Add tables, tracks",
}
"""The steps that accept files, with the labels of their upload buttons."""

HEAD: Final = '<link rel="stylesheet" href="/window/window.css"><script src="/window/plan.js" defer></script>'


def build(desk: Desk) -> None:
    """Build the page for one browser tab."""
    # Each tab has its own progress, so that other tabs keep their buttons and keyboard focus if one tab redraws its
    # command.
    progress = ui.refreshable(_progress)

    @ui.refreshable
    def activity() -> None:
        _activity(desk, progress)

    # If the content has changed, redraw all tabs now; otherwise, one tab would soon redraw the steps of all tabs.
    if _contents(desk) != desk.drawn:
        _redraw(desk)
    ui.colors(primary="#1f5fa8", negative="#a11d1d", positive="#1d6b3a", info="#1f5fa8")
    ui.add_head_html(HEAD)
    with ui.element("main").classes("calibray"):
        place = _show_map(desk, activity)
        with ui.element("div").classes("steps"):
            for number, (name, show) in enumerate(STEPS, 1):
                with ui.element("section").classes("step").props(f'aria-label="{name}"'):
                    heading(f"{number}. {name}", 2)
                    # The upload button is outside the part that is redrawn, because redrawing would abort an upload.
                    if name in UPLOADS:
                        upload(desk, UPLOADS[name])
                    show(desk)
    _answer_map(desk, place)
    _follow_changes(desk, activity, progress)


def _show_map(desk: Desk, activity: Callable[[], None]) -> ui.label:
    """Draw the map with its buttons and the last command, and return the label of the chosen position or area."""

    def clear_area() -> None:
        desk.area = None
        place.set_text("")
        desk.mark()
        show_prediction.refresh()

    with ui.element("section").classes("plan").props('aria-label="Map"'):
        heading("Calibray", 1)
        ui.label(str(desk.folder.path)).classes("quiet")
        canvas = ui.element("canvas").props(
            'id=plan tabindex=0 role=application aria-label="Map: arrow keys move it, plus and minus zoom, Enter '
            'chooses the centre"'
        )
        canvas.classes("map")
        with ui.row().classes("tools"):
            # The browser handles these buttons without the server, so that the map has changed before the next input.
            for name, call in (("Whole map", "fit"), ("Draw an area", "drawArea")):
                button = ui.button(name).props("outline dense")
                button.on("click", js_handler=f"() => plan.{call}()")
            ui.button("Clear the area", on_click=clear_area).props("outline dense")
            view_button(desk)
        ui.label("Drag to move, scroll or pinch to zoom, and click to choose a place.").classes("quiet")
        place = ui.label().classes("quiet").mark("place")
        activity()
    return place


def _answer_map(desk: Desk, place: ui.label) -> None:
    """Handle the events of the map's script: the user's choices and loaded data."""

    def picked(event: events.GenericEventArguments) -> None:
        # Adding 0 removes the sign of a negative zero.
        desk.point = round(float(event.args["x"]), 1) + 0.0, round(float(event.args["y"]), 1) + 0.0
        place.set_text(f"Chosen place: x {desk.point[0]:.1f} m, y {desk.point[1]:.1f} m")
        show_prediction.refresh()

    def area_drawn(event: events.GenericEventArguments) -> None:
        west, south, east, north = (
            round(float(event.args[name]), 1) for name in ("west", "south", "east", "north")
        )
        desk.area = west, south, east, north
        place.set_text(f"Chosen area: {east - west:.0f} m by {north - south:.0f} m")
        show_prediction.refresh()

    def loaded(event: events.GenericEventArguments) -> None:
        desk.sites = event.args["sites"]
        show_prediction.refresh()

    def examined(event: events.GenericEventArguments) -> None:
        desk.findings = event.args["findings"]
        findings.refresh()

    ui.on("picked", picked)
    ui.on("area", area_drawn)
    ui.on("plan", loaded)
    ui.on("findings", examined)


def _contents(desk: Desk) -> dict[str, object]:
    """The content of the steps that are redrawn only if their content changes, by step, and the running command.

    These steps have input fields, which would lose the keyboard focus if they were redrawn.
    """
    text, files, job = desk.folder.text(), desk.folder.files((*MAPS, ".tif", ".tiff")), desk.jobs.running()
    return {
        "Map or plan": (text, files, desk.folder.scenes(), desk.scene),
        "Measurements": (text, desk.folder.tables(), desk.folder.files((".gpx",))),
        "Parameters": text,
        "Run": desk.folder.study_file.is_file(),
        "command": None if job is None else job.number,
    }


def _redraw(desk: Desk) -> None:
    """In all tabs, redraw the steps whose content has changed, and the steps whose content is not compared."""
    now = _contents(desk)
    for name, show in STEPS:
        if name not in now or now[name] != desk.drawn.get(name):
            show.refresh()
    show_commands.refresh()
    desk.drawn = now


def _follow_changes(
    desk: Desk, activity: ui.refreshable[[], None], progress: ui.refreshable[[Job], None]
) -> None:
    """Redraw steps when the files in the folder or the running command have changed."""
    watched = {"job": desk.jobs.running(), "text": desk.folder.text(), "drawn": desk.drawn}

    def reload_map() -> None:
        ui.run_javascript(f"plan.load({json.dumps(desk.scene)})")

    def follow() -> None:
        # Without this update, `watch` would redraw the command, and a simultaneous click on its Stop button would be
        # lost.
        watched.update(job=desk.jobs.running(), drawn=desk.drawn)
        activity.refresh()
        reload_map()

    def refresh() -> None:
        _redraw(desk)
        follow()

    def first_map() -> None:
        reload_map()
        desk.mark()

    def watch() -> None:
        before, job, text = watched["job"], desk.jobs.running(), desk.folder.text()
        # Only changed parts are redrawn, because redrawing a button takes away its keyboard focus and may lose a click.
        if job is None or before is None or job.number != before.number:
            if job != before:
                activity.refresh()
        elif job != before:
            progress.refresh(job)
        # A command that has ended may have written files. An editor may have changed the study. A new text counts only
        # if it stays unchanged for a second, because a study that is being written can be incomplete.
        ended = job is None and desk.drawn["command"] is not None
        edited = text == watched["text"] != desk.drawn["Parameters"]
        watched.update(job=job, text=text)
        if ended or edited:
            _redraw(desk)
        # This tab or another tab has redrawn the steps of all tabs.
        if watched["drawn"] != desk.drawn:
            follow()

    desk.show_again[ui.context.client.id] = refresh
    ui.timer(0.1, first_map, once=True)
    ui.timer(1.0, watch)


def heading(text: str, level: int) -> None:
    """Draw a heading that screen readers recognize."""
    with ui.element(f"h{level}"):
        ui.label(text)


def _activity(desk: Desk, progress: Callable[[Job], None]) -> None:
    """Draw the running command, or else the most recent command, with the end of its output."""
    jobs = desk.jobs.list()
    if not jobs:
        return
    job = jobs[0]
    with ui.element("div").classes("activity").props('role=status aria-label="Last command"'):
        ui.label(f"{job.state}: {job.command}").classes("command").mark("activity")
        if job.state == "running":
            progress(job)
            ui.button("Stop", on_click=lambda: desk.jobs.stop(job)).props("outline dense color=negative")
        else:
            lines = [line for line in job.log.splitlines() if line.strip()]
            ui.label("\n".join(lines[-6:])).classes("log")


def _progress(job: Job) -> None:
    """Draw the stages of a running command: earlier stages, the last stage's progress, and the best value so far."""
    shown = stages(job.log)
    for stage in shown[:-1]:
        ui.label(" · ".join(filter(None, (stage.name, f"{stage.seconds} s", stage.best)))).classes("quiet")
    last = shown[-1] if shown else None
    share = None if last is None else last.share
    bar = ui.linear_progress(share or 0.0, show_value=False)
    bar.props('aria-label="Progress of the stage"' + (" indeterminate" if share is None else ""))
    if last is None:
        ui.label("starting").classes("stage")
        return
    done = "" if share is None else f"{100 * share:.0f} %"
    left = "" if last.left is None else f"about {last.left} s left"
    ui.label(" · ".join(filter(None, (last.name, done, f"{last.seconds} s", left)))).classes("stage")
    if last.best:
        ui.label(last.best).classes("best")


COLORS: Final = ("#8f9aa3", "#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2", "#d55e00")
"""Grey, then the Okabe-Ito colours, which colour-blind people can distinguish (jfly.uni-koeln.de/color)."""


@dataclass
class Camera:
    """A camera on a sphere around the scene.

    Attributes:
        azimuth: Azimuth, counter-clockwise from east [rad].
        elevation: Elevation above the horizon [rad].
        distance: Distance from the centre of the scene.
    """

    azimuth: float = -2.0
    elevation: float = 0.7
    distance: float = 1.9 * RADIUS

    def move(self, turn: float = 0.0, rise: float = 0.0, factor: float = 1.0) -> None:
        """Turn and raise the camera, and scale its distance; it never looks straight down, where up is undefined."""
        self.azimuth += turn
        self.elevation = float(np.clip(self.elevation + rise, 0.05, 1.5))
        self.distance = float(np.clip(self.distance * factor, 0.1 * RADIUS, 10 * RADIUS))

    def place(self) -> tuple[float, float, float]:
        """The position of the camera."""
        across = self.distance * np.cos(self.elevation)
        x, y = across * np.cos(self.azimuth), across * np.sin(self.azimuth)
        return float(x), float(y), float(self.distance * np.sin(self.elevation))


def view_button(desk: Desk) -> None:
    """Draw a button that opens a dialog with the scene in 3-D, in which materials can be hidden."""
    dialog = ui.dialog().props('aria-label="Scene in 3-D"')

    async def show() -> None:
        with desk.messages():
            desk.solid = await run.io_bound(solid, desk.folder, desk.scene)
            if desk.solid is None:
                ui.notify("Make or add a scene first.", type="warning")
                return
            dialog.clear()
            with dialog, ui.card().classes("solid"):
                _view(desk.solid)
                ui.button("Close", on_click=dialog.close).props("outline")
            dialog.open()

    ui.button("Show in 3-D", on_click=show).props("outline dense")


def _view(shown: Solid) -> None:
    camera, age = Camera(), time.monotonic_ns()
    with ui.scene(900, 520, grid=False, background_color="#eef1f4").classes("wide") as view:
        objects: dict[str, Any] = {}
        for number, name in enumerate(shown.meshes):
            color = COLORS[number % len(COLORS)]
            objects[name] = view.stl(f"/data/solid/{number}.stl?{age}").material(color, side="both")
        if len(shown.rx):
            view.point_cloud(shown.rx.tolist(), [[0.12, 0.37, 0.66]] * len(shown.rx), 0.01 * RADIUS)
        for x, y, z in shown.tx.tolist():
            view.sphere(0.02 * RADIUS).material("#8a1f6b").move(x, y, z)
    view.props('role=img aria-label="The scene in 3-D"')

    def move(**change: float) -> None:
        camera.move(**change)
        x, y, z = camera.place()
        view.move_camera(x, y, z, 0, 0, 0, 0, 0, 1, duration=0.2)

    move()
    with ui.row():
        for name, change in (
            ("Turn left", {"turn": -0.4}), ("Turn right", {"turn": 0.4}), ("Higher", {"rise": 0.25}),
            ("Lower", {"rise": -0.25}), ("Closer", {"factor": 0.7}), ("Farther", {"factor": 1.4}),
        ):  # fmt: skip
            ui.button(name, on_click=partial(move, **change)).props("outline dense")
    with ui.row().props('role=group aria-label="Materials"'):
        for (name, mesh), color in zip(objects.items(), COLORS * len(objects), strict=False):
            with ui.element("span").classes("material"):
                ui.element("span").classes("swatch").style(f"background: {color}")
                ui.checkbox(name, value=True, on_change=lambda event, mesh=mesh: mesh.visible(event.value))
    ui.label("Drag to turn, and scroll to zoom. Receivers are blue, and transmitters are purple.").classes(
        "quiet"
    )
