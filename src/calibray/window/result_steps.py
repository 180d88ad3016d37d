"""The steps of the page that use a study: runs, results and predictions.

These steps are redrawn after each command.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
import pandas as pd
from nicegui import run, ui
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.reporting.link_survey import QUANTITIES
from calibray.result.files import read
from calibray.result.held_out import HeldOutErrors, Model
from calibray.support.messages import counted
from calibray.support.output_files import write_table
from calibray.validation.held_out_statistics import compare
from calibray.window.desk import (
    CANDIDATES,
    PLACE,
    PREDICTED,
    STUDY,
    SUGGESTED,
    Desk,
    filled,
    grid_above_ground,
)
from calibray.window.jobs import Job
from calibray.window.study_steps import safe


@ui.refreshable
def show_run(desk: Desk) -> None:
    """Draw the step for runs: calibration, validation, and all commands that ran or are running in the folder."""
    if desk.folder.study_file.is_file():
        with ui.row():
            out = desk.keep(ui.input("Name of the result", value="result"))
            blocks = desk.keep(
                ui.number("Number of validation blocks", value=4, min=2, max=100, step=1, format="%d")
            )

        def start(words: list[object]) -> None:
            if not re.fullmatch(r"\w[\w-]*", out.value or ""):
                ui.notify("Use only letters, digits, _ and - in the name of a result.", type="negative")
                return
            desk.start(words)

        def validate() -> None:
            start(["validate", STUDY, "--blocks", int(blocks.value or 4), "--out", out.value])

        with ui.row():
            ui.button("Calibrate", on_click=lambda: start(["run", STUDY, "--out", out.value]))
            ui.button("Validate", on_click=validate).props("outline")
            ui.button("Check the rays", on_click=lambda: start(["trace", STUDY, "--check"])).props("outline")
    show_commands(desk)


RESUMED: Final = frozenset({"run", "validate", "trace", "predict", "map", "suggest"})
"""Commands that keep finished work: traces in the cache or engine calls in the ledger."""


@ui.refreshable
def show_commands(desk: Desk) -> None:
    """Draw the list of commands that ran or are running in the folder."""
    jobs = [*desk.jobs.elsewhere(), *desk.jobs.list()][:20]
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
    if job.state in {"died", "stopped", "failed"} and RESUMED.intersection(job.words[:1]):
        # The accessible name starts with the text of the button, so that voice control finds the button (WCAG 2.5.3).
        ui.button("Resume", on_click=lambda: desk.start(job.words)).props(
            'outline dense aria-label="Resume: start this command again without repeating finished work"'
        )
    if job.log:
        with ui.expansion("Output").classes("wide"):
            ui.label(job.log).classes("log")


NONE = "-"


@ui.refreshable
def show_result(desk: Desk) -> None:
    """Draw the step for results: a table of key figures, and the report."""
    names = desk.folder.results()
    if not names:
        ui.label("No result yet.").classes("quiet")
        return
    with desk.messages():
        _table(desk, names)
    if len(names) > 1:
        with desk.messages():
            _comparison(desk, names)
    chosen = desk.keep(ui.select(names, label="Report", value=names[-1]).classes("wide"))
    frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts" title="Report"')

    def point() -> None:
        frame.props(f'src="/result/{quote(chosen.value)}/report.html"')
        link.props(f'href="/result/{quote(chosen.value)}/report.html"')

    with ui.row():
        ui.button("Write the report again", on_click=lambda: desk.start(["report", chosen.value])).props(
            "outline"
        ).tooltip("After a validation, the report includes the errors of the held-out blocks")
    link = ui.link("Open the report in a new tab", "#", new_tab=True)
    chosen.on_value_change(point)
    point()


def _table(desk: Desk, names: list[str]) -> None:
    """Draw parameter values and errors, with one column per result."""
    columns = {name: _facts(desk, name) for name in names}
    rows = dict.fromkeys(key for column in columns.values() for key in column)
    _facts_table(
        names, {row: {name: column.get(row, NONE) for name, column in columns.items()} for row in rows}
    )


def _facts_table(names: list[str], rows: dict[str, dict[str, str]]) -> None:
    """Draw rows of text, with one column per result; differences from the first result are bold."""
    with ui.element("div").classes("scrolled").props("tabindex=0"), ui.element("table").classes("facts"):
        with ui.element("tr"):
            for text in ("", *names):
                with ui.element("th").props("scope=col"):
                    ui.label(text)
        for row, texts in rows.items():
            with ui.element("tr"):
                with ui.element("th").props("scope=row"):
                    ui.label(row)
                for name in names:
                    with ui.element("td"):
                        label = ui.label(texts[name])
                        if texts[name] != texts[names[0]]:
                            label.classes("differs")


def _facts(desk: Desk, name: str) -> dict[str, str]:
    """Key figures of a result, keyed by name."""
    record = desk.folder.result(name)
    facts = {
        "Links": _shown(record, "links", "calibrated_on"),
        "RMSE, initial materials [dB]": _shown(record, "fit", "initial_rmse_db"),
        "RMSE, calibrated [dB]": _shown(record, "fit", "rmse_db"),
        "RMSE, log-distance model [dB]": _shown(record, "fit", "log_distance_rmse_db"),
        "RMSE of held-out links, calibrated [dB]": _shown(record, "accuracy", "holdout_rmse_db"),
    }
    model = str(_inside(record, "prediction", "model", "name") or NONE)
    if model != Model.CALIBRATED and _inside(record, "accuracy", "holdout_rmse_db") is not None:
        residual_db = _shown(record, "prediction", "model", "residual_db")
        facts["RMSE of held-out links, prediction model [dB]"] = residual_db
    facts["Prediction model"] = model
    for parameter, value in (_inside(record, "fit", "parameters") or {}).items():
        interval = _inside(record, "uncertainty", "intervals", parameter) or {}
        ends = f" ({_number(interval.get('lower'))} to {_number(interval.get('upper'))})" if interval else ""
        approximate = ", approximate" if interval.get("approximate") else ""
        facts[parameter] = f"{_number(value)}{ends}, {interval.get('verdict', NONE)}{approximate}"
    return facts


def _comparison(desk: Desk, names: list[str]) -> None:
    """Draw the differences between the studies, and a button that shows which result predicts better."""
    changed = changes([desk.folder.result(name).get("study") or {} for name in names])
    ui.label("Differences between the studies").classes("title")
    if changed:
        rows = [
            {
                name: NONE if value is None else json.dumps(value, ensure_ascii=False)[:300]
                for name, value in zip(names, values, strict=True)
            }
            for values in changed.values()
        ]
        _facts_table(names, dict(zip(changed, rows, strict=True)))
    else:
        ui.label("None: the studies have the same settings.").classes("quiet")
    with ui.row():
        first = desk.keep(ui.select(names, label="Compare", value=names[0]))
        second = desk.keep(ui.select(names, label="with", value=names[-1]))

    async def judge() -> None:
        with desk.messages():
            verdict.text = await run.io_bound(better, first.value, second.value, desk.folder.path) or ""

    ui.button("Which predicts better?", on_click=judge).props("outline")
    verdict = ui.label().classes("predicted").props("role=status")


def _inside(record: Any, *keys: str) -> Any:
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def _shown(record: Any, *keys: str) -> str:
    return _number(_inside(record, *keys))


def _number(value: Any) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else NONE


def settings(study: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The settings of a study by dotted name.

    Example:
        >>> settings({"scene": {"frequency": 3.5e9}, "offset": {}})
        {'scene.frequency': 3500000000.0}
    """
    values: dict[str, Any] = {}
    for name, value in study.items():
        values |= (
            settings(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
        )
    return values


def changes(studies: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Settings that differ between studies, by dotted name: the value in each study, or None if it is missing."""
    tables = [settings(study) for study in studies]
    rows = {name: [table.get(name) for table in tables] for table in tables for name in table}
    return {name: values for name, values in rows.items() if any(value != values[0] for value in values)}


def predictive_errors(folder: Path) -> tuple[str, HeldOutErrors] | None:
    """The prediction model of a result, and the model's held-out errors; None if this model was not validated.

    Raises:
        InputError: The result or its validation cannot be read, or the two belong to different studies.
    """
    fields = read(folder, allow_changed_inputs=True)
    held_out, model = fields["held_out"], fields["prediction"].model.name
    return None if held_out is None or model not in held_out.errors else (model, held_out)


def better(first: str, second: str, folder: Path) -> str:
    """A sentence that states which of two results in a folder predicts held-out blocks better, and how certain this is.

    Raises:
        InputError: The two names are the same, or a result or its validation cannot be read.
    """
    if first == second:
        raise InputError(f"{first}: chosen twice; choose two different results")
    results = {name: predictive_errors(folder / name) for name in (first, second)}
    if missing := [name for name, errors in results.items() if errors is None]:
        return f"{' and '.join(missing)}: not validated, so it is unknown which result predicts better. Validate both."
    (model, one), (other_model, other) = (errors for errors in results.values() if errors is not None)
    same = [(one.position, other.position), (one.measured_db, other.measured_db)]
    if not all(np.array_equal(*pair) for pair in same):
        return (
            f"{first} and {second} were validated on different links, so the two results cannot be compared."
        )
    judged = (one.block >= 0) & (other.block >= 0)
    if not judged.any():
        return f"{first} and {second} have no held-out link in common. Validate both with the same blocks."
    errors = {first: one.errors[model][judged], second: other.errors[other_model][judged]}
    best, worst = sorted(errors, key=lambda name: float(np.mean(errors[name] ** 2)))
    judgement = compare(errors[best], {worst: errors[worst]}, one.position[judged])
    # The blocks are those of the first result; the second result may have different blocks.
    lower = sum(
        np.mean(errors[best][rows] ** 2) < np.mean(errors[worst][rows] ** 2)
        for rows in (one.block[judged] == block for block in np.unique(one.block[judged]))
    )
    certainty = "" if judgement.error_db is None else f", standard error {judgement.error_db:.2f} dB"
    blocks = len(np.unique(one.block[judged]))
    verb = "predicts" if judgement.helped else "does not predict significantly"
    return (
        f"{best} {verb} better than {worst}: RMSE {judgement.rmse_db:.2f} versus "
        f"{judgement.baseline_rmse_db:.2f} dB on {counted(judgement.links, 'held-out link')} (difference "
        f"{judgement.gain_db:.2f} dB{certainty}). The RMSE is lower in {lower} of {blocks} blocks of {first}."
    )


MOST_CANDIDATES: Final = 2000
"""Maximum number of candidate positions, each of which is traced."""


@ui.refreshable
def show_prediction(desk: Desk) -> None:
    """Draw the step for predictions (at a position or over an area), suggested measurement positions, and export."""
    names = desk.folder.results()
    if not names:
        ui.label("Calibrate first.").classes("quiet")
        return
    sites = {json.dumps(site): site["name"] for site in desk.sites}
    with ui.row():
        chosen = desk.keep(ui.select(names, label="Result", value=names[-1]))
        tx = desk.keep(ui.select(sites, label="Transmitter at x, y, z [m]", value=next(iter(sites), None)))
        height = desk.keep(ui.number("Receiver above the ground [m]", value=1.5, step=0.1))
        cell = desk.keep(ui.number("Width of a cell [m]", value=5.0, min=0.1, step=1))
    x, y = desk.point or (None, None)
    with ui.row():
        east = ui.number("x [m]", value=x, format="%.1f")
        north = ui.number("y [m]", value=y, format="%.1f")

    def placed() -> None:
        if east.value is not None and north.value is not None:
            desk.point = east.value, north.value
            desk.mark()

    for coordinate in (east, north):
        coordinate.on_value_change(placed)

    def site() -> dict[str, Any]:
        if tx.value is None:
            raise InputError("choose a transmitter")
        return json.loads(tx.value)

    async def write(file: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        await run.io_bound(write_links, desk, file, site(), x, y, filled(height))

    async def predict() -> None:
        with desk.messages():
            if east.value is None or north.value is None:
                raise InputError("choose a place: click on the map, or give x and y")
            await write(PLACE, np.array([east.value]), np.array([north.value]))
            predict_table(PLACE)

    def predict_table(name: str) -> None:
        desk.start(["predict", chosen.value, name, "--level", 0.9, "--out", f"{Path(name).stem}{PREDICTED}"])

    def cover() -> None:
        with desk.messages():
            words: list[object] = ["map", chosen.value, "--tx", *site()["tx"]]
            words += ["--height", filled(height), "--cell", filled(cell)]
            words += ["--bounds", *desk.area] if desk.area else []
            words += [
                f"--column={name}={value}" for name, value in site()["columns"].items() if value is not None
            ]
            desk.start(words)

    async def suggest() -> None:
        with desk.messages():
            await write(CANDIDATES, *_grid(desk, filled(cell)))
            desk.start(["suggest", chosen.value, CANDIDATES, "--count", 5, "--out", SUGGESTED])

    def export() -> None:
        desk.start(["export", chosen.value, "--out", f"exported-{chosen.value}", "--copy"])

    with ui.row():
        ui.button("Predict here", on_click=predict)
        ui.button("Map the area", on_click=cover)
        ui.button("Suggest places", on_click=suggest)
        ui.button("Export", on_click=export).props("outline")
    if tables := desk.folder.tables():
        with ui.row():
            table = desk.keep(ui.select(tables, label="Table of new links", value=tables[-1]))
            ui.button("Predict the table", on_click=lambda: predict_table(table.value)).props("outline")
    area = (
        "x {0:.1f} to {2:.1f} m, y {1:.1f} to {3:.1f} m".format(*desk.area)
        if desk.area
        else "the whole scene"
    )
    ui.label(f"Area: {area}").classes("quiet")
    _predicted(desk)
    _suggested(desk)
    for name in names:
        if (desk.folder.path / name / "map.png").is_file():
            age = (desk.folder.path / name / "map.png").stat().st_mtime_ns
            ui.element("img").props(
                f'src="/result/{quote(name)}/map.png?{age}" alt="Map of {safe(name)}"'
            ).classes("coverage")


def write_links(
    desk: Desk, file: str, site: dict[str, Any], x: NDArray[np.float64], y: NDArray[np.float64], height: float
) -> None:
    """Write a table of links from a transmitter to a grid of positions x, y [m], at a given height above ground [m].

    The links have the transmitter's groups, carrier frequency and antenna direction.

    Raises:
        InputError: The scene cannot be read, or the table cannot be written.
    """
    rx = grid_above_ground(desk.folder, desk.scene, x, y, height)
    table = pd.DataFrame({f"rx_{axis}": rx[:, k] for k, axis in enumerate("xyz")})
    for k, axis in enumerate("xyz"):
        table[f"tx_{axis}"] = site["tx"][k]
    write_table(desk.folder.path / file, table.assign(**site["columns"]))


def _grid(desk: Desk, cell: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The x and y coordinates [m] of a regular grid in the chosen area."""
    if desk.area is None:
        raise InputError(
            "draw an area on the map first; the grid cells of this area are the candidate positions"
        )
    west, south, east, north = desk.area
    if (east - west) * (north - south) / cell**2 > MOST_CANDIDATES:
        raise InputError(
            f"the area has more than {MOST_CANDIDATES} cells; draw a smaller area, or use larger cells"
        )
    return np.arange(west, east, cell), np.arange(south, north, cell)


def _read(desk: Desk, name: str) -> pd.DataFrame | None:
    try:
        return pd.read_csv(desk.folder.path / name)
    except (OSError, ValueError):
        return None


def _predicted(desk: Desk) -> None:
    table = _read(desk, f"{Path(PLACE).stem}{PREDICTED}")
    if table is None or not len(table) or "upper_db" not in table:
        return
    ui.label(predicted_text(table.iloc[0])).classes("predicted")


def predicted_text(row: pd.Series) -> str:
    """A sentence with the predicted value of the measured quantity.

    If received power was measured but the transmitted power is unknown, the sentence instead states a path loss that
    includes this unknown power.
    """
    value, lower, upper, name, unit = "path_loss_db", "lower_db", "upper_db", "path loss", "dB"
    for key, quantity in QUANTITIES.items():
        column = f"{key}_{quantity.unit.lower()}"
        if key != "path_loss" and column in row:
            # The table has these columns only if this quantity was measured.
            value, name, unit = column, quantity.name, quantity.unit
            lower, upper = (f"{key}_{end}_{unit.lower()}" for end in ("lower", "upper"))
    remark = row.get("remark")
    return (
        f"At x {row['rx_x']:.1f} m, y {row['rx_y']:.1f} m: {name} {row[value]:.1f} {unit}, 90 % interval "
        f"{row[lower]:.1f} to {row[upper]:.1f} {unit} ({row['basis']})"
        + (f"; {remark}" if isinstance(remark, str) and remark else "")
    )


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
