"""The third step: what is calibrated, within which bounds, and with which prior."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import run, ui

from calibray.window.desk import Desk
from calibray.window.steps.scene import ITU


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    content = desk.folder.content()
    parameters = content.get("parameters")
    if not isinstance(parameters, dict):
        ui.label("Draft the study first.").classes("quiet")
        return
    edits = {name: _entry(name, entry) for name, entry in parameters.items() if isinstance(entry, dict)}

    async def save() -> None:
        with desk.messages():
            kept = {name: read() for name, read in edits.items()}
            changed = {name: entry for name, entry in kept.items() if entry is not None}
            await run.io_bound(desk.folder.save, {**content, "parameters": changed})
            ui.notify("Saved", type="positive")
            desk.refresh()

    ui.button("Save parameters", on_click=save)


def _entry(name: str, entry: dict[str, Any]) -> Callable[[], dict[str, Any] | None]:
    """The controls of a parameter, and a function that reads its entry; None if it is not calibrated."""
    low, high = (float(bound) for bound in entry.get("bounds", [1.5, 15.0]))
    prior = entry.get("prior", {})
    with ui.element("fieldset"):
        with ui.element("legend"):
            ui.label(name)
        with ui.row():
            chosen = ui.switch("Calibrate", value=True)
            lower = ui.number("Lowest", value=low, format="%.6g")
            upper = ui.number("Highest", value=high, format="%.6g")
            itu = ui.select(["", *ITU], label="Prior: ITU-R P.2040", value=_known(prior.get("itu")))
            spread = ui.number(
                "Spread of the prior", value=prior.get("spread", 0.3), min=0.01, max=10, step=0.05
            )
        if entry.get("scale") != "log":
            with ui.row():
                for bound, which in ((lower, "lowest"), (upper, "highest")):
                    slider = ui.slider(min=0, max=max(2 * high, 20.0), step=0.1).bind_value(bound)
                    slider.classes("bound").props(f'label aria-label="{_safe(name)} {which}, slider"')

    def read() -> dict[str, Any] | None:
        if not chosen.value:
            return None
        changed = {**entry, "bounds": [lower.value, upper.value]}
        if itu.value:
            changed["prior"] = {"itu": itu.value, "spread": spread.value}
        elif "itu" in prior:
            del changed["prior"]
        return changed

    return read


def _known(name: object) -> str:
    return name if isinstance(name, str) and name in ITU else ""


def _safe(name: str) -> str:
    """A name for a property, whose syntax has quotes."""
    return "".join(letter for letter in name if letter.isalnum() or letter in " ._-")
