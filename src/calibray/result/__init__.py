"""The record of a finished calibration: plain data in sections, the result files, and the text that describes them."""

from calibray.result.files import FILES
from calibray.result.held_out import FittedTerm, HeldOutErrors, Judgement, PredictionModel, ResidualField
from calibray.result.record import (
    Accuracy,
    Cost,
    Fit,
    Nuisance,
    Prediction,
    Provenance,
    Record,
    Uncertainty,
)
from calibray.result.verdict import Interval, Reason, ReasonKind, Remark, RemarkKind, Verdict

__all__ = [
    "FILES",
    "Accuracy",
    "Cost",
    "Fit",
    "FittedTerm",
    "HeldOutErrors",
    "Interval",
    "Judgement",
    "Nuisance",
    "Prediction",
    "PredictionModel",
    "Provenance",
    "Reason",
    "ReasonKind",
    "Record",
    "Remark",
    "RemarkKind",
    "ResidualField",
    "Uncertainty",
    "Verdict",
]
