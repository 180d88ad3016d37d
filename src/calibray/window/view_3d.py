"""A dialog with the scene in 3-D: materials that can be hidden, and a camera for mouse, touch and keys."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from nicegui import run, ui

from calibray.window.desk import RADIUS, Desk, Solid, solid

COLORS: Final = ("#8f9aa3", "#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2", "#d55e00")
"""Grey, then the colours of Okabe and Ito, which colour-blind people can distinguish (jfly.uni-koeln.de/color)."""


@dataclass
class Camera:
    """A camera on a sphere around the scene.

    Attributes:
        azimuth: From the east, anticlockwise [rad].
        elevation: Above the horizon [rad].
        distance: Distance from the centre of the scene.
    """

    azimuth: float = -2.0
    elevation: float = 0.7
    distance: float = 1.9 * RADIUS

    def move(self, turn: float = 0.0, rise: float = 0.0, factor: float = 1.0) -> None:
        """Turn, raise and approach the camera; straight down, the direction up would be undefined."""
        self.azimuth += turn
        self.elevation = float(np.clip(self.elevation + rise, 0.05, 1.5))
        self.distance = float(np.clip(self.distance * factor, 0.1 * RADIUS, 10 * RADIUS))

    def place(self) -> tuple[float, float, float]:
        """Where it is."""
        across = self.distance * np.cos(self.elevation)
        x, y = across * np.cos(self.azimuth), across * np.sin(self.azimuth)
        return float(x), float(y), float(self.distance * np.sin(self.elevation))


def button(desk: Desk) -> None:
    """A button that opens the dialog."""
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
        ui.button("Turn left", on_click=lambda: move(turn=-0.4)).props("outline dense")
        ui.button("Turn right", on_click=lambda: move(turn=0.4)).props("outline dense")
        ui.button("Higher", on_click=lambda: move(rise=0.25)).props("outline dense")
        ui.button("Lower", on_click=lambda: move(rise=-0.25)).props("outline dense")
        ui.button("Closer", on_click=lambda: move(factor=0.7)).props("outline dense")
        ui.button("Farther", on_click=lambda: move(factor=1.4)).props("outline dense")
    with ui.row().props('role=group aria-label="Materials"'):
        for (name, mesh), color in zip(objects.items(), COLORS * len(objects), strict=False):
            with ui.element("span").classes("material"):
                ui.element("span").classes("swatch").style(f"background: {color}")
                ui.checkbox(name, value=True, on_change=lambda event, mesh=mesh: mesh.visible(event.value))
    ui.label("Drag to turn, wheel to zoom. Blue: receivers; purple: transmitters.").classes("quiet")
