"""Time to make and to trace a scene of 5,000 buildings, compared with reading the map alone.

    python benchmarks/scene_making.py [--buildings 5000] [--windows 0.3] [--trace]

A town of blocks is written as an OpenStreetMap extract: rows of houses that share walls, with heights stated, given by
storeys, or missing. Reading is the part of pyosmium alone: the same areas are assembled, but no scene is made.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar

import numpy as np
import osmium
import shapely
from osmium.filter import KeyFilter
from osmium.geom import WKBFactory
from osmium.osm import Area

from calibray.coordinates import Frame
from calibray.scenes.authoring import MadeScene, Windows, make_scene, read_openstreetmap

PLACE = (11.5755, 48.1374)
ROW = 10  # houses that share walls


def plant(path: Path, buildings: int) -> None:
    """Write an extract of rows of houses."""
    random = np.random.default_rng(0)
    columns = int(np.ceil(np.sqrt(buildings / ROW / 4)))
    corners, ways = [], []
    for number in range(buildings):
        row, place = divmod(number, ROW)
        west, south = 160.0 * (row % columns) + 14.0 * place, 40.0 * (row // columns)
        depth = 12.0 + random.integers(0, 3)
        bay = random.uniform(3.0, 9.0)
        # A house with a bay at the back, which has eight corners.
        back = [(bay + 3, depth), (bay + 3, depth + 2), (bay, depth + 2), (bay, depth)]
        ring = [(0, 0), (14, 0), (14, depth), *back, (0, depth)]
        corners += [(west + x, south + y, 0.0) for x, y in ring]
        tags = [
            ("height", f"{random.uniform(6, 25):.1f}"),
            ("building:levels", str(random.integers(1, 8))),
            ("name", "x"),
        ]
        ways.append((number, len(ring), tags[random.integers(0, 3)]))
    degrees = Frame.local(*PLACE).to_geographic(corners)
    with path.open("w") as file:
        file.write('<osm version="0.6">')
        for index, (longitude, latitude, _) in enumerate(degrees, start=1):
            file.write(f'<node id="{index}" version="1" lat="{latitude:.7f}" lon="{longitude:.7f}"/>')
        for number, count, (key, value) in ways:
            first = 8 * number + 1
            nodes = "".join(f'<nd ref="{node}"/>' for node in [*range(first, first + count), first])
            file.write(
                f'<way id="{number + 1}" version="1">{nodes}<tag k="building" v="yes"/>'
                f'<tag k="{key}" v="{value}"/></way>'
            )
        file.write("</osm>")


def read_alone(path: Path) -> int:
    """Assemble the areas with pyosmium and their geometry with shapely, without making a scene."""
    wanted, geometry = KeyFilter("building"), WKBFactory()
    areas = osmium.FileProcessor(path).with_areas(wanted).with_filter(wanted)
    return len(
        [shapely.from_wkb(geometry.create_multipolygon(area)) for area in areas if isinstance(area, Area)]
    )


def resident() -> float:
    """Peak memory of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


R = TypeVar("R")


def timed(function: Callable[..., R], *arguments: object) -> tuple[float, R]:
    """Processor time of a call [s], which other work on the machine hardly affects, and its return value."""
    start = time.process_time()
    returned = function(*arguments)
    return time.process_time() - start, returned


def trace(made: MadeScene) -> float:
    """Processor time to load and trace ten links of the scene [s]."""
    from calibray.scenes import read_scene
    from calibray.tracing.settings import Antenna, TraceSettings
    from calibray.tracing.sionna import Tracer

    def run() -> int:
        settings = TraceSettings(max_depth=3, samples=200_000)
        tracer = Tracer(read_scene(made.path, 3.5e9), 3.5e9, settings, Antenna(), Antenna())
        rx = np.random.default_rng(1).uniform((-200, -200, 1.5), (200, 200, 1.6), (10, 3))
        return tracer.trace(SimpleNamespace(tx=np.tile([0.0, 0.0, 40.0], (10, 1)), rx=rx)).num_paths

    return timed(run)[0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--buildings", type=int, default=5000)
    parser.add_argument("--windows", type=float, default=0.3)
    parser.add_argument("--trace", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        extract = Path(folder) / "town.osm"
        plant(extract, arguments.buildings)
        read_alone(extract)
        alone, count = timed(read_alone, extract)
        before = resident()
        reading, (footprints, frame) = timed(read_openstreetmap, extract)
        for name, windows in (
            ("walls alone", None),
            (f"{arguments.windows:.0%} window", Windows(arguments.windows)),
        ):
            making, made = timed(
                lambda windows=windows: make_scene(footprints, Path(folder) / "scene", frame, windows=windows)
            )
            total = reading + making
            print(
                f"{count} buildings, {name}: {sum(made.triangles.values())} triangles, {total:.1f} s, "
                f"{total / alone:.0f} times as long as reading; {resident():.0f} MiB, {before:.0f} MiB before"
            )
        print(f"{made.counts}")
        if arguments.trace:
            seconds = trace(made)
            print(
                f"loaded and ten links traced: {seconds:.1f} s, {seconds / total:.1f} times making; "
                f"{resident():.0f} MiB"
            )
