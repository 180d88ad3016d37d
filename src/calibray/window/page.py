"""The page: the map, and the steps from a map to a prediction."""

from __future__ import annotations

import json
from typing import Any, Final

from nicegui import events, ui

from calibray.window import view_3d
from calibray.window.desk import Desk
from calibray.window.jobs import Stage, stages
from calibray.window.steps import measurements, parameters, prediction, result, run, scene

STEPS: Final = (
    ("Map or plan", scene.show),
    ("Measurements", measurements.show),
    ("Parameters", parameters.show),
    ("Run", run.show),
    ("Result", result.show),
    ("Predict and use", prediction.show),
)
HEAD: Final = '<link rel="stylesheet" href="/window/window.css"><script src="/window/plan.js" defer></script>'


def build(desk: Desk) -> None:
    """Build the page for one tab of the browser."""
    ui.colors(primary="#1f5fa8", negative="#a11d1d", positive="#1d6b3a", info="#1f5fa8")
    ui.add_head_html(HEAD)
    with ui.element("main").classes("calibray"):
        with ui.element("section").classes("plan").props('aria-label="Map"'):
            heading("Calibray", 1)
            ui.label(str(desk.folder.path)).classes("quiet")
            canvas = ui.element("canvas").props(
                'id=plan tabindex=0 role=application aria-label="Map: arrow keys move it, plus and minus zoom, Enter '
                'chooses the middle"'
            )
            canvas.classes("map")
            with ui.row().classes("tools"):
                ui.button("Whole map", on_click=lambda: ui.run_javascript("plan.fit()")).props(
                    "outline dense"
                )
                ui.button("Draw an area", on_click=lambda: ui.run_javascript("plan.drawArea()")).props(
                    "outline dense"
                )
                view_3d.button(desk)
            ui.label("Drag to move, wheel to zoom, click to choose a place.").classes("quiet")
            place = ui.label().classes("quiet").mark("place")
            activity(desk)
        with ui.element("div").classes("steps"):
            for number, (name, show) in enumerate(STEPS, 1):
                with ui.element("section").classes("step").props(f'aria-label="{name}"'):
                    heading(f"{number}. {name}", 2)
                    show(desk)

    def refresh() -> None:
        for _, show in STEPS:
            show.refresh()
        activity.refresh()
        reload_map()

    def reload_map() -> None:
        ui.run_javascript(f"plan.load({json.dumps(desk.scene)})")

    def picked(event: events.GenericEventArguments) -> None:
        desk.point = float(event.args["x"]), float(event.args["y"])
        place.set_text(f"Chosen place: x {desk.point[0]:.1f} m, y {desk.point[1]:.1f} m")
        prediction.show.refresh()

    def area_drawn(event: events.GenericEventArguments) -> None:
        west, south, east, north = (
            round(float(event.args[name]), 1) for name in ("west", "south", "east", "north")
        )
        desk.area = west, south, east, north
        place.set_text(f"Chosen area: {east - west:.0f} m by {north - south:.0f} m")
        prediction.show.refresh()

    def loaded(event: events.GenericEventArguments) -> None:
        data: dict[str, Any] = event.args
        desk.transmitters = data["transmitters"]
        prediction.show.refresh()

    def examined(event: events.GenericEventArguments) -> None:
        desk.findings = event.args["findings"]
        measurements.findings.refresh()

    desk.refresh = refresh
    ui.timer(0.1, reload_map, once=True)
    ui.on("picked", picked)
    ui.on("area", area_drawn)
    ui.on("plan", loaded)
    ui.on("findings", examined)
    watched = {"job": desk.jobs.running()}

    def watch() -> None:
        job = desk.jobs.running()
        # Only after a change: a button that is made again loses the keyboard.
        if job != watched["job"]:
            activity.refresh()
        ended = watched["job"] is not None and job is None
        watched["job"] = job
        if ended:
            refresh()

    ui.timer(1.0, watch)


def heading(text: str, level: int) -> None:
    """A heading, for readers of the screen too."""
    with ui.element(f"h{level}"):
        ui.label(text)


@ui.refreshable
def activity(desk: Desk) -> None:
    """The command that is running, or ran last, with the end of its output."""
    jobs = desk.jobs.list()
    if not jobs:
        return
    job = jobs[0]
    with ui.element("div").classes("activity").props('role=status aria-label="Last command"'):
        ui.label(f"{job.state}: {job.command}").classes("command").mark("activity")
        if job.state == "running":
            progress(stages(job.log))
            ui.button("Stop", on_click=lambda: desk.jobs.stop(job)).props("outline dense color=negative")
        else:
            lines = [line for line in job.log.splitlines() if line.strip()]
            ui.label("\n".join(lines[-6:])).classes("log")


def progress(shown: list[Stage]) -> None:
    """The stages of a running command: the earlier ones, the progress of the last one, and the best value so far."""
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
