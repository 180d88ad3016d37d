"""Commands whose output nobody watches: while any one step lasts, lines of progress keep coming."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from threading import Timer

import pytest
from test_cli_run import write_study

import programs

TOWN = Path(__file__).parents[2] / "examples" / "bring_your_own" / "town.osm"
LONGEST = 10.0
"""Time that a redirected command may be silent [s]."""
LASTS = 25.0
"""Time that every slow step lasts [s], by the clock of the lines: each stands for `progress.EVERY`."""
DEADLINE = 300.0
"""Time after which a command that prints nothing more is ended, and the test fails [s]."""
SLOW = """
import importlib, time
from pathlib import Path

def last(name):
    Path(name + ".begun").touch()
    while not Path(name + ".over").exists():
        time.sleep(0.005)
"""
PRELUDE = """
from calibray.cli import main, progress

print("every", progress.EVERY, flush=True)
progress.EVERY = 0.02

def slow(place):
    home, _, name = place.rpartition(".")
    module = importlib.import_module(home)
    quick = getattr(module, name)
    setattr(module, name, lambda *words, **named: (last(place), quick(*words, **named))[1])
"""
LINE = re.compile(r"[a-z].*, \d+ s(, about \d+ s left)?")


def redirected(folder: Path, slow: list[str], *words: object) -> tuple[int, dict[str, float], str]:
    """Run a command whose output is a pipe, and end each slow step when lines for `LASTS` came while it lasted.

    Args:
        folder: Where it runs.
        slow: Functions of the package that are made to last.
        words: The command line.

    Returns:
        Exit status, how long each slow step lasted by its lines [s], and all that was printed.
    """
    code = "\n".join([SLOW, PRELUDE, *(f"slow({place!r})" for place in slow), "main()"])
    told: Counter[str] = Counter()
    printed = []
    with subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)], cwd=folder, env={**os.environ, "CALIBRAY_CACHE": ""},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as process:  # fmt: skip
        deadline = Timer(DEADLINE, process.kill)
        deadline.start()
        assert process.stdout is not None
        every = float(process.stdout.readline().split()[1])
        # Two spells of work, one after the other: the last line of one comes just before the other begins.
        assert 2 * every < LONGEST
        for text in process.stdout:
            printed.append(text)
            if not LINE.fullmatch(text.rstrip("\n")):
                continue
            for begun in folder.glob("*.begun"):
                over = begun.with_suffix(".over")
                if not over.exists():
                    told[begun.stem] += 1
                    if told[begun.stem] * every >= LASTS:
                        over.touch()
        status = process.wait()
        deadline.cancel()
    return status, {step: lines * every for step, lines in told.items()}, "".join(printed)


@pytest.mark.parametrize(
    "slow",
    [
        [],
        [
            "calibray.study.link_checks.examine", "calibray.calibration.calibrate.search",
            "calibray.reporting.page.report",
        ],
    ],
    ids=["a program's call", "the steps before and after"],
)  # fmt: skip
def test_a_calibration_whose_steps_last(tmp_path, slow):
    """One call of a program that says nothing; checks before it, the search about it, the report after it."""
    method = {"name": "auto", "options": {"budget": 18}}
    before = "" if slow else f"{SLOW}\nlast('program')"
    write_study(tmp_path, programs.content(tmp_path, before, timeout=DEADLINE) | {"method": method})
    status, told, printed = redirected(tmp_path, slow, "run", "study.toml", "--out", "out")
    assert status == 0, printed
    assert set(told) == set(slow or ["program"])
    assert min(told.values()) >= LASTS


def test_a_scene_whose_steps_last(tmp_path):
    slow = [
        "calibray.scenes.authoring.read_openstreetmap",
        "calibray.scenes.authoring.make_scene",
    ]
    status, told, printed = redirected(tmp_path, slow, "scene", "osm", TOWN, "--out", "town")
    assert status == 0, printed
    assert set(told) == set(slow)
    assert "reading, " in printed
    assert "making, " in printed
