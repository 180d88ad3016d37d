"""Coverage of prediction intervals on clusters of links that the calibration does not use.

    CALIBRAY_DATA=FOLDER python benchmarks/far_predictions.py examples/auckland_tower.toml examples/nist_boulder.toml
    python benchmarks/far_predictions.py --districts development --seeds 2
    python benchmarks/far_predictions.py --worlds --districts judging --seeds 1 --out worlds.jsonl

K-means with several seeds divides the receivers into four clusters. Each cluster is kept apart in turn, and so is the
quarter of the links at each end of the longer axis. Validation on blocks of the other links chooses the model and gives
its errors. Four 90 % intervals are compared at the links kept apart: by the ranks of all errors; in two levels (within
and between blocks); these also wider out of sight; and these with the error between blocks counted twice. Clusters that
contain all links of an offset's group are left out. A second table has the RMSE of every model on the links kept apart,
and that of the model chosen without them. If the choice is an average, the RMSE without averaging is listed too.

With `--worlds`, the truth differs from each district's study (`misfit_worlds.py`). One of four blocks is kept apart;
the regret is the RMSE there of the chosen model minus that of the best. "Of few" is the regret relative to the best of
the initial materials, the calibrated model and the log-distance model; "not averaged" is that of a choice without
averages. Each run is a line of the file `--out`; an interrupted benchmark continues where it stopped.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

import districts
import misfit_worlds
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.result.held_out import FITTED, WITHOUT_MATERIALS, Model
from calibray.scenes.obstruction import OUT_OF_SIGHT
from calibray.tables import Column, Table, numbers, render
from calibray.validation.held_out_statistics import (
    interval_half_width,
    out_of_sight_ratio,
    spatial_blocks,
    two_levels,
)
from calibray.validation.validate import fit_models, fit_variants, validate_problem
from choice import half_widths, opened
from finished_runs import append_run, read_runs

LEVEL = 0.9
CLUSTERS = 4
NOISE_DB = 3.0
WAYS = ("by ranks", "two levels", "wider out of sight", "between twice")
USED = WAYS.index("wider out of sight")


CHOSEN = "chosen without them"
ALONE = "this, not averaged"
FEW = (Model.INITIAL, Model.CALIBRATED, Model.LOG_DISTANCE)
CLOSE_DB = 0.3
"""Largest regret for which the choice counts as right."""


def coverage(problem: Problem, apart: np.ndarray) -> tuple[list[float], list[float], dict[str, np.ndarray]]:
    """Share of the links kept apart [L] in each kind of interval, half the widths, and errors of every model [dB]."""
    objective, links = problem.objective, problem.setup.links
    part = replace(problem, objective=replace(objective, weight=np.where(apart, 0.0, objective.weight)))
    part = replace(part, setup=part.setup.with_obstruction())
    fits = fit_variants(part)
    inner = validate_problem(part, known_minima={Model.CALIBRATED: fits[Model.CALIBRATED][1]})
    name, judged = inner.chosen, inner.judged
    errors = inner.errors[name][judged]
    levels = two_levels(errors, inner.block[judged], np.hstack([links.tx, links.rx])[judged])
    if levels is None:
        raise InputError("too few links")
    within, between = half_widths(levels, len(errors))
    blocked = part.setup.links.table.numbers(OUT_OF_SIGHT) > 0
    wider = np.where(blocked[apart], out_of_sight_ratio(errors, blocked[judged]), 1.0)
    halves = [
        np.full(len(wider), interval_half_width(np.sort(np.abs(errors)), LEVEL)),
        np.full(len(wider), np.hypot(within, between)),
        np.hypot(within, between) * wider,
        np.sqrt(within**2 + 2 * between**2) * wider,
    ]
    found = fit_models(part, fits)
    errors = {str(model): (loss - objective.measured)[apart] for model, loss in found.items()}
    errors[CHOSEN], errors[ALONE] = errors[name], errors[inner.preferred]
    finite = np.isfinite(errors[name])
    inside = [float(np.mean((np.abs(errors[name]) <= half)[finite])) for half in halves]
    return inside, [float(half.mean()) for half in halves], errors


def judged(
    problem: Problem, seeds: int
) -> tuple[list[list[float]], list[list[float]], list[dict[str, np.ndarray]]]:
    """Coverage, half widths and errors of all clusters."""
    links, counted = problem.setup.links, np.flatnonzero(problem.objective.weight > 0)
    inside, halves, errors, seen = [], [], [], set()
    for seed in range(-1, seeds):
        cluster, place = np.full(len(links), -1), links.rx[counted, :2]
        cluster[counted] = _ends(place) if seed < 0 else kmeans2(place, CLUSTERS, rng=seed, minit="++")[1]
        for number in range(CLUSTERS):
            apart = cluster == number
            rest = counted[~apart[counted]]
            groups = np.zeros(len(links)) if links.group is None else links.group_index
            known = set(groups[apart]) <= set(groups[rest])
            key = apart.tobytes()
            if key in seen or not known or len(rest) < problem.unknowns + 8 or not apart.any():
                continue
            seen.add(key)
            share, half, error = coverage(problem, apart)
            inside.append(share)
            errors.append(error)
            halves.append(half)
            print(f"{links.source}, seed {seed}, cluster {number}: {share}", file=sys.stderr)
    return inside, halves, errors


def _ends(place: np.ndarray) -> np.ndarray:
    """The quarters of the links at the ends of the longer axis, as clusters 0 and 1; -1 for the links between [n]."""
    centred = place - place.mean(axis=0)
    rank = (centred @ np.linalg.svd(centred, full_matrices=False)[2][0]).argsort().argsort()
    return np.where(rank < len(rank) // 4, 0, np.where(rank >= len(rank) - len(rank) // 4, 1, -1))


def rmse_rows(name: str, errors: list[dict[str, np.ndarray]]) -> list[tuple[str, ...]]:
    """Median and largest RMSE of every model over the clusters, and its RMSE over all links."""
    rows = []
    for model in errors[0]:
        by_cluster = [np.sqrt(np.nanmean(error[model] ** 2)) for error in errors if model in error]
        every = np.concatenate([error[model] for error in errors if model in error])
        figures = (np.sqrt(np.nanmean(every**2)), np.median(by_cluster), np.max(by_cluster))
        rows.append((name, model, *(f"{figure:.2f}" for figure in figures)))
    return rows


def planted(name: str, folder: Path, seed: int) -> Problem:
    """A district with a truth drawn from the whole bounds, and 3 dB of noise."""
    problem = districts.make(name, folder).problem
    random = np.random.default_rng([seed, int(name.rpartition("-")[2])])
    truth = random.uniform(*problem.parameters.search_bounds)
    loss = problem.engine.path_loss(problem.parameters.from_search(truth)[None])[0]
    measured = np.where(np.isfinite(loss), loss, 0.0) + NOISE_DB * random.standard_normal(len(loss))
    weight = np.where(np.isfinite(loss), problem.objective.weight, 0.0)
    return replace(problem, objective=replace(problem.objective, measured=measured, weight=weight))


def in_worlds(names: str, seeds: int, out: Path) -> Table:
    """Regret and coverage in every world, with one block of each district kept apart."""
    rows = [row for row in read_runs(out, {}) if row["district"] in misfit_worlds.named(names)]
    rows = [row for row in rows if row["seed"] < seeds]
    known = {(row["district"], row["world"], row["seed"]) for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        for name in misfit_worlds.named(names):
            wanted = [(name, world, seed) for world in misfit_worlds.WORLDS for seed in range(seeds)]
            missing = tuple(
                dict.fromkeys(world for _, world, seed in wanted if (name, world, seed) not in known)
            )
            worlds = misfit_worlds.make(name, Path(folder), missing) if missing else {}
            for _, world, seed in (each for each in wanted if each not in known):
                problem = worlds[world].planted(seed).problem
                counted = problem.objective.weight > 0
                block = np.full(len(counted), -1)
                block[counted] = spatial_blocks(problem.setup.links.rx[counted, :2], CLUSTERS)
                apart = block == int(name.rpartition("-")[2]) % CLUSTERS
                if counted.sum() - apart.sum() < problem.unknowns + 8:
                    continue
                share, _, errors = coverage(problem, apart)
                rmse = {model: float(np.sqrt(np.mean(error**2))) for model, error in errors.items()}
                row = {"district": name, "world": world, "seed": seed, "inside": share[USED], "rmse": rmse}
                rows.append(row)
                append_run(out, row)
    columns = (
        Column("the truth has"), numbers("runs"), numbers("median regret", "dB"), numbers("mean regret", "dB"),
        numbers(f"at most {CLOSE_DB} dB"), numbers("mean, of few", "dB"), numbers("not averaged", "dB"),
        numbers("in 90 % interval"), numbers("below 0.75"),
    )  # fmt: skip
    lines = []
    for world in (*misfit_worlds.WORLDS, "all"):
        mine = [row for row in rows if world in (row["world"], "all")]
        if mine:
            every = regrets(mine, CHOSEN, (Model.INITIAL, *FITTED, *WITHOUT_MATERIALS))
            few = [regrets(mine, name, FEW).mean() for name in (CHOSEN, ALONE)]
            inside = np.array([row["inside"] for row in mine])
            figures = (np.median(every), every.mean(), np.mean(every <= CLOSE_DB), *few, inside.mean())
            cells = (f"{figure:.2f}" for figure in figures)
            lines.append((world, str(len(mine)), *cells, str(int((inside < 0.75).sum()))))
    return Table("Choice of the prediction model where the study is wrong", columns, tuple(lines))


def regrets(rows: list[dict[str, Any]], name: str, rivals: tuple[str, ...]) -> np.ndarray:
    """RMSE of a model minus that of the best of given models, for every run [dB]."""
    lowest = [np.nanmin([row["rmse"].get(rival, np.inf) for rival in rivals]) for row in rows]
    return np.array([row["rmse"][name] for row in rows]) - lowest


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*")
    parser.add_argument("--districts", default="", help="development, judging or names")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--worlds", action="store_true", help="use worlds that differ from the study")
    parser.add_argument("--out", type=Path, default=Path("worlds.jsonl"), help="file of the runs in worlds")
    given = parser.parse_args()
    if given.worlds:
        print(render(in_worlds(given.districts, given.seeds, given.out)))
        return
    names = districts.named(given.districts) if given.districts else []
    rows, accuracy = [], []
    with tempfile.TemporaryDirectory() as folder:
        problems = [(Path(study).stem, opened(study)) for study in given.studies]
        problems += [(name, planted(name, Path(folder), 0)) for name in names]
        for name, problem in problems:
            inside, halves, errors = judged(problem, given.seeds)
            if not inside:
                continue
            accuracy += rmse_rows(name, errors)
            for way, share, half in zip(WAYS, np.transpose(inside), np.transpose(halves), strict=True):
                rows.append((
                    name, way, str(len(share)), f"{share.mean():.2f}", f"{share.min():.2f}",
                    str(int((share < 0.75).sum())), f"{half.mean():.1f}",
                ))  # fmt: skip
    columns = (
        Column("links"), Column("interval"), numbers("clusters"), numbers("in 90 % interval, mean"),
        numbers("worst"), numbers("below 0.75"), numbers("half width", "dB"),
    )  # fmt: skip
    print(render(Table(f"Clusters kept apart, k-means from {given.seeds} seeds", columns, tuple(rows))))
    columns = (
        Column("links"), Column("model"), numbers("RMSE of all links", "dB"), numbers("median of clusters", "dB"),
        numbers("worst cluster", "dB"),
    )  # fmt: skip
    print(render(Table("Accuracy on the links kept apart", columns, tuple(accuracy))))


if __name__ == "__main__":
    main()
