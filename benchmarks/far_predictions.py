"""Coverage of prediction intervals on clusters of links that were kept apart.

    CALIBRAY_DATA=FOLDER python benchmarks/far_predictions.py examples/auckland_tower.toml examples/nist_boulder.toml
    python benchmarks/far_predictions.py --districts development --seeds 2

K-means from several seeds divides the receivers into four clusters. Each is kept apart in turn: the other links are
validated on blocks, choose the model and give its errors. Three intervals of 90 % are compared at the links kept apart:
by the ranks of all errors, in two levels (within and between blocks), and in two levels with the error between blocks
counted twice. Clusters that hold all links of an offset's group are left out. A second table has the RMSE of every
model on the links kept apart, and of the model that was chosen without them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.special import stdtrit

import districts
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.tables import Column, Table, numbers
from calibray.tables.text import render
from calibray.validation.held_out_statistics import interval_half_width, two_levels
from calibray.validation.validate import fit_models, fit_variants, validate_problem
from choice import opened

LEVEL = 0.9
CLUSTERS = 4
NOISE_DB = 3.0
WAYS = ("by ranks", "two levels", "two levels, between twice")


CHOSEN = "chosen without them"


def coverage(problem: Problem, apart: np.ndarray) -> tuple[list[float], list[float], dict[str, np.ndarray]]:
    """Share of the links kept apart [L] in each kind of interval, half the widths, errors of every model [dB]."""
    objective, links = problem.objective, problem.setup.links
    part = replace(problem, objective=replace(objective, weight=np.where(apart, 0.0, objective.weight)))
    inner = validate_problem(part)
    name, judged = inner.chosen, inner.judged
    errors = inner.errors[name][judged]
    levels = two_levels(errors, inner.block[judged], np.hstack([links.tx, links.rx])[judged])
    if levels is None:
        raise InputError("too few links")
    factor = float(stdtrit(levels.freedom, (1 + LEVEL) / 2))
    halves = [
        interval_half_width(np.sort(np.abs(errors)), LEVEL),
        factor * float(np.hypot(levels.within_db, levels.between_db)),
        factor * float(np.sqrt(levels.within_db**2 + 2 * levels.between_db**2)),
    ]
    part = replace(part, setup=part.setup.with_obstruction())
    errors = {
        str(model): (loss - objective.measured)[apart]
        for model, loss in fit_models(part, fit_variants(part)).items()
    }
    errors[CHOSEN] = errors[name]
    error = np.abs(errors[name][np.isfinite(errors[name])])
    return [float(np.mean(error <= half)) for half in halves], halves, errors


def judged(
    problem: Problem, seeds: int
) -> tuple[list[list[float]], list[list[float]], list[dict[str, np.ndarray]]]:
    """Coverage, half widths and errors of all clusters."""
    links, counted = problem.setup.links, np.flatnonzero(problem.objective.weight > 0)
    inside, halves, errors, seen = [], [], [], set()
    for seed in range(seeds):
        cluster = np.full(len(links), -1)
        cluster[counted] = kmeans2(links.rx[counted, :2], CLUSTERS, rng=seed, minit="++")[1]
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


def rmse_rows(name: str, errors: list[dict[str, np.ndarray]]) -> list[tuple[str, ...]]:
    """Median and largest RMSE of every model over the clusters, and that over all links."""
    rows = []
    for model in errors[0]:
        by_cluster = [np.sqrt(np.nanmean(error[model] ** 2)) for error in errors if model in error]
        every = np.concatenate([error[model] for error in errors if model in error])
        figures = (np.sqrt(np.nanmean(every**2)), np.median(by_cluster), np.max(by_cluster))
        rows.append((name, model, *(f"{figure:.2f}" for figure in figures)))
    return rows


def planted(name: str, folder: Path, seed: int) -> Problem:
    """A district with a truth anywhere, and 3 dB of noise."""
    problem = districts.make(name, folder).problem
    random = np.random.default_rng([seed, int(name.rpartition("-")[2])])
    truth = random.uniform(*problem.parameters.search_bounds)
    loss = problem.engine.path_loss(problem.parameters.from_search(truth)[None])[0]
    measured = np.where(np.isfinite(loss), loss, 0.0) + NOISE_DB * random.standard_normal(len(loss))
    weight = np.where(np.isfinite(loss), problem.objective.weight, 0.0)
    return replace(problem, objective=replace(problem.objective, measured=measured, weight=weight))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*")
    parser.add_argument("--districts", default="", help="development, judging or names")
    parser.add_argument("--seeds", type=int, default=5)
    given = parser.parse_args()
    groups = {"development": districts.DEVELOPMENT, "judging": districts.JUDGING, "": ()}
    names = groups.get(given.districts, tuple(given.districts.split(",")))
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
