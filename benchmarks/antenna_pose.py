"""Planted sectors whose stated directions are wrong: does calibration recover them and the materials?

    python benchmarks/antenna_pose.py --first 100 --districts 20 --repetitions 5

Every district has buildings, two masts and three 65-degree sectors: panels of eight rows 0.8 wavelengths apart, whose
beam is 65 degrees wide in azimuth and 8 degrees in elevation, with 6 degrees of electrical downtilt. A repetition draws
two permittivities, azimuths off by up to 20 degrees and downtilts by up to 5, computes the path loss of 200 links, and
adds 3 dB of noise. It then calibrates all links except a block of 50, starting from the stated directions, once with
the directions as parameters and once without. The table shows how often the 90 % intervals of the draws contain the
truth, and the RMSE on the held-out block, relative to the measured path loss and to the true one without noise. The
last lines show how many sectors the remark on directions names, by azimuth error, and how often it names one although
all directions are right.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

import calibray as cb
from calibray.fields import path_loss
from calibray.result.verdict import RemarkKind
from calibray.scenes import Mesh, MeshObject, join_meshes, write_scene
from calibray.study import Setup, Study

Repetition = Callable[[Path, pd.DataFrame, list[int]], list[dict[str, Any]]]
"""Function that takes the folder of a district, its links and a seed, and returns rows of a table."""

FREQUENCY: Final = 3.5e9
NOISE_DB: Final = 3.0
RAYS: Final = 100_000
AZIMUTH_DEG, DOWNTILT_DEG = 20.0, 5.0
"""Largest errors of the stated directions."""
HALF: Final = 120.0
"""Half of the district's width [m]."""
MATERIALS: Final = {"walls.relative_permittivity": [2.0, 9.0], "ground.relative_permittivity": [2.0, 15.0]}
PANEL: Final = {"pattern": "tr38901", "polarization": "V", "rows": 8, "spacing": [0.5, 0.8]}
SECTORS: Final = ("west-1", "west-2", "east-1")
POSITION: Final = ["tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"]


def district(folder: Path, seed: int) -> pd.DataFrame:
    """Write a scene, and draw masts, sectors and receivers; the columns contain the true directions."""
    random = np.random.default_rng([seed, 27])
    boxes, centres = [], [(x, y) for x in (-70.0, 0.0, 70.0) for y in (-70.0, 0.0, 70.0)]
    footprints = []
    for x, y in centres:
        low = np.round([x - random.uniform(12, 24), y - random.uniform(12, 24)], 1)
        high = np.round([x + random.uniform(12, 24), y + random.uniform(12, 24)], 1)
        boxes.append(_box(low, high, round(random.uniform(10, 25), 1)))
        footprints.append((low, high))
    objects = [
        MeshObject("houses", "walls", join_meshes(boxes)),
        MeshObject("plane", "ground", _box(np.full(2, -HALF - 30), np.full(2, HALF + 30), 0.0)),
    ]
    constants = {"relative_permittivity": 5.0, "conductivity": 0.05, "thickness": 0.3}
    write_scene(folder / "scene", objects, {"walls": constants, "ground": constants})
    masts = {"west": [-105.0, random.uniform(-40, 40), 30.0], "east": [105.0, random.uniform(-40, 40), 25.0]}
    azimuth = {
        "west-1": random.uniform(30, 60),
        "west-2": random.uniform(115, 150),
        "east-1": random.uniform(250, 290),
    }
    parts = []
    for sector, count in zip(SECTORS, (67, 67, 66), strict=True):
        tx, rx = np.array(masts[sector.partition("-")[0]]), []
        while len(rx) < count:
            point = random.uniform(-HALF, HALF, 2)
            bearing = np.degrees(np.arctan2(*(point - tx[:2])))
            off = abs((bearing - azimuth[sector] + 180) % 360 - 180)
            inside = any(((low - 1 < point) & (point < high + 1)).all() for low, high in footprints)
            if not inside and off < 75:
                rx.append([*point.round(2), 1.5])
        table = pd.DataFrame(np.hstack([np.tile(tx, (count, 1)), rx]), columns=POSITION)
        parts.append(table.assign(sector=sector, azimuth=azimuth[sector], downtilt=random.uniform(0, 4)))
    links = pd.concat(parts, ignore_index=True)
    # The held-out block consists of the fifty receivers nearest to a point.
    centre = random.uniform(-60, 60, 2)
    distance = np.linalg.norm(links[["rx_x", "rx_y"]] - centre, axis=1)
    return links.assign(held_out=distance.argsort().argsort() < 50, loss_db=100.0)


def _box(low: np.ndarray, high: np.ndarray, height: float) -> Mesh:
    """A box without a floor; a rectangle if the height is 0."""
    corners = np.array([[*low], [high[0], low[1]], [*high], [low[0], high[1]]])
    roof = np.column_stack([corners, np.full(4, height)])
    faces = [[0, 1, 2], [0, 2, 3]]
    if height == 0:
        return Mesh(roof, np.array(faces))
    walls = [
        face for k in range(4) for face in ([k, (k + 1) % 4 + 4, k + 4], [k, (k + 1) % 4, (k + 1) % 4 + 4])
    ]
    return Mesh(np.vstack([roof, roof * [1, 1, 0]]), np.array([*faces, *([a, c, b] for a, b, c in walls)]))


def study(folder: Path, table: pd.DataFrame, posed: bool, rays: int = RAYS) -> Study:
    """The study of links; with the directions of its sectors as parameters if `posed`."""
    table.to_csv(folder / "links.csv", index=False)
    parameters: dict[str, Any] = {name: {"bounds": bounds} for name, bounds in MATERIALS.items()}
    if posed:
        for sector in SECTORS:
            parameters[f"tx:{sector}.azimuth"] = {"bounds": [-30.0, 30.0]}
            parameters[f"tx:{sector}.downtilt"] = {"bounds": [-10.0, 10.0]}
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": FREQUENCY},
        "links": {
            "file": "links.csv", "tx": POSITION[:3], "rx": POSITION[3:], "value": "loss_db", "transmitter": "sector",
            "tx_antenna": {"azimuth_deg": "azimuth", "downtilt_deg": "downtilt", "electrical_downtilt_deg": 6.0},
        },
        "antennas": {"tx": PANEL, "rx": {"pattern": "dipole"}},
        "trace": {"max_depth": 3, "samples": rays},
        "holdout": {"where": "held_out == True"},
        "parameters": parameters,
    }  # fmt: skip
    return Study.from_content(content, folder / "study.toml")


def planted(
    folder: Path, links: pd.DataFrame, random: np.random.Generator, rays: int = RAYS
) -> tuple[dict[str, float], np.ndarray, pd.DataFrame]:
    """A draw of the materials, a mask of the links with a path, and the links with their noisy path loss."""
    setup = Setup.open(study(folder, links, posed=False, rays=rays))
    truth = {name: random.uniform(bounds[0] + 0.5, bounds[1] - 2.0) for name, bounds in MATERIALS.items()}
    values = np.array([truth[name] for name in setup.parameters.names])
    loss = path_loss(setup.trace(), setup.parameters.materials(values, setup.scene.materials))
    reached = np.isfinite(loss)
    measured = np.where(reached, loss, 0.0) + NOISE_DB * random.standard_normal(len(loss))
    return truth, reached, links.assign(loss_db=measured, true_db=loss)


def repetition(folder: Path, links: pd.DataFrame, seed: list[int]) -> list[dict[str, Any]]:
    """Calibrate one draw of the truth with and without directions as parameters; return rows of both tables."""
    random = np.random.default_rng(seed)
    truth, reached, stated = planted(folder, links, random)
    alarms = named(cb.calibrate(study(folder, stated[reached], posed=False)))
    for sector in SECTORS:
        azimuth, downtilt = random.uniform(-1, 1, 2) * (AZIMUTH_DEG, DOWNTILT_DEG)
        here = stated["sector"] == sector
        stated.loc[here, "azimuth"] -= azimuth
        stated.loc[here, "downtilt"] -= downtilt
        truth |= {f"tx:{sector}.azimuth": azimuth, f"tx:{sector}.downtilt": downtilt}
    rows, true_db = [], stated.loc[reached, "true_db"].to_numpy()
    for posed in (True, False):
        started = time.process_time()
        result = cb.calibrate(study(folder, stated[reached], posed))
        seconds = time.process_time() - started
        table = result.links[result.links["held_out"]]
        error = (table["after_db"] - table["measured_db"]).to_numpy()
        excess = table["after_db"].to_numpy() - true_db[result.links["held_out"].to_numpy(bool)]
        common = {
            "posed": posed,
            "alarm": bool(alarms),
            "named": [sector in named(result) for sector in SECTORS],
            "off": [abs(truth[f"tx:{sector}.azimuth"]) for sector in SECTORS],
            "seconds": seconds,
            "held_out_db": float(np.sqrt(np.mean(error**2))),
            "without_noise_db": float(np.sqrt(np.mean(excess**2))),
        }
        for name, value in result.parameters.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            interval = result.intervals.get(name)
            rows.append(
                common
                | {
                    "parameter": name.partition(":")[0] + "." + name.rpartition(".")[2]
                    if ":" in name
                    else name,
                    "covered": bool(low <= truth[name] <= high),
                    "identified": interval is not None and interval.label == "identified",
                    "error": abs(value - truth[name]),
                    "width": high - low,
                }
            )
    return rows


def named(result: cb.Result) -> set[str]:
    """The sectors that the remark on directions names."""
    remarks = [
        remark for remark in result.uncertainty.remarks if remark.kind == RemarkKind.ANTENNA_DIRECTIONS
    ]
    return {name for remark in remarks for name in remark.values["transmitters"]}


def arguments(description: str | None) -> argparse.ArgumentParser:
    """The options that all benchmarks on these districts share."""
    parser = argparse.ArgumentParser(description=(description or "").partition("\n")[0])
    parser.add_argument("--first", type=int, default=0, help="seed of the first district")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no repetition after this time")
    return parser


def repeated(options: argparse.Namespace, repetition: Repetition, stream: int) -> pd.DataFrame:
    """The rows of all repetitions in all districts, printed as each repetition ends; `stream` is part of their seed."""
    started, tables = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as root:
        seeds = range(options.first, options.first + options.districts)
        links = {seed: district(Path(root) / str(seed), seed) for seed in seeds}
        for number in range(options.repetitions):
            for seed in seeds:
                if time.perf_counter() - started < options.seconds:
                    rows = repetition(Path(root) / str(seed), links[seed], [seed, number, stream])
                    tables.append(pd.DataFrame(rows).assign(seed=seed, number=number))
                    print(
                        tables[-1].round(2).to_csv(index=False, header=len(tables) == 1), end="", flush=True
                    )
    return pd.concat(tables, ignore_index=True)


def main() -> None:
    """Run the repetitions and print the table."""
    table = repeated(arguments(__doc__).parse_args(), repetition, 270)
    summary = table.groupby(["posed", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"), identified=("identified", "mean"),
        median_error=("error", "median"), median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())
    print("coverage where identified")
    judged = table[table["identified"]].groupby(["posed", "parameter"])["covered"]
    print(judged.agg(["size", "mean"]).round(3).to_string())
    runs = table.drop_duplicates(["posed", "held_out_db"])
    errors = ["held_out_db", "without_noise_db"]
    print("medians over runs; seconds of processor time of a calibration")
    print(runs.groupby("posed")[[*errors, "seconds"]].median().round(2).to_string())
    pairs = runs[errors].to_numpy().reshape(-1, 2, 2)
    measured, true = np.median(pairs[:, 1] - pairs[:, 0], axis=0)
    stated = runs[~runs["posed"]]
    off, named = (np.concatenate(stated[name].to_list()) for name in ("off", "named"))
    for low, high in ((0, 5), (5, 10), (10, 20)):
        chosen = (low <= off) & (off < high)
        print(
            f"azimuth off by {low} to {high} deg: {named[chosen].mean():.2f} of {chosen.sum()} sectors are named"
        )
    print(f"directions right: a sector is named in {stated['alarm'].mean():.2f} of {len(stated)} runs")
    print(f"median improvement on held-out blocks: {measured:.2f} dB, without noise {true:.2f} dB")


if __name__ == "__main__":
    main()
