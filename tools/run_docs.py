"""Run every Calibray command in the documentation, page by page, in folders with the files that a reader has.

Usage: `python tools/run_docs.py [PAGE...]`, for instance `python tools/run_docs.py README.md docs/index.md`. Failures
are printed with their messages, and the exit status is then 1. A page with commands needs an entry in `PREPARED`.
`LEFT_OUT` lists commands that take hours or need measured data.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import osmium
import pandas as pd
import rasterio
import shapely
from pyogrio import raw as pyogrio_raw
from rasterio.transform import from_bounds

import calibray as cb
from calibray.scenes import Mesh, MeshObject, join_meshes, write_scene
from calibray.study import Setup, Study

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "benchmarks"))

from coastal_district import Building, building_meshes  # noqa: E402

EXAMPLES = ROOT / "examples"
TOWN = EXAMPLES / "bring_your_own"
CALIBRAY = Path(sys.executable).with_name("calibray")
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md")]
AT_ONCE = 2  # pages
LIMIT = 900.0  # for one command [s]

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_STUDY = re.compile(r"^```toml\n(version = 1\n.*?)^```", re.MULTILINE | re.DOTALL)
_TYPED = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?(calibray .*|cd .*)$")

MEASURED = "measured data are not part of the repository"
LEFT_OUT = {
    "calibray run examples/nist_boulder": MEASURED,
    "calibray run examples/auckland": MEASURED,
    "calibray validate examples/nist_boulder": MEASURED,
    "calibray validate examples/auckland": MEASURED,
    "calibray run study.toml --out result --scheduler": "needs a cluster; tests/engines/test_dask.py starts one",
    "calibray compare study.toml": "takes an hour; tests/comparison/test_comparison.py runs a small one",
}
"""Commands that are not run, by their first words, with the reason."""


def nothing(folder: Path) -> None:
    """Prepare nothing: the commands need no file."""


def repository(folder: Path) -> None:
    """Copy the examples, with new links for the town."""
    shutil.copytree(EXAMPLES, folder / "examples")
    town(folder / "examples" / "bring_your_own")


def town(folder: Path) -> None:
    """Copy the example town, with one phone at every fourth stop of the log, so that a run takes seconds."""
    shutil.copytree(TOWN, folder, dirs_exist_ok=True)
    log = pd.read_csv(TOWN / "rsrp.csv")
    stop = log.groupby(["longitude", "latitude"], sort=False).ngroup()
    log[(stop % 4 == 0) & (log["device"] == "phone-a")].to_csv(folder / "rsrp.csv", index=False)
    new_links(folder / "new-links.csv", (20.0, 10.0, 6.0), cell="cell-1", device="phone-a")


def flat(folder: Path) -> None:
    """Copy the example flat, with every third position, so that a run takes a minute."""
    shutil.copytree(TOWN / "flat", folder, dirs_exist_ok=True)
    pd.read_csv(TOWN / "flat" / "rss.csv").iloc[::3].to_csv(folder / "rss.csv", index=False)


def hill(folder: Path) -> None:
    """Copy the example hill."""
    shutil.copytree(TOWN / "hill", folder, dirs_exist_ok=True)


def maps(folder: Path) -> None:
    """Write the town as an extract, the hill's houses as a GeoPackage, a height model, and the flat in millimetres."""
    with osmium.SimpleWriter(str(folder / "town.osm.pbf")) as writer:
        for element in osmium.FileProcessor(str(TOWN / "town.osm")):
            writer.add(element)
    west, south, east, north = 9.985, 50.006, 9.995, 50.014
    ground = np.linspace(100.0, 104.0, 40)[:, None] * np.ones(40)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", width=40, height=40, count=1, dtype="float64", crs="EPSG:4326",
        transform=from_bounds(west, south, east, north, 40, 40),
    ) as raster:  # fmt: skip
        raster.write(ground, 1)
    houses = json.loads((TOWN / "hill" / "houses.geojson").read_text())["features"]
    shapes = np.array([shapely.from_geojson(json.dumps(house["geometry"])) for house in houses])
    heights = np.array([float(house["properties"]["height_m"]) for house in houses])
    pyogrio_raw.write(
        folder / "blocks.gpkg", shapely.to_wkb(shapes), [heights], ["height_m"], geometry_type="Polygon",
        crs="EPSG:4326",
    )  # fmt: skip
    plan = pd.read_csv(TOWN / "flat" / "plan.csv")
    plan[["x0", "y0", "x1", "y1", "thickness"]] *= 1000.0
    plan.replace({"type": {"plasterboard": "drywall"}}).to_csv(folder / "flat.csv", index=False)


def own_scene(folder: Path) -> None:
    """Write the study of README.md, houses along a street, and links simulated there with 1 dB of noise."""
    houses = [
        Building(f"house-{number}", np.array([0.0, side]) + box(28.0 * number - 14.0), 12.0, 0.0)
        for number in range(7)
        for side in (10.0, -20.0)
    ]
    walls = join_meshes(building_meshes(house)[0] for house in houses)
    ground = Mesh(
        np.array([[-60.0, -60, 0], [220, -60, 0], [220, 60, 0], [-60, 60, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    constants = {"relative_permittivity": 5.0, "conductivity": 0.3, "thickness": 0.3}
    objects = [MeshObject("houses", "walls", walls), MeshObject("plane", "ground", ground)]
    write_scene(folder / "scene", objects, {"walls": constants, "ground": constants})
    (folder / "study.toml").write_text(_STUDY.findall((ROOT / "README.md").read_text(encoding="utf-8"))[0])
    random = np.random.default_rng(0)
    table = pd.DataFrame({"rx_x_m": random.uniform(15.0, 170.0, 40), "rx_y_m": random.uniform(-8.0, 8.0, 40)})
    table.assign(path_loss_db=100.0).to_csv(folder / "links.csv", index=False)
    loss = cb.path_loss(Setup.open(Study.load(folder / "study.toml")).trace())
    table.assign(path_loss_db=loss + 3.0 + random.normal(0.0, 1.0, 40)).to_csv(
        folder / "links.csv", index=False
    )
    new_links(folder / "new-links.csv", (0.0, 0.0, 2.5))


def calibrated(folder: Path) -> None:
    """Prepare the study of README.md and calibrate it."""
    own_scene(folder)
    subprocess.run(
        [CALIBRAY, "run", "study.toml", "--out", "result"], cwd=folder, check=True, capture_output=True
    )


def box(west: float) -> np.ndarray:
    """Footprint of a house, 18 m by 10 m [4, 2], [m]."""
    return np.array([[west, 0.0], [west + 18.0, 0.0], [west + 18.0, 10.0], [west, 10.0]])


def new_links(file: Path, tx: tuple[float, float, float], **labels: str) -> None:
    """Write new links: one transmitter, five receivers in a row."""
    along = np.linspace(2.0, 12.0, 5)
    table = pd.DataFrame(dict(zip(("tx_x", "tx_y", "tx_z"), tx, strict=True)), index=range(5))
    table.assign(rx_x=tx[0] + along, rx_y=tx[1], rx_z=1.5, **labels).to_csv(file, index=False)


PREPARED: dict[str, tuple[Callable[[Path], None], ...]] = {
    "README.md": (own_scene,),
    "docs/index.md": (own_scene,),
    "docs/tutorial/ten-minutes.md": (repository,),
    "docs/guides/install.md": (nothing,),
    "docs/guides/bring-your-own.md": (town,),
    "docs/guides/plans-and-tracks.md": (flat, hill),
    "docs/guides/scenes.md": (maps,),
    "docs/guides/predict.md": (calibrated,),
    "docs/guides/export.md": (calibrated,),
    "docs/guides/compare-methods.md": (nothing,),
    "docs/guides/many-machines.md": (own_scene,),
    "docs/measurements/expensive-engines.md": (repository,),
    "docs/case-studies/boulder.md": (repository,),
    "docs/case-studies/auckland.md": (repository,),
    "examples/README.md": (repository,),
    "examples/octave_canyon/README.md": (repository,),
}
"""Functions that prepare the files of each page: one for all its blocks, or one per block."""


@dataclass(frozen=True)
class Ran:
    """The outcome of a command.

    Attributes:
        page: The page that contains the command.
        command: The command.
        seconds: Time that it took [s].
        failure: Its messages if it failed; empty otherwise.
        reason: Why it was not run; empty if it was run.
    """

    page: str
    command: str
    seconds: float = 0.0
    failure: str = ""
    reason: str = ""


def commands(text: str) -> list[list[str]]:
    """Commands of every code block that has any, with continuation lines joined."""
    shell = (block for language, block in _BLOCK.findall(text) if language in {"", "sh"})
    blocks = (re.sub(r"\\\n\s*", "", block).splitlines() for block in shell)
    typed = ([match[1] for line in block if (match := _TYPED.match(line))] for block in blocks)
    return [block for block in typed if any(command.startswith("calibray") for command in block)]


def run_page(page: str, blocks: list[list[str]]) -> Iterator[Ran]:
    """Run the commands of a page in order, as a reader would.

    Args:
        page: The page, relative to the repository's root.
        blocks: Its commands, block by block.

    Yields:
        The outcome of each command.
    """
    prepared = PREPARED.get(page, ())
    if len(prepared) not in {1, len(blocks)}:
        yield Ran(
            page,
            blocks[0][0],
            failure="no files are prepared for this page: add it to PREPARED in tools/run_docs.py",
        )
        return
    with tempfile.TemporaryDirectory(prefix="calibray-docs-") as name:
        folder = Path(name)
        for number, block in enumerate(blocks):
            if number < len(prepared):
                folder = Path(name) / f"block-{number}"
                folder.mkdir()
                prepared[number](folder)
            for command in block:
                if command.startswith("cd "):
                    folder /= command.removeprefix("cd ")
                else:
                    yield run(page, command, folder)


def run(page: str, command: str, folder: Path) -> Ran:
    """Run a command in a folder, unless it is left out."""
    for start, reason in LEFT_OUT.items():
        if command.startswith(start):
            return Ran(page, command, reason=reason)
    words = shlex.split(command, comments=True)
    start = time.monotonic()
    try:
        process = subprocess.run(
            [CALIBRAY, *words[1:]], cwd=folder, capture_output=True, text=True, check=False, timeout=LIMIT
        )
    except subprocess.TimeoutExpired:
        return Ran(page, command, LIMIT, f"took longer than {LIMIT:.0f} s")
    failure = (
        f"exit status {process.returncode}\n{process.stdout}{process.stderr}" if process.returncode else ""
    )
    return Ran(page, command, time.monotonic() - start, failure)


def main(pages: list[str]) -> int:
    """Run the commands of pages and print the outcomes.

    Args:
        pages: The pages, relative to the repository's root; all if empty.

    Returns:
        The number of commands that failed.
    """
    texts = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in PAGES}
    blocks = {page: commands(texts[page]) for page in pages or sorted(texts)}
    blocks = {page: lines for page, lines in blocks.items() if lines}
    failed = 0
    with ThreadPoolExecutor(AT_ONCE) as executor:
        for outcomes in executor.map(lambda page: list(run_page(page, blocks[page])), blocks):
            for ran in outcomes:
                failed += bool(ran.failure)
                ending = ran.failure or (f"not run: {ran.reason}" if ran.reason else f"{ran.seconds:.0f} s")
                sys.stdout.write(f"{ran.page}: {ran.command}: {ending}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(blocks)} pages with commands, {failed} commands failed\n")
    return failed


if __name__ == "__main__":
    sys.exit(bool(main(sys.argv[1:])))
