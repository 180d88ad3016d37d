"""Make the files of this folder anew; README.md says with which version of the code, and where.

Everything goes into the working directory: scene, links and studies first, then what the command line writes of them.
"""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd

import calibray as cb

POSITIONS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
# Relative permittivity of stone and ground, conductivity of the tower [S/m].
TRUTH = (6.5, 3.4, 0.1)

SCENE = """<scene version="2.1.0">
<bsdf type="radio-material" id="mat-stone"><float name="relative_permittivity" value="5.0"/>
<float name="conductivity" value="0.05"/><float name="thickness" value="0.3"/>
<float name="scattering_coefficient" value="0.4"/></bsdf>
<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="4.0"/>
<float name="conductivity" value="0.02"/><float name="thickness" value="0.5"/></bsdf>
{shapes}
</scene>
"""
SHAPE = """<shape type="ply" id="mesh-{name}"><string name="filename" value="meshes/{name}.ply"/>
<ref id="mat-{material}" name="bsdf"/></shape>"""

REPLAY = """version = 1

[scene]
file = "scene/scene.xml"
frequency = 3.5e9
bandwidth = 20e6

[objects]
"tower" = "tower*"

[materials]
stone = { itu = "concrete", revision = "P.2040-1", thickness = 0.3 }
tower = { scattering_coefficient = 0.2 }

[links]
file = "links.csv"
tx = [0.0, 0.0, 12.0]
rx = ["rx_x", "rx_y", 1.5]
value = "path_loss_db"
where = "rx_x < 45"
weight = "weight"

[antennas]
tx = { pattern = "dipole", polarization = "V", orientation = [0.1, 0.0, 0.0] }
rx = { pattern = "iso", polarization = "V" }

[trace]
max_depth = 3
diffraction = true
samples = 20000
seed = 7

[objective]
combining = "power"
no_path = "censor"
ceiling_db = 160.0

[parameters]
"stone.relative_permittivity" = { bounds = [2.0, 12.0], start = "itu:brick@P.2040-2" }
"ground.relative_permittivity" = { bounds = [2.0, 12.0] }
"tower.conductivity" = { bounds = [1e-3, 1.0], start = 0.03, scale = "log" }

[offset]
per = "half"
bounds = [-10.0, 10.0]

[holdout]
where = "rx_y > 20"

[fidelity]
tolerance_db = 0.25
rounds = 2

[method]
name = "least-squares"
seed = 3
options = { starts = 16, iterations = 50 }

[engine]
name = "replay"
"""

PROGRAM = """version = 1
scene = { file = "scene/scene.xml", frequency = 3.5e9 }
offset = {}
method = { name = "sgwo-im", seed = 5, options = { population = 4, iterations = 8, full_iterations = 3, elites = 2 } }

[links]
file = "links.csv"
tx = ["tx_x", "tx_y", "tx_z"]
rx = ["rx_x", "rx_y", "rx_z"]
value = "path_loss_db"

[parameters]
"stone.relative_permittivity" = { bounds = [2.0, 12.0] }
"ground.relative_permittivity" = { bounds = [2.0, 12.0] }

[holdout]
where = "half == 'east' and rx_y > 0"

[engine]
name = "command"
command = ["python3", "model.py", "{request}", "{response}"]
timeout = 60.0
retries = 1
give_up_after = 3
"""

CARRIERS = """version = 1

[scene]
file = "scene/scene.xml"
frequency = 3.5e9

[links]
file = "links.csv"
tx = ["tx_x", "tx_y", "tx_z"]
rx = ["rx_x", "rx_y", "rx_z"]
value = "power_dbm"
quantity = "received_power"
tx_power_dbm = 30.0
std = 2.5
frequency = "carrier_hz"

[parameters]
"stone.itu_a" = { bounds = [3.0, 9.0], start = "itu:concrete" }
"stone.itu_c" = { bounds = [0.005, 0.3], start = "itu:concrete", scale = "log" }
"stone.itu_d" = { bounds = [0.3, 1.3], start = "itu:concrete" }

[method]
name = "auto"
"""

MODEL = '''"""A made-up path loss: distance, and a smooth share of every parameter."""

import json
import math
import sys
from pathlib import Path

request = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
values = [entry["value"] for entry in request["parameters"]]
losses = []
for tx, rx in zip(request["links"]["tx"], request["links"]["rx"], strict=True):
    loss = 40 + 22 * math.log10(math.dist(tx, rx))
    for place, value in enumerate(values):
        loss += 6 * math.sin(value / 3 + rx[place] / 15)
    losses.append(loss)
Path(sys.argv[2]).write_text(json.dumps({"path_loss_db": losses}), encoding="utf-8")
'''


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> str:
    """A closed box as the text of a PLY mesh, outward normals."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return ply(corners, quads)


def ply(corners: list[tuple[float, float, float]], quads: list[tuple[int, ...]]) -> str:
    """Quadrilaterals as the text of a PLY mesh of triangles."""
    triangles = [each for a, b, c, d in quads for each in (f"3 {a} {b} {c}", f"3 {a} {c} {d}")]
    header = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*header, *(" ".join(map(str, corner)) for corner in corners), *triangles, ""])


def write_scene() -> None:
    """The ground, two blocks and a tower."""
    meshes = {
        "plain": (ply([(-80, -80, 0), (80, -80, 0), (80, 80, 0), (-80, 80, 0)], [(0, 1, 2, 3)]), "ground"),
        "block-1": (box((15, -30, 0), (30, 10, 9)), "stone"),
        "block-2": (box((-35, -5, 0), (-20, 30, 7)), "stone"),
        "tower-1": (box((-8, 22, 0), (2, 32, 20)), "stone"),
    }
    Path("scene/meshes").mkdir(parents=True)
    for name, (text, _) in meshes.items():
        Path(f"scene/meshes/{name}.ply").write_text(text)
    shapes = "\n".join(SHAPE.format(name=name, material=material) for name, (_, material) in meshes.items())
    Path("scene/scene.xml").write_text(SCENE.format(shapes=shapes))


def links() -> pd.DataFrame:
    """Receivers around the blocks, seeded."""
    random = np.random.default_rng(11)
    rx = random.uniform(-48, 48, (40, 2)).round(2)
    inside = ((rx > [15, -30]) & (rx < [30, 10])).all(1) | ((rx > [-35, -5]) & (rx < [-20, 30])).all(1)
    inside |= ((rx > [-8, 22]) & (rx < [2, 32])).all(1)
    rx = rx[~inside]
    table = pd.DataFrame(dict.fromkeys(POSITIONS, 1.5), index=range(len(rx)))
    table[["tx_x", "tx_y", "tx_z"]] = [0.0, 0.0, 12.0]
    table[["rx_x", "rx_y"]] = rx
    table["half"] = np.where(table.rx_x < 0, "west", "east")
    table["weight"] = np.where(table.rx_y < 0, 1.0, 2.0)
    table["carrier_hz"] = np.where(np.arange(len(rx)) % 2, 3.5e9, 28e9)
    return table


def main() -> None:
    """Write everything into the working directory."""
    write_scene()
    table = links()
    Path("replay.toml").write_text(REPLAY)
    Path("program.toml").write_text(PROGRAM)
    Path("carriers.toml").write_text(CARRIERS)
    Path("model.py").write_text(MODEL)
    table.assign(path_loss_db=90.0, power_dbm=-60.0).to_csv("links.csv", index=False)
    study = cb.Study.load("replay.toml")
    planted = cb.engines.make(study, "replay").path_loss(np.array([TRUTH]))[0]
    measured = pd.Series(110.0, index=table.index)
    measured[table.rx_x < 45] = np.where(np.isfinite(planted), planted, 150.0)
    measured += np.random.default_rng(12).standard_normal(len(table)) + 3.0 * (table.half == "west")
    frame = table.assign(path_loss_db=measured.round(3), power_dbm=(30.0 - measured).round(3))
    frame.to_csv("links.csv", index=False)

    # A path program with every kind of interaction that takes numbers of its own.
    study = cb.Study.load("replay.toml")
    few = study.measurements().select(np.arange(len(study.measurements())) < 6)
    paths = cb.trace(
        "scene/scene.xml", few, frequency=3.5e9, max_depth=2, refraction=True, diffraction=True,
        diffuse_reflection=True, samples=2_000, seed=2,
    )  # fmt: skip
    paths.save("paths.h5")

    calibray = [sys.executable, "-c", "from calibray.cli import main; main()"]
    for arguments in (
        ["run", "replay.toml", "--out", "replay"],
        ["run", "program.toml", "--out", "program"],
        [
            "compare",
            "replay.toml",
            "--out",
            "compare",
            "--methods",
            "random,sgwo-im",
            "--seeds",
            "2",
            "--budget",
            "24",
        ],
    ):
        subprocess.run([*calibray, *arguments], check=True)
    for picture in Path("compare").glob("*.png"):
        picture.unlink()
    with closing(sqlite3.connect("program/ledger.sqlite")) as ledger:
        ledger.execute("PRAGMA journal_mode = DELETE")  # one file, no journal beside it
        ledger.execute("VACUUM")


def record() -> None:
    """Write down what the files mean to this version."""
    new = pd.DataFrame(
        [[0.0, 0.0, 12.0, x, y, 1.5, half] for x, y, half in ((40.0, 20.0, "east"), (-10.0, -40.0, "west"))],
        columns=[*POSITIONS, "half"],
    )
    new.to_csv("new-links.csv", index=False)
    paths, result = cb.Paths.load("paths.h5"), cb.Result.load("replay")
    other = paths.materials | {"stone": cb.Material(6.5, 0.1, 0.2, 0.3, 0.1)}
    expected = {
        "studies": {
            name: {"digest": (loaded := cb.Study.load(f"{name}.toml")).digest(), "content": loaded.content()}
            for name in ("replay", "program", "carriers")
        },
        "paths": {
            "kinds": sorted({int(kind) for kind in paths.kind}),
            "num_paths": len(paths.link),
            "path_loss_db": cb.path_loss(paths).tolist(),
            "other_path_loss_db": cb.path_loss(paths, other).tolist(),
            "coherent_path_loss_db": cb.path_loss(paths, combining="coherent").tolist(),
        },
        "predicted_db": result.predict(new).tolist(),
    }
    Path("expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
    record()
