"""The fifth step: key numbers of the results, one beside the other, and the report."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import quote

from nicegui import ui

from calibray.window.desk import Desk

NONE = "-"


@ui.refreshable
def show(desk: Desk) -> None:
    """Draw the step."""
    names = desk.folder.results()
    if not names:
        ui.label("No result yet.").classes("quiet")
        return
    with desk.messages():
        _table(desk, names)
    chosen = ui.select(names, label="Report", value=names[-1]).classes("wide")
    frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts" title="Report"')

    def point() -> None:
        frame.props(f'src="/result/{quote(chosen.value)}/report.html"')
        link.props(f'href="/result/{quote(chosen.value)}/report.html"')

    with ui.row():
        ui.button("Write the report again", on_click=lambda: desk.start(["report", chosen.value])).props(
            "outline"
        ).tooltip("After a validation: with the errors of the held-out blocks")
    link = ui.link("Open the report in a tab of its own", "#", new_tab=True)
    chosen.on_value_change(point)
    point()


def _table(desk: Desk, names: list[str]) -> None:
    """Values and errors, one column a result; what differs from the first result is bold."""
    columns = [_facts(desk, name) for name in names]
    rows = list(dict.fromkeys(key for column in columns for key in column))
    with ui.element("div").classes("scrolled"), ui.element("table").classes("facts"):
        with ui.element("tr"):
            for text in ("", *names):
                with ui.element("th").props("scope=col"):
                    ui.label(text)
        for row in rows:
            with ui.element("tr"):
                with ui.element("th").props("scope=row"):
                    ui.label(row)
                for column in columns:
                    with ui.element("td"):
                        label = ui.label(column.get(row, NONE))
                        if column.get(row) != columns[0].get(row):
                            label.classes("differs")


def _facts(desk: Desk, name: str) -> dict[str, str]:
    """Key numbers of a result by their names."""
    record = desk.folder.result(name)
    facts = {
        "Links": _shown(record, "links", "calibrated_on"),
        "RMSE, initial materials [dB]": _shown(record, "fit", "initial_rmse_db"),
        "RMSE, calibrated [dB]": _shown(record, "fit", "rmse_db"),
        "RMSE, log-distance model [dB]": _shown(record, "fit", "log_distance_rmse_db"),
        "RMSE of held-out links [dB]": _shown(record, "accuracy", "holdout_rmse_db"),
    }
    for parameter, value in (_inside(record, "fit", "parameters") or {}).items():
        interval = _inside(record, "uncertainty", "intervals", parameter) or {}
        ends = f" ({_number(interval.get('lower'))} to {_number(interval.get('upper'))})" if interval else ""
        facts[parameter] = f"{_number(value)}{ends}, {interval.get('verdict', NONE)}"
    for key, value in _differences(
        record.get("study"), desk.folder.result(desk.folder.results()[0]).get("study")
    ):
        facts[f"Study: {key}"] = value
    return facts


def _differences(study: Any, first: Any) -> list[tuple[str, str]]:
    """Settings of a study that differ from those of the first one."""
    if not (isinstance(study, dict) and isinstance(first, dict)):
        return []
    return [
        (key, json.dumps(study.get(key))[:300])
        for key in study
        if key != "links" and study.get(key) != first.get(key)
    ]


def _inside(record: Any, *keys: str) -> Any:
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def _shown(record: Any, *keys: str) -> str:
    return _number(_inside(record, *keys))


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else NONE
