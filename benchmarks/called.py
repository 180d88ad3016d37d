"""Intervals for black-box engines, compared with intervals from derivatives of the same engines.

    python benchmarks/called.py --repetitions 30 --districts demo,development --out called.jsonl
    python benchmarks/called.py --repetitions 4 --districts demo,district-100 --calls 2,4,8,16 --noises 0.5,1.5,4

The engine is the replay of a district whose fixed constants (thickness, conductivity) have random factors and whose
links have random errors of 0.5 dB. The study's own replay is therefore a cheap model with wrong constants. Truths are
drawn uniformly from their ranges, and the noise is 1 or 3 dB. Two methods only call the engine: space mapping with the
study's replay, with 10 calls per parameter, and the vector surrogate without it, with 20 calls per parameter. The third
method uses derivatives. A row shows how often 90 % and 95 % intervals cover the truth, and how wide they are relative
to those from derivatives on the same data. With `--calls`, the vector surrogate has these numbers of calls per
parameter instead. With `--any-error`, intervals are drawn even if the calls do not predict one another.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import districts
from calibray.engines import Replay
from calibray.fitting.cheap_replay import ProblemRows, ReplayedModel, with_constants
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares, SpaceMapping, VectorSurrogate
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty import assessment
from calibray.uncertainty.assessment import Certainty, certainty
from calibray.uncertainty.verdicts import credible_sets
from finished_runs import append_run, read_runs

LEVELS = (0.9, 0.95)
OWN_DB = 0.5
"""Standard deviation of the links' differences between the engine and the study's replay [dB]."""
OFF = 0.5
"""Spread of the errors of its constants, relative to the spread that space mapping allows."""


@dataclass
class Engine:
    """A district with its own constants.

    Attributes:
        stored: Replay of its paths as a function of the parameters, followed by the constants.
        constants: The constants, in the fields' units.
        own: Error of every link [L], [dB].
        parameters: The parameters, in the order of a candidate's components.
        calls: Candidates evaluated so far.
    """

    stored: Replay
    constants: np.ndarray
    own: np.ndarray
    parameters: Any
    calls: int = 0

    @property
    def materials(self) -> dict[str, Any]:
        """The scene's materials."""
        return self.stored.materials

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        """Path loss [n, L], [dB]."""
        self.calls += len(candidates)
        return self.stored.path_loss(self._whole(candidates)) + self.own

    def _whole(self, candidates: np.ndarray) -> np.ndarray:
        return np.hstack([candidates, np.tile(self.constants, (len(candidates), 1))])


@dataclass
class WithDerivatives(Engine):
    """The same engine with derivatives."""

    large: bool = False

    @property
    def interactions(self) -> int:
        """Number of interactions evaluated per candidate."""
        return self.stored.interactions

    def path_loss_and_jacobian(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Path loss [n, L], [dB], and derivatives [n, L, d]."""
        self.calls += len(candidates)
        loss, slope = self.stored.path_loss_and_jacobian(self._whole(candidates))
        return loss + self.own, slope[:, :, : candidates.shape[1]]


@cache
def _opened(name: str, folder: Path) -> tuple[Problem, Replay]:
    """A district's problem, and the replay of its paths as a function of the parameters and the constants."""
    district = districts.make(name, folder)
    problem, paths = district.problem, district.paths
    setup = problem.setup
    stored = Replay(
        paths, with_constants(problem.parameters, paths.materials), setup.study.objective.combining,
        setup.study.scene.bandwidth,
    )  # fmt: skip
    return problem, stored


def repetition(name: str, noise_db: float, turn: int, folder: Path, calls: tuple[int, ...]) -> dict[str, Any]:
    """One planted truth, estimated with derivatives, by space mapping and with numbers of calls per parameter."""
    problem, stored = _opened(name, folder)
    parameters, started = problem.parameters, time.process_time()
    random = np.random.default_rng([zlib.crc32(name.encode()), turn, 12])
    bounds, count = parameters.search_bounds, len(parameters)
    point = random.uniform(*bounds)
    low, high = (each[count:] for each in stored.parameters.search_bounds)
    # The bounds are three spreads away.
    moved = (low + high) / 2 + OFF * (high - low) / 6 * random.standard_normal(len(low))
    constants = stored.parameters.from_search(np.append(point, np.clip(moved, low, high)))[count:]
    own = OWN_DB * random.standard_normal(len(problem.before))
    called = Engine(stored, constants, own, parameters)
    exact = WithDerivatives(stored, constants, own, parameters)
    loss = exact.path_loss(parameters.from_search(point)[None])[0]
    known = np.isfinite(loss)
    measured = np.where(known, loss + noise_db * random.standard_normal(len(loss)), 0.0)
    objective = replace(
        problem.objective, measured=measured, weight=np.where(known, problem.objective.weight, 0.0)
    )
    found = {}
    planes = {f"planes, {number}": number for number in calls}
    for way in ("derivatives", "mapped", *planes):
        asked = replace(problem, engine=exact if way == "derivatives" else called, objective=objective)
        asked = replace(asked, before=asked.engine.path_loss(parameters.start[None])[0])
        model = ReplayedModel(stored, count, ProblemRows(asked)) if way == "mapped" else None
        if way in planes:
            optimizer: Any = VectorSurrogate(*bounds, budget=planes[way] * count, seed=turn)
        elif way == "mapped":
            optimizer = SpaceMapping(*bounds, cheap_model=model, budget=10 * count, seed=turn)
        else:
            optimizer = LeastSquares(*bounds, starts=64, seed=turn)
        trail = search(asked, optimizer)
        before = time.process_time()
        assessed = certainty(asked, trail, model=model)
        sets = [_sets(assessed, k, bounds[0][k], bounds[1][k]) for k in range(count)]
        found[way] = {
            "verdicts": [each.verdict for each in assessed.record.intervals.values()],
            "held": [
                {level: _holds(pieces, value) for level, pieces in each.items()}
                for value, each in zip(point, sets, strict=True)
            ],
            "width": [sum(b - a for a, b in each["0.9"]) for each in sets],
            "drawn": assessed.posterior is not None,
            "rmse_db": trail.best_rmse_db,
            "calls": trail.rt_calls,
            "seconds": time.process_time() - before,
        }  # fmt: skip
    return {
        "district": name, "noise_db": noise_db, "turn": turn, "ways": found, "seconds": time.process_time() - started
    }  # fmt: skip


def _sets(
    assessed: Certainty, k: int, lower: float, upper: float
) -> dict[str, tuple[tuple[float, float], ...]]:
    """Credible sets of parameter k by level; the whole range if there are no draws."""
    if assessed.posterior is None:
        return {str(level): ((lower, upper),) for level in LEVELS}
    draws = assessed.posterior.means
    return {
        str(level): credible_sets(draws.point[:, k], draws.weight, lower, upper, [level])[0]
        for level in LEVELS
    }


def _holds(pieces: tuple[tuple[float, float], ...], value: float) -> bool:
    return any(low <= value <= high for low, high in pieces)


def _table(lines: list[dict[str, Any]]) -> Table:
    columns = (
        Column("noise"), Column("way"), numbers("intervals"), numbers("of them drawn"),
        *(numbers(f"{level:.0%} held") for level in LEVELS), numbers("identified or weakly"),
        numbers("90% held there"), numbers("width by derivatives', median"), numbers("a tenth below"),
        numbers("a tenth above"), numbers("seconds"),
    )  # fmt: skip
    return Table("Intervals on engines that can only be called", columns, tuple(_rows(lines)))


def _rows(lines: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    for noise in sorted({line["noise_db"] for line in lines}):
        here = [line["ways"] for line in lines if line["noise_db"] == noise]
        for way in here[0]:
            held = [each for ways in here for each in ways[way]["held"]]
            verdict = [each for ways in here for each in ways[way]["verdicts"]]
            widths = [
                each["0.9"]
                for each, said in zip(held, verdict, strict=True)
                if said in ("identified", "weakly identified")
            ]
            ratio = np.concatenate(
                [np.array(ways[way]["width"]) / ways["derivatives"]["width"] for ways in here]
            )
            low, middle, high = np.quantile(ratio, (0.1, 0.5, 0.9))
            yield (
                f"{noise:g} dB", way, str(len(held)),
                str(sum(len(ways[way]["held"]) for ways in here if ways[way]["drawn"])),
                *(f"{np.mean([each[str(level)] for each in held]):.2f}" for level in LEVELS),
                str(len(widths)), f"{np.mean(widths):.2f}" if widths else "-",
                f"{middle:.2f}", f"{low:.2f}", f"{high:.2f}",
                f"{np.mean([ways[way]['seconds'] for ways in here]):.1f}",
            )  # fmt: skip


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--districts", default="demo,development")
    parser.add_argument("--noises", default="1,3", help="standard deviations of the noise [dB]")
    parser.add_argument("--calls", default="20", help="calls per parameter of the vector surrogate")
    parser.add_argument("--any-error", action="store_true", help="draw whatever the error of the emulator is")
    parser.add_argument("--out", type=Path, help="file with one line per repetition, to continue from")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "calibray-districts")
    given = parser.parse_args()
    noises = [float(noise) for noise in given.noises.split(",")]
    calls = tuple(int(number) for number in given.calls.split(","))
    settings = {"calls": given.calls, "any_error": given.any_error}
    if given.any_error:
        assessment.LARGEST_ERROR = np.inf  # type: ignore[misc]
    names, lines = districts.named(given.districts), read_runs(given.out, settings)
    done = {(line["district"], line["noise_db"], line["turn"]) for line in lines}
    for turn in range(given.repetitions):
        for name in names:
            for noise in noises:
                if (name, noise, turn) in done:
                    continue
                lines.append(repetition(name, noise, turn, given.folder, calls) | settings)
                took = f"{lines[-1]['seconds']:.0f} s"
                print(f"{name}, {noise:g} dB, repetition {turn + 1}: {took}", file=sys.stderr)
                append_run(given.out, lines[-1])
    print(render(_table([line for line in lines if line["district"] in names])))


if __name__ == "__main__":
    main()
