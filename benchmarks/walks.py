"""From raw files to a report by commands alone, for the three example walks and both campaigns, in one table.

    python benchmarks/walks.py [--walks town flat hill boulder auckland] [--folder FOLDER] [--samples N]

Each walk runs `scene`, `init`, `run`, `predict` on the links of the result, `export`, and the exported script in plain
Sionna RT. The campaigns begin at `run` with the study in `examples`; CALIBRAY_DATA names the folder of their data. The
table has the links without a path, the errors of the fit and in held-out blocks, the prediction model, and the largest
difference over the links [dB] from the reported path loss: that of the exported scene in Sionna RT, and that of
`predict` at the measured links, where the residual field acts. To compare with another version of Calibray, set
PYTHONPATH to its `src`: a step that fails there is shown with its message.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd

EXAMPLES = Path(__file__).parents[1] / "examples"

TOWN = (
    "scene osm town.osm --out scene",
    "init scene/scene.xml rsrp.csv --transmitters cells.csv --frequency 3.6e9 --out study.toml",
)
FLAT = (
    "scene plan plan.csv --height 2.6 --out scene",
    "init scene/scene.xml rss.csv --transmitters access_points.csv --frequency 2.44e9 --out study.toml",
)
HILL = (
    "scene footprints houses.geojson --height height_m --terrain ground.tif --out scene",
    "init scene/scene.xml power.csv --transmitters masts.csv --track walk.gpx --frequency 2.1e9 --out study.toml",
)
WALKS = {
    "town": (EXAMPLES / "bring_your_own", TOWN),
    "flat": (EXAMPLES / "bring_your_own" / "flat", FLAT),
    "hill": (EXAMPLES / "bring_your_own" / "hill", HILL),
    "boulder": (EXAMPLES / "nist_boulder.toml", ()),
    "auckland": (EXAMPLES / "auckland_tower.toml", ()),
}
RUN = "run study.toml --out result"
FINISH = (
    "predict result result/result-links.csv --out predicted.csv",
    "export result --out exported --copy",
)


@dataclass(frozen=True)
class Step:
    """One command: its words, exit status, seconds and output."""

    command: str
    status: int
    seconds: float
    output: str
    messages: str


@dataclass
class Walk:
    """A walk in its folder, with the steps completed so far."""

    folder: Path
    steps: list[Step] = field(default_factory=list)

    def take(self, command: str, *words: str) -> bool:
        """Run a command in the folder, and return whether it succeeded."""
        started = time.monotonic()
        done = subprocess.run(words, cwd=self.folder, capture_output=True, text=True, check=False)
        seconds = time.monotonic() - started
        self.steps.append(Step(command, done.returncode, seconds, done.stdout, done.stderr))
        print(f"  {command}: exit {done.returncode}, {seconds:.0f} s", file=sys.stderr, flush=True)
        return done.returncode == 0


def take(source: Path, commands: tuple[str, ...], folder: Path, samples: int | None) -> Walk:
    """Walk from the files of a folder, or from a study, to the exported scene."""
    walk = Walk(folder)
    if source.is_dir():
        for file in source.iterdir():
            if file.is_file():
                shutil.copy(file, folder)
    else:
        study = source.read_text(encoding="utf-8")
        if samples:
            study = re.sub(r"samples = [\d_]+", f"samples = {samples}", study)
        (folder / "study.toml").write_text(study, encoding="utf-8")
    for command in (*commands, RUN):
        if not walk.take(command, sys.executable, "-m", "calibray", *command.split()):
            return walk
    for command in FINISH:
        walk.take(command, sys.executable, "-m", "calibray", *command.split())
    walk.take("load_scene.py", sys.executable, "exported/load_scene.py")
    return walk


def first_value(record: Any, key: str) -> Any:
    """The first value of a key anywhere in a record; None if there is none."""
    if isinstance(record, dict):
        if key in record:
            return record[key]
        values = (first_value(value, key) for value in record.values())
        return next((value for value in values if value is not None), None)
    return None


def differences(walk: Walk) -> tuple[float | None, float | None]:
    """Largest differences [dB] of the exported scene, and of predictions at the links, from the reported path loss."""
    script, predicted = walk.steps[-1], walk.folder / "predicted.csv"
    exported = near = None
    if script.status == 0:
        loaded = pd.read_csv(StringIO(script.output))
        exported = float((loaded.iloc[:, 1] - loaded.iloc[:, 2]).abs().max())
    if predicted.exists():
        links = pd.read_csv(walk.folder / "result" / "result-links.csv")
        reported = links["predicted_db" if "predicted_db" in links else "after_db"]
        near = float((pd.read_csv(predicted)["path_loss_db"] - reported).abs().max())
    return exported, near


def line(name: str, walk: Walk) -> str:
    """The line of a walk in the table."""
    seconds = sum(step.seconds for step in walk.steps)
    failed = [step for step in walk.steps if step.status]
    for step in failed:
        message = (step.messages.strip().splitlines() or ["no message"])[-1]
        print(f"{name}: {step.command}: exit {step.status}: {message}", file=sys.stderr)
    if not (walk.folder / "result" / "result.json").exists():
        return f"| {name} | {failed[-1].command} failed |"
    record = json.loads((walk.folder / "result" / "result.json").read_text(encoding="utf-8"))
    links = pd.read_csv(walk.folder / "result" / "result-links.csv")
    (exported, near), model = differences(walk), first_value(record.get("prediction", record), "model")
    texts = [
        name,
        f"{len(walk.steps)}" + (f" ({len(failed)} failed)" if failed else ""),
        f"{len(links)} ({int((~links['has_path']).sum())} without)",
        missing(walk.folder / "predicted.csv"),
        number(first_value(record, "rmse_db")),
        number(first_value(record, "holdout_rmse_db")),
        number(first_value(record, "log_distance_holdout_rmse_db")),
        model.get("name", "-") if isinstance(model, dict) else "-",
        number(exported),
        number(near),
        f"{seconds:.0f}",
    ]
    return "| " + " | ".join(str(text) for text in texts) + " |"


def missing(table: Path) -> str:
    """Number of links without a prediction in a table; a dash if there is no table."""
    return str(int(pd.read_csv(table)["path_loss_db"].isna().sum())) if table.exists() else "-"


def number(value: float | None) -> str:
    """A decibel value with two digits; a dash if there is none."""
    return "-" if value is None else f"{value:.2f}"


def main() -> None:
    """Take the walks and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--walks", nargs="+", choices=WALKS, default=list(WALKS))
    parser.add_argument("--folder", type=Path, help="write into this folder and keep it")
    parser.add_argument("--samples", type=int, help="number of rays launched in the campaigns")
    options = parser.parse_args()
    base = options.folder or Path(tempfile.mkdtemp(prefix="walks-"))
    lines = []
    for name in options.walks:
        source, commands = WALKS[name]
        if not source.is_dir() and "CALIBRAY_DATA" not in os.environ:
            print(f"{name}: left out, CALIBRAY_DATA is not set", file=sys.stderr)
            continue
        print(name, file=sys.stderr)
        folder = base / name
        folder.mkdir(parents=True)
        lines.append(line(name, take(source, commands, folder, options.samples)))
    print(
        "| walk | commands | links (without a path) | links without a prediction | fit [dB] | held out [dB]"
        " | log-distance, held out [dB] | predicts | exported - reported [dB] | predict - reported [dB] | seconds |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    print("\n".join(lines))
    if not options.folder:
        shutil.rmtree(base)


if __name__ == "__main__":
    main()
