"""Planted errors of receivers' positions: do intervals of materials cover the truth, with and without the key?

    python benchmarks/position_errors.py --districts 20 --repetitions 5

The districts are those of antenna_pose.py, with correct stated directions. Links are measured at the true positions;
the study states positions that are off by 5 m (standard deviation along x and along y), with or without
`links.position_error_m = 5`. The noise is 3 dB. The table shows how often the 90 % intervals of the draws cover the
truth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import calibray as cb
from antenna_pose import NOISE_DB, arguments, planted, repeated, study
from calibray.study import Study

ERROR_M = 5.0


def repetition(folder: Path, links: pd.DataFrame, seed: list[int]) -> list[dict[str, Any]]:
    """Calibrate one draw of the truth with and without the key."""
    random = np.random.default_rng(seed)
    truth, reached, stated = planted(folder, links, random)
    stated[["rx_x", "rx_y"]] += ERROR_M * random.standard_normal((len(links), 2))
    rows: list[dict[str, Any]] = []
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
    table = repeated(arguments(__doc__).parse_args(), repetition, 271)
    summary = table.groupby(["key", "parameter"]).agg(
        count=("covered", "size"), coverage=("covered", "mean"), median_error=("error", "median"),
        median_width=("width", "median"),
    )  # fmt: skip
    print(summary.round(3).to_string())


if __name__ == "__main__":
    main()
