"""Small external programs for the command engine, and studies that call them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import planted
from calibray.study import Study

PYTHON = (sys.executable, "-I", "-S")  # starts in a few hundredths of a second
MODEL = """
import json, math, os, sys
request_file, response_file = sys.argv[1:3]
with open(request_file) as file:
    request = json.load(file)
values = [entry["value"] for entry in request["parameters"]]
with open("calls.log", "a") as log:
    log.write(json.dumps(values) + "\\n")
earlier = sum(1 for line in open("calls.log"))
def loss(tx, rx):
    near = 1 / (1 + math.dist(tx, rx))
    return 60 + 40 * near * values[0] ** 0.5 + values[1] * math.sin(rx[0]) ** 2 + 0.1 * values[2] * rx[1] ** 2
losses = [loss(tx, rx) for tx, rx in zip(request["links"]["tx"], request["links"]["rx"])]
"""
ANSWER = """
with open(response_file, "w") as file:
    json.dump({"path_loss_db": losses}, file)
"""
STUDY_TOML = """
version = 1
scene = {{ file = "sionna:simple_street_canyon", frequency = 3.5e9 }}
links = {{ file = "links.csv", tx = ["tx_x", "tx_y", "tx_z"], rx = ["rx_x", "rx_y", "rx_z"], value = "path_loss_db" }}
trace = {{ max_depth = 1, samples = 10_000 }}
engine = {{ name = "command", command = {command}, retries = 0 }}
method = {{ name = "{method}", options = {options} }}
noise = {{ kind = "gaussian", range_m = 0, heterogeneity = 0, constants_spread = 0 }}
[parameters]
"concrete.relative_permittivity" = {{ bounds = [1.5, 12.0] }}
"marble.relative_permittivity" = {{ bounds = [1.5, 12.0] }}
"wood.relative_permittivity" = {{ bounds = [1.5, 12.0] }}
"""
TRUTH = np.array([3.2, 8.1, 2.6])


def expected(candidates: np.ndarray, links: pd.DataFrame) -> np.ndarray:
    """What the program answers to candidates [n, 3], [n, L], [dB]."""
    tx, rx = (links[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() for end in ("tx", "rx"))
    near = 1 / (1 + np.linalg.norm(tx - rx, axis=1))
    a, b, c = (column[:, None] for column in np.atleast_2d(candidates).T)
    return 60 + 40 * near * np.sqrt(a) + b * np.sin(rx[:, 0]) ** 2 + 0.1 * c * rx[:, 1] ** 2


def content(folder: Path, before: str = "", after: str = ANSWER, **engine: Any) -> dict[str, Any]:
    """The content of a study in a folder that calls the program, lines put in before and after its computation."""
    (folder / "model.py").write_text("\n".join([MODEL, before, after]))
    links = planted.links()
    links.assign(path_loss_db=expected(TRUTH, links)[0]).to_csv(folder / "links.csv", index=False)
    command = [*PYTHON, "model.py"]
    return planted.content("links.csv") | {
        "engine": {"name": "command", "command": command, "timeout": 20.0, "retries": 0, **engine},
    }


def study(folder: Path, before: str = "", after: str = ANSWER, **engine: Any) -> Study:
    """The study itself."""
    return Study.from_content(content(folder, before, after, **engine), folder / "study.toml")


def study_file(
    folder: Path, before: str = "", method: str = "random", options: str = "{ budget = 6 }"
) -> Study:
    """A study in a file that calls the program."""
    content(folder, before)
    text = STUDY_TOML.format(command=[*PYTHON, "model.py"], method=method, options=options)
    (folder / "study.toml").write_text(text)
    return Study.load(folder / "study.toml")


def calls(folder: Path) -> list[tuple[float, ...]]:
    """The candidates that the program was started for, as it counted them itself."""
    log = folder / "calls.log"
    return [tuple(json.loads(line)) for line in log.read_text().splitlines()] if log.exists() else []
