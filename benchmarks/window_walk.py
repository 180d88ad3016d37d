"""From an empty folder to a report and a prediction by clicks alone, for the town, the flat and the hill.

    python benchmarks/window_walk.py [town|flat|hill ...] [--pictures FOLDER]

Each walk uploads the files of `examples/bring_your_own`, makes the scene, drafts the study, calibrates and predicts.
Then `calibray run` calibrates the study file that the window wrote; the values must be identical in all digits. The
script prints a table.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from window_server import SIZES, add, choose, launched, opened, press, served, step

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "bring_your_own"
MAPS = {"town": ["town.osm"], "flat": ["flat/plan.csv"], "hill": ["hill/houses.geojson", "hill/ground.tif"]}
TABLES = {
    "town": ["rsrp.csv", "cells.csv"],
    "flat": ["flat/rss.csv", "flat/access_points.csv"],
    "hill": ["hill/power.csv", "hill/masts.csv", "hill/walk.gpx"],
}
FREQUENCY = {"town": "3.6e9", "flat": "2.44e9", "hill": "2.1e9"}


def walk(page, name: str) -> None:
    """The clicks."""
    add(page, "Map or plan", [EXAMPLES / file for file in MAPS[name]])
    if name == "hill":
        page.get_by_text("Settings of the scene").click()
        page.get_by_label("Height: a column, or metres").fill("height_m")
        choose(page, "Map or plan", "Height model of the ground", "ground.tif")
    press(page, "Map or plan", "Make the scene")
    add(page, "Measurements", [EXAMPLES / file for file in TABLES[name]])
    page.get_by_label("Carrier frequency [Hz]").fill(FREQUENCY[name])
    press(page, "Measurements", "Draft the study", 120)
    press(page, "Run", "Calibrate", 600)
    step(page, "Result").locator("iframe").wait_for()
    canvas = page.locator("#plan")
    canvas.focus()
    page.keyboard.press("Enter")
    page.get_by_text("Chosen place").wait_for()
    page.wait_for_timeout(500)
    press(page, "Predict and use", "Predict here", 120)
    page.get_by_text("90 % interval").wait_for()


def same_digits(folder: Path) -> bool:
    """Whether the command line calibrates the window's study to the same values."""
    words = [sys.executable, "-m", "calibray", "run", "study.toml", "--out", "again"]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    first, second = (json.loads((folder / name / "result.json").read_text()) for name in ("result", "again"))
    return all(first[part] == second[part] for part in ("fit", "uncertainty", "accuracy", "prediction"))


def main() -> None:
    """Run the walks, compare the results, and take pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(MAPS))
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    print(
        "| example | links | RMSE, calibrated [dB] | from an empty folder to a prediction | same by `calibray run` |"
    )
    print("|---|---|---|---|---|", flush=True)
    for name in options.names:
        with TemporaryDirectory() as folder, served(Path(folder)) as address, launched() as browser:
            start = time.monotonic()
            page = opened(browser, address)
            noted = page.noted  # type: ignore[attr-defined]
            walk(page, name)
            seconds = time.monotonic() - start
            assert not noted, noted
            if options.pictures:
                options.pictures.mkdir(parents=True, exist_ok=True)
                for size in SIZES:
                    for scheme in ("light", "dark"):
                        page.set_viewport_size(dict(zip(("width", "height"), SIZES[size], strict=True)))
                        page.emulate_media(color_scheme=scheme)
                        page.wait_for_timeout(1500)
                        page.screenshot(path=options.pictures / f"{name}-{size}-{scheme}.png", full_page=True)
            record = json.loads((Path(folder) / "result" / "result.json").read_text())
            cells = (
                name,
                record["links"]["calibrated_on"],
                f"{record['fit']['rmse_db']:.2f}",
                f"{seconds:.0f} s",
            )
            same = "to the digit" if same_digits(Path(folder)) else "no"
            print(f"| {' | '.join(map(str, cells))} | {same} |", flush=True)


if __name__ == "__main__":
    main()
