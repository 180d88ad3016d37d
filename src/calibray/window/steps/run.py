"""The fourth step: calibrate, validate, and everything that has run or is running in the folder."""

from __future__ import annotations

import re

from nicegui import ui

from calibray.window.desk import STUDY, Desk
from calibray.window.jobs import Job

RUNS_SHOWN = 20


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    if desk.folder.study_file.is_file():
        with ui.row():
            out = ui.input("Name of the result", value="result")
            blocks = ui.number("Blocks to validate by", value=4, min=2, max=100, step=1, format="%d")

        def start(words: list[object]) -> None:
            if not re.fullmatch(r"\w[\w-]*", out.value or ""):
                ui.notify("Use letters, digits, _ and - in names of results.", type="negative")
                return
            desk.start(words)

        def validate() -> None:
            start(["validate", STUDY, "--blocks", int(blocks.value or 4), "--out", out.value])

        with ui.row():
            ui.button("Calibrate", on_click=lambda: start(["run", STUDY, "--out", out.value]))
            ui.button("Validate", on_click=validate).props("outline")
            ui.button("Check the rays", on_click=lambda: start(["trace", STUDY, "--check"])).props("outline")
    jobs = [*desk.jobs.elsewhere(), *desk.jobs.list()][:RUNS_SHOWN]
    if not jobs:
        ui.label("Nothing has run here yet.").classes("quiet")
        return
    with ui.element("ul").classes("runs").props('aria-label="Commands"'):
        for job in jobs:
            with ui.element("li"):
                _row(desk, job)


def _row(desk: Desk, job: Job) -> None:
    ui.label(job.state if job.number else f"{job.state}, in a terminal").classes(f"state {job.state}")
    ui.label(job.command).classes("command")
    if job.state in {"died", "stopped", "failed"}:
        ui.button("Resume", on_click=lambda: desk.start(job.words)).props(
            'outline dense aria-label="Start this command again; finished work is not repeated"'
        )
    if job.log:
        with ui.expansion("Output").classes("wide"):
            ui.label(job.log).classes("log")
