"""Held-out errors: residuals of several models on links to which none of the models was fitted."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import stdtrit

from calibray.result.verdict import CONFIDENCE


class Model(StrEnum):
    """The models that validation compares."""

    INITIAL = "initial materials"
    CALIBRATED = "calibrated"
    PRIOR = "calibrated with prior"
    OFFSETS = "calibrated with prior and offsets"
    AVERAGE_INITIAL = "average of prior and initial materials"
    AVERAGE_CALIBRATED = "average of calibrated and prior"
    AVERAGE_OFFSETS = "average of calibrated and offsets"
    AVERAGE_LOG_DISTANCE = "average of prior and log-distance"
    AVERAGE_OBSTRUCTION = "average of prior and log-distance with obstruction"
    RESIDUAL_FIELD = "calibrated with residual field"
    LOG_DISTANCE = "log-distance"
    OBSTRUCTION = "log-distance with obstruction"
    KRIGING = "kriging"


WITHOUT_MATERIALS: Final = (Model.LOG_DISTANCE, Model.OBSTRUCTION)
"""Models that use no paths; the second of them uses the walls and roofs of the scene."""

BASELINES: Final = (Model.INITIAL, *WITHOUT_MATERIALS, Model.KRIGING)
"""Models without calibrated materials."""

FITTED: Final = (Model.CALIBRATED, Model.PRIOR, Model.OFFSETS)
"""Models that calibrate materials and can predict any link."""


class Average(NamedTuple):
    """The two models whose path loss is averaged, and the weight of the first model.

    If an average is chosen for predictions, an exported scene has the materials of the first model.
    """

    first: Model
    second: Model
    weight: float = 0.5

    def of(self, first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        """The weighted mean of the values [n] from the two models."""
        return self.weight * first + (1.0 - self.weight) * second


AVERAGES: Final[dict[str, Average]] = {
    Model.AVERAGE_INITIAL: Average(Model.PRIOR, Model.INITIAL, 2 / 3),
    Model.AVERAGE_CALIBRATED: Average(Model.PRIOR, Model.CALIBRATED),
    Model.AVERAGE_OFFSETS: Average(Model.CALIBRATED, Model.OFFSETS),
    Model.AVERAGE_LOG_DISTANCE: Average(Model.PRIOR, Model.LOG_DISTANCE),
    Model.AVERAGE_OBSTRUCTION: Average(Model.PRIOR, Model.OBSTRUCTION),
}
"""The averages by name. docs/measurements/predictions.md compares the weights 2/3 and 1/2."""

AVERAGE_OF: Final[dict[str, Model]] = {
    Model.INITIAL: Model.AVERAGE_INITIAL,
    Model.CALIBRATED: Model.AVERAGE_CALIBRATED,
    Model.PRIOR: Model.AVERAGE_CALIBRATED,
    Model.OFFSETS: Model.AVERAGE_OFFSETS,
    Model.LOG_DISTANCE: Model.AVERAGE_LOG_DISTANCE,
    Model.OBSTRUCTION: Model.AVERAGE_OBSTRUCTION,
}
"""The average that replaces a model in predictions if that model is chosen."""


@dataclass(frozen=True)
class ObservableErrors:
    """Held-out errors of a further observable, in the unit of the observable.

    Attributes:
        unit: The unit.
        links: Number of held-out links for which the observable was measured.
        rmse: RMSE of the calibrated model.
        mean_rmse: RMSE of a baseline that predicts the mean value of the other links.
        distance_rmse: RMSE of a baseline that is linear in distance or its logarithm, fitted to the other links.
    """

    unit: str
    links: Annotated[int, Field(ge=1)]
    rmse: Annotated[float, Field(ge=0)]
    mean_rmse: Annotated[float, Field(ge=0)]
    distance_rmse: Annotated[float, Field(ge=0)]


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Residuals of several models on the same links; each link is predicted by models fitted without its block.

    Attributes:
        labels: Names of the blocks.
        block: Index of the block that contains each link [links]; -1 if the link is not judged.
        errors: Modelled minus measured path loss of every link [links], [dB], keyed by model name; NaN if the link is
            not judged.
        position: Positions of the moving end of the links [links, 3], [m]; see `moving_end`.
        measured_db: Measured path loss [links], [dB].
        level: Nominal coverage of the intervals.
        observables: Errors of the further observables by name; empty in a loaded result, where `Accuracy` contains
            these errors.
    """

    labels: tuple[str, ...]
    block: NDArray[np.int64]
    errors: dict[str, NDArray[np.float64]]
    position: NDArray[np.float64]
    measured_db: NDArray[np.float64]
    level: float = 0.9
    observables: dict[str, ObservableErrors] = field(default_factory=dict)


@dataclass(frozen=True)
class Judgement:
    """Comparison of the calibrated model with the best baseline, on links to which neither model was fitted.

    Attributes:
        links: Number of links.
        rmse_db: RMSE of the calibrated model [dB].
        baseline: Name of the best baseline.
        baseline_rmse_db: RMSE of this baseline [dB].
        error_db: Bootstrap standard error of the difference in RMSE [dB]; None if there are fewer than two clusters.
        clusters: Number of resampled clusters, each of neighbouring links.
    """

    links: int
    rmse_db: float
    baseline: str
    baseline_rmse_db: float
    error_db: float | None
    clusters: int

    @property
    def gain_db(self) -> float:
        """RMSE of the baseline minus that of the calibrated model [dB]; positive if calibration helped."""
        return self.baseline_rmse_db - self.rmse_db

    @property
    def helped(self) -> bool:
        """Whether the gain is significantly greater than zero (Student's t, clusters - 1 degrees of freedom)."""
        if self.error_db is None:
            return False
        # The standard error is computed by resampling clusters, so their number determines its degrees of freedom.
        return self.gain_db > float(stdtrit(max(self.clusters - 1, 1), (1 + CONFIDENCE) / 2)) * self.error_db


NO_PATH: Final = "no path"
"""Beginning of the entry in the column `basis` for links without a path."""

NEW_GROUP: Final = "group without measurements"
"""Part of the entry in the column `basis` for predictions that use the mean offset of the measured groups."""


@dataclass(frozen=True)
class FittedTerm:
    """A nuisance term with its coefficients.

    Attributes:
        name: Name of the term.
        by: Column of the term: "constant", "log_distance", or a column of the links' table.
        per: Groups of the term: "offset" for the groups of the study's offset, "transmitter", a column, or "" for no
            groups.
        coefficients: Coefficient by group, [dB] per unit of the column; for other groups, the mean of these
            coefficients is used.
        centre: Value that is subtracted from the values in the column.
        spread_db: Standard deviation between the groups of a random effect, [dB] per unit of the column; if None, the
            standard deviation of the coefficients is used.
    """

    name: str
    by: str
    per: str
    coefficients: dict[str, float]
    centre: float = 0.0
    spread_db: float | None = None


@dataclass(frozen=True)
class BlockErrors:
    """Errors on new links at two levels: within blocks of neighbouring links, and common to all links of a block.

    Attributes:
        within_db: Standard deviation of the error of an individual link [dB].
        between_db: Standard deviation of the error that the links of a new block have in common [dB].
        blocks: Number of blocks.
        reach_m: 90 % quantile of the distance from a held-out link to the nearest calibration link [m].
        groups_db: RMS contribution [dB] of random effects to these errors, for groups that occur in only one block.
        out_of_sight: RMS error of non-line-of-sight links, divided by the RMS error of all links; at least 1.
    """

    within_db: float
    between_db: float
    blocks: int
    reach_m: float
    groups_db: float = 0.0
    out_of_sight: float = 1.0


@dataclass(frozen=True)
class PredictionModel:
    """A model fitted to the calibration links, with its errors on new links.

    Attributes:
        name: Name of the model; see `held_out.Model`.
        parameters: Values of the parameters, in their units; None if the model uses no scene.
        terms: Nuisance terms of the model.
        residual_db: RMS of the model's residuals on new links [dB]; None if there are too few links to estimate it.
        basis: Description of the links on which these residuals were computed.
        links: Number of these links or, if they are calibration links, the number of degrees of freedom.
        sizes_db: Absolute held-out residuals, ascending [dB]; if there are more than 400, 400 quantiles of the
            residuals.
        blocks: Standard deviations of these residuals within and between blocks; None if too few links were held out.
        averaged: The second set of parameter values if path loss is averaged over two sets; otherwise None.
    """

    name: str
    parameters: dict[str, float] | None
    terms: tuple[FittedTerm, ...] = field(default_factory=tuple)
    residual_db: float | None = None
    basis: str = ""
    links: int = 1
    sizes_db: tuple[float, ...] = ()
    blocks: BlockErrors | None = None
    averaged: dict[str, float] | None = None


@dataclass(frozen=True)
class ResidualField:
    """The spatially correlated part of the residuals; see `prediction.corrections`.

    Attributes:
        range_m: Distance at which the correlation has fallen to 1/e [m].
        shared_db: Standard deviation of the correlated part [dB].
        own_db: Standard deviation of the uncorrelated part [dB].
    """

    range_m: float
    shared_db: float
    own_db: float
