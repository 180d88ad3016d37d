"""How often intervals cover the truth: planted values on replayed paths of several districts, in worlds of errors.

    python benchmarks/coverage.py --repetitions 200 --workers 2 --out coverage.jsonl
    python benchmarks/coverage.py --districts demo --worlds random,offset --repetitions 20
    python benchmarks/coverage.py --districts judging --repetitions 200 --workers 2 --out judging.jsonl
    python benchmarks/coverage.py --districts district-233:10138 --worlds random --repetitions 10   # as many links

Every repetition draws a truth for each parameter uniformly from its search range, computes the path losses, adds the
errors of its world, and calibrates as `calibray run` does, but from fewer starting points. The study does not state the
world: all settings are defaults. A row shows how often the interval covered the truth, over all repetitions and where
the verdict was "identified" or "weakly identified", and how often the verdict was "not identifiable". Two reference
posteriors know the noise and that buildings are equal. One has the study's prior for the constants that the scene
fixes; the other knows these constants, and no posterior is narrower. If buildings differ, neither exists.

Each repetition is a line of the file `--out`; an interrupted run continues where it stopped, and `--repetitions 0`
prints the tables of the stored repetitions. The last rows are the negative control: the same posterior with the noise
understated by a factor of two, whose coverage must be too low, or the script fails. It also fails if more than a tenth
of the values that the posterior with known noise determines to a tenth of the range are not called identified or weakly
identified.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import norm
from scipy.stats import t as student

import districts
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, search
from calibray.optimizers import LeastSquares
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.draws import Draws
from calibray.uncertainty.joint_model import joint_model
from calibray.uncertainty.noise_models import GAUSSIAN, Marginal, NoiseModel
from calibray.uncertainty.sequential_monte_carlo import draw_posterior
from calibray.uncertainty.verdicts import credible_sets
from districts import District
from finished_runs import append_run, read_runs
from markdown_tables import render_markdown

NOISE_DB = 3.0
RANGE_M = 60.0
SPREAD = 0.15
OFFSET_DB = 4.0
OUTLIERS, OUTLIER_DB = 0.1, 20.0
FREEDOM = 4.0
LEVELS = (0.9, 0.95)
UNDERSTATED = 4.0
"""Square of the factor by which the negative control understates the noise."""

World = Callable[[District, np.ndarray, np.random.Generator], np.ndarray]
"""Function of a district, a truth [d] and random numbers that returns measured path loss [L], [dB]."""


def _plain(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = district.path_loss(truth)
    return loss + NOISE_DB * random.standard_normal(len(loss))


def _correlated(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    factor = _factor(district)
    return district.path_loss(truth) + NOISE_DB * factor @ random.standard_normal(len(factor))


def _factor(district: District) -> np.ndarray:
    links = district.problem.setup.links
    place = np.hstack([links.rx, links.tx])
    return np.linalg.cholesky(np.exp(-cdist(place, place) / RANGE_M) + 1e-9 * np.eye(len(place)))


def _buildings(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = district.path_loss_apart(truth, SPREAD, random)
    return loss + NOISE_DB * random.standard_normal(len(loss))


def _offset(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return _plain(district, truth, random) + OFFSET_DB


def _outliers(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    measured = _plain(district, truth, random)
    return measured + OUTLIER_DB * (random.random(len(measured)) < OUTLIERS)


def _student(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = district.path_loss(truth)
    return loss + NOISE_DB * np.sqrt((FREEDOM - 2) / FREEDOM) * random.standard_t(FREEDOM, len(loss))


WORLDS: dict[str, World] = {
    "random": _plain,
    "correlated": _correlated,
    "buildings": _buildings,
    "offset": _offset,
    "outliers": _outliers,
    "student-t": _student,
}


def _whole(district: District, left: np.ndarray, mean: float = 0.0) -> np.ndarray:
    return norm.logpdf(left, mean, NOISE_DB).sum(axis=1)


def _shared(district: District, left: np.ndarray) -> np.ndarray:
    white = np.linalg.solve(_factor(district), left.T)
    return -0.5 * np.sum(white**2, axis=0) / NOISE_DB**2


def _mixed(district: District, left: np.ndarray) -> np.ndarray:
    parts = norm.logpdf(left, 0.0, NOISE_DB), norm.logpdf(left, OUTLIER_DB, NOISE_DB)
    return np.logaddexp(np.log(1 - OUTLIERS) + parts[0], np.log(OUTLIERS) + parts[1]).sum(axis=1)


def _tailed(district: District, left: np.ndarray) -> np.ndarray:
    return student.logpdf(left, FREEDOM, scale=NOISE_DB * np.sqrt((FREEDOM - 2) / FREEDOM)).sum(axis=1)


KNOWN: dict[str, Callable[[District, np.ndarray], np.ndarray]] = {
    "random": _whole,
    "correlated": _shared,
    "offset": lambda district, left: _whole(district, left, OFFSET_DB),
    "outliers": _mixed,
    "student-t": _tailed,
}
"""Log density, up to a constant, of measured minus modelled path loss [n, L] in the world."""

DETERMINED: Final = 0.1
"""Width of the posterior with known noise, relative to the range, below which a parameter is well determined."""

DENIED: Final = 0.1
"""Largest share of well-determined values that may have a different verdict."""

IDENTIFIED: Final = ("identified", "weakly identified")


@cache
def _district(name: str, folder: Path) -> District:
    return districts.make(name, folder)


def repetition(name: str, world: str, turn: int, seed: int, starts: int, folder: Path) -> dict[str, Any]:
    """Calibrate one planted truth.

    Args:
        name: The district.
        world: The world of errors.
        turn: Number of the repetition.
        seed: Seed of all repetitions.
        starts: Number of local searches of the calibration.
        folder: Folder of the districts.

    Returns:
        A line of the file.
    """
    district = _district(name, folder)
    problem, started = district.problem, time.process_time()
    random = np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(world.encode()), turn])
    lower, upper = problem.parameters.search_bounds
    point = random.uniform(lower, upper)
    measured = WORLDS[world](district, problem.parameters.from_search(point), random)
    known = np.isfinite(measured)
    objective = replace(
        problem.objective,
        measured=np.where(known, measured, 0.0),
        weight=np.where(known, problem.objective.weight, 0.0),
    )
    problem = replace(problem, objective=objective)
    trail = search(problem, LeastSquares(lower, upper, starts=starts, seed=turn))
    assessed = certainty(problem, trail)
    posterior, found = assessed.posterior, []
    if posterior is None:
        raise RuntimeError(f"{name}, {world}, {turn}: no draws; {assessed.record.remarks}")
    means = posterior.means
    references = {
        reference: _known(district, world, problem, trail, turn, exact)
        for reference, exact in (("known", False), ("exact", True))
        if known.all() and world in KNOWN
    }
    narrow = means.weight * np.exp((UNDERSTATED - 1) * (means.density - means.density.max()))
    for k, parameter in enumerate(problem.parameters.names):
        told_sets = credible_sets(means.point[:, k], means.weight, lower[k], upper[k], LEVELS)
        sets = dict(zip(map(str, LEVELS), told_sets, strict=True))
        control = credible_sets(means.point[:, k], narrow / narrow.sum(), lower[k], upper[k], [LEVELS[0]])[0]
        by_reference = {}
        for reference, draws in references.items():
            alike = credible_sets(draws.point[:, k], draws.weight, lower[k], upper[k], [LEVELS[0]])[0]
            by_reference[reference] = {
                "held": bool(_holds(alike, point[k])), "width": _width(alike) / (upper[k] - lower[k])
            }  # fmt: skip
        found.append({
            "name": parameter,
            "verdict": assessed.record.intervals[parameter].verdict,
            "held": {level: bool(_holds(pieces, point[k])) for level, pieces in sets.items()},
            "width": _width(sets["0.9"]) / (upper[k] - lower[k]),
            "control": bool(_holds(control, point[k])),
            **by_reference,
        })  # fmt: skip
    return {
        "district": name, "world": world, "repetition": turn, "seed": seed, "starts": starts, "parameters": found,
        "noise": assessed.record.noise, "agree": means.agree, "calls": assessed.calls,
        "seconds": time.process_time() - started,
    }  # fmt: skip


@dataclass(frozen=True)
class KnownNoise:
    """The density of a world's errors, used in place of the noise models.

    With `censored` links, the sampler requests the densities themselves.
    """

    district: District
    world: str
    models: tuple[NoiseModel, ...] = (NoiseModel(GAUSSIAN, 1.0),)

    censored: np.ndarray = field(default_factory=lambda: np.ones(1, dtype=bool))
    column: np.ndarray = field(default_factory=lambda: np.ones(1))

    def densities(self, gap: np.ndarray) -> np.ndarray:
        """Log density of the gaps [n, L], shape [n, 1]."""
        density = np.where(np.isfinite(gap).all(axis=1), KNOWN[self.world](self.district, gap), -np.inf)
        return density[:, None]


def _known(
    district: District, world: str, problem: Problem, trail: Trail, seed: int, exact_constants: bool
) -> Draws:
    """Draws with known noise and equal buildings; the constants that the scene fixes may be known too."""
    study = problem.setup.study
    spread = 0.0 if exact_constants else study.noise.constants_spread
    noise = study.noise.model_copy(update={"constants_spread": spread, "heterogeneity": 0.0})
    setup = replace(problem.setup, study=study.model_copy(update={"noise": noise}))
    best, freedom = problem.parameters.to_search(trail.best), max(problem.freedom, 1)
    model = joint_model(replace(problem, setup=setup), best, float(trail.best_value**2), freedom)
    known = KnownNoise(district, world, column=np.ones(problem.objective.num_counted))
    return draw_posterior(replace(model, marginal=cast(Marginal, known)), seed).means


def _width(pieces: tuple[tuple[float, float], ...]) -> float:
    return sum(high - low for low, high in pieces)


def _holds(pieces: tuple[tuple[float, float], ...], value: float) -> bool:
    return any(low <= value <= high for low, high in pieces)


def _run(tasks: list[tuple[Any, ...]], workers: int) -> Iterator[dict[str, Any]]:
    if workers < 2:
        for task in tasks:
            yield repetition(*task)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(repetition, *task) for task in tasks]):
            yield future.result()


def main() -> None:
    """Run what is missing and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument(
        "--districts", default="demo,development", help="names, or demo, development, judging, all"
    )
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--starts", type=int, default=64, help="number of local searches per calibration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file with one line per repetition, to continue from")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "calibray-districts")
    parser.add_argument("--markdown", action="store_true", help="print tables for the documentation")
    given = parser.parse_args()
    names, worlds = districts.named(given.districts), given.worlds.split(",")
    lines = read_runs(given.out, {"seed": given.seed, "starts": given.starts})
    done = {(each["district"], each["world"], each["repetition"]) for each in lines}
    for name in names:
        if given.repetitions:
            _district(name, given.folder)  # traced once, by this process
    # Repetition by repetition, so that an interrupted run has equally many from every district and world.
    tasks = [
        (name, world, turn, given.seed, given.starts, given.folder)
        for turn in range(given.repetitions)
        for name in names
        for world in worlds
        if (name, world, turn) not in done
    ]
    for count, line in enumerate(_run(tasks, given.workers), start=1):
        lines.append(line)
        append_run(given.out, line)
        print(f"{count} of {len(tasks)}", end="\r", file=sys.stderr)
    lines = [each for each in lines if each["district"] in names and each["world"] in worlds]
    for table in tables(lines):
        print(f"\n**{table.title}**\n\n{render_markdown(table)}" if given.markdown else render(table))
    for reference, words in (("known", "the noise"), ("exact", "the noise and the scene's constants")):
        count, denied = determined(lines, reference)
        print(
            f"Determined to a tenth of the range by {words}: {count}; of these not (weakly) identified: {denied}."
        )
        if reference == "known" and denied > DENIED * count:
            sys.exit("too many well-determined parameters are not called identified or weakly identified")
    control = [entry["control"] for line in lines if line["world"] == "random" for entry in line["parameters"]
               if entry["verdict"] != "not identifiable"]  # fmt: skip
    if control and np.mean(control) > LEVELS[0] - 0.04:
        sys.exit("negative control: intervals with the noise understated by two cover as if they were right")


def determined(lines: list[dict[str, Any]], reference: str) -> tuple[int, int]:
    """Number of values that a reference determines well, and of those not called identified or weakly identified."""
    entries = [entry for line in lines for entry in line["parameters"] if entry.get(reference)]
    verdicts = [entry["verdict"] for entry in entries if entry[reference]["width"] < DETERMINED]
    return len(verdicts), sum(verdict not in IDENTIFIED for verdict in verdicts)


def tables(lines: list[dict[str, Any]]) -> list[Table]:
    """Coverage by world and parameter of every district, and of all districts together."""
    found = []
    for name in dict.fromkeys(line["district"] for line in lines):
        found.append(_table(f"{name}", [line for line in lines if line["district"] == name], by_name=True))
    if len(found) > 1:
        found.append(_table("all districts, by parameter", lines, by_name=True))
    return [*found, _table("all districts", lines, by_name=False)]


def _table(title: str, lines: list[dict[str, Any]], by_name: bool) -> Table:
    columns = (
        Column("world"), Column("parameter"), numbers("repetitions"), numbers("90 % held"), numbers("95 % held"),
        numbers("noise known, 90 %"), numbers("identified"), numbers("90 % held there"), numbers("95 % held there"),
        numbers("noise known, 90 % there"), numbers("not identifiable"), numbers("median width"),
        numbers("by that, noise known"), numbers("there"), numbers("constants known too"), numbers("there"),
        numbers("control, 90 %"),
    )  # fmt: skip
    rows = []
    for world in dict.fromkeys(line["world"] for line in lines):
        here = [entry for line in lines if line["world"] == world for entry in line["parameters"]]
        for name in dict.fromkeys(entry["name"] for entry in here) if by_name else ("all",):
            mine = [entry for entry in here if name in (entry["name"], "all")]
            sure = [entry for entry in mine if entry["verdict"] in IDENTIFIED]
            blind = np.mean([entry["verdict"] == "not identifiable" for entry in mine])
            rows.append((
                world, name, str(len(mine)), _share(mine, "0.9"), _share(mine, "0.95"), _lucky(mine), str(len(sure)),
                _share(sure, "0.9") + _error(sure, "0.9"), _share(sure, "0.95") + _error(sure, "0.95"), _lucky(sure),
                f"{blind:.2f}",
                f"{np.median([entry['width'] for entry in mine]):.2f}",
                *(_wider(entries, known) for known in ("known", "exact") for entries in (mine, sure)),
                f"{np.mean([entry['control'] for entry in sure]):.2f}" if sure and world == "random" else "-",
            ))  # fmt: skip
    seconds = sum(line["seconds"] for line in lines) / max(len(lines), 1)
    return Table(f"{title}: {len(lines)} repetitions, {seconds:.1f} s of CPU each", columns, tuple(rows))


def _lucky(entries: list[dict[str, Any]]) -> str:
    """How often the posterior with known noise contains the truth."""
    known = [entry["known"]["held"] for entry in entries if entry.get("known")]
    return f"{np.mean(known):.2f}" if known else "-"


def _wider(entries: list[dict[str, Any]], reference: str) -> str:
    """Median of the widths relative to those of a reference."""
    ratio = [entry["width"] / entry[reference]["width"] for entry in entries if entry.get(reference)]
    return f"{np.median(ratio):.2f}" if ratio else "-"


def _error(entries: list[dict[str, Any]], level: str) -> str:
    """Standard error of a share of independent draws, at least that with one more draw of the opposite outcome."""
    if not entries:
        return ""
    share = (sum(entry["held"][level] for entry in entries) + 1) / (len(entries) + 2)
    return f" ± {np.sqrt(share * (1 - share) / len(entries)):.2f}"


def _share(entries: list[dict[str, Any]], level: str) -> str:
    return f"{np.mean([entry['held'][level] for entry in entries]):.2f}" if entries else "-"


if __name__ == "__main__":
    main()
