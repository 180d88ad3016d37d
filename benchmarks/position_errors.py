"""Planted errors of receivers' positions: do intervals of materials hold the truth, with and without the key?

    python benchmarks/position_errors.py --districts 20 --repetitions 5

Districts are those of antenna_pose.py, with stated directions that are right. Measured are true positions; the study
states positions that are off by 5 m (standard deviation along x and along y), with or without
`links.position_error_m = 5`. The noise is 3 dB. The table says how often the 90 % intervals of the draws hold the
truth.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

import calibray as cb
from antenna_pose import MATERIALS, NOISE_DB, district, study
from calibray.fields import path_loss
from calibray.study import Setup, Study

ERROR_M = 5.0


def repetition(folder: Path, links: pd.DataFrame, seed: list[int]) -> list[dict[str, object]]:
    """Calibrate one draw of the truth with and without the key."""
    random = np.random.default_rng(seed)
    setup = Setup.open(study(folder, links, posed=False))
    truth = {name: random.uniform(bounds[0] + 0.5, bounds[1] - 2.0) for name, bounds in MATERIALS.items()}
    values = np.array([truth[name] for name in setup.parameters.names])
    loss = path_loss(setup.trace(), setup.parameters.materials(values, setup.scene.materials))
    reached = np.isfinite(loss)
    stated = links.assign(loss_db=np.where(reached, loss, 0.0) + NOISE_DB * random.standard_normal(len(loss)))
    stated[["rx_x", "rx_y"]] += ERROR_M * random.standard_normal((len(links), 2))
    rows: list[dict[str, object]] = []
    for key in (True, False):
        content = study(folder, stated[reached], posed=False).content()
        content["noise"]["std_db"] = NOISE_DB
        if key:
            content["links"]["position_error_m"] = ERROR_M
        result = cb.calibrate(Study.from_content(content, folder / "study.toml"))
        for name, value in result.parameters.items():
            low, high = np.quantile(result.uncertainty.draws[name], [0.05, 0.95])
            covered = bool(low <= truth[name] <= high)
            error = abs(value - truth[name])
            rows.append(
                {"key": key, "parameter": name, "covered": covered, "error": error, "width": high - low}
            )
    return rows


def main() -> None:
    """Run the repetitions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", type=int, default=20)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=np.inf, help="start no repetition after this time")
    options = parser.parse_args()
    started, rows = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as root:
        for seed in range(options.districts):
            links = district(Path(root) / str(seed), seed)
            for number in range(options.repetitions):
                if time.perf_counter() - started < options.seconds:
                    rows += repetition(Path(root) / str(seed), links, [seed, number, 271])
    summary = pd.DataFrame(rows).groupby(["key", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"), median_error=("error", "median"),
        median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())


if __name__ == "__main__":
    main()
