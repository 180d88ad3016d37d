"""A file of finished runs, one line of JSON each, from which an interrupted benchmark continues.

A line contains the settings of its run, and only lines with the settings of the current run count. The version of
Calibray is not one of the settings: use another file after the code changes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_runs(file: Path | None, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The finished runs with given settings; an incomplete last line is removed."""
    if file is None or not file.exists():
        return []
    whole = [line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
    file.write_text("".join(whole))
    return [run for run in map(json.loads, whole) if settings.items() <= run.items()]


def append_run(file: Path | None, run: dict[str, Any]) -> None:
    """Append a finished run, if a file is given."""
    if file is not None:
        with file.open("a") as stream:
            stream.write(json.dumps(run) + "\n")
