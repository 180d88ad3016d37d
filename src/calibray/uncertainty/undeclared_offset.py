"""An offset that a study forgot: tried beside every model that has none, and said aloud where it is not zero."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.problem import Problem
from calibray.fitting.search import BASINS, relevant_minima, rounds
from calibray.optimizers import LeastSquares
from calibray.result.remark import Remark, RemarkKind
from calibray.result.verdict import CONFIDENCE
from calibray.uncertainty.likelihood import has_offset

STARTS: Final = 16
"""New local searches beside those from the minima without it."""

NOTED_DB: Final = 0.1
"""Offset below which none is spoken of [dB]."""


@dataclass(frozen=True, eq=False)
class ForgottenOffset:
    """An offset for all links beside a study's model.

    Attributes:
        minima: Minima with it that may matter, the lowest first [k, d].
        offset_db: The offset that fits best [dB]; None where it was not tried, or changes nothing.
        error_db: Its standard error [dB].
        remarks: A warning where it is significantly not zero.
    """

    minima: NDArray[np.float64]
    offset_db: float | None = None
    error_db: float | None = None
    remarks: tuple[Remark, ...] = ()


def forgotten_offset(
    problem: Problem, known: NDArray[np.float64], square: float, freedom: int
) -> ForgottenOffset:
    """Try an offset for all links, where the study's model has no term of that kind.

    Args:
        problem: The problem.
        known: Its minima, the lowest first [k, d].
        square: Mean square of the residuals at the lowest [dB^2].
        freedom: Rows of the residuals less the unknowns.

    Returns:
        What it would be.
    """
    objective = problem.objective
    if has_offset(problem) or freedom < 2:
        return ForgottenOffset(np.zeros((0, len(problem.parameters))))
    term = make_term(problem.setup.links, "free offset")
    terms = (*objective.nuisance.terms, term)
    trial = replace(problem, objective=replace(objective, nuisance=Nuisance(len(objective.weight), terms)))
    search = LeastSquares(*problem.parameters.search_bounds, starts=STARTS, x0=known[:BASINS])
    for _ in rounds(search, trial.squares):
        pass
    told = trial.squares(search.minima)
    shifted = relevant_minima(search.minima, told.value**2, freedom - 1)
    best = int(np.argmin(told.value))
    offset = float(trial.objective.coefficients(trial.modelled(search.minima[best : best + 1]))[0, -1])
    left = float(told.value[best] ** 2)
    # F of one further column: the offset over its standard error, squared.
    ratio = (square - left) / left * (freedom - 1) if left > 0 else np.inf
    if not ratio > 0 or not np.isfinite(ratio):
        return ForgottenOffset(shifted)
    error = abs(offset) / float(np.sqrt(ratio))
    remarks: tuple[Remark, ...] = ()
    if ratio > fdtri(1, freedom - 1, CONFIDENCE) and abs(offset) >= NOTED_DB:
        rmse = {"rmse_db": float(np.sqrt(left)), "rmse_without_db": float(np.sqrt(square))}
        remarks = (
            Remark(RemarkKind.UNDECLARED_OFFSET, {"offset_db": offset, "error_db": float(error), **rmse}),
        )
    return ForgottenOffset(shifted, offset, error, remarks)
