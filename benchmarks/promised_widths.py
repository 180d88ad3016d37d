"""Do intervals become as narrow as suggestions promise? Calibrate, suggest five links, measure them, calibrate again.

    python benchmarks/promised_widths.py --districts development --repetitions 1
    python benchmarks/promised_widths.py --districts judging --repetitions 1

A repetition draws a truth within the bounds of a district's study and 3 dB of noise. Half of the links, at most 40, are
measured; the others are candidates. The table compares, over all parameters, the width of the reported interval before,
the width that the last of five suggestions promises, and the resulting width, each relative to the range.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import calibray as cb
import districts
import misfit_worlds
from calibray.study import Study
from districts import District

NOISE_DB, MOST, MORE = 3.0, 40, 5


def repetition(district: District, seed: int) -> list[dict[str, object]]:
    """Calibrate, measure and calibrate again for one truth; return a row per parameter."""
    problem = district.problem
    parameters, study = problem.parameters, problem.setup.study
    random = np.random.default_rng([seed, len(problem.before), 31])
    loss = district.path_loss(parameters.from_search(random.uniform(*parameters.search_bounds)))
    table = problem.setup.links.frame.assign(loss_db=loss + NOISE_DB * random.standard_normal(len(loss)))
    order = random.permutation(len(table))
    known, others = np.split(order, [min(len(table) // 2, MOST)])

    def calibrated(rows: np.ndarray) -> cb.Result:
        content = study.content()
        content["links"]["file"] = "measured.csv"
        table.iloc[rows].to_csv(study.path.parent / "measured.csv", index=False)
        return cb.calibrate(Study.from_content(content, study.path))

    before = calibrated(known)
    suggested = cb.suggest(before, table.iloc[others].reset_index(drop=True), MORE)
    after = calibrated(np.concatenate([known, others[suggested["row"].to_numpy(int) - 1]]))
    rows = []
    for name, section in study.parameters.items():
        old, new = before.intervals[name], after.intervals[name]
        ends = np.array([[old.lower, old.upper], [new.lower, new.upper], section.bounds], dtype=float)
        width = suggested[f"{name}_width"].iloc[-1]
        if section.scale == "log":
            # A promised width applies at the centre of the interval in search coordinates.
            centre = np.sqrt(old.lower * old.upper)
            width = 2 * np.arcsinh(width / (2 * centre))
            ends = np.log(ends)
        share = np.diff(ends, axis=1)[:, 0] / np.ptp(ends[2])
        rows.append({
            "parameter": name, "before": share[0], "promised": width / np.ptp(ends[2]), "came about": share[1],
            "ranges": len(old.pieces),
        })  # fmt: skip
    return rows


def main() -> None:
    """Run the repetitions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    parser.add_argument("--repetitions", type=int, default=1)
    given = parser.parse_args()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in misfit_worlds.named(given.districts):
            district = districts.make(name, Path(folder))
            for seed in range(given.repetitions):
                rows += repetition(district, seed)
                print(f"{name}, {seed}", pd.DataFrame(rows[-4:]).round(2).to_string(), file=sys.stderr)
    table = pd.DataFrame(rows)
    groups = {"all": table, **{f"{name}": group for name, group in table.groupby("parameter")}}
    summary = {
        name: {
            "count": len(group), **group[["before", "promised", "came about"]].mean(),
            "came about by promised, median": (group["came about"] / group["promised"]).median(),
            "wider than 1.5 times the promise": (group["came about"] > 1.5 * group["promised"]).sum(),
        }
        for name, group in groups.items()
    }  # fmt: skip
    print(pd.DataFrame(summary).T.round(2).to_string())


if __name__ == "__main__":
    main()
