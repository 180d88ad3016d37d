"""Whether the model chosen on held-out blocks is also the best one on links that were not used for fitting or choice.

    CALIBRAY_DATA=FOLDER python benchmarks/choice.py examples/nist_boulder.toml examples/auckland_tower.toml
    CALIBRAY_DATA=FOLDER python benchmarks/choice.py examples/nist_boulder.toml --blocks 5 --uneven 22
    python benchmarks/choice.py --rule 24 --districts demo,district-101
    python benchmarks/choice.py --planted 40
    python benchmarks/choice.py --chance 100 --workers 2 --out chance.jsonl

The validation is nested: each block is held out in turn, and all models are validated on blocks of the remaining links.
The chosen model is fitted to the remaining links and judged on the block. The output has its pooled RMSE, that of the
model with the lowest RMSE on the inner blocks, and those of all models. It also shows how often the block's links lie
in the 90 % interval, which follows from the chosen model's errors on the inner blocks. The blocks have equal size; with
`--uneven`, they are clusters of receivers (k-means from that seed).

With `--rule`, the same for planted truths in districts: at the study's start values, near them, and anywhere, with an
offset of 3 dB and 3 dB of noise. One of four blocks is left out each time.

With `--planted`, the output shows how often the links of a block of the demo district lie in the interval predicted
from the other blocks, for planted truths and 3 dB of noise.

With `--chance`, the scene contains no information: measurements follow a log-distance law with noise, in the demo
district. The result must state that calibration did not help; the script fails if the result does so in fewer than 95
of 100 repetitions. Each repetition is a line of the file `--out`; an interrupted run continues where it stopped.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.special import stdtrit

import districts
from calibray import engines
from calibray.errors import InputError
from calibray.fitting.preliminary_fits import estimate_noise
from calibray.fitting.problem import Problem
from calibray.result.held_out import FITTED, WITHOUT_MATERIALS, BlockErrors, Model
from calibray.scenarios import demo_study_path
from calibray.study import Study
from calibray.tables import Column, Table, numbers, render
from calibray.validation.held_out_statistics import spatial_blocks
from calibray.validation.models import fit_variants
from calibray.validation.validate import fit_models, validate_problem
from finished_runs import append_run, read_runs

LEVEL = 0.9
NOISE_DB = 4.0
PLANTED_DB = 3.0
OFFSET_DB = 3.0
INTERCEPT_DB, SLOPE_DB = 40.0, 35.0
CHOSEN = "chosen without the block"


def opened(file: str) -> Problem:
    """A study's problem over all its links, including those that the study holds out."""
    setup = Study.load(file).opened()
    setup = replace(setup, held_out=np.zeros(len(setup.links), dtype=bool))
    return estimate_noise(Problem.of(setup, engines.make(setup)))


LEAST = "least RMSE on the others"
"""The choice without margins."""

APART = (0.0, 0.3, 1.0)
"""Distances of truths from the study's start values, relative to that of a random point."""


def left_out(
    problem: Problem, here: np.ndarray, inner_blocks: int | None = None
) -> tuple[str, dict[str, np.ndarray], list[bool]]:
    """Choose and fit a model without some links, and judge it on these links.

    Args:
        problem: The problem.
        here: Which links are left out [L].
        inner_blocks: Number of blocks of the other links for choosing the model; the study's number if None.

    Returns:
        The model chosen on the other links; the errors of every model, and of the one with the lowest RMSE on the other
        links, at the links left out; and which of these links that have a path lie in the chosen model's interval.
    """
    objective = problem.objective
    part = replace(problem, objective=replace(objective, weight=np.where(here, 0.0, objective.weight)))
    part = replace(part, setup=part.setup.with_obstruction())
    fits = fit_variants(part)
    inner = validate_problem(part, inner_blocks, known_minima={Model.CALIBRATED: fits[Model.CALIBRATED][1]})
    found = fit_models(part, fits)
    errors = {name: (model - objective.measured)[here] for name, model in found.items()}
    least = inner.table["rmse_db"].reindex([Model.INITIAL, *FITTED, *WITHOUT_MATERIALS]).idxmin()
    errors[LEAST] = errors[str(least)]
    judged = errors[inner.chosen][np.isfinite(errors[inner.chosen])]
    levels = inner.levels(inner.chosen, problem.setup.links)
    if levels is None:
        raise InputError("too few links to judge")
    half = np.hypot(*half_widths(levels, int(inner.judged.sum())))
    return inner.chosen, errors, (np.abs(judged) <= half).tolist()


def half_widths(levels: BlockErrors, links: int) -> tuple[float, float]:
    """Half the width of the 90 % interval for errors within and between blocks [dB]."""
    freedom = (links - levels.blocks, levels.blocks)
    within, between = (float(stdtrit(each, (1 + LEVEL) / 2)) for each in freedom)
    return within * levels.within_db, between * levels.between_db


def nested(problem: Problem, count: int, uneven: int | None, inner_blocks: int | None) -> tuple[Table, str]:
    """Choose a model without one block."""
    links, objective = problem.setup.links, problem.objective
    block = blocks_of(problem, count, uneven)
    errors, inside, chosen = {}, [], []
    mine = np.full(len(links), np.nan)
    for number in range(count):
        here = block == number
        best, found, held = left_out(problem, here, inner_blocks)
        for name, each in found.items():
            errors.setdefault(name, np.full(len(links), np.nan))[here] = each
        chosen.append(best)
        mine[here] = errors[best][here]
        inside += held
        print(
            f"block {number + 1} of {count}: {best}, {np.mean(held):.0%} of {len(held)} links",
            file=sys.stderr,
        )
    rmse = {name: float(np.sqrt(np.nanmean(each**2))) for name, each in errors.items()}
    rows = [(CHOSEN, f"{np.sqrt(np.nanmean(mine**2)):.2f}", f"{np.mean(inside):.0%}")]
    rows += [(name, f"{value:.2f}", "") for name, value in sorted(rmse.items(), key=lambda each: each[1])]
    columns = (Column("model"), numbers("RMSE", "dB"), numbers(f"in {LEVEL:.0%} interval"))
    title = f"{links.source}: {np.count_nonzero(objective.weight)} links, {count} blocks"
    return Table(title, columns, tuple(rows)), ", ".join(chosen)


def blocks_of(problem: Problem, count: int, uneven: int | None = None) -> np.ndarray:
    """Block of every link, -1 for links without weight [L]: blocks of equal size, or clusters from a seed."""
    links, counted = problem.setup.links, np.flatnonzero(problem.objective.weight > 0)
    block, place = np.full(len(links), -1), links.rx[counted, :2]
    block[counted] = (
        spatial_blocks(place, count) if uneven is None else kmeans2(place, count, rng=uneven, minit="++")[1]
    )
    return block


def ruled(name: str, count: int, folder: Path) -> dict[float, list[dict[str, np.ndarray]]]:
    """Errors at left-out blocks, for planted truths in a district, by distance of the truths from the start values."""
    problem, found = districts.make(name, folder).problem, {apart: [] for apart in APART}
    parameters, objective = problem.parameters, problem.objective
    start = parameters.to_search(parameters.start)
    for seed in range(count):
        random, apart = np.random.default_rng([seed, 1009]), APART[seed % len(APART)]
        anywhere = random.uniform(*parameters.search_bounds)
        loss = problem.engine.path_loss(parameters.from_search(start + apart * (anywhere - start))[None])[0]
        measured = np.where(np.isfinite(loss), loss, 0.0) + random.normal(0.0, OFFSET_DB)
        measured += PLANTED_DB * random.standard_normal(len(loss))
        weight = np.where(np.isfinite(loss), objective.weight, 0.0)
        planted = replace(problem, objective=replace(objective, measured=measured, weight=weight))
        chosen, errors, _ = left_out(planted, blocks_of(planted, 4) == seed % 4)
        found[apart].append(errors | {CHOSEN: errors[chosen]})
        print(f"{name}: {seed + 1} of {count}", end="\r", file=sys.stderr)
    return found


def rules(names: list[str], count: int) -> Table:
    """Errors of the chosen model over planted truths, compared with always using the same model."""
    every: dict[float, list[dict[str, np.ndarray]]] = {apart: [] for apart in APART}
    with TemporaryDirectory() as folder:
        for name in names:
            for apart, runs in ruled(name, count, Path(folder)).items():
                every[apart] += runs
    taken = (CHOSEN, LEAST, Model.INITIAL, Model.CALIBRATED)
    rows = []
    for apart, runs in every.items():
        errors = ([run[name][np.isfinite(run[name])] for run in runs] for name in taken)
        sizes = (f"{np.sqrt(np.mean(np.concatenate(each) ** 2)):.2f}" for each in errors)
        rows.append((f"{apart:g}", str(len(runs)), *sizes))
    columns = (numbers("truth apart"), numbers("repetitions"), *(numbers(name, "dB") for name in taken))
    return Table(f"RMSE on blocks left out, {', '.join(names)}", columns, tuple(rows))


def planted(seed: int) -> tuple[str, list[bool]]:
    """The model chosen without one block of the demo district, and which links of the block lie in its interval."""
    problem, random = _demo(), np.random.default_rng([seed, 6])
    parameters, objective = problem.parameters, problem.objective
    truth = parameters.from_search(random.uniform(*parameters.search_bounds))
    loss = problem.engine.path_loss(truth[None])[0]
    measured = np.where(np.isfinite(loss), loss, 0.0) + PLANTED_DB * random.standard_normal(len(loss))
    weight = np.where(np.isfinite(loss), objective.weight, 0.0)
    problem = replace(problem, objective=replace(objective, measured=measured, weight=weight))
    chosen, _, inside = left_out(problem, blocks_of(problem, 4) == seed % 4)
    return chosen, inside


@cache
def _demo() -> Problem:
    return opened(str(demo_study_path()))


def without_a_chance(seed: int) -> tuple[int, str]:
    """The seed, and the verdict on a twin of the demo whose measurements depend on distance alone."""
    problem = _demo()
    links, random = problem.setup.links, np.random.default_rng([seed, 5])
    law = INTERCEPT_DB + SLOPE_DB * np.log10(links.distance)
    measured = law + NOISE_DB * random.standard_normal(len(links))
    return seed, validate_problem(
        replace(problem, objective=replace(problem.objective, measured=measured))
    ).sentence


def said_without_a_chance(count: int, workers: int, out: Path | None) -> list[str]:
    """The verdicts of all repetitions; those already in the file are read from it."""
    said = {run["seed"]: run["sentence"] for run in read_runs(out, {})}
    left = [seed for seed in range(count) if seed not in said]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for turn, (seed, sentence) in enumerate(pool.map(without_a_chance, left), start=1):
            said[seed] = sentence
            print(f"repetition {turn} of {len(left)}: {sentence}", file=sys.stderr)
            append_run(out, {"seed": seed, "sentence": sentence})
    return [said[seed] for seed in range(count)]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*", help="study files")
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--inner", type=int, help="number of blocks for choosing the model; 4 if not given")
    parser.add_argument(
        "--uneven", type=int, help="seed of clusters of receivers, instead of blocks of equal size"
    )
    parser.add_argument("--rule", type=int, default=0, help="planted truths in each district")
    parser.add_argument("--districts", default="demo,district-101,district-103,district-105,district-107")
    parser.add_argument("--planted", type=int, default=0, help="repetitions in the demo district")
    parser.add_argument("--chance", type=int, default=0, help="repetitions of the twin without information")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file of the repetitions")
    given = parser.parse_args()
    for file in given.studies:
        table, chosen = nested(opened(file), given.blocks, given.uneven, given.inner)
        print(render(table, f"Chosen for each block: {chosen}."))
    if given.rule:
        print(render(rules(given.districts.split(","), given.rule)))
    if given.planted:
        inside: list[bool] = []
        for seed in range(given.planted):
            chosen, held = planted(seed)
            inside += held
            print(
                f"repetition {seed + 1}: {chosen}; {np.mean(inside):.1%} of {len(inside)} links",
                file=sys.stderr,
            )
        share = f"{np.mean(inside):.1%} of {len(inside)} held-out links"
        print(
            f"{LEVEL:.0%} intervals contain {share}, with {given.planted} planted truths in the demo district."
        )
    if not given.chance:
        return
    said = said_without_a_chance(given.chance, given.workers, given.out)
    right = sum(sentence.startswith("Calibration did not") for sentence in said)
    print(f"A model that cannot help is reported as such in {right} of {given.chance} repetitions.")
    if right < 0.95 * given.chance:
        sys.exit("too often, a model that cannot help is reported to help")


if __name__ == "__main__":
    main()
