"""Predictions for links without a path: the log-distance model, marked, with its own interval."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.prediction.nuisance_shift import model_terms, nuisance_shift
from calibray.result.held_out import NO_PATH
from calibray.result.record import Prediction
from calibray.study.model import StudyModel
from calibray.validation.baselines import without_scene
from calibray.validation.held_out_statistics import interval_half_width


def fill_missing(
    prediction: Prediction,
    study: StudyModel,
    links: Measurements,
    table: pd.DataFrame,
    level: float | None = None,
    least_db: NDArray[np.float64] | float = 0.0,
) -> pd.DataFrame:
    """Use the fallback to predict the links without a path.

    Args:
        prediction: The prediction model and its fallback.
        study: The study.
        links: The links.
        table: Their predictions: path_loss_db, infinite without a path, basis and, with a level, lower_db and upper_db.
        level: Probability that the interval contains a measurement; None for no interval.
        least_db: Half the width of the prediction model's interval [links], [dB]; the fallback's interval is at least
            as wide.

    Returns:
        The table, with the fallback's predictions for links without a path; unchanged if there are none.
    """
    missing = ~np.isfinite(table["path_loss_db"].to_numpy(float))
    if not missing.any():
        return table
    model, filled = prediction.fallback, table.copy()
    if model is None:
        filled.loc[missing, "basis"] = NO_PATH
        filled.loc[missing, [name for name in ("lower_db", "upper_db") if name in table]] = np.nan
        return filled
    at = links.select(missing)
    shift = nuisance_shift(model_terms(model, at), at, new_groups=True)
    path_loss_db = without_scene(study, at) + shift.value_db[0]
    filled.loc[missing, "path_loss_db"] = path_loss_db
    filled.loc[missing, "basis"] = f"{NO_PATH}: {model.name if level is None else model.basis}"
    if level is None:
        return filled
    half_width = np.broadcast_to(least_db, len(links))[missing]
    if model.residual_db:
        errors_db = interval_half_width(np.array(model.sizes_db), level)
        half_width = np.maximum(half_width, errors_db * np.hypot(1.0, shift.spread_db / model.residual_db))
    filled.loc[missing, "lower_db"] = path_loss_db - half_width
    filled.loc[missing, "upper_db"] = path_loss_db + half_width
    return filled
