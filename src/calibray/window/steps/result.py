"""The fifth step: key numbers of the results in a table, and the report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from nicegui import run, ui

from calibray.result.files import read
from calibray.result.held_out import HeldOutErrors
from calibray.validation.held_out_statistics import compare
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
    if len(names) > 1:
        with desk.messages():
            _comparison(desk, names)
    chosen = ui.select(names, label="Report", value=names[-1]).classes("wide")
    frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts" title="Report"')

    def point() -> None:
        frame.props(f'src="/result/{quote(chosen.value)}/report.html"')
        link.props(f'href="/result/{quote(chosen.value)}/report.html"')

    with ui.row():
        ui.button("Write the report again", on_click=lambda: desk.start(["report", chosen.value])).props(
            "outline"
        ).tooltip("After a validation: with the errors of the held-out blocks")
    link = ui.link("Open the report in its own tab", "#", new_tab=True)
    chosen.on_value_change(point)
    point()


def _table(desk: Desk, names: list[str]) -> None:
    """Values and errors, with one column per result."""
    columns = {name: _facts(desk, name) for name in names}
    rows = dict.fromkeys(key for column in columns.values() for key in column)
    _facts_table(
        names, {row: {name: column.get(row, NONE) for name, column in columns.items()} for row in rows}
    )


def _facts_table(names: list[str], rows: dict[str, dict[str, str]]) -> None:
    """Rows of texts, with one column per result; differences from the first result are bold."""
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
    return facts


def _comparison(desk: Desk, names: list[str]) -> None:
    """The differences between the studies, and which result predicts better."""
    changed = changes([desk.folder.result(name).get("study") or {} for name in names])
    ui.label("Differences between the studies").classes("title")
    if changed:
        rows = [
            {name: _text(value) for name, value in zip(names, values, strict=True)}
            for values in changed.values()
        ]
        _facts_table(names, dict(zip(changed, rows, strict=True)))
    else:
        ui.label("None: the studies have the same settings.").classes("quiet")
    with ui.row():
        first = ui.select(names, label="Compare", value=names[0])
        second = ui.select(names, label="with", value=names[-1])

    async def judge() -> None:
        with desk.messages():
            verdict.text = await run.io_bound(better, first.value, second.value, desk.folder.path) or ""

    ui.button("Which predicts better?", on_click=judge).props("outline")
    verdict = ui.label().classes("predicted").props("role=status")


def _text(value: Any) -> str:
    return NONE if value is None else json.dumps(value, ensure_ascii=False)[:300]


def _inside(record: Any, *keys: str) -> Any:
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def _shown(record: Any, *keys: str) -> str:
    return _number(_inside(record, *keys))


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else NONE


def settings(study: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The settings of a study by their dotted names.

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
    """Settings that differ between studies: by dotted name, the value of each; None if a study lacks it."""
    tables = [settings(study) for study in studies]
    rows = {name: [table.get(name) for table in tables] for table in tables for name in table}
    return {name: values for name, values in rows.items() if any(value != values[0] for value in values)}


def predictive_errors(folder: Path) -> tuple[str, HeldOutErrors] | None:
    """The model that a result's predictions use, and its held-out errors; None without a validation of this model.

    Raises:
        InputError: The result or its validation cannot be read, or belong to different studies.
    """
    fields = read(folder, allow_changed_inputs=True)
    held_out, model = fields["held_out"], fields["prediction"].model.name
    return None if held_out is None or model not in held_out.errors else (model, held_out)


def better(first: str, second: str, folder: Path) -> str:
    """Which of two results of a folder predicts held-out blocks better, with what certainty, as a sentence.

    Raises:
        InputError: A result or its validation cannot be read.
    """
    results = {name: predictive_errors(folder / name) for name in (first, second)}
    if missing := [name for name, errors in results.items() if errors is None]:
        return f"{' and '.join(missing)}: not validated, so nothing shows which result predicts better. Validate both."
    (model, one), (other_model, other) = (errors for errors in results.values() if errors is not None)
    same = [(one.position, other.position), (one.measured_db, other.measured_db)]
    if not all(np.array_equal(*pair) for pair in same):
        return f"{first} and {second} were validated on other links, so nothing shows which predicts better."
    judged = (one.block >= 0) & (other.block >= 0)
    if not judged.any():
        return f"{first} and {second} have no held-out link in common. Validate both with the same blocks."
    errors = {first: one.errors[model][judged], second: other.errors[other_model][judged]}
    best, worst = sorted(errors, key=lambda name: float(np.mean(errors[name] ** 2)))
    judgement = compare(errors[best], {worst: errors[worst]}, one.position[judged])
    lower = sum(
        np.mean(errors[best][rows] ** 2) < np.mean(errors[worst][rows] ** 2)
        for rows in (one.block[judged] == block for block in np.unique(one.block[judged]))
    )
    certainty = "" if judgement.error_db is None else f", standard error {judgement.error_db:.2f} dB"
    blocks = len(np.unique(one.block[judged]))
    clearly = "" if judgement.helped else "not clearly "
    return (
        f"{best} predicts {clearly}better than {worst}: RMSE {judgement.rmse_db:.2f} against "
        f"{judgement.baseline_rmse_db:.2f} dB on {judgement.links} held-out links (difference "
        f"{judgement.gain_db:.2f} dB{certainty}); lower in {lower} of {blocks} blocks of {first}."
    )
