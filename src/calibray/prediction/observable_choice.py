"""Which further observable is worth measuring at suggested links: the one that narrows the parameters most."""

from __future__ import annotations

from typing import Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Observing
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

CHOICES: Final = (DELAY_SPREAD, EXCESS_DELAY, K_FACTOR, DEPARTURE_SPREAD, ARRIVAL_SPREAD)
"""Observables that depend on materials without a bias of devices."""

RELATIVE_ERROR: Final = 0.1
"""Expected error of a spread or an excess delay that the study lacks, relative to its root mean square. In downtown
Boulder delay spreads vary by 3 % in sight and by 15 % out of sight when the receiving array turns."""

ERROR_DB: Final = 1.0
"""Expected error of a K-factor that the study lacks [dB]."""


class Worth(NamedTuple):
    """The observable worth measuring at a suggestion and those above it.

    Attributes:
        kind: The observable.
        narrowed: Expected standard deviation of every parameter, relative to that with path loss alone [d].
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
    """Compare the observables at suggested links.

    Args:
        result: The calibration.
        engine: The replay of the candidates.
        draws: Draws of the parameters, and their derivatives by the coordinates of the unit cube [n, d].
        index: The suggested candidates, the best first [suggestions].
        information: Information matrices with path loss of each suggestion and those above it [suggestions, n, d, d].

    Returns:
        The best observable of every suggestion.
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
