"""The record of a finished calibration, divided into sections; `calibration.result.Result` adds the methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements.placement import ends_of
from calibray.paths import Paths
from calibray.result.held_out import (
    HeldOutErrors,
    Judgement,
    ObservableErrors,
    PredictionModel,
    ResidualField,
)
from calibray.result.verdict import Interval, Remark
from calibray.scenes import Scene
from calibray.study import Study
from calibray.support.messages import type_name
from calibray.tracing.protocol import EnclosedAntennas

# When `files` reads the sections, Pydantic validates their values, including these numeric bounds.
NonNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]
Offset = Annotated[float, Field(ge=-500, le=500)]
Share = Annotated[float, Field(ge=0, le=1.000001)]
Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class ObservableFit:
    """Accuracy of the calibrated model for a further observable, on the calibration links.

    Attributes:
        kind: Kind of the observable.
        unit: Unit of the observable.
        links: Number of calibration links for which the observable was measured.
        rmse: RMSE of the calibrated model.
        initial_rmse: RMSE with the initial materials.
        mean_rmse: RMSE of a baseline that predicts the mean value for every link.
        error: Standard deviation of the error of a measured value, either stated in the study or estimated.
        biases: Device bias by group; the group "" contains all links.
        bias_errors: Standard error of each bias, including the uncertainty of the parameters.
    """

    kind: str
    unit: str
    links: Count
    rmse: NonNegative
    initial_rmse: NonNegative
    mean_rmse: NonNegative
    error: NonNegative
    biases: dict[str, float] = field(default_factory=dict)
    bias_errors: dict[str, NonNegative] = field(default_factory=dict)


@dataclass(frozen=True)
class Fit:
    """The candidate with the lowest RMSE, and its accuracy on the calibration links.

    Attributes:
        parameters: Calibrated values by parameter, in the units of the parameters.
        initial_parameters: Values before calibration.
        materials: All materials of the scene at the study's carrier frequency, with the calibrated values.
        laws: Coefficients itu_a to itu_d of ITU-R P.2040 by material, for laws with a calibrated coefficient.
        rmse_db: RMSE over the calibration links (paper eq. 1) [dB].
        initial_rmse_db: RMSE with the initial materials and without nuisances [dB].
        nuisance_only_rmse_db: RMSE with the initial materials and fitted nuisances [dB]; None if there are no
            nuisances.
        log_distance_rmse_db: RMSE of a log-distance model fitted to the calibration links [dB].
        retrace_gap_db: Largest change [dB] in a calibration link's path loss when the scene is traced again with the
            calibrated materials; None if the paths do not depend on the materials.
        power_shares: Share of the links' power by material and type of interaction, or under "line of sight" for paths
            without interactions. The shares can add up to more than 1, because a path contributes to the share of each
            of its interactions.
        observables: Accuracy of the calibrated model for the further observables, by name.
    """

    parameters: dict[str, float]
    initial_parameters: dict[str, float]
    materials: dict[str, Material]
    rmse_db: NonNegative
    initial_rmse_db: NonNegative
    nuisance_only_rmse_db: NonNegative | None
    log_distance_rmse_db: NonNegative
    retrace_gap_db: NonNegative | None = None
    laws: dict[str, dict[str, float]] = field(default_factory=dict)
    power_shares: dict[str, dict[str, Share]] = field(default_factory=dict)
    observables: dict[str, ObservableFit] = field(default_factory=dict)


@dataclass(frozen=True)
class Accuracy:
    """Accuracy on held-out links; every RMSE is None if no link is held out.

    Attributes:
        holdout_rmse_db: RMSE of the calibrated model [dB].
        initial_holdout_rmse_db: RMSE with the initial materials and without nuisances [dB].
        nuisance_only_holdout_rmse_db: RMSE with the initial materials and fitted nuisances [dB].
        log_distance_holdout_rmse_db: RMSE of the log-distance model fitted to the calibration links [dB].
        judgement: Comparison of the calibrated model with the best baseline.
        observables: Errors of the further observables by name.
    """

    holdout_rmse_db: NonNegative | None = None
    initial_holdout_rmse_db: NonNegative | None = None
    nuisance_only_holdout_rmse_db: NonNegative | None = None
    log_distance_holdout_rmse_db: NonNegative | None = None
    judgement: Judgement | None = None
    observables: dict[str, ObservableErrors] = field(default_factory=dict)


@dataclass(frozen=True)
class Uncertainty:
    """Reliability of the calibrated values.

    Attributes:
        intervals: 95 % interval and verdict by parameter.
        draws: Posterior draws by parameter, constant and nuisance coefficient; empty if there are no draws.
        constants_db: Constants that are fixed in the scene but vary in the draws, each with the change in path loss
            [dB] per standard deviation of the constant.
        noise: Posterior weights of the noise models and of an undeclared offset.
        undeclared_offset_db: Best-fitting offset if the study declares no offset [dB]; None if no offset was estimated.
        undeclared_offset_error_db: Standard error of the undeclared offset [dB].
        remarks: Warnings and advice.
    """

    intervals: dict[str, Interval] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)
    constants_db: dict[str, NonNegative] = field(default_factory=dict)
    noise: dict[str, Share] = field(default_factory=dict)
    undeclared_offset_db: float | None = None
    undeclared_offset_error_db: NonNegative | None = None
    remarks: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class Nuisance:
    """Coefficients of the study's nuisances at the candidate with the lowest RMSE.

    Attributes:
        coefficients: Coefficient by term and group, [dB] per unit of the term's column; the offset is the term
            "offset", and the group "" contains all links.
        centres: Value that is subtracted from the values in each term's column, by term.
        groups_without_path: Groups that have no offset, because none of their calibration links has a path.
    """

    coefficients: dict[str, dict[str, float]] = field(default_factory=dict)
    centres: dict[str, float] = field(default_factory=dict)
    groups_without_path: tuple[str, ...] = ()

    @property
    def offsets_db(self) -> dict[str, float]:
        """Offset by group [dB]; empty if the study has no offset."""
        return self.coefficients.get("offset", {})


@dataclass(frozen=True)
class Prediction:
    """The model that is used for predictions, maps, exports and the report.

    Attributes:
        model: The prediction model, chosen by errors on held-out links; the calibrated model if too few links are held
            out.
        materials: All materials of the scene at the study's carrier frequency, with the model's parameter values; None
            if the model uses no scene.
        residual_field: The spatially correlated part of the residuals; None if the residuals are uncorrelated.
        fallback: The model for links without a path; None if the model uses no scene, or the study states a ceiling.
    """

    model: PredictionModel
    materials: dict[str, Material] | None
    residual_field: ResidualField | None = None
    fallback: PredictionModel | None = None


@dataclass(frozen=True)
class Cost:
    """Numbers of RT calls and replays, and computing times.

    Attributes:
        rt_calls: Number of RT calls of the method, including those found in the ledger.
        ledger_hits: Number of RT calls that were found in the ledger.
        seconds: Time taken by the method, excluding tracing [s].
        trace_seconds: Time taken to trace, or to load traced paths, before the search [s].
        uncertainty_replays: Number of replays for intervals and draws.
        uncertainty_seconds: Time taken to compute intervals and draws [s].
        cheap_replays: Number of replays of the cheap model, which are not RT calls.
        cheap_seconds: Time taken by the replays of the cheap model [s].
        total_seconds: Time taken by the whole calibration, including validation [s]; 0 if unknown.
    """

    rt_calls: Count
    ledger_hits: Count
    seconds: NonNegative
    trace_seconds: NonNegative
    uncertainty_replays: Count = 0
    uncertainty_seconds: NonNegative = 0.0
    cheap_replays: Count = 0
    cheap_seconds: NonNegative = 0.0
    total_seconds: NonNegative = 0.0


@dataclass(frozen=True)
class Provenance:
    """The inputs of the calibration.

    Attributes:
        files: SHA-256 digests of all files of the scene and the antennas, by path; empty if unknown.
        rows: Numbers of table rows that were left out, averaged or moved during conversion to links, by cause.
        enclosed: Antennas inside closed bodies of the scene or below the ground; None if this was not checked.
    """

    files: dict[str, Digest] = field(default_factory=dict)
    rows: dict[str, Count] = field(default_factory=dict)
    enclosed: EnclosedAntennas | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Record:
    """The data of a finished calibration. This class is abstract; use `calibration.result.Result` instead.

    Attributes:
        study: The study, with the method, seed and engine that were used.
        fit: The candidate with the lowest RMSE.
        accuracy: Accuracy on held-out links.
        uncertainty: Intervals, draws and warnings.
        nuisance: Coefficients of the nuisances.
        prediction: The model that predictions use.
        cost: RT calls, replays and time.
        provenance: The inputs of the calibration.
        links: One row per link, with its row number in the source file, has_path, held_out, and the positions tx_x to
            rx_z [m]. Path loss [dB] is listed as measured, as modelled before and after calibration, as predicted by
            the log-distance model and by the prediction model (for links without a path, by the fallback model), and as
            computed from the scene of the prediction model alone. Another column contains the change in path loss when
            the scene is traced again [dB]. If applicable, further columns are group, frequency [Hz], path loss with the
            nuisances alone [dB], values in the measured quantity, leverage, depth, and whether the link is censored or
            near the noise floor.
        history: One row per RT call: number, iteration, RMSE, lowest RMSE so far, seconds since the start.
        held_out: Held-out errors of every model, if blocks were held out in turn; otherwise None.
        scene: The scene as it was read; None in a loaded result.
        paths: The paths that were replayed, kept for drawing; None in a loaded result.
    """

    study: Study
    fit: Fit
    accuracy: Accuracy
    uncertainty: Uncertainty
    nuisance: Nuisance
    prediction: Prediction
    cost: Cost
    provenance: Provenance
    links: pd.DataFrame
    history: pd.DataFrame
    held_out: HeldOutErrors | None = None
    scene: Scene | None = None
    paths: Paths | None = None

    @property
    def parameters(self) -> dict[str, float]:
        """Calibrated values by parameter, in the units of the parameters."""
        return self.fit.parameters

    @property
    def materials(self) -> dict[str, Material]:
        """All materials of the scene at the study's carrier frequency, with the calibrated values."""
        return self.fit.materials

    @property
    def intervals(self) -> dict[str, Interval]:
        """95 % interval and verdict by parameter."""
        return self.uncertainty.intervals

    @property
    def ends(self) -> NDArray[np.float64] | None:
        """Positions of the transmitter and the receiver of every link [links, 6], [m]; None if unknown."""
        return ends_of(self.links)

    @property
    def scene_materials(self) -> dict[str, Material]:
        """The materials to export: those of the prediction model or, if it uses no scene, the calibrated materials."""
        return self.materials if self.prediction.materials is None else self.prediction.materials

    @property
    def scene_laws(self) -> dict[str, dict[str, float]]:
        """Coefficients of ITU-R P.2040 by material, as in `Fit.laws`, but for the constants in `scene_materials`."""
        # The values of the prediction model may differ from the calibrated values.
        values = self.prediction.model.parameters or {}
        return {
            material: {name: values.get(f"{material}.{name}", value) for name, value in law.items()}
            for material, law in self.fit.laws.items()
        }

    @property
    def rmse_db(self) -> float:
        """RMSE over the calibration links (paper eq. 1) [dB]."""
        return self.fit.rmse_db

    @property
    def initial_rmse_db(self) -> float:
        """RMSE over the calibration links with the initial materials and without nuisances [dB]."""
        return self.fit.initial_rmse_db

    @property
    def holdout_rmse_db(self) -> float | None:
        """RMSE of the calibrated model over the held-out links [dB]; None if no link is held out."""
        return self.accuracy.holdout_rmse_db

    @property
    def rt_calls(self) -> int:
        """Number of RT calls of the method, including those found in the ledger."""
        return self.cost.rt_calls

    @property
    def counts(self) -> dict[str, Any]:
        """Numbers of links, and the rows of links with possible problems.

        Held-out links are counted only if the hold-out RMSE includes them.
        """
        has_path = self.links["has_path"].to_numpy(bool)
        held_out = self.links["held_out"].to_numpy(bool)
        # As in the objective, links without a path count as used if a ceiling replaces their missing path loss.
        usable = has_path | (self.study.objective.no_path == "censor")
        if "faint" in self.links:
            usable &= ~self.links["faint"].to_numpy(bool)
        enclosed = self.provenance.enclosed
        return {
            "calibrated_on": int((~held_out & usable).sum()),
            "held_out": int((held_out & usable).sum()),
            "rows_without_path": self.links["row"][~has_path].tolist(),
            "rows_with_enclosed_tx": None if enclosed is None else sorted(enclosed.tx + enclosed.tx_below),
            "rows_with_enclosed_rx": None if enclosed is None else sorted(enclosed.rx + enclosed.rx_below),
        }


def check_record(result: object) -> None:
    """Refuse anything but a result.

    Raises:
        InputError: The object is not a result but, for example, a study.
    """
    if not isinstance(result, Record):
        raise InputError(
            f"result: is a {type_name(result)}, must be a Result; read one with Result.load(folder)"
        )
