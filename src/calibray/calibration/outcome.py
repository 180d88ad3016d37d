"""From a finished search to its result: accuracy beside its rivals, intervals, and a row for every link."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.calibration.problem import Problem
from calibray.calibration.search import Trail
from calibray.calibration.settle import largest
from calibray.engines.kinds.replay import ReplaySection
from calibray.engines.replay import Replay
from calibray.inference.intervals import Interval, intervals
from calibray.inference.rivals import log_distance
from calibray.measurements import Measurements
from calibray.paths import Paths
from calibray.result import Result
from calibray.study import Study
from calibray.tracing.enclosed import Enclosed


def outcome(
    problem: Problem,
    trail: Trail,
    gap: NDArray[np.float64] | None,
    enclosed: Enclosed | None,
    seconds: float,
    trace_seconds: float,
) -> Result:
    """What a calibration found.

    Args:
        problem: The problem, on the last trace calibrated on.
        trail: Its search.
        gap: Change of every link's path loss on tracing again [L], [dB]; None where nothing was checked.
        enclosed: Antennas inside closed bodies; None where nothing was looked for.
        seconds: Time that the method took [s].
        trace_seconds: Time that tracing and loading took before [s].

    Returns:
        The result.
    """
    setup, objective, parameters = problem.setup, problem.objective, problem.parameters
    study, links, held_out = setup.study, setup.links, setup.held_out
    before, best, counted = problem.before, trail.best_modelled, objective.weight > 0
    reached = np.isfinite(before) & np.isfinite(best)
    judged = held_out & (reached | (objective.ceiling_db is not None))
    offsets, fitted = objective.coefficients(best[None]), bool(objective.nuisance.terms)
    offset_only, after = objective.model(np.stack([before, best]))
    rival = log_distance(links, objective.measured, objective.weight, study.scene.frequency)

    def rmse(model: NDArray[np.float64], mask: NDArray[np.bool_]) -> float:
        return float(np.sqrt(np.average((model - objective.measured)[mask] ** 2, weights=links.weight[mask])))

    def held_out_rmse(model: NDArray[np.float64]) -> float | None:
        return rmse(model, judged) if judged.any() else None

    table = pd.DataFrame(
        {
            "row": links.row,
            "measured_db": objective.measured,
            "before_db": before,
            "after_db": best + objective.nuisance.contribution(offsets)[0],
            "log_distance_db": rival,
            "has_path": reached,
            "held_out": held_out,
            "retrace_gap_db": np.nan if gap is None else gap,
            **_places(links),
            **({"offset_only_db": offset_only} if fitted else {}),
        }
    )
    table = table.assign(**_as_measured(study, links, table))
    return Result(
        study=study,
        parameters=parameters.named(trail.best),
        initial_parameters=parameters.named(parameters.start),
        intervals=_intervals(problem, trail.best),
        materials=parameters.materials(trail.best, problem.engine.materials),
        offsets_db={links.group_names[k]: float(offsets[0, k]) for k in np.flatnonzero(objective.determined)},
        groups_without_path=tuple(links.group_names[k] for k in np.flatnonzero(~objective.determined)),
        rmse_db=trail.best_rmse_db,
        initial_rmse_db=rmse(objective.capped(before), counted),
        offset_only_rmse_db=rmse(offset_only, counted) if fitted else None,
        holdout_rmse_db=held_out_rmse(after),
        initial_holdout_rmse_db=held_out_rmse(objective.capped(before)),
        offset_only_holdout_rmse_db=held_out_rmse(offset_only) if fitted else None,
        log_distance_rmse_db=rmse(rival, counted),
        log_distance_holdout_rmse_db=held_out_rmse(rival),
        retrace_gap_db=largest(gap, counted),
        rt_calls=trail.rt_calls,
        ledger_hits=trail.ledger_hits,
        seconds=seconds,
        trace_seconds=trace_seconds,
        links=table,
        history=trail.history(),
        laws=parameters.law(trail.best),
        enclosed=enclosed,
        scene=setup.scene,
        files=setup.files,
        paths=_traced(problem),
        prepared=links.prepared,
    )


def _places(links: Measurements) -> dict[str, NDArray[Any]]:
    """Where the links' ends stand, and what sets them apart: columns of a table of links."""
    ends = {
        f"{end}_{axis}": position[:, k]
        for end, position in (("tx", links.tx), ("rx", links.rx))
        for k, axis in enumerate("xyz")
    }
    group = {} if links.group is None else {"group": links.group}
    carrier = {} if links.frequency is None else {"frequency": links.frequency}
    return ends | group | carrier


def _as_measured(study: Study, links: Measurements, table: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Path gain or received power, with the sign it was measured with; nothing where that is path loss."""
    quantity, column = study.links.quantity, study.links.value
    if quantity == "path_loss" or column not in links.frame:
        return {}
    # Path gain is 0 dB less path loss, received power the transmitted power less it.
    start = links.frame[column].to_numpy(float) + links.path_loss_db
    unit = "dbm" if quantity == "received_power" else "db"
    return {
        f"{when}_{quantity}_{unit}": start - table[f"{when}_db"].to_numpy()
        for when in ("measured", "before", "after")
    }


def _traced(problem: Problem) -> Paths | None:
    """The paths calibrated on, where they are at hand as they were traced."""
    section = problem.setup.study.engine
    whole = isinstance(section, ReplaySection) and section.compress_db is None
    return problem.engine.paths if whole and isinstance(problem.engine, Replay) else None


def _intervals(problem: Problem, best: NDArray[np.float64]) -> dict[str, Interval]:
    """Intervals by parameter, taken in the search space: of what spans decades, the logarithm is what is uncertain."""
    if not problem.differentiable:
        return {}
    parameters, objective = problem.parameters, problem.objective
    point = parameters.to_search(best)
    told = problem.evaluate(point[None], derivatives=True)
    if told.jacobian is None:
        return {}
    nuisances = int(objective.determined.sum())
    found = intervals(point, told.residuals[0], told.jacobian[0], *parameters.search_bounds, nuisances)
    lower, upper = (
        parameters.from_search(np.array(ends))
        for ends in zip(*((each.lower, each.upper) for each in found), strict=True)
    )
    unit = parameters.search_slope(best)
    return {
        name: Interval(each.standard_error * float(unit[k]), float(lower[k]), float(upper[k]), each.verdict)
        for k, (name, each) in enumerate(zip(parameters.names, found, strict=True))
    }
