"""The last step: predict at a place, map an area, suggest where to measure, export."""

from __future__ import annotations

import json
from typing import Any, Final

import numpy as np
import pandas as pd
from nicegui import ui

from calibray.errors import InputError
from calibray.support.output_tables import write_table
from calibray.window.desk import Desk

PLACE, PREDICTED = "place.csv", "place-predicted.csv"
CANDIDATES, SUGGESTED = "candidates.csv", "suggested.csv"
MOST_CANDIDATES: Final = 2000
"""Largest number of candidate places; each is traced."""


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    names = desk.folder.results()
    if not names:
        ui.label("Calibrate first.").classes("quiet")
        return
    sites = {json.dumps(site): f"{site[0]:g}, {site[1]:g}, {site[2]:g}" for site in desk.transmitters}
    with ui.row():
        chosen = ui.select(names, label="Result", value=names[-1])
        tx = ui.select(sites, label="Transmitter x, y, z [m]", value=next(iter(sites), None))
        height = ui.number("Height of the receiver [m]", value=1.5, step=0.1)
        cell = ui.number("Width of a cell [m]", value=5.0, min=0.1, step=1)
    x, y = desk.point or (None, None)
    with ui.row():
        east = ui.number("x [m]", value=x, format="%.1f")
        north = ui.number("y [m]", value=y, format="%.1f")

    def site() -> list[float]:
        if tx.value is None:
            raise InputError("choose a transmitter")
        return json.loads(tx.value)

    def predict() -> None:
        with desk.messages():
            if east.value is None or north.value is None:
                raise InputError("choose a place: click on the map, or give x and y")
            places = np.array([[east.value, north.value, height.value]])
            write_table(desk.folder.path / PLACE, _links(desk, site(), places))
            desk.start(["predict", chosen.value, PLACE, "--level", 0.9, "--out", PREDICTED])

    def cover() -> None:
        with desk.messages():
            bounds = ["--bounds", *desk.area] if desk.area else []
            desk.start(
                [
                    "map",
                    chosen.value,
                    "--tx",
                    *site(),
                    "--height",
                    height.value,
                    "--cell",
                    cell.value,
                    *bounds,
                ]
            )

    def suggest() -> None:
        with desk.messages():
            write_table(
                desk.folder.path / CANDIDATES,
                _links(desk, site(), _grid(desk, cell.value or 5.0, height.value or 1.5)),
            )
            desk.start(["suggest", chosen.value, CANDIDATES, "--count", 5, "--out", SUGGESTED])

    with ui.row():
        ui.button("Predict here", on_click=predict)
        ui.button("Map the area", on_click=cover)
        ui.button("Suggest places", on_click=suggest)
        export = ["export", chosen.value, "--out", f"exported-{chosen.value}", "--copy"]
        ui.button("Export", on_click=lambda: desk.start(export)).props("outline")
    ui.label(f"Area: {desk.area or 'the whole scene'}").classes("quiet")
    _predicted(desk)
    _suggested(desk)
    for name in names:
        if (desk.folder.path / name / "map.png").is_file():
            age = (desk.folder.path / name / "map.png").stat().st_mtime_ns
            ui.element("img").props(f'src="/result/{name}/map.png?{age}" alt="Map of {name}"').classes(
                "coverage"
            )


def _links(desk: Desk, tx: list[float], rx: Any) -> pd.DataFrame:
    """Links from a transmitter to places, with the groups and the carrier of its measured links."""
    from calibray.study import Study

    study = Study.load(desk.folder.study_file)
    links = study.measurements()
    table = pd.DataFrame({f"rx_{axis}": rx[:, k] for k, axis in enumerate("xyz")})
    for k, axis in enumerate("xyz"):
        table[f"tx_{axis}"] = tx[k]
    same = np.flatnonzero(np.abs(links.tx - tx).max(axis=1) < 0.01)
    row = links.table.frame.iloc[int(same[0]) if len(same) else 0]
    columns = [*study.offset_groups, study.links.transmitter, study.links.frequency]
    for column in columns:
        if isinstance(column, str) and column in row.index and column not in table:
            table[column] = row[column]
    return table


def _grid(desk: Desk, cell: float, height: float) -> Any:
    """Places of a regular grid in the chosen area [n, 3], [m]."""
    if desk.area is None:
        raise InputError("draw an area on the map first; its places are the candidates")
    west, south, east, north = desk.area
    if (east - west) * (north - south) / cell**2 > MOST_CANDIDATES:
        raise InputError(
            f"the area has more than {MOST_CANDIDATES} cells; draw a smaller one, or widen the cells"
        )
    x, y = np.meshgrid(np.arange(west, east, cell), np.arange(south, north, cell))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def _read(desk: Desk, name: str) -> pd.DataFrame | None:
    try:
        return pd.read_csv(desk.folder.path / name)
    except (OSError, ValueError):
        return None


def _predicted(desk: Desk) -> None:
    table = _read(desk, PREDICTED)
    if table is None or not len(table) or "upper_db" not in table:
        return
    row = table.iloc[0]
    ui.label(
        f"At x {row['rx_x']:.1f} m, y {row['rx_y']:.1f} m: path loss {row['path_loss_db']:.1f} dB, 90 % interval "
        f"{row['lower_db']:.1f} to {row['upper_db']:.1f} dB ({row['basis']})"
    ).classes("predicted")


def _suggested(desk: Desk) -> None:
    table = _read(desk, SUGGESTED)
    if table is None or not {"rx_x", "rx_y"} <= set(table):
        return
    points = table[["rx_x", "rx_y"]].to_numpy().tolist()
    ui.run_javascript(f"plan.suggest({json.dumps(points)})")
    with ui.element("ol").props('aria-label="Suggested places"'):
        for x, y in points:
            with ui.element("li"):
                ui.label(f"x {x:.1f} m, y {y:.1f} m")
