"""Attacks from outside: what external programs answer, and what is typed on the command line."""

from __future__ import annotations

import io
import json
import math
import os
import shlex
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

from calibray import engines
from calibray.study import Study
from fuzzing import world
from fuzzing.mutations import NUMBERS, TEXTS, damage, edited
from fuzzing.outcome import Case
from fuzzing.world import OWN, World

RIGHT = [70.0, 75.5, 80.25, None, 90.0, 95.0, 72.0, 77.0]
_BEHAVIOURS = (
    "exit {n}",
    "kill -{n} $$",
    'cat answer.json > "$2"; exit {n}',
    'cat answer.json > "$2"; kill -{n} $$',
    "true",
    "head -c 30000000 /dev/zero",
    "head -c 30000000 /dev/urandom >&2; exit 3",
    'mkfifo "$2"',
    'mkdir "$2"',
    'ln -s "$PWD/answer.json" "$2"',
    'truncate -s 20G "$2"',
    'ln -s /dev/zero "$2"',
    ': > "$2"',
    'cat "$1" > "$2"',
    'rm -rf "$(dirname "$2")"',
    "sleep 60",
    "setsid sleep 60 & sleep 60",
    "(sleep 60 &) ; exit 1",
    "printf '\\033[2J\\377' >&2; exit 4",
    'chmod 000 "$(dirname "$2")"; exit 5',
    'rm "$1"; cat answer.json > "$2"',
    "kill -9 $PPID",
    'echo \'{{"path_loss_db": 70}}\' > "$2"',
)
_FAITHFUL = ('cat answer.json > "$2"; exit 0', 'rm "$1"; cat answer.json > "$2"')


def answer(rng: Random, found: World, folder: Path) -> Case:
    """What a program answers, how it ends, and what it leaves behind."""
    file = found.copy(folder)
    form, right, note = rng.choice(("json", "json", "hdf5")), None, ""
    raw = json.dumps({"path_loss_db": RIGHT}).encode() if form == "json" else _hdf5(rng)
    match rng.randrange(4):
        case 0:
            script = rng.choice(_BEHAVIOURS).format(n=rng.choice((0, 1, 2, 9, 11, 15, 34, 63, 64, 127, 255)))
            raw, form, note = json.dumps({"path_loss_db": RIGHT}).encode(), "json", script
            right = RIGHT if "answer.json" in script else None
        case 1 | 2:
            raw, note, script = damage(rng, raw), f"{form} bytes", world.SCRIPT
        case _:
            script, form = world.SCRIPT, "json"
            changed, note, _ = edited(rng, json.loads(json.dumps({"path_loss_db": RIGHT})))
            raw = json.dumps(changed).encode()
            if rng.random() < 0.2:
                raw, note = (
                    rng.choice(
                        (b"[" * 10**6, b'{"path_loss_db": ' + b"[" * 5000, b"1" * 10**6, b"\xff\xfe", b"null")
                    ),
                    "odd",
                )
    if right is None and form == "json":
        right = _plain(raw) if script == world.SCRIPT else None
    bad = right is None and (form == "json" or script != world.SCRIPT)
    (folder / "answer.json").write_bytes(raw)
    (folder / "answer.sh").write_text(script)
    tree = world.content()
    tree["engine"] |= {"name": "command", "format": form, "timeout": 0.5 if "60" in script else 5.0}
    file.write_text(world.toml(tree))

    def act() -> list[float]:
        engine = engines.make(Study.load(file).opened())
        return engine.path_loss(np.array([[4.0, 0.01]]))[0].tolist()

    expected = None if right is None else [math.inf if each is None else each for each in right]
    return Case("answer", note, act, bad, expected, own=OWN)


def _plain(raw: bytes) -> list[float | None] | None:
    """The numbers of an answer by the plainest means; None where it is none."""
    try:
        values = json.loads(raw)["path_loss_db"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    if not isinstance(values, list) or len(values) != len(RIGHT):
        return None
    found: list[float | None] = []
    for value in values:
        if value in (None, "inf", "Infinity") or value == math.inf:
            found.append(None)
        elif isinstance(value, bool) or not isinstance(value, int | float) or not 20 <= value <= 300:
            return None
        else:
            found.append(float(value))
    return found


def _hdf5(rng: Random) -> bytes:
    """An answer in HDF5, of one odd form or another."""
    stream = io.BytesIO()
    values = np.array([math.inf if each is None else each for each in RIGHT])
    with h5py.File(stream, "w") as file:
        match rng.randrange(6):
            case 0:
                file["path_loss_db"] = values[:, None]
            case 1:
                file["path_loss_db"] = h5py.ExternalLink("/etc/passwd", "x")
            case 2:
                file.create_dataset("path_loss_db", (2**40,), "f8", chunks=(1024,), compression="gzip")
            case 3:
                file["path_loss_db"] = "text"
            case 4:
                file.create_group("path_loss_db")
            case _:
                file["path_loss_db"] = values
    return stream.getvalue()


VALUES: tuple[str, ...] = tuple(
    text.replace("\0", "")
    for text in (
        *TEXTS[:30],
        *(str(each)[:400] for each in NUMBERS),
        "-",
        "--",
        "a=b",
        "concrete:x",
        "1,2",
        "1,2,3",
    )
)
TARGETS = (
    "new",
    "deep/er/new",
    "links.csv",
    "scene.xml",
    "study.toml",
    "notes.txt",
    "meshes",
    ".",
    "",
    "new.csv",
    "fresh.csv",
    "fresh.h5",
    "fifo",
    "link",
    "dangling",
    "gone/x.csv",
    "x" * 300,
    "a\nb",
    "\udcff",
    "/dev/null",
    "/dev/full",
    "/proc/self/mem",
    "out",
    "paid",
    "notes.txt/x",
)
_FAMILIAR = {
    "engine": ("replay", "retrace", "command"),
    "method": ("random", "auto", "gwo", "sobol"),
    "methods": ("random,sobol", "random@8", ","),
    "seed": ("0", "7"),
    "seeds": ("1", "2", "0"),
    "budget": ("4", "1"),
    "workers": ("1", "2", "0"),
}
_HERE = {
    "folder": "out",
    "links_file": "new.csv",
    "study_file": "study.toml",
    "scene": "scene.xml",
    "links": "links.csv",
    "subject": "scene.xml",
}


def line(rng: Random, found: World, folder: Path) -> Case:
    """A command with arguments and options of any value."""
    found.copy(folder, "out")
    os.mkfifo(folder / "fifo")
    (folder / "link").symlink_to("notes.txt")
    (folder / "dangling").symlink_to("nothing.txt")
    words, command = [], world.command()
    while getattr(command, "commands", None):
        name = rng.choice(sorted({*command.commands} - {"open"}))  # a window is served until it is stopped
        words.append(name)
        command = command.commands[name]
    if words == ["compare"]:
        words += ["--methods=random@8", "--seeds=1"]  # what is given below counts, being later
    if words == ["map"]:
        words += ["--cell=20"]
    for parameter in command.params:
        required = parameter.required or _is_argument(parameter)
        if not (required and rng.random() < 0.97) and rng.random() < 0.7:
            continue
        words += _given(rng, parameter)
    if words[0] == "demo":
        words += ["--engine", rng.choice(("nothing", "", "command"))]  # or it would run for minutes
    if rng.random() < 0.05:
        words.insert(rng.randrange(len(words) + 1), rng.choice(VALUES))

    def act() -> str:
        here = Path.cwd()
        os.chdir(folder)
        try:
            return world.calibray(*words)
        finally:
            os.chdir(here)

    own = (*OWN, "deep", "fresh", "paid", "meshes/.calibray", "new/*")
    if "--overwrite" in words:
        # What is no input of the command may be replaced, since that is asked for.
        own += tuple({"notes.txt", "new.csv"} - set(words))
    return Case("line", shlex.join(words)[:400], act, own=own)


def _is_argument(parameter: Any) -> bool:
    return parameter.param_type_name == "argument"


def _given(rng: Random, parameter: Any) -> list[str]:
    """The words that give a parameter a value."""
    name = parameter.name or ""
    if name in ("out",):
        value = rng.choice(TARGETS)
    elif _is_argument(parameter) and rng.random() < 0.8:
        value = _HERE.get(name, rng.choice(TARGETS))
    elif name in _FAMILIAR and rng.random() < 0.6:
        value = rng.choice(_FAMILIAR[name])
    else:
        value = rng.choice((*VALUES, *TARGETS))
    if _is_argument(parameter):
        return [value]
    if getattr(parameter, "is_flag", False):
        return [parameter.opts[0]]
    return (
        [f"{parameter.opts[0]}={value}"] if parameter.opts[0].startswith("--") else [parameter.opts[0], value]
    )
