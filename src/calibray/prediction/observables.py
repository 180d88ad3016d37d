"""Further observables of new links, with intervals for a measurement on these links."""

from __future__ import annotations

from typing import Final, NamedTuple, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray.engines.protocol import Engine, Observing
from calibray.measurements import Measurements
from calibray.measurements.observables import (
    ARRIVAL_SPREAD,
    DELAY_SPREAD,
    DEPARTURE_SPREAD,
    EXCESS_DELAY,
    K_FACTOR,
    KINDS,
    Statistic,
)
from calibray.result.record import Record
from calibray.study import Study
from calibray.study.mounting import PORT_POWER, states_port_power
from calibray.uncertainty.draws import evenly_spaced

MOST_DRAWS: Final = 64
"""Maximum number of posterior draws from which the width of an interval and the errors of biases are computed. A
standard deviation estimated from 64 draws has a relative error of 9 %."""


class Replayed(NamedTuple):
    """An engine for new links, with parameter values [1 + draws, d]: those of the prediction model, then every draw.

    If path loss is averaged over two sets of values, both sets precede the draws, and `averaged` is 2. `answers`
    [averaged, links], [dB], is the path loss that an external program returns for the values before the draws.
    """

    engine: Engine
    values: NDArray[np.float64]
    averaged: int = 1
    answers: NDArray[np.float64] | None = None


def observable_columns(study: Study, level: float | None) -> tuple[str, ...]:
    """Names of the columns for further observables, such as spread_ns, spread_lower_ns and spread_upper_ns.

    Without a level, there are no columns for the interval.
    """
    ends = ("",) if level is None else ("", "_lower", "_upper")
    return tuple(f"{name}{end}_{section.unit}" for name, section in study.observables.items() for end in ends)


def further_observables(
    result: Record, replayed: Replayed | None, level: float | None = None
) -> dict[str, NDArray[np.float64]]:
    """Predict further observables [links], by column name, for the links of an opened study, without device biases.

    The interval combines two parts: the errors of individual values, taken from held-out links if there are any, and
    the scatter of the draws. The result is empty if the study has no further observables, or if the prediction model
    uses no scene.
    """
    sections = result.study.observables
    if not sections or replayed is None or not isinstance(replayed.engine, Observing):
        return {}
    best, draws = replayed.values[:1], replayed.values[replayed.averaged :]
    draws = draws if level is not None else draws[:0]
    draws = draws[evenly_spaced(len(draws), MOST_DRAWS)]
    statistics = tuple(section.statistic for section in sections.values())
    answers = replayed.engine.respond(np.vstack([best, draws]), statistics).observed
    columns: list[NDArray[np.float64]] = []
    for index, (name, section) in enumerate(sections.items()):
        value, drawn = answers[0, index] / section.scale, answers[1:, index] / section.scale
        columns.append(value)
        if level is None:
            continue
        deviation = np.nan_to_num(drawn - value)
        variance = np.mean(deviation**2, axis=0) if len(drawn) else 0.0
        fit, held_out = result.fit.observables[name], result.accuracy.observables.get(name)
        error, freedom = fit.error, max(fit.links - len(fit.biases), 1)
        if held_out is not None:
            error, freedom = held_out.rmse, held_out.links
        half_width = float(stdtrit(freedom, (1 + level) / 2)) * np.sqrt(error**2 + variance)
        columns += [value - half_width, value + half_width]
    return dict(zip(observable_columns(result.study, level), columns, strict=True))


CHOICES: Final = (DELAY_SPREAD, EXCESS_DELAY, K_FACTOR, DEPARTURE_SPREAD, ARRIVAL_SPREAD)
"""Observables that depend on the materials and have no device bias."""

RELATIVE_ERROR: Final = 0.1
"""Expected error of a spread or an excess delay that the study does not measure, relative to the RMS of its values. In
downtown Boulder, rotating the receiving array changes delay spreads by 3 % on line-of-sight links and by 15 % on other
links."""

ERROR_DB: Final = 1.0
"""Expected error of a K-factor that the study does not measure [dB]."""


class Worth(NamedTuple):
    """The most informative observable at a suggested link, assuming that the links ranked above it are also measured.

    `narrowed` [d] is the expected standard deviation of every parameter, relative to that with path loss alone.
    """

    kind: str
    narrowed: NDArray[np.float64]


def worth_measuring(
    result: Record,
    engine: Observing,
    draws: tuple[NDArray[np.float64], NDArray[np.float64]],
    index: NDArray[np.int64],
    information: NDArray[np.float64],
) -> list[Worth]:
    """Find the most informative observable [suggestions] at every suggested link; the best link comes first.

    `draws` contains draws of the parameters and their derivatives with respect to the coordinates of the unit cube,
    both of shape [n, d]. Each matrix in `information` [suggestions, n, d, d] includes the path loss of a suggestion and
    of those ranked above it.
    """
    own = {section.kind: (name, section) for name, section in result.study.observables.items()}
    statistics = tuple(own[kind][1].statistic if kind in own else Statistic(kind) for kind in CHOICES)
    values, unit_slope = draws
    answer = engine.respond(values, statistics, derivatives=True)
    modelled, jacobian = answer.observed[:, :, index], cast(NDArray, answer.observed_slope)[:, :, index]
    best: list[Worth] = []
    before = _deviation(information)
    for column, kind in enumerate(CHOICES):
        finite = modelled[:, column][np.isfinite(modelled[:, column])]
        if not len(finite):
            continue
        error = ERROR_DB if KINDS[kind] == "dB" else RELATIVE_ERROR * float(np.sqrt(np.mean(finite**2)))
        if kind in own:
            name, section = own[kind]
            error = result.fit.observables[name].error * section.scale
        slope = np.nan_to_num(jacobian[:, column]) * unit_slope[:, None, :] / max(error, 1e-300)
        # Each suggestion is measured in addition to the suggestions ranked above it.
        added = np.cumsum(np.einsum("nli,nlj->lnij", slope, slope), axis=0)
        narrowed = np.mean(_deviation(information + added) / before, axis=1)
        for number, ratio in enumerate(narrowed):
            if len(best) <= number:
                best.append(Worth(kind, ratio))
            elif np.log(ratio).sum() < np.log(best[number].narrowed).sum():
                best[number] = Worth(kind, ratio)
    return best


def _deviation(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of every parameter [..., d]."""
    return np.sqrt(np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1))


def as_measured(study: Study, links: Measurements, table: pd.DataFrame) -> dict[str, NDArray[np.float64]]:
    """Convert predicted path loss and its interval to the quantity that the study measures, by column name.

    The measured quantity is path gain [dB], received power [dBm] or RSRP [dBm]. Column names are, for example,
    `received_power_dbm`, `received_power_lower_dbm` and `received_power_upper_dbm` [links]. The result is empty if path
    loss itself was measured, or if the transmitted power of the links is unknown.
    """
    quantity = study.links.quantity
    reference = _reference_level(study, links)
    if reference is None:
        return {}
    unit = "db" if quantity == "path_gain" else "dbm"
    # The upper end of the path-loss interval is the lower end of the power interval.
    ends = {"path_loss_db": "", "upper_db": "_lower", "lower_db": "_upper"}
    return {
        f"{quantity}{end}_{unit}": reference - table[name].to_numpy(float)
        for name, end in ends.items()
        if name in table
    }


def _reference_level(study: Study, links: Measurements) -> NDArray[np.float64] | None:
    """The level [links], [dBm] or [dB], from which path loss is subtracted; None if this level is unknown."""
    section = study.links
    if section.quantity == "path_loss":
        return None
    if section.quantity != "received_power":
        # Path gain is 0 dB minus path loss. For RSRP, the transmitted power is part of the offset.
        return np.zeros(len(links))
    power = PORT_POWER if states_port_power(study) else section.tx_power_dbm
    if isinstance(power, str):
        return links.table.numbers(power) if power in links.frame else None
    return None if power is None else np.full(len(links), float(power))
