"""Sentences about predictions and held-out links, for the report, its summary and the export."""

from __future__ import annotations

from typing import Final

import numpy as np

from calibray.result.held_out import HeldOutErrors, Model
from calibray.result.record import Record

SCENE_ALONE_DB: Final = 0.05
"""Difference between the exported scene and the predictions that is not reported."""


def prediction_text(record: Record) -> str:
    """What predictions use."""
    model = record.prediction.model
    if model.parameters is None:
        source = "no materials" if model.name == Model.OBSTRUCTION else "no scene"
    elif model.parameters == record.parameters:
        source = "the calibrated materials"
    else:
        source = (
            "other values than the calibrated ones"
            if model.name != Model.INITIAL
            else "the initial materials"
        )
    terms = [term.name for term in model.terms]
    added = f" and the fitted {', '.join(terms)}" if terms else ""
    fallback = record.prediction.fallback
    text = f"Predictions, maps and exports use the model {str(model.name)!r}: {source}{added}."
    if fallback is None:
        return text
    error = "" if fallback.residual_db is None else f", with an error of {fallback.residual_db:.1f} dB (RMS)"
    return f"{text} Where no path leads, predictions use the log-distance model{error}, and are marked."


def scene_alone_text(record: Record) -> str:
    """How far the exported scene alone is from the predictions.

    Returns:
        One or two sentences; empty if the scene gives the predictions.
    """
    links, model = record.links, record.prediction.model
    scene_db, predicted_db = (links[name].to_numpy(float) for name in ("scene_db", "predicted_db"))
    both = np.isfinite(scene_db) & np.isfinite(predicted_db)
    difference = scene_db[both] - predicted_db[both]
    rms_db = float(np.sqrt(np.mean(difference**2))) if len(difference) else 0.0
    field = record.prediction.residual_field
    near = (
        ""
        if field is None
        else f" Within some {field.range_m:.3g} m of measured links, predictions also add what "
        f"their residuals have in common ({field.shared_db:.2f} dB RMS), which no scene contains."
    )
    if rms_db < SCENE_ALONE_DB:
        return near.lstrip()
    rough = [
        name.removesuffix(".roughness_mm")
        for name in model.parameters or {}
        if name.endswith(".roughness_mm")
    ]
    missing = [
        *(f"the region {name}" for name in record.study.regions),
        *(f"the facade {name}" for name in record.study.facades),
        *(f"the roughness of {name}" for name in dict.fromkeys((*record.study.roughness_mm, *rough))),
        *(term.name for term in model.terms),
    ]
    cause = ", ".join(missing) or "its ceiling"
    if model.parameters is None:
        return (
            f"Predictions use the model {str(model.name)!r}, which uses no scene. The exported scene has the "
            f"calibrated materials; its path loss differs from the predictions by {rms_db:.2f} dB (RMS over "
            f"{len(difference)} links).{near}"
        )
    return (
        f"The exported scene alone differs from the predictions by {rms_db:.2f} dB (RMS over {len(difference)} links): "
        f"a scene cannot contain {cause}.{near}"
    )


def sampling_text(record: Record) -> str:
    """Why the exported scene can give another path loss than the reported one; empty if it cannot.

    Returns:
        One or two sentences.
    """
    trace, model = record.study.trace, record.prediction.model
    calibrated = model.parameters is None or model.parameters == record.parameters
    causes = []
    if trace.adaptive:
        causes.append(
            f"The exported script sends out {type(trace).samples:,} rays, a calibration with trace.samples = "
            '"auto" as many as it needs.'
        )
    sampled = record.study.engine.name == "replay" and (trace.refraction or trace.diffuse_reflection)
    if sampled and not (calibrated and record.fit.retrace_gap_db is not None):
        causes.append(
            "Which refracted and diffuse paths are traced depends on the materials, and the reported path loss was "
            "computed on paths that may have been traced with others than those of the exported scene."
        )
    return " ".join([*causes, "load_scene.py prints the difference of every link."]) if causes else ""


def held_out_text(record: Record) -> str:
    """How many links were held out."""
    held_out = record.held_out
    if held_out is None:
        return f"{record.counts['held_out']:,} of them held out"
    return f"{np.count_nonzero(held_out.block >= 0):,} of them held out in turn, in {len(held_out.labels)} blocks"


def block_sentence(held_out: HeldOutErrors) -> str:
    """How many blocks were held out."""
    return f"{len(held_out.labels)} blocks of links were held out in turn."
