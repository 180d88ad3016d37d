"""Planted errors of mast heights and a shifted track: do the intervals of these and of the materials cover the truth?

    python benchmarks/displaced_antennas.py one --first 100 --districts 20 --repetitions 1
    python benchmarks/displaced_antennas.py all --first 100 --districts 20 --repetitions 1

The districts are those of antenna_pose.py, with correct directions. One: the stated height of one of the three
transmitters is off by 5 m, up or down; the heights of all three are parameters. All: the stated heights of all three
transmitters are off by 5 m, and the whole track by up to 5 m along x and along y; all five are parameters. The noise is
3 dB. Every draw is calibrated with these parameters and, with `--blind`, also without them. The table shows how often
the 90 % intervals of the draws contain the truth; the RMSE on the held-out block is relative to path loss without
noise. The tracer launches 20,000 rays, which give the same path loss as the 100,000 of antenna_pose.py.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

import calibray as cb
from antenna_pose import SECTORS, arguments, planted, repeated, study
from calibray.study import Study

OFF_M: Final = 5.0
RAYS: Final = 20_000


def repetition(
    folder: Path, links: pd.DataFrame, seed: list[int], every: bool, blind: bool
) -> list[dict[str, Any]]:
    """Calibrate one draw of the truth; return a row for every parameter."""
    random = np.random.default_rng(seed)
    truth, reached, stated = planted(folder, links, random, RAYS)
    wrong = SECTORS if every else [random.choice(SECTORS)]
    for sector in SECTORS:
        off = float(OFF_M * random.choice([-1.0, 1.0])) if sector in wrong else 0.0
        truth[f"tx:{sector}.height"] = off
        stated.loc[stated["sector"] == sector, "tx_z"] -= off
    for axis in "xy" if every else "":
        truth[f"rx:*.d{axis}"] = float(random.uniform(-OFF_M, OFF_M))
        stated[f"rx_{axis}"] -= truth[f"rx:*.d{axis}"]
    rows: list[dict[str, Any]] = []
    for known in (True, False) if blind else (True,):
        content = study(folder, stated[reached], posed=False, rays=RAYS).content()
        if known:
            displaced = [name for name in truth if ":" in name]
            content["parameters"] |= {name: {"bounds": [-8.0, 8.0]} for name in displaced}
        started = time.process_time()
        result = cb.calibrate(Study.from_content(content, folder / "study.toml"))
        seconds = time.process_time() - started
        held_out = result.links["held_out"].to_numpy(bool)
        error = (
            result.links["after_db"].to_numpy()[held_out] - stated[reached]["true_db"].to_numpy()[held_out]
        )
        for name, value in result.parameters.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            kind = "wrong height" if truth[name] else "right height"
            rows.append(
                {
                    "known": known,
                    "parameter": kind if name.endswith("height") else name,
                    "truth": truth[name],
                    "low": low,
                    "high": high,
                    "covered": bool(low <= truth[name] <= high),
                    "error": abs(value - truth[name]),
                    "width": high - low,
                    "held_out_db": float(np.sqrt(np.mean(error[np.isfinite(error)] ** 2))),
                    "gap_db": result.fit.retrace_gap_db,
                    "seconds": seconds,
                }
            )
    return rows


def main() -> None:
    """Run the repetitions and print the table."""
    parser = arguments(__doc__)
    parser.set_defaults(repetitions=1)
    parser.add_argument("case", choices=["one", "all"])
    parser.add_argument("--blind", action="store_true", help="also calibrate without heights and shifts")
    options = parser.parse_args()
    table = repeated(options, partial(repetition, every=options.case == "all", blind=options.blind), 272)
    summary = table.groupby(["known", "parameter"]).agg(
        count=("covered", "size"), covered=("covered", "sum"), median_error=("error", "median"),
        median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())
    print(table.groupby("known")[["held_out_db", "gap_db", "seconds"]].median().round(2).to_string())


if __name__ == "__main__":
    main()
