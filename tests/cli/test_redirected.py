"""Commands without a terminal print lines of progress while any slow step lasts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from threading import Timer

import programs
from commands import few_draws, write_study

TOWN = Path(__file__).parents[2] / "examples" / "bring_your_own" / "town.osm"
LONGEST = 10.0
"""Longest time without a line [s]."""
LASTS = 25.0
"""Duration of every slow step [s], counted in lines: each line counts as `LINE_INTERVAL`."""
DEADLINE = 300.0
"""Time after which a silent command is killed and the test fails [s]."""
SLOW = """
import importlib, time
from pathlib import Path

def last(name):
    Path(name + ".begun").touch()
    while not Path(name + ".over").exists():
        time.sleep(0.005)
"""
PRELUDE = """
from calibray.cli import console, main

print("every", console.LINE_INTERVAL, flush=True)
console.LINE_INTERVAL = 0.02

def slow(function):
    home, _, name = function.rpartition(".")
    module = importlib.import_module(home)
    quick = getattr(module, name)
    setattr(module, name, lambda *words, **named: (last(function), quick(*words, **named))[1])
"""
LINE = re.compile(r"[a-z].*, \d+ s(, about \d+ s left)?")


def redirected(folder: Path, slow: list[str], *words: object) -> tuple[int, dict[str, float], str]:
    """Run a command with its output in a pipe; each slow step ends once lines for `LASTS` seconds were printed.

    Args:
        folder: Working directory.
        slow: Functions of the package that are made slow.
        words: The command line.

    Returns:
        Exit status, duration of each slow step by its lines [s], and the output.
    """
    draws = [few_draws()] if words[0] == "run" else []
    code = "\n".join([SLOW, *draws, PRELUDE, *(f"slow({function!r})" for function in slow), "main()"])
    lines: Counter[str] = Counter()
    printed = []
    with subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], cwd=folder, env={**os.environ, "CALIBRAY_CACHE": ""},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as process:  # fmt: skip
        deadline = Timer(DEADLINE, process.kill)
        deadline.start()
        assert process.stdout is not None
        every = float(process.stdout.readline().split()[1])
        # Between two consecutive progress displays, two intervals can pass without a line.
        assert 2 * every < LONGEST
        for text in process.stdout:
            printed.append(text)
            if not LINE.fullmatch(text.rstrip("\n")):
                continue
            for begun in folder.glob("*.begun"):
                over = begun.with_suffix(".over")
                if not over.exists():
                    lines[begun.stem] += 1
                    if lines[begun.stem] * every >= LASTS:
                        over.touch()
        status = process.wait()
        deadline.cancel()
    return status, {step: count * every for step, count in lines.items()}, "".join(printed)


def test_a_calibration_whose_steps_last(tmp_path):
    """The checks before it, the search, one silent call of an external program in it, and the report after it."""
    slow = [
        "calibray.study.link_checks.examine", "calibray.calibration.calibrate.search",
        "calibray.reporting.page.report",
    ]  # fmt: skip
    method = {"name": "random", "options": {"budget": 6}}
    content = programs.content(tmp_path, f"{SLOW}\nlast('program')", timeout=DEADLINE)
    write_study(tmp_path, content | {"method": method})
    status, durations, printed = redirected(tmp_path, slow, "run", "study.toml", "--out", "out")
    assert status == 0, printed
    assert set(durations) == {*slow, "program"}
    assert min(durations.values()) >= LASTS


def test_a_scene_whose_steps_last(tmp_path):
    slow = [
        "calibray.scenes.authoring.read_openstreetmap",
        "calibray.scenes.authoring.make_scene",
    ]
    status, durations, printed = redirected(tmp_path, slow, "scene", "osm", TOWN, "--out", "town")
    assert status == 0, printed
    assert set(durations) == set(slow)
    assert "reading, " in printed
    assert "making, " in printed
