"""The one loop (paper Fig. 1): ask for candidates, run the engine, compare with the measurements, tell."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from calibray import engines, optimizers
from calibray.engines import Differentiable, Engine, Recorded
from calibray.errors import InputError
from calibray.files import check_folder
from calibray.inference.likelihood import Interval, LogDistance, Objective, intervals, make_objective
from calibray.measurements import Measurements
from calibray.optimizers import METHODS, Optimizer
from calibray.parameters import Parameters
from calibray.result import Result, by_group
from calibray.spelling import did_you_mean
from calibray.study import Study

AUTO: Final = "auto"
STARTS: Final = (16, 512)  # local searches on the largest and on small programs
START_INTERACTIONS: Final = 15_000_000  # local searches times interactions between the two

Progress = Callable[[str, int, int | None], None]
"""Called with what is done, how much of it, and out of how much (None if unknown)."""


def calibrate(
    study: Study,
    method: str | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    *,
    engine: Engine | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Result:
    """Calibrate a scene's materials against measurements.

    Args:
        study: The study.
        method: Method in place of the study's: "auto", "sgwo-im", "gwo", ...
        seed: Seed in place of the study's.
        out: Folder to save the result in; checked before anything is computed. The ledger of RT calls lies there,
            and a run that was killed repeats none of them when it is started again.
        engine: Engine to run on, over all links of the study; made from the study, with a ledger, if None.
        executor: What runs the calls of a batch on the engine "command".
        progress: Called as the work goes on.

    Returns:
        The result.

    Raises:
        InputError: Something in the study, the method or the folder cannot be used.
        EngineError: The engine failed.
    """
    study = study.replace(method=method, seed=seed)
    check_method(study.method.name)
    if out is not None:
        check_folder(out)
    started = time.perf_counter()
    links = study.measurements()
    study.split(links)  # refuses a hold-out that leaves nothing, before anything is traced
    if engine is None:
        ledger = None if out is None else Path(out) / engines.LEDGER_FILE
        engine = engines.make(study, None, _stage(progress, "tracing"), ledger, executor)
    problem = Problem.of(study, links, engine)
    traced = time.perf_counter()
    run = search(problem, _optimizer(problem), progress)
    problem, run, gap = settle(problem, run, progress)
    result = _result(problem, run, gap, time.perf_counter() - traced, traced - started)
    if out is not None:
        result.save(out)
    return result


def check_method(name: str) -> None:
    """Refuse a method that does not exist.

    Args:
        name: The method.

    Raises:
        InputError: There is no such method.
    """
    known = (AUTO, *METHODS)
    if name not in known:
        raise InputError(f"method {name!r}: there is no such method; {did_you_mean(name, known)}")


@dataclass(frozen=True)
class Problem:
    """A study ready to be solved.

    Attributes:
        study: The study.
        links: All its links.
        engine: The engine over all links.
        objective: What is minimized.
        held_out: Which links are held out [L].
        before: Path loss with the materials before calibration [L], [dB].
    """

    study: Study
    links: Measurements
    engine: Engine
    objective: Objective
    held_out: np.ndarray
    before: np.ndarray

    @classmethod
    def of(cls, study: Study, links: Measurements, engine: Engine) -> Problem:
        """Set up a study's problem; runs the engine once, on the values before calibration.

        Args:
            study: The study.
            links: All its links.
            engine: The engine over all links.

        Returns:
            The problem.

        Raises:
            InputError: No link is left to calibrate on, or none of a group of which links are held out.
        """
        held_out = links.where(study.holdout.where) if study.holdout else np.zeros(len(links), dtype=bool)
        before = engine.path_loss(engine.parameters.start[None])[0]
        objective = make_objective(
            links,
            np.isfinite(before),
            ~held_out,
            offset=study.offset is not None,
            bounds=study.offset.bounds if study.offset else None,
            ceiling_db=study.objective.ceiling_db,
        )
        _check_groups(links, objective, held_out & np.isfinite(before))
        return cls(study, links, engine, objective, held_out, before)


def _check_groups(links: Measurements, objective: Objective, judged: np.ndarray) -> None:
    """Refuse links held out whose offset no link to calibrate on could tell."""
    if objective.num_groups:
        unknown = np.setdiff1d(objective.group[judged], objective.group[objective.weight > 0])
        if len(unknown):
            raise InputError(
                f"{links.source}: group {links.group_names[unknown[0]]!r} is held out but has no link to "
                "calibrate its offset on; change [holdout] or [offset]"
            )


@dataclass
class Run:
    """What a search has seen: every RT call in order, the path loss at the best candidate, and the engine's count."""

    candidates: list[np.ndarray] = field(default_factory=list)
    rmse_db: list[float] = field(default_factory=list)
    iteration: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    best: np.ndarray = field(default_factory=lambda: np.zeros(0))
    best_loss: np.ndarray = field(default_factory=lambda: np.zeros(0))
    best_rmse_db: float = np.inf
    rt_calls: int = 0
    ledger_hits: int = 0

    def add(
        self, candidates: np.ndarray, loss: np.ndarray, rmse_db: np.ndarray, iteration: int, now: float
    ) -> None:
        """Record one batch of RT calls."""
        self.candidates += list(candidates)
        self.rmse_db += rmse_db.tolist()
        self.iteration += [iteration] * len(rmse_db)
        self.seconds += [now] * len(rmse_db)
        leader = int(np.argmin(rmse_db))
        if rmse_db[leader] < self.best_rmse_db:
            self.best, self.best_loss = candidates[leader], loss[leader]
            self.best_rmse_db = float(rmse_db[leader])

    def history(self) -> pd.DataFrame:
        """One row per RT call."""
        return pd.DataFrame(
            {
                "call": np.arange(1, len(self.rmse_db) + 1),
                "iteration": self.iteration,
                "rmse_db": self.rmse_db,
                "best_db": np.minimum.accumulate(self.rmse_db),
                "seconds": self.seconds,
            }
        )


def search(problem: Problem, optimizer: Optimizer, progress: Progress | None = None) -> Run:
    """Run an optimizer on a problem until it is done.

    Args:
        problem: The problem.
        optimizer: The optimizer, over the search space of `problem`'s parameters (`to_search`).
        progress: Called after every batch.

    Returns:
        What it saw.

    Raises:
        InputError: No candidate could be evaluated.
    """
    engine, objective, parameters, run = problem.engine, problem.objective, problem.engine.parameters, Run()
    derivatives = optimizer.needs_derivatives() and isinstance(engine, Differentiable)
    started, iteration, calls, hits = time.perf_counter(), 0, engine.calls, _hits(engine)
    # Matrices of surrogates are small: threads of the linear algebra cost more there than they give.
    with threadpool_limits(1, user_api="blas"):
        while not optimizer.done:
            points = optimizer.ask()
            candidates = from_search(parameters, points)
            iteration += 1
            if derivatives:
                loss, slope = engine.path_loss_and_jacobian(candidates)
                jacobian = objective.jacobian(loss, slope * search_slope(parameters, candidates)[:, None, :])
            else:
                loss, jacobian = engine.path_loss(candidates), None
            residuals = objective.residuals(loss)
            rmse = objective.rmse(loss)
            optimizer.tell(points, rmse, residuals=residuals, jacobian=jacobian)
            run.add(candidates, loss, rmse, iteration, time.perf_counter() - started)
            if progress is not None:
                progress("calibrating", len(run.rmse_db), optimizer.budget)
    run.ledger_hits = _hits(engine) - hits
    # What the ledger answered was paid for before, so that a run ends alike however often it was started again.
    run.rt_calls = engine.calls - calls + run.ledger_hits
    if not np.isfinite(run.best_rmse_db):
        raise InputError(
            "every candidate lost the path of some link; exclude those links or use no_path = 'censor'"
        )
    return run


def settle(
    problem: Problem, run: Run, progress: Progress | None = None
) -> tuple[Problem, Run, np.ndarray | None]:
    """Trace again with the materials found, and calibrate again while that changes the path loss too much.

    Refraction and diffuse reflection are sampled by the materials of the trace, so the set of paths can change with
    them. Where a trace follows neither, there is nothing to check. Only `auto` calibrates again: the other methods
    have a budget of RT calls to keep to.

    Args:
        problem: The problem.
        run: Its first search.
        progress: Called as the work goes on.

    Returns:
        The problem on the last trace calibrated on, its search, and the gap of every link, path loss on paths traced
        with the materials found minus path loss on those calibrated on [L], [dB]; None where nothing was checked.
    """
    study, engine = problem.study, problem.engine
    sampled = study.trace.refraction or study.trace.diffuse_reflection
    if not sampled or not study.fidelity.rounds or not isinstance(engine, Differentiable):
        return problem, run, None
    for turn in range(study.fidelity.rounds):
        scene = engines.make_scene(study, engine.parameters.materials(run.best, engine.materials))
        paths = engines.traced_paths(study, scene, problem.links, _stage(progress, "checking"))
        paths = engines.compressed_paths(study, paths, engine.parameters)
        again = engines.make_replay(study, paths, problem.links, engine.parameters)
        gap = _gap(again.path_loss(run.best[None])[0], run.best_loss)
        objective = problem.objective
        settled = np.abs(gap[objective.weight > 0]).max() <= study.fidelity.tolerance_db
        if settled or study.method.name != AUTO or turn == study.fidelity.rounds - 1:
            break
        if objective.ceiling_db is None:  # a link that the new trace does not reach is left out from here on
            objective = replace(objective, weight=np.where(np.isfinite(gap), objective.weight, 0.0))
        moved = replace(problem, engine=again, objective=objective)
        run, problem = search(moved, _optimizer(moved), progress), moved
    return problem, run, gap


def _gap(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Difference of path losses; 0 where neither has a path, infinite where one has none."""
    lost = np.isinf(after) & np.isinf(before)
    return np.where(lost, 0.0, after - np.where(lost, 0.0, before))


def _largest(gap: np.ndarray | None, counted: np.ndarray) -> float | None:
    """Largest gap of the links that count and have a path on both traces."""
    if gap is None:
        return None
    return float(np.abs(gap[counted & np.isfinite(gap)]).max(initial=0.0))


def _hits(engine: Engine) -> int:
    return engine.hits if isinstance(engine, Recorded) else 0


def to_search(parameters: Parameters, values: np.ndarray) -> np.ndarray:
    """Candidates [..., d] as the optimizers see them: the logarithm of what is searched on a logarithmic scale.

    Others keep their physical unit, as in the paper.
    """
    return np.where(parameters.logarithmic, np.log(np.where(parameters.logarithmic, values, 1.0)), values)


def from_search(parameters: Parameters, points: np.ndarray) -> np.ndarray:
    """Candidates [..., d] in the fields' units from points of the search space, never beyond the bounds."""
    values = np.where(parameters.logarithmic, np.exp(np.where(parameters.logarithmic, points, 0.0)), points)
    return np.clip(values, parameters.lower, parameters.upper)


def search_slope(parameters: Parameters, candidates: np.ndarray) -> np.ndarray:
    """Derivative of the fields' units by the search coordinate [..., d]."""
    return np.where(parameters.logarithmic, candidates, 1.0)


def local_searches(interactions: int) -> int:
    """Starting points of a method that takes them, on paths where they cost what they may.

    Args:
        interactions: Interactions that a candidate is evaluated at.

    Returns:
        Their number.
    """
    return int(np.clip(START_INTERACTIONS // max(interactions, 1), *STARTS))


def _optimizer(problem: Problem) -> Optimizer:
    section, parameters = problem.study.method, problem.engine.parameters
    replay, name = isinstance(problem.engine, Differentiable), section.name
    if name == AUTO:
        name = "least-squares" if replay else "vector-surrogate"
    if METHODS[name].needs_derivatives() and not replay:
        raise InputError(f"method {name!r} needs derivatives, which only the replay engine gives")
    start, lower, upper = (
        to_search(parameters, values) for values in (parameters.start, parameters.lower, parameters.upper)
    )
    starts = local_searches(problem.engine.interactions) if replay else None
    return optimizers.make(
        name, lower, upper, section.seed, start=start, starts=starts, options=section.options
    )


def _result(
    problem: Problem, run: Run, gap: np.ndarray | None, seconds: float, trace_seconds: float
) -> Result:
    study, links, engine, objective = problem.study, problem.links, problem.engine, problem.objective
    names = engine.parameters.names
    before, best, counted = problem.before, run.best_loss, objective.weight > 0
    reached = np.isfinite(before) & np.isfinite(best)
    judged = problem.held_out & (reached | (objective.ceiling_db is not None))
    offsets = objective.offsets(best[None])[0] if objective.num_groups else np.zeros(0)
    offset_only, after = objective.model(np.stack([before, best]))
    rival = _log_distance(links, objective.weight, study.scene.frequency)

    def rmse(model: np.ndarray, mask: np.ndarray) -> float | None:
        if not mask.any():
            return None
        return float(np.sqrt(np.average((model - links.path_loss_db)[mask] ** 2, weights=links.weight[mask])))

    table = pd.DataFrame(
        {
            "row": links.row,
            "measured_db": links.path_loss_db,
            "before_db": before,
            "after_db": best + (offsets[objective.group] if objective.num_groups else 0.0),
            "log_distance_db": rival,
            "has_path": reached,
            "held_out": problem.held_out,
            "retrace_gap_db": np.nan if gap is None else gap,
        }
    )
    return Result(
        study=study,
        parameters=by_group(names, run.best),
        initial_parameters=by_group(names, engine.parameters.start),
        intervals=_intervals(problem, run.best),
        materials=engine.parameters.materials(run.best, engine.materials),
        offsets_db={links.group_names[k]: float(offsets[k]) for k in np.unique(objective.group[counted])}
        if objective.num_groups
        else {},
        rmse_db=run.best_rmse_db,
        initial_rmse_db=rmse(objective.capped(before), counted),
        offset_only_rmse_db=rmse(offset_only, counted) if objective.num_groups else None,
        holdout_rmse_db=rmse(after, judged),
        initial_holdout_rmse_db=rmse(objective.capped(before), judged),
        offset_only_holdout_rmse_db=rmse(offset_only, judged) if objective.num_groups else None,
        log_distance_rmse_db=rmse(rival, counted),
        log_distance_holdout_rmse_db=rmse(rival, judged),
        retrace_gap_db=_largest(gap, counted),
        rt_calls=run.rt_calls,
        ledger_hits=run.ledger_hits,
        seconds=seconds,
        trace_seconds=trace_seconds,
        links=table,
        history=run.history(),
        laws=engine.parameters.law(run.best),
    )


def _log_distance(links: Measurements, weight: np.ndarray, frequency: float) -> np.ndarray:
    """Path loss [L], [dB] of the log-distance model fitted to links; over carriers it rises as in free space."""
    rise = 0.0 if links.frequency is None else 20 * np.log10(links.frequency / frequency)
    model = LogDistance.fit(links.distance, links.path_loss_db - rise, weight)
    return model.path_loss(links.distance) + rise


def _intervals(problem: Problem, best: np.ndarray) -> dict[str, Interval]:
    """Intervals by parameter, taken in the search space: of what spans decades, the logarithm is what is uncertain."""
    if not isinstance(problem.engine, Differentiable):
        return {}
    parameters, objective = problem.engine.parameters, problem.objective
    loss, slope = problem.engine.path_loss_and_jacobian(best[None])
    unit = search_slope(parameters, best)
    found = intervals(
        to_search(parameters, best),
        objective.residuals(loss)[0],
        objective.jacobian(loss, slope * unit)[0],
        to_search(parameters, parameters.lower),
        to_search(parameters, parameters.upper),
        objective.num_groups,
    )
    lower, upper = (
        from_search(parameters, np.array(ends))
        for ends in zip(*((each.lower, each.upper) for each in found), strict=True)
    )
    return {
        name: Interval(each.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), each.verdict)
        for k, (name, each) in enumerate(zip(parameters.names, found, strict=True))
    }


def _stage(progress: Progress | None, name: str) -> engines.Progress | None:
    return None if progress is None else lambda done, total: progress(name, done, total)
