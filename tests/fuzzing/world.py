"""The small world that is attacked: a study with all its files, what calibrating it leaves, and the right numbers."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import typer.main

import small_scenes
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.study import Study
from fuzzing.mutations import toml
from fuzzing.outcome import Exited

LINKS = """x,y,loss,half,w
10,0,65.2,a,1
20,0,70.9,a,1
30,1,74.1,a,2
40,-1,77.0,b,1
50,2,79.5,b,1
60,0,80.8,b,0.5
15,3,69.0,b,1
25,-2,73.1,a,1
"""
NEW = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,half\n0,0,2,12,0,1.5,a\n0,0,2,35,2,1.5,b\n"
ROOF = "v 5 12 9\nv 25 12 9\nv 25 20 9\nv 5 20 9\nf 1 2 3\nf 1 3 4\n"
WALLS = {
    "house": [[(0, 6, 0), (60, 6, 0), (60, 6, 12), (0, 6, 12)]],
    "shed": small_scenes.block((30, -12, 0), (36, -8, 4)),
}
BSDF = small_scenes.CONCRETE.replace("stone", "walls") + (
    '<bsdf type="itu-radio-material" id="mat-roof"><string name="type" value="wood"/></bsdf>'
)
GROUND = (
    '<shape type="rectangle" id="mesh-ground"><transform name="to_world"><scale x="80" y="80"/></transform>'
    '<ref id="mat-walls" name="bsdf"/></shape>'
    '<shape type="obj" id="mesh-roof"><string name="filename" value="meshes/roof.obj"/>'
    '<ref id="mat-roof" name="bsdf"/></shape>'
)
FILES = (
    "study.toml", "links.csv", "new.csv", "scene.xml", "horn.csv", "answer.json", "answer.sh", "notes.txt",
    "meshes/house.ply", "meshes/shed.ply", "meshes/roof.obj",
)  # fmt: skip
SCRIPT = 'cat answer.json > "$2"\n'
OWN = ("out", "*.calibray", "*.csv.calibray", "calls.log")


def content(**sections: Any) -> dict[str, Any]:
    """The study; sections given replace those here."""
    return {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "objects": {"front": "house"},
        "materials": {"roof": {"thickness": 0.05}},
        "links": {
            "file": "links.csv", "tx": [0.0, 0.0, 2.0], "rx": ["x", "y", 1.5], "value": "loss",
            "where": "loss < 200 and half in ['a', 'b']", "weight": "w",
        },
        "antennas": {"tx": {"pattern": "horn.csv", "orientation": [0.0, 0.0, 0.0]}, "rx": {"pattern": "dipole"}},
        "trace": {"max_depth": 1, "samples": 1000, "seed": 1, "refraction": False},
        "objective": {"combining": "power", "no_path": "exclude"},
        "parameters": {
            "walls.relative_permittivity": {"bounds": [1.5, 12.0], "start": 4.0, "scale": "linear"},
            "front.conductivity": {"bounds": [0.001, 1.0], "start": 0.01, "scale": "log"},
        },
        "offset": {"per": "half", "bounds": [-30.0, 30.0]},
        "holdout": {"where": "x > 55"},
        "fidelity": {"tolerance_db": 0.5, "rounds": 1},
        "method": {"name": "random", "seed": 0, "options": {"budget": 6}},
        "engine": {
            "name": "replay", "command": ["/bin/sh", "answer.sh", "{request}", "{response}"], "timeout": 5.0,
            "retries": 0,
        },
        **sections,
    }  # fmt: skip


def horn() -> str:
    """An antenna's gains, every 15 degrees."""
    rows = [
        f"{azimuth},{elevation},{-((azimuth / 60) ** 2) - (elevation / 60) ** 2 + 2:.4f}"
        for azimuth in range(-180, 180, 15)
        for elevation in range(-90, 91, 15)
    ]
    return "\n".join(["azimuth_deg,elevation_deg,gain_dbi", *rows, ""])


def write(folder: Path) -> None:
    """Write all files of the world."""
    small_scenes.write_scene(folder, WALLS, BSDF, "mat-walls")
    scene = folder / "scene.xml"
    scene.write_text(scene.read_text().replace("</scene>", f"{GROUND}</scene>"))
    texts = {
        "study.toml": toml(content()), "links.csv": LINKS, "new.csv": NEW, "horn.csv": horn(),
        "answer.json": json.dumps({"path_loss_db": [70.0, 75.5, 80.25, None, 90.0, 95.0, 72.0, 77.0]}),
        "answer.sh": SCRIPT, "notes.txt": "mine\n", "meshes/roof.obj": ROOF,
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text)


@functools.cache
def command() -> Any:
    """The command line."""
    return typer.main.get_command(app)


def calibray(*arguments: object) -> str:
    """Call the command line, and give what it prints; `Exited` if it ends with another status than 0."""
    err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="backslashreplace", write_through=True)
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(Twice(err)):
        try:
            status = command().main(
                [str(each) for each in arguments], prog_name="calibray", standalone_mode=False
            )
        except Exception as error:
            # Typer carries a Click of its own, whose errors are known by what they have.
            if not hasattr(error, "exit_code"):
                raise
            raise Exited(error.exit_code, str(error)) from None
    err.seek(0)
    out.seek(0)
    if status:
        raise Exited(int(status), err.read() or out.read())
    return out.read()


class Twice(io.TextIOBase):
    """Messages go to a file that outlives the process as well: what it said before it hung counts."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:
        """As stderr has it."""
        return "utf-8"

    def write(self, text: str) -> int:
        """Write to both."""
        os.write(2, text.encode(errors="backslashreplace"))
        return self._stream.write(text)

    def flush(self) -> None:
        """Nothing is held back."""


@dataclass(frozen=True)
class World:
    """What cases start from.

    Attributes:
        place: The folder that all lies in.
        base: The folder with the undamaged files and what calibrating them left.
        right: The right numbers: "rmse", "predicted", "path_loss", "ledger".
    """

    place: Path
    base: Path
    right: dict[str, Any]

    @classmethod
    def open(cls, place: Path) -> World:
        """Find the world in a folder, or make it."""
        base = place / "base"
        os.environ["CALIBRAY_CACHE"] = str(place / "cache")
        if not (base / "right.json").exists():
            shutil.rmtree(base, ignore_errors=True)
            base.mkdir(parents=True)
            write(base)
            (base / "right.json").write_text(json.dumps(_calibrated(base)))
        return cls(place, base, json.loads((base / "right.json").read_text()))

    def warm(self) -> None:
        """Load what is loaded when first used, and see that the right numbers come out again."""
        setup = Study.load(self.base / "study.toml").opened()
        found = path_loss(setup.tracer.trace(setup.links))
        if not np.array_equal(found, self.right["path_loss"]):
            raise RuntimeError(f"an undamaged study gives {found}, gave {self.right['path_loss']}")
        with tempfile.TemporaryDirectory(dir=self.place) as folder:
            again = rmse(self.copy(Path(folder)), "-o", Path(folder) / "out")["rmse_db"]
            if not np.isclose(again, self.right["rmse"], rtol=1e-9):
                raise RuntimeError(f"an undamaged study gives {again} dB, gave {self.right['rmse']} dB")
            predicted(self.base / "out", self.base / "new.csv")

    def copy(self, folder: Path, *more: str) -> Path:
        """Copy the user's files, and more of what calibrating left; gives the study file."""
        for name in FILES:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.base / name, folder / name)
        for name in more:
            source = self.base / name
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, folder / name)
        result = folder / "out" / "result.json"
        if result.exists():
            result.write_text(result.read_text().replace(str(self.base), str(folder)))
            sign(result)
        return folder / "study.toml"


def sign(file: Path) -> None:
    """Say that a file is as Calibray wrote it."""
    with (file.parent / ".calibray").open("a") as stream:
        stream.write(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n")


def _calibrated(base: Path) -> dict[str, Any]:
    study = base / "study.toml"
    rmse = json.loads(calibray("run", study, "-o", base / "out", "--json"))["fit"]["rmse_db"]
    calibray("trace", study, "-o", base / "paths.h5")
    paid = json.loads(calibray("run", study, "-o", base / "paid", "--json", "--engine", "command"))["fit"][
        "rmse_db"
    ]
    return {
        "rmse": rmse,
        "ledger": paid,
        "predicted": predicted(base / "out", base / "new.csv"),
        "path_loss": loss(base / "paths.h5"),
    }


def predicted(folder: Path, links: Path) -> list[float]:
    """What `calibray predict` prints."""
    table = pd.read_csv(io.StringIO(calibray("predict", folder, links)))
    return table["path_loss_db"].astype(float).tolist()


def loss(file: Path) -> list[float]:
    """Path loss of a path file."""
    return np.asarray(path_loss(Paths.load(file))).tolist()


def rmse(*arguments: object) -> dict[str, Any]:
    """The errors that `calibray run --json` prints."""
    found = json.loads(calibray("run", *arguments, "--json"))
    Result.load(arguments[arguments.index("-o") + 1])
    return {key: value for key, value in found["fit"].items() if key.endswith("rmse_db")}


def opened(study: Path) -> list[float]:
    """A study opened as far as it goes without tracing."""
    setup = Study.load(study).opened()
    links = setup.links
    return [*links.tx.ravel(), *links.rx.ravel(), *links.path_loss_db, *setup.parameters.start]
