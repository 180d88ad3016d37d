"""Intervals, warnings and choice if the study's scene lacks part of the truth: seven worlds, on drawn districts.

    python benchmarks/misfit.py --repetitions 5 --districts judging
    python benchmarks/misfit.py --worlds "nothing,thickness" --no-choice --constants-spread 0 --out exact.jsonl
    python benchmarks/misfit.py --repetitions 2 --districts judging --no-draws

A repetition draws a truth from the bounds, computes path loss in its world, adds 3 dB of noise, keeps one of four
clusters of receivers apart, and calibrates on the others as `calibray run` does. The true paths of a world are traced
once for each district.

The table shows, by verdict, how often 90 % sets contain the truth. It also shows how often a run with a wrong verdict
has a warning, or a value at a bound, which the report explains as a possible defect of the model. A verdict is wrong if
it is not "not identifiable" and the 95 % interval misses the truth. The regret is the RMSE at the cluster kept apart of
the model that held-out blocks choose, minus that of the best of the initial materials, the calibrated ones and the
log-distance model. The same is shown for the choice without averaging, for the calibrated models without and with a
prior, and for the average of these two.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from calibray.calibration.link_diagnostics import directions_remark, region_remark
from calibray.errors import InputError
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail, search
from calibray.optimizers import LeastSquares
from calibray.result.held_out import Model
from calibray.result.verdict import RemarkKind
from calibray.tables import Column, Table, numbers, render
from calibray.uncertainty.assessment import Certainty, certainty
from calibray.uncertainty.richer_paths import assess_richer_paths
from calibray.uncertainty.verdicts import credible_sets
from calibray.validation.models import fit_variants
from calibray.validation.validate import fit_models, validate_problem
from finished_runs import append_run, read_runs
from misfit_worlds import WORLDS, World, make, named

LEVEL = 0.9
APART = 4
"""Clusters of receivers, one of which is kept apart."""
FEWEST = 8
"""Mean number of links per cluster below which no cluster is kept apart."""
NEARLY_DB = 0.3
"""Largest regret for which a choice is right."""
IDENTIFIED = ("identified", "weakly identified")
PARTLY = ("ambiguous", "at bound")
OWN_PATHS = "own paths"


def repetition(world: World, seed: int, spread: float | None, *, draws: bool, choice: bool) -> dict[str, Any]:
    """Calibrate one truth; judge verdicts and sets from draws, and the chosen model at the cluster kept apart."""
    started, drawn = time.process_time(), world.planted(seed)
    problem, loss, random = drawn.problem, drawn.loss_db, np.random.default_rng([seed, 4])
    weight, far = problem.objective.weight.copy(), np.zeros(len(loss), dtype=bool)
    known = np.flatnonzero((weight > 0) & np.isfinite(problem.before))
    if len(known) >= FEWEST * APART:
        cluster = kmeans2(problem.setup.links.rx[known, :2], APART, rng=random, minit="++")[1]
        far[known[cluster == random.integers(APART)]] = True
    weight[far] = 0.0
    setup, study = problem.setup, problem.setup.study
    if spread is not None:
        noise = study.noise.model_copy(update={"constants_spread": spread})
        setup = replace(setup, study=study.model_copy(update={"noise": noise}))
    planted = replace(problem, setup=setup, objective=replace(problem.objective, weight=weight))
    lower, upper = problem.parameters.search_bounds
    trail = search(planted, LeastSquares(lower, upper, starts=32, seed=seed))
    line: dict[str, Any] = {"links": int((weight > 0).sum())}
    line |= dict.fromkeys(("verdicts", "inside", "held", "remarks"), ())
    if draws:
        line |= intervals(planted, trail, drawn.truth)
    if choice and far.any():
        part = replace(planted, setup=planted.setup.with_obstruction())
        minima = {Model.CALIBRATED: trail.minima}
        validation = validate_problem(planted, known_minima=minima)
        fitted = fit_models(part, fit_variants(part, minima))
        errors = {str(name): each[far] - loss[far] for name, each in fitted.items()}
        sizes = {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items() if np.isfinite(e).all()}
        line |= {"chosen": validation.chosen, "preferred": validation.preferred, "far_db": sizes}
    return line | {"seconds": time.process_time() - started}


def intervals(planted: Problem, trail: Trail, point: np.ndarray) -> dict[str, Any]:
    """Verdicts and remarks of a calibration, and whether its sets and intervals contain the truth [d].

    If the measurements favour paths that the study leaves out, the values for its own paths are under `OWN_PATHS`.
    """
    own_paths = certainty(planted, trail)
    assessed = assess_richer_paths(planted, trail, own_paths)
    line = _judged(planted, trail, point, assessed)
    favoured = str(RemarkKind.RICHER_PATHS) in line["remarks"]
    return line | ({OWN_PATHS: _judged(planted, trail, point, own_paths)} if favoured else {})


def _judged(planted: Problem, trail: Trail, point: np.ndarray, assessed: Certainty) -> dict[str, Any]:
    parameters, (lower, upper) = planted.parameters, planted.parameters.search_bounds
    if assessed.posterior is None:
        raise RuntimeError(f"no draws; {assessed.record.remarks}")
    means, inside, widths = assessed.posterior.means, [], []
    for k, value in enumerate(point):
        pieces = credible_sets(means.point[:, k], means.weight, lower[k], upper[k], [LEVEL])[0]
        inside.append(any(low <= value <= high for low, high in pieces))
        widths.append(sum(high - low for low, high in pieces) / (upper[k] - lower[k]))
    truth = parameters.from_search(point)
    held = [each.contains(v) for each, v in zip(assessed.record.intervals.values(), truth, strict=True)]
    own = directions_remark(planted, trail.best) or region_remark(planted, trail)
    remarks = (*assessed.record.remarks, *own)
    return {
        "names": parameters.names,
        "verdicts": [str(interval.verdict) for interval in assessed.record.intervals.values()],
        "inside": inside, "widths": widths, "held": held, "remarks": [str(remark.kind) for remark in remarks],
        "noise": assessed.record.noise, "rmse_db": trail.best_value, "agree": means.agree,
        "certainty": assessed.seconds, "calls": assessed.calls,
    }  # fmt: skip


def table(lines: list[dict[str, Any]]) -> Table:
    """Coverage, warnings and regret by world."""
    columns = (
        Column("the truth has"), numbers("runs"), numbers("identified or weakly"), numbers("in 90 % set"),
        numbers("identified"), numbers("in 90 % set"), numbers("ambiguous or at bound"), numbers("in 90 % set"),
        numbers("all, in 90 % set"), numbers("wrong runs"), numbers("of these warned"), numbers("warned or at bound"),
        numbers("all runs, warned"), numbers("choice right"), numbers("regret", "dB"), numbers("not averaged", "dB"),
        numbers("calibrated", "dB"), numbers("with prior", "dB"), numbers("their average", "dB"),
        numbers(f"at most {NEARLY_DB} dB"), numbers("CPU", "s"),
    )  # fmt: skip
    rows, average = [], Model.AVERAGE_CALIBRATED
    for world in (*dict.fromkeys(line["world"] for line in lines), "all"):
        mine = [line for line in lines if world in (line["world"], "all")]
        values = [each for line in mine for each in zip(line["verdicts"], line["inside"], strict=True)]
        cells = []
        for verdicts in (IDENTIFIED, IDENTIFIED[:1], PARTLY):
            inside = [held for verdict, held in values if verdict in verdicts]
            cells += [str(len(inside)), _share(inside)]
        wrong = [
            line for line in mine
            if any(not held and verdict in IDENTIFIED + PARTLY
                   for verdict, held in zip(line["verdicts"], line["held"], strict=True))
        ]  # fmt: skip
        choices = [line for line in mine if "chosen" in line]
        regret = [_regret(line, line["chosen"]) for line in choices]
        rivals = [
            [_regret(line, line["preferred"]) for line in choices],
            *([_regret(line, name) for line in choices] for name in (Model.CALIBRATED, Model.PRIOR, average)),
        ]
        rows.append((
            world, str(len(mine)), *cells, _share([held for _, held in values]), str(len(wrong)),
            _share([bool(line["remarks"]) for line in wrong]),
            _share([bool(line["remarks"]) or "at bound" in line["verdicts"] for line in wrong]),
            _share([bool(line["remarks"]) for line in mine]),
            _share([loss <= NEARLY_DB for loss in regret]),
            *(f"{np.mean(each):.2f}" if each else "-" for each in (regret, *rivals)),
            _share([loss <= NEARLY_DB for loss in rivals[-1]]),
            f"{np.mean([line['seconds'] for line in mine]):.1f}",
        ))  # fmt: skip
    return Table("Where the truth has what the scene lacks", columns, tuple(rows))


def _regret(line: dict[str, Any], name: str) -> float:
    """RMSE of a model at the cluster kept apart, minus that of the best simple model [dB]."""
    simple = (Model.INITIAL, Model.CALIBRATED, Model.LOG_DISTANCE)
    return line["far_db"][name] - min(line["far_db"].get(name, np.inf) for name in simple)


def _share(values: list[bool]) -> str:
    return f"{np.mean(values):.2f}" if values else "-"


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--repetitions", type=int, default=5, help="repetitions of every world in every district"
    )
    parser.add_argument("--districts", default="development", help="names, or development or judging")
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--constants-spread", type=float, help="noise.constants_spread; the default if absent"
    )
    parser.add_argument("--own-paths", action="store_true", help="show intervals on the study's own paths")
    parser.add_argument("--no-choice", action="store_true", help="omit validation and choice")
    parser.add_argument("--no-draws", action="store_true", help="omit verdicts and intervals")
    parser.add_argument("--out", type=Path, help="file with one line per repetition, to continue from")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "calibray-districts")
    given = parser.parse_args()
    worlds = tuple(name for name in WORLDS if any(name.startswith(word) for word in given.worlds.split(",")))
    names = named(given.districts)
    settings = {
        "seed": given.seed, "constants_spread": given.constants_spread, "draws": not given.no_draws,
        "choice": not given.no_choice,
    }  # fmt: skip
    lines = read_runs(given.out, settings)
    lines = [line for line in lines if line["district"] in names and line["world"] in worlds]
    done = {(line["district"], line["world"], line["repetition"]) for line in lines}
    for name in names:
        missing = [
            (w, turn) for w in worlds for turn in range(given.repetitions) if (name, w, turn) not in done
        ]
        started = time.process_time()
        try:
            made = make(name, given.folder, tuple(dict.fromkeys(world for world, _ in missing)))
        except InputError as error:
            # Some districts draw a carrier that ITU-R P.2040-3 does not cover for their materials.
            print(f"{name}: cannot be made; {error}", file=sys.stderr)
            continue
        print(f"{name}: {time.process_time() - started:.0f} s of CPU to make its worlds", file=sys.stderr)
        for world, turn in missing:
            line = repetition(
                made[world], 1000 * given.seed + turn, given.constants_spread,
                draws=settings["draws"], choice=settings["choice"],
            )  # fmt: skip
            lines.append(line | settings | {"district": name, "world": world, "repetition": turn})
            append_run(given.out, lines[-1])
    shown = [line | line.get(OWN_PATHS, {}) for line in lines] if given.own_paths else lines
    print(render(table(shown)))


if __name__ == "__main__":
    main()
