"""Planted delay spreads and round-trip times: do they determine what path loss leaves open, with honest intervals?

    python benchmarks/observables.py --districts 20 --repetitions 5

Every district of antenna_pose.py gets diffuse walls and 40 links in sight along two streets. A repetition draws the
permittivity and the scattering coefficient S of the walls, computes path loss and RMS delay spread, adds noise of 3 dB
and 3 ns, and calibrates on path loss alone and on both, with an unknown offset of path loss. The table says how often S
is identified, and how often the 90 % intervals of the draws hold the truth. A third run takes the delay spreads of the
next district: how often is a conflict reported there, and how often without one?
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

import calibray as cb
from antenna_pose import POSITION, district
from calibray.engines import Replay
from calibray.engines.kinds.replay import replay
from calibray.measurements.observables import Statistic
from calibray.result.remark import RemarkKind
from calibray.study import Setup, Study

NOISE_DB: Final = 3.0
NOISE_NS: Final = 3.0
BOUNDS: Final = {"walls.relative_permittivity": [2.0, 9.0], "walls.scattering_coefficient": [0.0, 0.95]}
DRAWN: Final = {"walls.relative_permittivity": (3.0, 8.0), "walls.scattering_coefficient": (0.2, 0.8)}
REPORTED: Final = {RemarkKind.CONFLICT}
SPREAD: Final = {"kind": "rms_delay_spread", "column": "spread_ns", "unit": "ns"}
LINKS: Final = 40
"""Links of a district, along two of its streets."""
SAMPLES: Final = 2000
"""Rays of a transmitter; truth and calibration share the paths."""
QUICK: Final = {"noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0}}
"""The noise that is planted: one model instead of all."""


def streets(folder: Path, seed: int) -> pd.DataFrame:
    """The scene of a district of antenna_pose.py with diffuse walls, and links in sight along two of its streets."""
    district(folder, seed)
    random = np.random.default_rng([seed, 28])
    street = np.repeat([-35.0, 35.0], LINKS // 2)
    tx = np.column_stack([street, np.full(LINKS, -80.0), np.full(LINKS, 4.0)])
    x, y = street + random.uniform(-8, 8, LINKS), random.uniform(-65, 90, LINKS)
    rx = np.column_stack([x, y, np.full(LINKS, 1.5)])
    return pd.DataFrame(np.hstack([tx, rx]).round(2), columns=POSITION).assign(loss_db=100.0)


def study(folder: Path, table: pd.DataFrame, **sections: Any) -> Study:
    """The study of a district's links."""
    table.to_csv(folder / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene/scene.xml", "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": POSITION[:3], "rx": POSITION[3:], "value": "loss_db"},
        "materials": {"walls": {"scattering_coefficient": 0.5}},
        "trace": {"max_depth": 2, "samples": SAMPLES, "diffuse_reflection": True},
        "parameters": {name: {"bounds": bounds} for name, bounds in BOUNDS.items()},
        "offset": {},
        "fidelity": {"rounds": 0},
        **QUICK,
    }
    return Study.from_content(content | sections, folder / "study.toml")


def planted(
    folder: Path, links: pd.DataFrame, random: np.random.Generator
) -> tuple[dict[str, float], pd.DataFrame]:
    """A draw of the truth, and the links that paths reach with their noisy path loss and delay spread."""
    setup = Setup.open(study(folder, links))
    truth = {name: random.uniform(*limits) for name, limits in DRAWN.items()}
    engine = replay(setup, setup.trace())
    assert isinstance(engine, Replay)
    values = np.array([[truth[name] for name in engine.parameters.names]])
    loss = engine.path_loss(values)[0]
    spread = 1e9 * engine.observe(values, (Statistic("rms_delay_spread"),))[0, 0]
    reached = np.isfinite(loss) & np.isfinite(spread)
    noise = random.standard_normal((2, len(links)))
    measured = links.assign(
        loss_db=loss + NOISE_DB * noise[0] + random.uniform(-5, 5), spread_ns=spread + NOISE_NS * noise[1]
    )
    return truth, measured[reached].reset_index(drop=True)


def district_runs(
    folder: Path, links: pd.DataFrame, other: pd.DataFrame, seed: list[int]
) -> list[dict[str, Any]]:
    """Calibrate one draw of the truth on path loss, on both, and with the delay spreads of another district."""
    random, rows = np.random.default_rng([*seed, 28]), []
    truth, table = planted(folder, links, random)
    _, elsewhere = planted(folder.with_name(f"{folder.name}-next"), other, random)
    foreign = table.assign(spread_ns=np.resize(elsewhere["spread_ns"].to_numpy(), len(table)))
    for data, measured in (("path loss", table), ("both", table), ("delays of another district", foreign)):
        sections: dict[str, Any] = {} if data == "path loss" else {"observables": {"spread": SPREAD}}
        started = time.perf_counter()
        result = cb.calibrate(study(folder, measured, **sections))
        common = {
            "data": data,
            "seed": tuple(seed),
            "seconds": time.perf_counter() - started,
            "kinds": {remark.kind for remark in result.uncertainty.remarks},
        }
        for name, interval in result.intervals.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            rows.append(
                common
                | {
                    "parameter": name,
                    "label": interval.label,
                    "covered": bool(low <= truth[name] <= high),
                    "width": high - low,
                }
            )
    return rows


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table and the shares of runs with remarks."""
    table = pd.DataFrame(rows)
    summary = table.groupby(["data", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"),
        identified=("label", lambda labels: (labels == "identified").mean()),
        median_width=("width", "median"), seconds=("seconds", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())
    runs = table.drop_duplicates(["data", "seed"])
    for data, kinds in runs.groupby("data")["kinds"]:
        reported = [bool(each & REPORTED) for each in kinds]
        print(f"{data}: a conflict is reported in {sum(reported)} of {len(reported)} runs")


def main() -> None:
    """Run the repetitions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first district")
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no repetition after this time")
    options = parser.parse_args()
    started, rows = time.perf_counter(), []
    seeds = range(options.first, options.first + options.districts)
    with tempfile.TemporaryDirectory() as root:
        for number in range(options.repetitions):
            for seed in seeds:
                here, there = Path(root) / str(seed), Path(root) / f"{seed}-next"
                if time.perf_counter() - started < options.seconds:
                    rows += district_runs(here, streets(here, seed), streets(there, seed + 1), [seed, number])
                    print(f"{len(rows)} rows after {time.perf_counter() - started:.0f} s", flush=True)
    report(rows)


if __name__ == "__main__":
    main()
