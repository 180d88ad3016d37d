"""Finished runs in a file, a line of JSON each, with which an interrupted benchmark continues where it stopped.

A line contains the settings of its run, and only lines with the settings of today's run count. The version of Calibray
is not among them: use another file after a change of the code.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_runs(file: Path | None, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The finished runs with some settings; a last line that was not written to its end is removed."""
    if file is None or not file.exists():
        return []
    whole = [line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
    file.write_text("".join(whole))
    return [run for run in map(json.loads, whole) if settings.items() <= run.items()]


def append_run(file: Path | None, run: dict[str, Any]) -> None:
    """Append a finished run, if there is a file."""
    if file is not None:
        with file.open("a") as stream:
            stream.write(json.dumps(run) + "\n")
