"""The window's first view and its panning with 10,000 points and 5,000 buildings.

    python benchmarks/window_view.py [--buildings 5000] [--points 10000] [--repeats 3]

The first view is the time from the request of the page to the first drawing with all links, in a browser with an empty
cache. Panning drags the map for a few seconds and counts the drawings of the canvas.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from calibray.scenes import read_scene, read_triangles
from scene_making import plant
from window_server import launched, opened, served

SECONDS = 3.0


def prepare(folder: Path, buildings: int, points: int) -> None:
    """A study of a synthetic town with points anywhere in it."""

    def calibray(*words: str) -> None:
        subprocess.run(
            [sys.executable, "-m", "calibray", *words], cwd=folder, check=True, capture_output=True
        )

    plant(folder / "map.osm", buildings)
    calibray(
        *["scene", "osm", "map.osm", "--out", "scene", "--wall", "concrete:0.3", "--ground", "concrete:1.0"]
    )
    corners = read_triangles(read_scene(str(folder / "scene" / "scene.xml"), 1e9)).vertex
    low, high = corners.min(axis=0), corners.max(axis=0)
    random = np.random.default_rng(0)
    table = pd.DataFrame(low[:2] + (high - low)[:2] * random.random((points, 2)), columns=["rx_x", "rx_y"])
    table = table.assign(
        rx_z=1.5, tx_x=0.0, tx_y=0.0, tx_z=40.0, path_loss_db=100 + 20 * random.random(points)
    )
    table.round(2).to_csv(folder / "links.csv", index=False)
    calibray(*["init", "scene/scene.xml", "links.csv", "--out", "study.toml", "--frequency", "3.5e9"])


def first_view(browser, address: str, points: int):
    """Seconds until all links are drawn, and the page."""
    start = time.monotonic()
    page = opened(browser, address)
    page.locator(f"#plan[data-links='{points}'][data-drawn]").wait_for()
    return time.monotonic() - start, page


def panning(page) -> float:
    """Frames per second while the map is dragged."""
    canvas = page.locator("#plan")
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    before, start, step = int(canvas.get_attribute("data-drawn")), time.monotonic(), 0
    while time.monotonic() - start < SECONDS:
        step += 1
        # The drag is so long that the map must be painted again on the way.
        page.mouse.move(
            x + 0.45 * box["width"] * np.sin(step / 30), y + 0.45 * box["height"] * np.cos(step / 30)
        )
    seconds = time.monotonic() - start
    page.mouse.up()
    return (int(canvas.get_attribute("data-drawn")) - before) / seconds


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--buildings", type=int, default=5000)
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    with TemporaryDirectory() as name, launched() as browser:
        prepare(Path(name), options.buildings, options.points)
        print("| first view [s] | panning [frames/s] |\n|---|---|", flush=True)
        for _ in range(options.repeats):
            with served(Path(name)) as address:
                seconds, page = first_view(browser, address, options.points)
                print(f"| {seconds:.1f} | {panning(page):.0f} |", flush=True)
                page.context.close()


if __name__ == "__main__":
    main()
