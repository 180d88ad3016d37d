"""Sentences about predictions and held-out links, for the report, the summary and the export."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pandas as pd

from calibray.fitting.search import AUTO
from calibray.measurements import FEW
from calibray.measurements.column_names import find_frequency_unit
from calibray.optimizers import label
from calibray.reporting.diagnostics import calibration_links, diagnostics, link_distance
from calibray.result.held_out import HeldOutErrors, Model, ResidualField
from calibray.result.record import Record
from calibray.result.verdict import RemarkKind
from calibray.study.calibration_sections import OFFSET
from calibray.study.displacement import RECEIVER
from calibray.support.messages import counted, percent
from calibray.tables import Column, Table, hertz, named, rows_text
from calibray.tracing.antennas import POSE
from calibray.uncertainty.verdicts import TRADE_OFF


def prediction_text(record: Record) -> str:
    """Describe the prediction model in at most three sentences."""
    model = record.prediction.model
    if model.parameters is None:
        source = _unused(record)
    elif model.parameters == record.parameters:
        source = "the calibrated materials"
    else:
        source = (
            "materials calibrated with a prior" if model.name != Model.INITIAL else "the initial materials"
        )
    terms = [term.name for term in model.terms]
    added = f" and the fitted {' and '.join(terms)}" if terms else ""
    if model.name in _AVERAGED:
        added = f", averaged with {_AVERAGED[Model(model.name)]}{',' if terms else ''}{added}"
    fallback = record.prediction.fallback
    text = f"Predictions and maps use the model {str(model.name)!r}, with {source}{added}."
    if fallback is None:
        return text
    error = "" if fallback.residual_db is None else f", with an error of {fallback.residual_db:.1f} dB (RMS)"
    return f"{text} For links without a path, predictions use the log-distance model{error} and are marked."


_AVERAGED: Final = {
    Model.AVERAGE_INITIAL: "the initial materials (weight 1/3)",
    Model.AVERAGE_CALIBRATED: "the calibrated materials",
    Model.AVERAGE_OFFSETS: "the materials of a fit with a prior and offsets",
    Model.AVERAGE_LOG_DISTANCE: "the log-distance model",
    Model.AVERAGE_OBSTRUCTION: "the log-distance model with obstruction",
}


def _unused(record: Record) -> str:
    """Name the inputs that a model without materials does not use; the model with obstruction uses walls and roofs."""
    return "no materials" if record.prediction.model.name == Model.OBSTRUCTION else "no scene"


def carriers_text(record: Record) -> str:
    """List the carrier frequencies of the links: that of the scene, unless the links state their own."""
    if "frequency" not in record.links:
        return hertz(record.study.scene.frequency)
    return named(map(hertz, np.unique(record.links["frequency"].to_numpy(float)).tolist()))


def group_text(record: Record, label: str) -> str:
    """The label of an offset group; if the groups are the carriers of the links, the label is in GHz or MHz."""
    column = record.study.links.frequency
    if column is None or record.study.offset_groups != (column,):
        return label
    try:
        return hertz(float(label) * find_frequency_unit(column))
    except ValueError:
        return label


def usable_link_text(record: Record) -> str:
    """State what a link needs to determine the offset of its group."""
    return "a path" + (" and a power well above the noise floor" if "faint" in record.links else "")


def scene_alone_text(record: Record) -> str:
    """State how path loss from the exported scene alone differs from the predictions.

    The text has at most three sentences; it is empty if the scene alone reproduces the predictions.
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
        else f" Within about {field.range_m:.3g} m of measured links, predictions also add the correlated part of the "
        "residuals of these links, which a scene cannot contain (standard deviation in the fitted model: "
        f"{field.shared_db:.2f} dB)."
    )
    if record.study.engine.external and model.parameters is not None:
        return (
            "Predictions and maps call the program. The exported scene contains only the materials: "
            f"another ray tracer gives a different path loss if its antennas or physics differ.{near}"
        )
    if rms_db < 0.05:
        return near.lstrip()
    values = model.parameters or {}
    rough = [name.removesuffix(".roughness_mm") for name in values if name.endswith(".roughness_mm")]
    missing = [
        *(f"the region {name}" for name in record.study.regions),
        *(f"the facade {name}" for name in record.study.facades),
        *(["the errors of antennas"] if any(name.startswith((POSE, RECEIVER)) for name in values) else []),
        *(f"the roughness of {name}" for name in dict.fromkeys((*record.study.roughness_mm, *rough))),
        *(f"the {term.name}" for term in model.terms),
        *(["the average with another model"] if model.name in _AVERAGED else []),
    ]
    cause = " or ".join(filter(None, (", ".join(missing[:-1]), *missing[-1:]))) or "its ceiling"
    group, mean = np.zeros(len(difference)), "their mean"
    if "group" in links:
        group, mean = links["group"].to_numpy()[both], "the mean of each group"
    means = pd.Series(difference).groupby(group, dropna=False).transform("mean").to_numpy()
    spread_db = float(np.sqrt(np.mean((difference - means) ** 2)))
    rms = f"{rms_db:.2f} dB (RMS over {counted(len(difference), 'link')}; {spread_db:.2f} dB after subtracting {mean})"
    if model.parameters is None:
        return (
            f"Predictions use the model {str(model.name)!r}, which uses {_unused(record)}. The exported scene contains "
            f"the calibrated materials; its path loss differs from the predictions by {rms}.{near}"
        )
    return f"The exported scene alone differs from the predictions by {rms}: a scene cannot contain {cause}.{near}"


def _given_engine(record: Record) -> dict[str, Any] | None:
    """The engine that a user passed to `calibrate`, as named in its remark; None if the study's engine was called."""
    remarks = record.uncertainty.remarks
    return next((dict(remark.values) for remark in remarks if remark.kind is RemarkKind.GIVEN_ENGINE), None)


def engine_text(record: Record) -> str:
    """The name of the engine that a calibration called."""
    given = _given_engine(record)
    return record.study.engine.name if given is None else given["engine"]


def method_text(record: Record, name: str) -> str:
    """The name of a calibration's method; for `auto` with an expensive engine, also the method that was used."""
    given = _given_engine(record)
    expensive = record.study.engine.expensive if given is None else not given["differentiable"]
    if name != AUTO or not expensive:
        return label(name)
    if record.study.engine.exports_rays:
        return f"{name} (ray mapping)"
    return f"{name} ({'space mapping' if record.cost.cheap_replays else 'vector surrogate'})"


def sampling_text(record: Record) -> str:
    """State why the path loss of the exported scene can differ from the reported one; empty if there is no reason."""
    trace, model = record.study.trace, record.prediction.model
    calibrated = model.parameters is None or model.parameters == record.parameters
    causes = []
    if trace.adaptive:
        causes.append(
            f"The exported script launches {type(trace).samples:,} rays, but a calibration with trace.samples "
            '= "auto" adds rays until path loss converges.'
        )
    # Paths that were traced again with the calibrated materials are also the paths of the exported scene.
    sampled = record.study.engine.name == "replay" and (trace.refraction or trace.diffuse_reflection)
    if sampled and not (calibrated and record.fit.retrace_gap_db is not None):
        causes.append(
            "The traced set of refracted and diffuse paths depends on the materials. The reported path loss was "
            "computed on paths that may have been traced with materials other than those of the exported scene."
        )
    if not causes:
        return ""
    study = record.study
    if study.links.mountings or any(each.gain_file or each.is_array for each in study.antenna_pair):
        causes.append(
            "load_scene.py prints no differences, because it cannot compute path loss with these antennas."
        )
    else:
        causes.append("load_scene.py prints the difference for every link.")
    return " ".join(causes)


def held_out_text(record: Record) -> str:
    """State the number of held-out links."""
    held_out = record.held_out
    if held_out is None:
        return f"{record.counts['held_out']:,} of them held out"
    return f"{np.count_nonzero(held_out.block >= 0):,} of them held out in turn, in {len(held_out.labels)} blocks"


def block_sentence(held_out: HeldOutErrors) -> str:
    """State the number of held-out blocks in a sentence."""
    return f"{len(held_out.labels)} blocks of links were held out in turn."


DECIDING: Final = 0.5
"""Leverage above which the report states that a link determines an unknown almost alone."""


CLEAR: Final = 2.0
"""Number of standard errors above which a difference counts as significant."""


def diagnostics_table(result: Record) -> Table:
    """Summarize each diagnostic in one line."""
    tables = diagnostics(result)

    def text(name: str, described: Callable[[pd.DataFrame], str]) -> str:
        return described(tables[name]) if name in tables else ""

    findings = {
        "power": text("power", _power_text),
        "by distance": _distance_text(result),
        "by depth": _class_text(
            tables, "depth", lambda depth: f"paths of {counted(int(depth), 'interaction')}"
        ),
        "by group": _class_text(tables, "group", lambda label: f"group {group_text(result, str(label))}"),
        "by obstruction": text("obstruction", _obstruction_text),
        "by street": _class_text(tables, "streets", str),
        "missing region": text("missing_region", _missing_region_text),
        "neighbours": text(
            "neighbours", lambda table: _neighbours_text(table, result.prediction.residual_field)
        ),
        "leverage": text("leverage", _leverage_text),
        "trade-offs": text("trade_offs", lambda table: _trade_offs_text(result, table)),
        "largest change": text("moved", _moved_text),
    }
    rows = tuple((name, text) for name, text in findings.items() if text)
    return Table("Diagnostics", (Column(), Column()), rows)


def _power_text(table: pd.DataFrame) -> str:
    rows = table.head(5).to_dict("records")
    shares = (
        f"{row['material']} {row['interaction']} {percent(float(row['share']))}".replace("  ", " ")
        for row in rows
    )
    overlap = (
        "; shares overlap, because a path counts for each of its interactions"
        if table["share"].sum() > 1
        else ""
    )
    return f"mean share of a link's power: {', '.join(shares)}{overlap}"


def _distance_text(result: Record) -> str:
    links, residuals = calibration_links(result)
    distance = link_distance(links)
    if distance is None or len(residuals) < FEW or np.ptp(distance) == 0:
        return ""
    # A least-squares line over the logarithm of distance is fitted; its two coefficients use two degrees of freedom.
    decades = np.log10(distance) - np.log10(distance).mean()
    slope = float(decades @ residuals / (decades @ decades))
    rest = residuals - residuals.mean() - slope * decades
    error = float(np.sqrt(rest @ rest / (len(residuals) - 2) / (decades @ decades)))
    verdict = "a trend" if abs(slope) > CLEAR * error else "no trend"
    return f"{verdict}: the residuals change by {slope:+z.1f} dB per decade, standard error {error:.1f} dB"


def _class_text(tables: dict[str, pd.DataFrame], column: str, described: Callable[[Any], str]) -> str:
    """Describe the class of links with the largest mean residual."""
    if column not in tables or len(tables[column]) < 2:
        return ""
    # The mean of one or two links is mostly noise.
    table = tables[column][tables[column]["links"] >= 3]
    if not len(table):
        return ""
    worst = table.iloc[int(np.argmax(table["mean_db"].abs()))]
    if abs(worst["mean_db"]) < 0.1:
        return ""
    clear = abs(worst["mean_db"]) > CLEAR * worst["standard_deviation_db"] / np.sqrt(worst["links"] - 1)
    return (
        f"largest mean residual: {worst['mean_db']:+z.1f} dB, {described(worst[column])}, {worst['links']:.0f} links"
        + ("" if clear else " (not significant)")
    )


def _obstruction_text(table: pd.DataFrame) -> str:
    """State the mean residual of line-of-sight links, and of other links by the length of their line below roofs."""
    parts = []
    for row in table.to_dict("records"):
        digits = 0 if row["to_m"] - row["from_m"] >= 1.0 else 1
        below = f"with {row['from_m']:.{digits}f} to {row['to_m']:.{digits}f} m below roofs"
        where = "in sight" if not row["out_of_sight"] else below if row["to_m"] >= 1.0 else "out of sight"
        parts.append(f"{row['mean_db']:+z.1f} dB {where} ({counted(row['links'], 'link')})")
    return f"mean residual: {', '.join(parts)}"


def _missing_region_text(table: pd.DataFrame) -> str:
    """Describe the region whose extra loss would explain the residuals, if it explains more than expected by chance."""
    row = table.iloc[0]
    if not row["significant"]:
        return "no region of extra loss, such as trees, would explain more of the residuals than chance does"
    return (
        f"losses of {row['attenuation']:.2g} dB/m within x = {row['west']:.0f} to {row['east']:.0f} m, "
        f"y = {row['south']:.0f} to {row['north']:.0f} m would explain {percent(float(row['share']))} of the mean "
        f"square of the residuals (by chance alone: {percent(float(row['chance']))})"
    )


def _neighbours_text(table: pd.DataFrame, field: ResidualField | None) -> str:
    if len(table) < 3:
        return ""
    # Distant links share no errors, so half the mean squared difference between them is the full variance (the sill).
    # Neighbouring links differ by less, to the extent that they share errors.
    nearest, sill = table.iloc[0], float(table["semivariance_db2"].iloc[len(table) // 2 :].mean())
    share = 1.0 - nearest["semivariance_db2"] / sill if sill > 0 else 0.0
    # The relative standard error of a semivariance of n independent pairs is sqrt(2 / n).
    if share < CLEAR * np.sqrt(2.0 / nearest["pairs"]):
        if field is None:
            return f"the errors of links {nearest['distance_m']:.0f} m apart show no significant correlation"
        # The fitted model uses all pairs, so the model can detect a correlation that the nearest pairs alone do not
        # show.
        decay = np.exp(-nearest["distance_m"] / field.range_m)
        share = decay * field.shared_db**2 / (field.shared_db**2 + field.own_db**2)
    return f"links {nearest['distance_m']:.0f} m apart share {percent(share)} of the variance of their errors"


def _leverage_text(table: pd.DataFrame) -> str:
    deciding = table[table["leverage"] > DECIDING]
    if len(deciding):
        links = "1 link determines" if len(deciding) == 1 else f"{len(deciding)} links determine"
        rows = rows_text(deciding["row"].tolist())
        return f"{links} an unknown almost alone (leverage above {DECIDING:g}): {rows}"
    largest = table.iloc[int(np.argmax(table["leverage"]))]
    return (
        f"no link determines an unknown alone; the largest leverage is {largest['leverage']:.2f}, in row "
        f"{largest['row']:.0f}"
    )


def _trade_offs_text(result: Record, table: pd.DataFrame) -> str:
    strong = table[table["correlation"].abs() > TRADE_OFF].head(3)
    if not len(strong):
        return f"no two unknowns have a correlation above {TRADE_OFF:g} in magnitude"
    shown = {
        f"{OFFSET}[{label}]": f"{OFFSET}[{group_text(result, label)}]" for label in result.nuisance.offsets_db
    }
    pairs = strong[["first", "second"]].replace(shown).assign(correlation=strong["correlation"])
    return "; ".join(f"{row.first} and {row.second} ({row.correlation:+z.2f})" for row in pairs.itertuples())


def _moved_text(table: pd.DataFrame) -> str:
    row = table.iloc[int(np.argmax(table["moved"].abs()))]
    moved = percent(abs(row["moved"]))
    return f"{row['parameter']}, from {row['before']:.4g} to {row['after']:.4g}: {moved} of its range"
