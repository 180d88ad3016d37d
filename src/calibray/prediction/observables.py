"""Further observables at new links, and the interval of a measurement there."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray.engines.protocol import Engine, Observing
from calibray.result.record import Record
from calibray.study import Study

MOST_DRAWS: Final = 64
"""Most posterior draws for the width of an interval; the error of a standard deviation from them is 9 %."""


class Replayed(NamedTuple):
    """An engine over new links, with the values to evaluate.

    Attributes:
        engine: The engine.
        values: Values of the prediction model, then of every draw [1 + draws, d].
    """

    engine: Engine
    values: NDArray[np.float64]


def observable_columns(study: Study, level: float | None) -> tuple[str, ...]:
    """Names of the columns of further observables, such as spread_ns, spread_lower_ns and spread_upper_ns.

    Args:
        study: The study.
        level: Probability of an interval; None for values alone.

    Returns:
        The names; empty without further observables.
    """
    ends = ("",) if level is None else ("", "_lower", "_upper")
    return tuple(f"{name}{end}_{section.unit}" for name, section in study.observables.items() for end in ends)


def further_observables(
    result: Record, replayed: Replayed | None, level: float | None = None
) -> dict[str, NDArray[np.float64]]:
    """Further observables at opened links [links] by column name; without the biases of devices.

    The interval has two parts: the errors of single values, on held-out links where there are any, and the draws.

    Args:
        result: The calibration.
        replayed: The engine over the links; None if the prediction model uses no scene.
        level: Probability that an interval contains a measurement; None for values alone.

    Returns:
        The columns; empty without further observables, or without a scene.
    """
    sections = result.study.observables
    if not sections or replayed is None or not isinstance(replayed.engine, Observing):
        return {}
    best, draws = replayed.values[:1], replayed.values[1:] if level is not None else replayed.values[:0]
    draws = draws[np.linspace(0, len(draws) - 1, min(len(draws), MOST_DRAWS)).round().astype(int)]
    statistics = tuple(section.statistic for section in sections.values())
    found = replayed.engine.respond(np.vstack([best, draws]), statistics).observed
    columns: list[NDArray[np.float64]] = []
    for index, (name, section) in enumerate(sections.items()):
        value, drawn = found[0, index] / section.scale, found[1:, index] / section.scale
        columns.append(value)
        if level is None:
            continue
        deviation = np.nan_to_num(drawn - value)
        variance = np.mean(deviation**2, axis=0) if len(drawn) else 0.0
        fit, held_out = result.fit.observables[name], result.accuracy.observables.get(name)
        error, links = (fit.error, fit.links) if held_out is None else (held_out.rmse, held_out.links)
        half_width = float(stdtrit(links, (1 + level) / 2)) * np.sqrt(error**2 + variance)
        columns += [value - half_width, value + half_width]
    return dict(zip(observable_columns(result.study, level), columns, strict=True))
