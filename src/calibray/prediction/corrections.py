"""Corrections to the modelled path loss of new links: nuisance, residual field, and fallback for a missing path.

The nuisance is uncertain for groups without measurements. For a link without a path, the log-distance model provides
the path loss and the interval, and the prediction is marked.

The residual field is the spatially correlated part of the calibration residuals, kriged to nearby links. Clutter that
is missing from the scene affects neighbouring links in the same way, so the residual of a new link near a measured link
is partly known. The correlated part has an exponential covariance. The range and variance of this covariance maximize
the restricted likelihood (`uncertainty.residual_correlation.fit_correlation`). Far from all measured links, the kriged
field is zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from calibray.errors import InputError
from calibray.fitting.nuisance import UNKNOWN_DB, column, deviations_of, transmitters
from calibray.measurements import Measurements
from calibray.result.held_out import NEW_GROUP, NO_PATH, PredictionModel, ResidualField
from calibray.result.record import Prediction
from calibray.study.calibration_sections import OFFSET, TX_OFFSET
from calibray.study.model import StudyModel
from calibray.validation.held_out_statistics import interval_half_width
from calibray.validation.models import without_scene

MOST_EXACT: Final = 1000
"""Number of measured links up to which kriging uses all of them at every new link. If there are more, it uses only the
nearest."""

NEAREST: Final = 50
"""Number of nearest measured links from which kriging predicts each new link."""

TOGETHER: Final = 500
"""Number of new links for which the kriging equations are solved together; each link needs about 150 kB of memory."""


@dataclass(frozen=True, eq=False)
class TermAtLinks:
    """A fitted nuisance term, evaluated on new links.

    Attributes:
        name: Name of the term.
        column: Values in the term's column [links], minus the term's centre.
        labels: Labels of the links' groups [links]; None for a term without groups.
        coefficients: Coefficient by group, [dB] per unit of the column.
        spread_db: Standard deviation between groups, in the unit of the coefficients; if None, the standard deviation
            of the coefficients is used.
    """

    name: str
    column: NDArray[np.float64]
    labels: NDArray[np.str_] | None
    coefficients: dict[str, float]
    spread_db: float | None


class Shift(NamedTuple):
    """The contribution of the nuisance to path loss.

    Attributes:
        value_db: Contribution [1 + draws, links], [dB], with the best coefficients, followed by that with each draw.
        spread_db: Standard deviation of the contribution [links], [dB], if the link's group has no coefficient;
            otherwise 0.
    """

    value_db: NDArray[np.float64]
    spread_db: NDArray[np.float64]


def model_terms(model: PredictionModel, links: Measurements) -> Iterator[TermAtLinks]:
    """Evaluate the nuisance terms of the prediction model on new links.

    Yields:
        Each term with the values of its column and the groups of the links.

    Raises:
        InputError: The links lack a column.
    """
    for term in model.terms:
        # The name of the term determines the labels, because a column of the study may be called "transmitter" or
        # "offset".
        if not term.per:
            labels = None
        elif term.name == TX_OFFSET:
            labels = transmitters(links)
        else:
            labels = links.group if term.name == OFFSET else links.table.labels(term.per)
        values = column(links, term.by) - term.centre
        yield TermAtLinks(term.name, values, labels, term.coefficients, term.spread_db)


def nuisance_shift(
    terms: Iterator[TermAtLinks],
    links: Measurements,
    draws: Mapping[str, list[float]] | None = None,
    *,
    new_groups: bool = False,
) -> Shift:
    """Compute the contribution of nuisance terms to the path loss of new links.

    A group without a coefficient is assigned the mean of the n coefficients. For such a group, the standard deviation s
    between groups is enlarged by the uncertainty of the mean, to s sqrt(1 + 1 / n). With `new_groups`, groups without a
    coefficient are also allowed in terms without an estimated spread. New transmitters are always allowed, because no
    column identifies transmitters. `draws` contains posterior draws, keyed by coefficient name.

    Raises:
        InputError: A group has no coefficient although `new_groups` is False.
    """
    draws = draws or {}
    num_draws = len(next(iter(draws.values()), ()))
    value, variance = np.zeros((1 + num_draws, len(links))), np.zeros(len(links))
    for term in terms:
        best = np.array(list(term.coefficients.values()))
        columns = []
        for label, coefficient in term.coefficients.items():
            # The draws of a random effect consist of a mean and the deviations of the groups from this mean.
            effect = (term.name, f"{deviations_of(term.name)}[{label}]")
            names = (f"{term.name}[{label}]" if label else term.name,) if term.spread_db is None else effect
            drawn = np.full(num_draws, coefficient)
            if draws.keys() >= set(names):
                drawn = np.sum([draws[name] for name in names], axis=0)
            columns.append(np.append(coefficient, drawn))
        coefficients = np.stack(columns, axis=1)
        labels = np.full(len(links), "") if term.labels is None else term.labels
        position = {label: index for index, label in enumerate(term.coefficients)}
        group = np.array([position.get(str(label), -1) for label in labels])
        if (group < 0).any() and term.spread_db is None and not new_groups and term.name != TX_OFFSET:
            new_label = str(labels[int(np.argmax(group < 0))])
            raise InputError(
                f"{links.source}: group {new_label!r} has no calibrated {term.name}; the calibrated groups are "
                f"{', '.join(term.coefficients)}; to use the mean for new groups, request an interval (--level, "
                "predict_interval)"
            )
        mean = coefficients.mean(axis=1, keepdims=True)
        value += term.column * np.where(group >= 0, coefficients[:, group], mean)
        spread = term.spread_db
        if spread is None:
            spread = np.std(best, ddof=1) if len(best) > 1 else UNKNOWN_DB
        variance += np.where(group >= 0, 0.0, (term.column * spread) ** 2 * (1 + 1 / len(best)))
    return Shift(value, np.sqrt(variance))


def fill_missing(
    prediction: Prediction,
    study: StudyModel,
    links: Measurements,
    table: pd.DataFrame,
    level: float | None = None,
    least_db: NDArray[np.float64] | float = 0.0,
) -> pd.DataFrame:
    """Fill in the rows of links without a path in a table of predictions, using the fallback model.

    The columns are path_loss_db (infinite without a path), basis and, with a level, lower_db and upper_db. `least_db`
    [links], [dB], is half the width of the prediction model's interval; the fallback's interval is at least as wide.
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
    basis = f"{NO_PATH}: {model.name if level is None else model.basis}"
    filled.loc[missing, "basis"] = basis
    if level is None:
        return filled
    filled.loc[missing, "basis"] = np.where(shift.spread_db > 0, f"{basis}, {NEW_GROUP}", basis)
    half_width = np.broadcast_to(least_db, len(links))[missing]
    if model.residual_db:
        # For a group without a coefficient, the spread between groups adds to the errors of the fallback.
        errors_db = interval_half_width(np.array(model.sizes_db), level)
        half_width = np.maximum(half_width, errors_db * np.hypot(1.0, shift.spread_db / model.residual_db))
    filled.loc[missing, "lower_db"] = path_loss_db - half_width
    filled.loc[missing, "upper_db"] = path_loss_db + half_width
    return filled


def krige_residuals(
    field: ResidualField,
    measured: NDArray[np.float64],
    residuals: NDArray[np.float64],
    position: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Krige the residual field from m measured links to n new links.

    `measured` [m, 6] and `position` [n, 6] contain the positions of both ends of each link, in metres. `residuals` [m]
    are the measured minus the modelled path loss [dB]. The results are the correction [n], [dB], of the modelled path
    loss, and the share [n] of the field's variance that the measured links explain. This share is 0 far from all
    measured links, and less than 1 near a measured link.
    """
    if len(measured) <= MOST_EXACT:
        return _krige(field, measured, residuals, position)
    correction, share = np.zeros(len(position)), np.zeros(len(position))
    # A small system of equations is solved for each new link.
    neighbours = np.asarray(KDTree(measured).query(position, k=NEAREST)[1])
    variance = field.shared_db**2
    for first in range(0, len(position), TOGETHER):
        links = slice(first, first + TOGETHER)
        near = measured[neighbours[links]]
        between = np.linalg.norm(near[:, :, None] - near[:, None], axis=3)
        covariance = variance * np.exp(-between / field.range_m) + field.own_db**2 * np.eye(NEAREST)
        distance = np.linalg.norm(near - position[links, None], axis=2)
        cross = variance * np.exp(-distance / field.range_m)
        weights = np.linalg.solve(covariance, cross[..., None])[..., 0]
        correction[links] = np.einsum("nm,nm->n", weights, residuals[neighbours[links]])
        share[links] = np.einsum("nm,nm->n", weights, cross) / variance
    return correction, share


def _krige(
    field: ResidualField,
    measured: NDArray[np.float64],
    residuals: NDArray[np.float64],
    position: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simple kriging with an exponential covariance: c^T K^-1 r, and c^T K^-1 c divided by the field's variance."""
    variance = field.shared_db**2
    covariance = variance * np.exp(-cdist(measured, measured) / field.range_m)
    covariance = covariance + field.own_db**2 * np.eye(len(measured))
    factor = cho_factor(covariance, lower=True)
    cross = variance * np.exp(-cdist(position, measured) / field.range_m)
    correction = cross @ cho_solve(factor, residuals)
    return correction, np.einsum("nm,mn->n", cross, cho_solve(factor, cross.T)) / variance


def calibration_residuals(links: pd.DataFrame) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the indices [k] of calibration links with a path, and their measured minus predicted path loss [k], [dB]."""
    modelled = links["predicted_db"].to_numpy(float)
    counted = links["has_path"].to_numpy(bool) & ~links["held_out"].to_numpy(bool) & np.isfinite(modelled)
    if "faint" in links:
        counted &= ~links["faint"].to_numpy(bool)
    rows = np.flatnonzero(counted)
    return rows, links["measured_db"].to_numpy(float)[rows] - modelled[rows]
