"""How often intervals hold the truth: planted values, replayed paths of several districts, several worlds of errors.

    python benchmarks/coverage.py --repetitions 200 --workers 2 --out coverage.jsonl
    python benchmarks/coverage.py --districts demo --worlds random,offset --repetitions 20
    python benchmarks/coverage.py --districts judging --repetitions 200 --workers 2 --out judging.jsonl

Every repetition draws a truth for each parameter evenly from its search range, makes path losses of it, adds the errors
of its world, and calibrates as `calibray run` does, from fewer starting points. Nothing is told of the world: every
study has the defaults. A row tells how often the interval held the truth, over all repetitions and where the verdict
was "identified" or "weakly identified", and how often the verdict was "not identifiable".

Each repetition is a line of the file `--out`; a run that was stopped goes on where it stood, and `--repetitions 0`
prints the tables of what is there. The last rows are the negative control, the same posterior with the noise
understated by two, which must cover too seldom: the script fails if it does not.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

import districts
from calibray.calibration.certainty import certainty
from calibray.calibration.search import search
from calibray.inference.credible import credible
from calibray.optimizers import LeastSquares
from calibray.tables import Column, Table, markdown, numbers
from calibray.tables.text import render
from districts import District

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
"""District, truth [d] and random numbers to measured path loss [L], [dB]."""


def _plain(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    loss = district.path_loss(truth)
    return loss + NOISE_DB * random.standard_normal(len(loss))


def _correlated(district: District, truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    links = district.problem.setup.links
    place = np.hstack([links.rx, links.tx])
    factor = np.linalg.cholesky(np.exp(-cdist(place, place) / RANGE_M) + 1e-9 * np.eye(len(place)))
    return district.path_loss(truth) + NOISE_DB * factor @ random.standard_normal(len(place))


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


@cache
def _district(name: str, folder: Path) -> District:
    return districts.make(name, folder)


def repetition(name: str, world: str, turn: int, seed: int, starts: int, folder: Path) -> dict[str, Any]:
    """One planted truth, calibrated.

    Args:
        name: The district.
        world: The world of errors.
        turn: Number of the repetition.
        seed: Seed of all of them.
        starts: Local searches of the calibration.
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
    told = certainty(problem, trail)
    draws, found = told.posterior, []
    if draws is None:
        raise RuntimeError(f"{name}, {world}, {turn}: no draws; {told.remarks}")
    narrow = draws.weight * np.exp((UNDERSTATED - 1) * (draws.density - draws.density.max()))
    for k, parameter in enumerate(problem.parameters.names):
        value = draws.point[:, k]
        sets = {str(level): credible(value, draws.weight, lower[k], upper[k], level) for level in LEVELS}
        control = credible(value, narrow / narrow.sum(), lower[k], upper[k], LEVELS[0])
        found.append({
            "name": parameter,
            "verdict": told.intervals[parameter].verdict,
            "held": {level: bool(_holds(pieces, point[k])) for level, pieces in sets.items()},
            "width": sum(high - low for low, high in sets["0.9"]) / (upper[k] - lower[k]),
            "control": bool(_holds(control, point[k])),
        })  # fmt: skip
    return {
        "district": name, "world": world, "repetition": turn, "seed": seed, "parameters": found,
        "noise": told.noise, "effective": draws.effective, "calls": told.calls,
        "seconds": time.process_time() - started,
    }  # fmt: skip


def _holds(pieces: tuple[tuple[float, float], ...], value: float) -> bool:
    return any(low <= value <= high for low, high in pieces)


def _read(file: Path | None, seed: int) -> list[dict[str, Any]]:
    if file is None or not file.exists():
        return []
    # A line that was being written when the run was stopped is written again.
    whole = [line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
    file.write_text("".join(whole))
    return [each for each in map(json.loads, whole) if each["seed"] == seed]


def _run(tasks: list[tuple[Any, ...]], workers: int) -> Iterator[dict[str, Any]]:
    if workers < 2:
        for task in tasks:
            yield repetition(*task)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(repetition, *task) for task in tasks]):
            yield future.result()


def _named(words: str) -> list[str]:
    groups = {"all": (districts.DEMO, *districts.DEVELOPMENT, *districts.JUDGING),
              "development": districts.DEVELOPMENT, "judging": districts.JUDGING}  # fmt: skip
    return [name for word in words.split(",") for name in groups.get(word, (word,))]


def main() -> None:
    """Run what is missing and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument(
        "--districts", default="demo,development", help="names, or demo, development, judging, all"
    )
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--starts", type=int, default=64, help="local searches of each calibration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file of lines, one a repetition; goes on where it stands")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "calibray-districts")
    parser.add_argument("--markdown", action="store_true", help="print tables for the documentation")
    given = parser.parse_args()
    names, worlds = _named(given.districts), given.worlds.split(",")
    lines = _read(given.out, given.seed)
    done = {(each["district"], each["world"], each["repetition"]) for each in lines}
    for name in names:
        if given.repetitions:
            _district(name, given.folder)  # traced once, by this process
        tasks = [
            (name, world, turn, given.seed, given.starts, given.folder)
            for turn in range(given.repetitions)
            for world in worlds
            if (name, world, turn) not in done
        ]
        for count, line in enumerate(_run(tasks, given.workers), start=1):
            lines.append(line)
            if given.out is not None:
                with given.out.open("a") as file:
                    file.write(json.dumps(line) + "\n")
            print(f"{name}: {count} of {len(tasks)}", end="\r", file=sys.stderr)
    lines = [each for each in lines if each["district"] in names and each["world"] in worlds]
    for table in tables(lines):
        print(f"\n**{table.title}**\n\n{markdown.render(table)}" if given.markdown else render(table))
    control = [entry["control"] for line in lines if line["world"] == "random" for entry in line["parameters"]
               if entry["verdict"] != "not identifiable"]  # fmt: skip
    if control and np.mean(control) > LEVELS[0] - 0.04:
        sys.exit("negative control: intervals with the noise understated by two cover as if they were right")


def tables(lines: list[dict[str, Any]]) -> list[Table]:
    """Coverage by world and parameter of every district, and of all districts together."""
    found = []
    for name in dict.fromkeys(line["district"] for line in lines):
        found.append(_table(f"{name}", [line for line in lines if line["district"] == name], by_name=True))
    found.append(_table("all districts", lines, by_name=False))
    return found


def _table(title: str, lines: list[dict[str, Any]], by_name: bool) -> Table:
    columns = (
        Column("world"), Column("parameter"), numbers("repetitions"), numbers("90 % held"), numbers("95 % held"),
        numbers("identified"), numbers("90 % held there"), numbers("95 % held there"), numbers("not identifiable"),
        numbers("median width"), numbers("control, 90 %"),
    )  # fmt: skip
    rows = []
    for world in dict.fromkeys(line["world"] for line in lines):
        here = [entry for line in lines if line["world"] == world for entry in line["parameters"]]
        for name in dict.fromkeys(entry["name"] for entry in here) if by_name else ("all",):
            mine = [entry for entry in here if name in (entry["name"], "all")]
            told = [entry for entry in mine if entry["verdict"] in ("identified", "weakly identified")]
            blind = np.mean([entry["verdict"] == "not identifiable" for entry in mine])
            rows.append((
                world, name, str(len(mine)), _share(mine, "0.9"), _share(mine, "0.95"), str(len(told)),
                _share(told, "0.9"), _share(told, "0.95"), f"{blind:.2f}",
                f"{np.median([entry['width'] for entry in mine]):.2f}",
                f"{np.mean([entry['control'] for entry in told]):.2f}" if told and world == "random" else "-",
            ))  # fmt: skip
    seconds = sum(line["seconds"] for line in lines) / max(len(lines), 1)
    return Table(f"{title}: {len(lines)} repetitions, {seconds:.1f} s of CPU each", columns, tuple(rows))


def _share(entries: list[dict[str, Any]], level: str) -> str:
    return f"{np.mean([entry['held'][level] for entry in entries]):.2f}" if entries else "-"


if __name__ == "__main__":
    main()
