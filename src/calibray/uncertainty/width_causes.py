"""What makes an interval wide: the share of its width that remains if one cause is ruled out.

Draws without a cause, for example those with equal buildings, follow the posterior of a study that rules it out.
Constants that the scene fixes are ruled out by a linear regression of the parameter on them. The remaining share is an
upper bound, because the parameter may not depend linearly on them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.result.verdict import Cause
from calibray.uncertainty.joint_model import JointModel
from calibray.uncertainty.noise_models import CORRELATED, HEAVY, OUT_OF_SIGHT
from calibray.uncertainty.sequential_monte_carlo import Posterior

FEWEST: Final = 30
"""Number of effective draws below which a standard deviation, then uncertain by 13 %, is not compared."""

NOTABLE: Final = 0.85
"""Largest share that is reported: the uncertainty of a standard deviation from `FEWEST` draws."""


def remaining_widths(model: JointModel, posterior: Posterior) -> list[dict[Cause, float]]:
    """By parameter of the study, the shares of its interval's width that remain without each cause.

    Only causes that make it noticeably wide are listed, with the smallest share first.
    """
    draws, width = posterior.means, len(model.study)
    models = [model.marginal.models[index] for index in posterior.model]
    present = {
        Cause.BUILDINGS: posterior.spread > 0,
        Cause.CORRELATION: np.array([each.kind == CORRELATED for each in models]),
        Cause.MISSING_PATHS: np.array([each.kind == OUT_OF_SIGHT for each in models]),
        Cause.HEAVY_TAILS: np.array([each.kind == HEAVY for each in models]),
        Cause.OFFSET: np.array([each.offset for each in models]),
    }
    shares: list[dict[Cause, float]] = [{} for _ in range(width)]
    full = _deviation(draws.point, draws.weight)
    for cause, mask in present.items():
        without = np.where(mask, 0.0, draws.weight)
        if mask.any() and _effective(without) >= FEWEST:
            _note(shares, cause, _deviation(draws.point, without) / full)
    constants = posterior.joint[:, width:]
    if constants.shape[1] and _effective(draws.weight) >= FEWEST + constants.shape[1]:
        root = np.sqrt(draws.weight)[:, None]
        design = np.hstack([np.ones((len(constants), 1)), constants]) * root
        fitted = design @ np.linalg.lstsq(design, draws.point * root, rcond=None)[0]
        left = np.sqrt(np.sum((draws.point * root - fitted) ** 2, axis=0))
        _note(shares, Cause.CONSTANTS, left / full)
    return [dict(sorted(each.items(), key=lambda entry: entry[1])) for each in shares]


def _note(shares: list[dict[Cause, float]], cause: Cause, share: NDArray[np.float64]) -> None:
    for noted, left in zip(shares, share.tolist(), strict=True):
        if left <= NOTABLE:
            noted[cause] = left


def _deviation(point: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = weight / weight.sum()
    return np.sqrt(np.maximum(weight @ (point - weight @ point) ** 2, 1e-300))


def _effective(weight: NDArray[np.float64]) -> float:
    return float(weight.sum() ** 2 / max(float(weight @ weight), 1e-300))
