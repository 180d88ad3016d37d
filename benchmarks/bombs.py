"""Inputs that request more resources than a machine has: their memory, and the time until they end or state their cost.

Run with: python benchmarks/bombs.py [--only WORD]

Each input is a small study with one huge item, passed to the command line in a separate process. This process is
stopped once it has stated its cost. Memory is that of the largest process that the command started.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import rasterio
from pyarrow import parquet

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzing import world
from fuzzing.mutations import toml
from fuzzing.outcome import MEMORY

SAYING, GIVEN_UP = 10.0, 120.0
"""Time limit for a bomb to end or to state its cost, after which it is stopped [s]."""
COST = re.compile(r"[\d.,]+ (GiB|MiB|GB|minutes|hours|days|seconds|RT calls|launches|runs|s left)\b")


@dataclass(frozen=True)
class Bomb:
    """One input, and the command that reads it.

    Attributes:
        name: What is huge.
        sections: Sections of the study that replace the harmless ones.
        prepare: Function that changes the folder's files.
        words: Arguments of the command line.
    """

    name: str
    sections: dict[str, Any] = field(default_factory=dict)
    prepare: Callable[[Path], object] = lambda _: None
    words: tuple[str, ...] = ("run", "study.toml", "--out", "out")


def changed(section: str, **keys: Any) -> dict[str, Any]:
    """A section of the harmless study with some keys replaced."""
    return {section: world.content()[section] | keys}


def method(name: str, **options: Any) -> dict[str, Any]:
    """The section of a method with its options."""
    return {"method": {"name": name, "seed": 0, "options": options}}


def named(file: str, text: str) -> Callable[[Path], object]:
    """Replace a file in the folder."""
    return lambda folder: (folder / file).write_text(text)


def many_links(folder: Path) -> None:
    """A table of a million links."""
    rows = (f"{10 + k % 300 / 10},{k % 7 / 10},{65 + k % 20},a,1" for k in range(1_000_000))
    (folder / "links.csv").write_text("\n".join(["x,y,loss,half,w", *rows, ""]))


def entities(levels: int) -> str:
    """A scene with nested entities."""
    inner = "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(levels))
    return f'<!DOCTYPE s [<!ENTITY e0 "ha">{inner}]><scene version="2.1.0"><bsdf id="&e{levels};"/></scene>'


def parameters(count: int) -> dict[str, Any]:
    """A study with many parameters, whose materials the scene lacks."""
    return {"parameters": {f"wall-{k}.conductivity": {"bounds": [0.001, 1.0]} for k in range(count)}}


def program(line: str) -> tuple[dict[str, Any], Callable[[Path], object]]:
    """An external program that does something before it answers."""
    return changed("engine", name="command"), named("answer.sh", line + "\n" + world.SCRIPT)


def rays(write: Callable[[Path], object], ending: str) -> tuple[dict[str, Any], Callable[[Path], object]]:
    """A study on a ray table with this file extension, which `write` creates."""
    return changed("engine", rays=f"rays.{ending}"), lambda folder: write(folder / f"rays.{ending}")


def parquet_bomb(file: Path) -> None:
    """A Parquet file of a few kilobytes whose rows share one text of 16 MB: 16 TB of text."""
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(2**20, dtype=np.int32)), pa.array(["x" * 2**24]))
    columns = {name: text for name in ("x", "y", "loss", "half", "w", "path", "point", "type", "z")}
    parquet.write_table(
        pa.table(columns), file, store_schema=False, dictionary_pagesize_limit=2**30, compression="zstd"
    )


def hdf5_bomb(file: Path) -> None:
    """An HDF5 file of a few kilobytes with columns of 80 TB."""
    with h5py.File(file, "w") as content:
        for name in ("path", "point", "type", "x", "y", "z"):
            content.create_dataset(name, (10**13,), chunks=(2**20,), dtype="f8", compression="gzip")


def raster_bomb(folder: Path) -> None:
    """A sparse GeoTIFF of one megabyte with 120 billion cells, under the footprint of a house."""
    profile = {"driver": "GTiff", "width": 400_000, "height": 300_000, "count": 1, "dtype": "uint8"}
    options = {"tiled": True, "compress": "deflate", "sparse_ok": True, "BIGTIFF": "YES"}
    grid = rasterio.Affine(5e-7, 0, 11.4, 0, -5e-7, 48.2)
    with rasterio.open(folder / "ground.tif", "w", crs="EPSG:4326", transform=grid, **profile, **options):
        pass
    ring = [[11.5, 48.1], [11.5002, 48.1], [11.5002, 48.1002], [11.5, 48.1002], [11.5, 48.1]]
    house = {
        "type": "Feature",
        "properties": {"height": 9},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    (folder / "house.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [house]}))


PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
PLY += "property float x\nproperty float y\nproperty float z\n"
PLY += "element face 4000000000\nproperty list uchar int vertex_indices\nend_header\n"

BOMBS = (
    Bomb("filter: a tower of powers", changed("links", where="x > 7**7**7**7")),
    Bomb("filter: 100,000 words", changed("links", where=" or ".join(["x > 1"] * 100_000))),
    Bomb("method: a budget of 10^12", method("random", budget=10**12)),
    Bomb("method: a population of 10^9", method("gwo", population=10**9, iterations=10)),
    Bomb("method: 10^9 iterations", method("gwo", population=10, iterations=10**9)),
    Bomb("method: 10^9 starts", method("least-squares", starts=10**9)),
    Bomb("trace: 10^15 samples", changed("trace", samples=10**15)),
    Bomb("trace: 10^11 samples", changed("trace", samples=10**11)),
    Bomb("trace: depth 10^6", changed("trace", max_depth=10**6)),
    Bomb("trace: depth 40, 10^7 samples", changed("trace", max_depth=40, samples=10**7)),
    Bomb("links: a million", changed("trace", samples=10**6), many_links),
    Bomb("links: one row of 100 MB", {}, named("links.csv", "x,y,loss,half,w\n" + "1" * 10**8 + ",1,1,a,1\n")),
    Bomb("parameters: 10,000", parameters(10_000)),
    Bomb("hold-out: 10^9 blocks", {"holdout": {"blocks": 10**9}}),
    Bomb("study: lists 100,000 deep", {}, named("study.toml", f"version = {'[' * 100_000}{']' * 100_000}\n")),
    Bomb("study: 50 MB of one key", {}, named("study.toml", f'version = 1\nscene = "{"x" * 5 * 10**7}"\n')),
    Bomb("scene: entities in entities", {}, named("scene.xml", entities(30))),
    Bomb("scene: 100,000 levels", {}, named("scene.xml", "<a>" * 100_000 + "</a>" * 100_000)),
    Bomb("mesh: four thousand million vertices", {}, named("meshes/house.ply", PLY)),
    Bomb("antenna: a million angles", {}, named("horn.csv", world.horn() + "0.5,0.5,1\n" * 10**6)),
    Bomb("program: 2 GB of errors", *program("head -c 2000000000 /dev/zero >&2")),
    Bomb("program: 2 GB of output", *program("head -c 2000000000 /dev/zero")),
    Bomb("program: an answer of 2 GB", *program("head -c 2000000000 /dev/zero > \"$2\"; exit")),
    Bomb("program: JSON 10^6 deep", *program("head -c 1000000 /dev/zero | tr '\\0' '[' > \"$2\"; exit")),
    Bomb("compare: 10^9 seeds", {}, words=("compare", "study.toml", "--seeds", "1000000000", "--out", "out")),
    Bomb("validate: 10^9 blocks", {}, words=("validate", "study.toml", "--blocks", "1000000000")),
    Bomb("links: Parquet of 16 TB", changed("links", file="rows.parquet"), lambda f: parquet_bomb(f / "rows.parquet")),
    Bomb("rays: Parquet of 16 TB", *rays(parquet_bomb, "parquet")),
    Bomb("rays: HDF5 of 80 TB", *rays(hdf5_bomb, "h5")),
    Bomb("rays: JSON 10^6 deep", *rays(lambda file: file.write_text("[" * 10**6), "json")),
    Bomb("rays: JSON of 100 MB", *rays(lambda file: file.write_text('{"path": [' + "1," * 5 * 10**7 + "1]}"), "json")),
    Bomb(
        "terrain: 120,000 million cells", {}, raster_bomb,
        ("scene", "footprints", "house.geojson", "--height", "height", "--terrain", "ground.tif", "--out", "made"),
    ),
    Bomb("plan: a file without an end", {}, words=("scene", "plan", "/dev/full", "--out", "made")),
)  # fmt: skip


def tree(root: int) -> list[int]:
    """A process and all its descendants."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(words[1]), []).append(int(entry.name))
    found = [root]
    for process in found:
        found += parents.get(process, [])
    return found


def memory(process: int) -> int:
    """Peak memory of a process [bytes]."""
    try:
        peak = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    except OSError:
        return 0
    return 0 if peak is None else 1024 * int(peak[1])


def explode(bomb: Bomb, folder: Path) -> tuple[str, float, int, str]:
    """Pass a bomb to the command line; return the outcome, its time [s], the memory [bytes], and the last message."""
    world.write(folder)
    (folder / "study.toml").write_text(toml(world.content(**bomb.sections)))
    bomb.prepare(folder)
    said, started, most = folder / "said.txt", time.monotonic(), 0
    with said.open("wb") as stream:
        command = [sys.executable, "-c", "from calibray.cli import main; main()", *bomb.words]
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            start_new_session=True,
        )
        came, after = "", 0.0
        while process.poll() is None and time.monotonic() - started < GIVEN_UP and not came:
            most = max(most, *map(memory, tree(process.pid)))
            if COST.search(said.read_text(errors="replace")[-5000:]):
                came = "announced"
            time.sleep(0.05)
        after = time.monotonic() - started
        if process.poll() is None:
            came = came or "HANGS"
            # Memory may still grow after the cost is stated, so the measurement continues for a while.
            until = time.monotonic() + (SAYING if came == "announced" else 0.0)
            while process.poll() is None and time.monotonic() < until:
                most = max(most, *map(memory, tree(process.pid)))
                time.sleep(0.05)
            for each in reversed(tree(process.pid)):
                try:
                    os.kill(each, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            process.wait()
        else:
            process.wait()
            came = {0: "done", 1: "failed", 2: "refused"}.get(
                process.returncode, f"STATUS {process.returncode}"
            )
    text = said.read_text(errors="replace")
    if "Traceback" in text:
        came = "TRACEBACK"
    if "Missing option" in text or "No such option" in text:  # nothing was requested
        came = "MISUSED"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    costly = [line for line in lines if COST.search(line)] if came == "announced" else lines
    return came, after, most, (costly or [""])[-1]


def main() -> int:
    """Print a line for each input; return 0 if all ended or stated their cost within the limits of time and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="only inputs whose name contains this text")
    only = parser.parse_args().only
    well = True
    print(f"{'':40}{'':>10}{'s':>7}{'MiB':>7}  said")
    with tempfile.TemporaryDirectory() as place:
        os.environ["CALIBRAY_CACHE"] = f"{place}/cache"
        for k, bomb in enumerate(bomb for bomb in BOMBS if only in bomb.name):
            folder = Path(place) / str(k)
            folder.mkdir()
            came, after, most, line = explode(bomb, folder)
            bad = came.isupper() or came.startswith("STATUS") or most > MEMORY
            bad |= after > SAYING
            well &= not bad
            print(
                f"{bomb.name:40}{came:>10}{after:7.1f}{most / 2**20:7.0f}  {'(!) ' if bad else ''}{line[:110]}",
                flush=True,
            )
    print("all well" if well else "NOT WELL")
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
