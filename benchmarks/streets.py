"""Planted differences between streets: do prediction intervals cover links of streets that were never measured?

    python benchmarks/streets.py --districts development --repetitions 2
    python benchmarks/streets.py --districts judging --repetitions 5 --stated

Links out of sight have 5 dB more loss than the district's materials cause, plus an extra loss per street, drawn with a
standard deviation of 6 dB; the noise is 3 dB. Two streets are kept apart. Two studies of the other streets are
calibrated: one states a random effect of the streets (`prior = "auto"`) and holds out one street at a time; the other
states no effect and holds out four blocks. The table shows how many links kept apart lie in the 90 % intervals, how
wide these are, and how the RMSE of the predictions compares with that of the log-distance model with obstruction, which
knows what blocks the straight line.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import calibray as cb
import districts
import misfit_worlds
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.study import Study
from calibray.validation.models import obstructed, without_scene
from districts import District

NOISE_DB, LOSS_DB, SPREAD_DB = 3.0, 5.0, 6.0
APART, LEAST = 2, 3
"""Number of streets kept apart, and smallest number of other streets."""
CHEAP = {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0}
"""Noise model of the planted errors. Others would only take time, because held-out links determine the intervals."""
STUDIES: dict[str, dict[str, Any]] = {
    "random effect, streets held out": {
        "nuisance": {"street": {"by": "out_of_sight", "per": "street", "prior": "auto"}},
        "holdout": {"by": "street"},
    },
    "nothing stated, four blocks held out": {"holdout": {"blocks": 4}},
}


def repetition(district: District, seed: int, studies: list[str]) -> list[dict[str, Any]]:
    """Plant one truth, and predict path loss in the streets kept apart with each study."""
    problem = district.problem
    links = problem.setup.with_obstruction().links
    street, blocked = links.frame["street"].to_numpy(str), links.table.numbers("out_of_sight")
    random = np.random.default_rng([seed, len(links), 29])
    names, index = np.unique(street, return_inverse=True)
    if len(names) < APART + LEAST:
        return []
    effect = LOSS_DB + SPREAD_DB * random.standard_normal(len(names))
    loss = district.path_loss(
        problem.parameters.from_search(random.uniform(*problem.parameters.search_bounds))
    )
    loss = loss + blocked * effect[index] + NOISE_DB * random.standard_normal(len(loss))
    apart = np.isin(street, random.choice(names, APART, replace=False))
    table = problem.setup.links.frame.assign(loss_db=loss)
    rows = []
    for name in studies:
        content = problem.setup.study.content()
        file = problem.setup.study.path.parent / "planted.csv"
        table[~apart].to_csv(file, index=False)
        content |= {"noise": CHEAP, **STUDIES[name]}
        content["links"]["file"] = file.name
        result = cb.calibrate(Study.from_content(content, problem.setup.study.path))
        found = result.predict_interval(table[apart].reset_index(drop=True))
        measured = loss[apart]
        rows.append({
            "study": name,
            "inside": (found["lower_db"] <= measured) & (measured <= found["upper_db"]),
            "blocked": blocked[apart] > 0,
            "half": (found["upper_db"] - found["lower_db"]) / 2,
            "square": (found["path_loss_db"] - measured) ** 2,
            "rival": (_rival(problem, loss, apart) - measured) ** 2,
        })  # fmt: skip
    return rows


def _rival(problem: Problem, loss: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Path loss at the links kept apart [dB], by the log-distance model with obstruction fitted to the others."""
    links = problem.setup.with_obstruction().links
    objective = replace(
        problem.objective, measured=loss, weight=np.where(apart, 0.0, problem.objective.weight)
    )
    return obstructed(links, objective, without_scene(problem.setup.study, links)).path_loss_db()[apart]


def main() -> None:
    """Run the repetitions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument(
        "--stated", action="store_true", help="run only the study that states a random effect"
    )
    given = parser.parse_args()
    studies = list(STUDIES)[:1] if given.stated else list(STUDIES)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in misfit_worlds.named(given.districts):
            district = districts.make(name, Path(folder))
            for seed in range(given.repetitions):
                try:
                    found = repetition(district, seed, studies)
                except InputError as error:  # too few links for the unknowns
                    print(f"{name}, {seed}: left out: {error}", file=sys.stderr)
                    continue
                rows += found
                for each in found:
                    inside, blocked = np.asarray(each["inside"]), each["blocked"]
                    rmse = [np.sqrt(np.mean(each[key])) for key in ("square", "rival")]
                    print(
                        f"{name}, {seed}: {inside.sum()} of {len(inside)} links in the interval, out of sight "
                        f"{inside[blocked].sum()} of {blocked.sum()}; RMSE {rmse[0]:.1f} and {rmse[1]:.1f} dB",
                        file=sys.stderr,
                    )
    summary = []
    for study in studies:
        mine = [row for row in rows if row["study"] == study]
        inside, blocked, half, square, rival = (
            np.concatenate([np.asarray(row[key]) for row in mine])
            for key in ("inside", "blocked", "half", "square", "rival")
        )
        summary.append({
            "study": study, "runs": len(mine), "links": len(inside), "inside": inside.mean(),
            "inside, mean of runs": np.mean([np.mean(row["inside"]) for row in mine]),
            "out of sight": inside[blocked].mean(), "in sight": inside[~blocked].mean(),
            "half width, out of sight": half[blocked].mean(), "in sight, half width": half[~blocked].mean(),
            "RMSE": np.sqrt(square.mean()), "RMSE of the rival": np.sqrt(rival.mean()),
        })  # fmt: skip
    print(pd.DataFrame(summary).set_index("study").T.round(2).to_string())


if __name__ == "__main__":
    main()
