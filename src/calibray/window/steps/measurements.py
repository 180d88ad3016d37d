"""The second step: tables of links become a drafted study, whose assumptions can be changed."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import run, ui

from calibray.errors import InputError
from calibray.window.desk import STUDY, TABLES, Desk
from calibray.window.steps.scene import upload

SECTIONS = ("scene", "links", "antennas", "trace", "offset")
"""Sections with assumptions that this step shows; parameters have their own step."""


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    upload(desk, "Add tables, tracks")
    if desk.folder.study_file.is_file():
        _assumptions(desk)
        findings(desk)
        with ui.expansion("The study file").classes("wide"):
            ui.label(desk.folder.text()).classes("log")
        return
    tables, tracks = desk.folder.files(TABLES), desk.folder.files((".gpx",))
    if not tables:
        ui.label("Add a table of measured links: CSV, Excel or Parquet.").classes("quiet")
        return
    with ui.row():
        links = ui.select(tables, label="Table of links", value=_likely(tables)).classes("wide")
        sites = ui.select(["", *tables], label="Table of transmitters", value=_sites(tables)).classes("wide")
        track = ui.select(["", *tracks], label="Track", value=tracks[0] if tracks else "").classes("wide")
        frequency = ui.input("Carrier frequency [Hz]", placeholder="3.5e9, unless a column has it")
        tx = ui.input("Transmitter x,y,z [m]", placeholder="unless a table has it")

    def draft() -> None:
        if desk.scene is None:
            ui.notify("Make or add a scene first.", type="negative")
            return
        words: list[object] = ["init", desk.scene, links.value, "--out", STUDY]
        options = {
            "--transmitters": sites.value, "--track": track.value, "--frequency": frequency.value, "--tx": tx.value
        }  # fmt: skip
        # One word each, so that a negative x is not taken for an option.
        words += [f"{option}={value}" for option, value in options.items() if value]
        desk.start(words)

    ui.button("Draft the study", on_click=draft)


@ui.refreshable
def findings(desk: Desk) -> None:
    """Suspicions about the links, which are orange on the map."""
    for finding in desk.findings:
        ui.label(finding).classes("warning").props("role=note")


def _assumptions(desk: Desk) -> None:
    content, reasons = desk.folder.content(), desk.folder.reasons()
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

    async def save() -> None:
        with desk.messages():
            for section, key, read in edits:
                content[section][key] = read()
            await run.io_bound(desk.folder.save, content)
            ui.notify("Saved", type="positive")
            desk.refresh()

    def again() -> None:
        with desk.messages():
            desk.folder.set_aside()
            desk.refresh()

    with ui.row():
        ui.button("Save changes", on_click=save)
        ui.button("Draft again", on_click=again).props("outline").tooltip(
            "Keeps this study under another name"
        )


def _control(key: str, value: Any, columns: list[str]) -> Callable[[], Any]:
    """A control for a value of the study, and a function that reads it."""
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
                f"{key} = {shown.value}: is not a value ({error}); put texts in quotes"
            ) from None

    return read


def _toml(value: Any) -> str:
    """A value in the form of the study file."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def _columns(desk: Desk, content: dict[str, Any]) -> list[str]:
    """The columns of the table of links."""
    from calibray.measurements import read_table

    try:
        return [str(name) for name in read_table(desk.folder.path / str(content["links"]["file"])).frame]
    except (InputError, KeyError, TypeError, OSError):
        return []


def _likely(tables: list[str]) -> str:
    """The table that most likely contains the links."""
    return min(tables, key=lambda name: (_is_sites(name), "plan" in name.lower(), Path(name).suffix))


def _sites(tables: list[str]) -> str:
    return next((name for name in tables if _is_sites(name)), "")


def _is_sites(name: str) -> bool:
    words = ("cell", "site", "mast", "access", "transmitter", "station")
    return any(word in name.lower() for word in words)
