"""Planted heights of masts and a shifted track: does calibration find them, and the materials beside them?

    python benchmarks/displaced_antennas.py --first 100 --districts 20 --repetitions 1

Districts are those of antenna_pose.py, with directions that are right. The stated heights of all three transmitters are
off by 5 m, up or down, and the whole track by up to 5 m along x and along y. The noise is 3 dB. Every draw is
calibrated with heights and shift as parameters, and without. The table says how often the 90 % intervals of the draws
hold the truth; the RMSE on the held-out block is that against path loss without noise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

import calibray as cb
from antenna_pose import SECTORS, planted, repeated, study
from calibray.study import Study

OFF_M: Final = 5.0


def repetition(folder: Path, links: pd.DataFrame, seed: list[int]) -> list[dict[str, Any]]:
    """Calibrate one draw of the truth with and without the parameters."""
    random = np.random.default_rng(seed)
    truth, reached, stated = planted(folder, links, random)
    for sector in SECTORS:
        truth[f"tx:{sector}.height"] = float(OFF_M * random.choice([-1.0, 1.0]))
        stated.loc[stated["sector"] == sector, "tx_z"] -= truth[f"tx:{sector}.height"]
    for axis in "xy":
        truth[f"rx:*.d{axis}"] = float(random.uniform(-OFF_M, OFF_M))
        stated[f"rx_{axis}"] -= truth[f"rx:*.d{axis}"]
    rows: list[dict[str, Any]] = []
    for known in (True, False):
        content = study(folder, stated[reached], posed=False).content()
        if known:
            displaced = [name for name in truth if ":" in name]
            content["parameters"] |= {name: {"bounds": [-8.0, 8.0]} for name in displaced}
        result = cb.calibrate(Study.from_content(content, folder / "study.toml"))
        held_out = result.links["held_out"].to_numpy(bool)
        error = (
            result.links["after_db"].to_numpy()[held_out] - stated[reached]["true_db"].to_numpy()[held_out]
        )
        for name, value in result.parameters.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            rows.append(
                {
                    "known": known,
                    "parameter": "height" if name.endswith("height") else name,
                    "covered": bool(low <= truth[name] <= high),
                    "error": abs(value - truth[name]),
                    "width": high - low,
                    "held_out_db": float(np.sqrt(np.nanmean(error**2))),
                    "gap_db": result.fit.retrace_gap_db,
                }
            )
    return rows


def main() -> None:
    """Run the repetitions and print the table."""
    table = repeated(__doc__.splitlines()[0] if __doc__ else "", repetition, 272)
    summary = table.groupby(["known", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"), median_error=("error", "median"),
        median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())
    print(table.groupby("known")[["held_out_db", "gap_db"]].median().round(2).to_string())


if __name__ == "__main__":
    main()
