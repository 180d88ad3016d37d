"""Downtown Boulder: what path loss and delay spread reveal about the walls' scattering coefficient.

    CALIBRAY_DATA=FOLDER python benchmarks/case_studies.py --samples 60000

The links are traced once with diffuse reflection, and the paths are replayed for each scattering coefficient S of the
walls. The table has the RMSE of path loss, with one offset for links in sight and one for links out of sight, and the
modelled and the measured (delay.csv) RMS delay spread in sight. Delay spreads are computed from power delay profiles
with bins of 1 ns. As in the sounder, bins with a path loss above 132 dB or more than 30 dB below the strongest bin are
left out. The script needs the data of the campaign.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from calibray.fields import path_loss
from calibray.fields.channel import power_delay_profile
from calibray.study import Study
from calibray.tables import Table, numbers, render

STUDY = Path(__file__).parents[1] / "examples" / "nist_boulder.toml"
WALLS, TRACED = "walls", 0.4
"""The scattering material, and its scattering coefficient during the trace."""
COEFFICIENTS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9)
FLOOR_DB, DYNAMIC_DB, BIN_S = 132.0, 30.0, 1e-9


def delay_spread(power: np.ndarray, delay: np.ndarray) -> np.ndarray:
    """RMS delay spread of the profiles after the sounder's thresholds [L], [s]."""
    level = -10 * np.log10(np.maximum(power, 1e-40))
    kept = (level <= FLOOR_DB) & (level <= level.min(axis=1, keepdims=True) + DYNAMIC_DB)
    share = np.where(kept, power, 0.0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
    mean = share @ delay
    return np.sqrt(np.maximum(share @ delay**2 - mean**2, 0.0))


def offset_rmse(error: np.ndarray, group: np.ndarray) -> float:
    """RMSE after the mean of every group is subtracted [dB]."""
    for label in np.unique(group):
        error = np.where(group == label, error - error[group == label].mean(), error)
    return float(np.sqrt(np.mean(error**2)))


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--samples", type=int, default=60_000, help="rays launched from the transmitter")
    samples = options.parse_args().samples
    data = Path(os.environ.get("CALIBRAY_DATA", STUDY.parent / "../../shared/data")) / "nist_boulder"
    if not data.is_dir():
        print(f"no campaign under {data}: not measured")
        return
    content = Study.load(STUDY).content()
    content["trace"] |= {"diffuse_reflection": True, "max_depth": 3, "samples": samples}
    content["materials"]["walls"] |= {"scattering_coefficient": TRACED}
    setup = Study.from_content(content, STUDY).opened()
    paths, frame = setup.trace(), setup.links.frame
    sets = frame["set"].to_numpy(str)
    measured = (
        pd.read_csv(data / "delay.csv").set_index("id").loc[frame["id"], "rms_delay_spread_ns"].to_numpy()
    )
    edges = np.arange(0.0, paths.delay.max() + 2 * BIN_S, BIN_S)
    rows = []
    for value in COEFFICIENTS:
        walls = replace(paths.materials[WALLS], scattering_coefficient=value)
        materials = {**paths.materials, WALLS: walls}
        error = path_loss(paths, materials) - setup.links.path_loss_db
        reached = np.isfinite(error)
        spread = 1e9 * delay_spread(power_delay_profile(paths, edges, materials), edges[:-1] + BIN_S / 2)
        sight = reached & (sets == "LOS")
        alone = [f"{error[reached & (sets == label)].mean():+.1f}" for label in ("LOS", "NLOS")]
        rows.append((
            f"{value:g}", f"{offset_rmse(error[reached], sets[reached]):.2f}", *alone,
            f"{spread[sight].mean():.1f}", f"{measured[sight].mean():.1f}",
        ))  # fmt: skip
    columns = (
        numbers("walls' S"), numbers("RMSE with offsets", "dB"), numbers("mean error in sight", "dB"),
        numbers("out of sight", "dB"), numbers("delay spread in sight", "ns"), numbers("measured", "ns"),
    )  # fmt: skip
    print(render(Table(f"{paths.num_paths:,} paths of {paths.num_links} links", columns, tuple(rows))))


if __name__ == "__main__":
    main()
