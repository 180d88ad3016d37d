"""The sentences that describe a result on the terminal, on the report page and in JSON."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from calibray.result.held_out import Judgement, Model
from calibray.result.record import Record
from calibray.result.verdict import Cause, Interval, Reason, ReasonKind, Remark, RemarkKind
from calibray.support.messages import counted, percent
from calibray.tables import rows_text

MOST_ODDS: Final = 1000.0
"""Maximum odds that are reported as a number."""

CLEAR_ODDS: Final = 2.0
"""Odds below which two candidates count as about equally probable. The log densities of draws of one Gaussian
parameter have a standard deviation of sqrt(1/2), which is close to ln 2."""

SHOWN_PIECES: Final = 3
"""Maximum number of separate ranges of an interval that are listed one by one."""

SHOWN_GROUPS: Final = 4
"""Maximum number of groups that a remark lists."""

UNKNOWN_BEST: Final = (
    "Errors on held-out links are unknown, so it is unclear which model predicts new links best."
)
NOT_JUDGED: Final = f"{UNKNOWN_BEST} Set [holdout] blocks = 4, or run calibray validate."


def interval_text(interval: Interval) -> str:
    """The ends of an interval, such as "2.1 to 3.4", or of each of its separate ranges if there are only a few."""
    hull = ((interval.lower, interval.upper),)
    pieces = interval.pieces if 1 < len(interval.pieces) <= SHOWN_PIECES else hull
    return ", ".join(f"{low:.4g} to {high:.4g}" for low, high in pieces)


def reason_text(reason: Reason | None) -> str:
    """The reason for a verdict, as a clause without a full stop; empty if there is no reason."""
    return "" if reason is None else _REASONS[reason.kind](reason.values, reason.ranges)


def explanation_text(interval: Interval) -> str:
    """The reason for a verdict, and the assumptions that would narrow the interval.

    The text consists of clauses without a full stop, and is empty if there is neither a reason nor such an assumption.
    """
    clauses = [reason_text(interval.reason)]
    if interval.seen:
        ends = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in interval.seen[:SHOWN_PIECES])
        clauses.append(f"for the measured buildings alone, the interval is {ends}")
    clauses += [
        f"{statement} {percent(interval.without[cause])} of the width would remain"
        for cause, statement in _STATEMENTS.items()
        if cause in interval.without
    ]
    return "; ".join(clause for clause in clauses if clause)


_STATEMENTS: Final = {
    Cause.BUILDINGS: "if all buildings were known to be identical (noise.heterogeneity = 0),",
    Cause.CORRELATION: "if errors of neighbouring links were known to be independent (noise.range_m = 0),",
    Cause.MISSING_PATHS: "if errors were known not to be larger out of sight (noise.range_m = 0),",
    Cause.HEAVY_TAILS: "if errors were known to be Gaussian (noise.kind = 'gaussian'),",
    Cause.OFFSET: "if the offset were known to be zero ([offset] with narrow bounds),",
    Cause.CONSTANTS: "if the scene's other constants were exact (noise.constants_spread = 0), at most",
}


def _range(values: dict[str, Any]) -> str:
    return "a usual range" if values.get("customary") else "the range"


def _width(values: dict[str, Any], ranges: tuple[tuple[float, ...], ...]) -> str:
    text = f"90 % of the posterior covers {percent(values['share'])} of {_range(values)}"
    if ranges:
        others = ", ".join(
            f"{low:.4g} to {high:.4g} ({percent(weight)} of the posterior)" for low, high, weight in ranges
        )
        text += f"; the 95 % interval also includes {others}"
    return text


def _separate(values: dict[str, Any], ranges: tuple[tuple[float, ...], ...]) -> str:
    modes = ", ".join(f"{value:.4g} ({percent(weight)} of the posterior)" for value, weight in ranges)
    return f"{len(ranges)} separate ranges fit the links, around {modes}"


_REASONS: Final[dict[ReasonKind, Callable[[dict[str, Any], tuple[tuple[float, ...], ...]], str]]] = {
    ReasonKind.WIDTH: _width,
    ReasonKind.SEPARATE_RANGES: _separate,
    ReasonKind.SEEN_BUILDINGS: lambda values, _: (
        f"for the measured buildings, the value is known to within {percent(values['share'])} of {_range(values)}; "
        "other buildings of this material may differ"
    ),
    ReasonKind.AT_BOUND: lambda values, _: (
        f"the interval reaches the {values['side']} bound: the links show only that the value is "
        f"{'below' if values['side'] == 'lower' else 'above'} {values['value']:.4g}, with a probability of 90 %"
    ),
    ReasonKind.NO_EFFECT: lambda values, _: (
        f"no link's path loss changes by more than {max(values['change_db'], 0.1):.1f} dB over the whole range"
        if values["change_db"]
        else "no link's path loss depends on this parameter"
    ),
    ReasonKind.TRADE_OFF: lambda values, _: (
        f"the value trades off with {values['parameter']} (rank correlation {values['correlation']:.2f})"
    ),
    ReasonKind.CONFOUNDED: lambda values, _: (
        f"path loss changes by up to {values['change_db']:.1f} dB over the range, but other unknowns can compensate: "
        "an offset, or errors shared by links"
    ),
    ReasonKind.NOISE: lambda values, _: (
        f"path loss changes by up to {values['change_db']:.1f} dB over the range, which is too little compared with "
        f"the noise of {values['noise_db']:.1f} dB"
    ),
    ReasonKind.OUTSIDE_INTERVAL: lambda values, _: (
        f"the value with the lowest RMSE, {values['value']:.4g}, is outside the interval"
    ),
    ReasonKind.TOO_FEW_LINKS: lambda values, _: (
        f"too few links ({values['links']:.0f}) for this number of unknowns"
    ),
    ReasonKind.TOO_FEW_CALLS: lambda values, _: (
        f"too few engine calls ({values['calls']:.0f}) to show how path loss depends on any parameter"
        + (
            f": predictions of each call from the others have an error of {values['error_db']:.2g} dB, and the best "
            f"RMSE is {values['rmse_db']:.2g} dB; use a larger budget"
            if "error_db" in values
            else ""
        )
    ),
    ReasonKind.NO_NOISE: lambda values, _: "the data contain no noise",
    ReasonKind.TOO_MANY_LINKS: lambda values, _: (
        f"the interval follows from the curvature at the optimum alone: with more than {values['limit']:,.0f} links, "
        "correlated noise is not considered"
    ),
}


def remark_text(remark: Remark) -> str:
    """The text of a remark."""
    return _REMARKS[remark.kind](remark.values)


def _have(count: int) -> str:
    return "has" if count == 1 else "have"


def _noise_remark(finding: str) -> Callable[[dict[str, Any]], str]:
    return lambda values: (
        f"{finding} (posterior weight {values['weight']:.2f}, versus {values['gaussian_weight']:.2f} for independent "
        "Gaussian noise). The intervals account for this."
    )


def _errors_out_of_sight(values: dict[str, Any]) -> str:
    text = _noise_remark(
        "Errors are larger on weak links out of sight than on other links, as if paths to these links were missing"
    )(values)
    # Results of earlier versions do not list the missing settings.
    lacking = values.get("lacking")
    return f"{text} To find more paths, set in [trace]: {', '.join(lacking)}." if lacking else text


def _richer_paths(values: dict[str, Any]) -> str:
    settings, outside = ", ".join(values["settings"]), values["outside"]
    text = (
        f"The measurements favour paths that the study's settings leave out, with a probability of "
        f"{values['probability']:.2f}. With {settings}, the RMSE would be {values['rmse_db']:.2f} instead of "
        f"{values['rmse_without_db']:.2f} dB. The intervals, verdicts and remarks on noise include these paths; "
        "calibrated values and predictions do not."
    )
    if outside:
        text += f" Calibrated values outside their intervals: {', '.join(outside)}."
    return f"{text} Set these keys in [trace], and calibrate again."


_CAUSES: Final = {
    "correlated": "neighbouring links have less weight than independent links if they share part of their errors",
    "out_of_sight": "weak links out of sight have less weight if paths to these links are missing",
    "student-t": "outliers have less weight if the noise has heavy tails",
    "heterogeneous": "links that depend on a single building have less weight if the constants of buildings differ",
    "gaussian": "the noise model of the intervals differs from that of the RMSE",
}


def _ranges(ends: list[float]) -> str:
    # Lower and upper ends alternate.
    return ", ".join(f"{low:.4g} to {high:.4g}" for low, high in zip(ends[::2], ends[1::2], strict=True))


def _outside_interval(values: dict[str, Any]) -> str:
    odds = values["odds"]
    rows = zip(values["names"], values["values"], values["pieces"], values["most_probable"], strict=True)
    parameters = [
        (f"{name} {value:.4g}, interval {_ranges(ends)}", f", most probable {probable:.4g}")
        for name, value, ends, probable in rows
    ]
    if odds < CLEAR_ODDS:
        text = (
            f"The candidate with the lowest RMSE is outside an interval: {'; '.join(low for low, _ in parameters)}. No "
            "other candidate is clearly more probable. Of the candidates that fit equally well, only a few are near "
            "this one; most are inside the intervals."
        )
    else:
        times = f"more than {MOST_ODDS:,.0f}" if odds >= 0.999 * MOST_ODDS else f"{odds:.2g}"
        text = (
            f"The candidate with the lowest RMSE is not the most probable one: {'; '.join(map(''.join, parameters))}. "
            "The RMSE treats the noise of all links as independent; the intervals do not, because "
            f"{_CAUSES.get(values['cause'], _CAUSES['gaussian'])}. The most probable values are {times} times as "
            "probable."
        )
    text += " Do not use the values with the lowest RMSE as material constants."
    if values["blocks"]:
        return text + " Held-out blocks show which model predicts best."
    return (
        f"{text} Predictions use the values with the lowest RMSE unless another model is chosen on held-out links "
        "([holdout])."
    )


def _approximate_intervals(values: dict[str, Any]) -> str:
    replay = ", combined with the corrected replay of its scene" if values["replay"] else ""
    return (
        f"The intervals are approximate: the engine {values['engine']!r} provides no derivatives, so an emulator was "
        f"fitted to {values['calls']} engine calls{replay}. In cross-validation, the emulator's RMS error is "
        f"{values['error_db']:.2g} dB for calls whose RMSE is below the median."
    )


def _conflict(values: dict[str, Any]) -> str:
    rows = zip(values["names"], values["path_loss"], values["further"], strict=True)
    answers = "; ".join(f"{name} {first:.4g} or {second:.4g}" for name, first, second in rows)
    observables = ", ".join(values["observables"])
    if "slope" in values:
        return (
            f"Measured {observables} changes from link to link by {values['slope']:.2f} times the change that the "
            f"calibrated model predicts (standard error {values['slope_error']:.2f}), "
            f"{values['standard_errors']:.1f} standard errors below 1. Path loss alone, or further observables alone, "
            f"would require {answers}. Check the receiver's range, and that the values belong to these links and this "
            "scene."
        )
    return (
        f"Path loss and {observables} require parameter values that differ by {values['standard_errors']:.1f} standard "
        f"errors: {answers}. The joint fit explains neither quantity. Check units, the receiver's range and the scene."
    )


def _unreached_links(values: dict[str, Any]) -> str:
    trials, sample = zip(values["switches"], values["reached"], strict=True), values["sample"]
    reached = ", ".join(f"{count:.0f} {_have(count)} a path with {switch}" for switch, count in trials)
    text = (
        f"{values['links']:,} of {values['of']:,} links {_have(values['links'])} no path. Links without a path do not "
        "constrain any material."
    )
    if max(values["reached"], default=0.0) == 0:
        return (
            f"{text} No tested setting of [trace] finds a path for any of {sample} sampled links: check the "
            "positions of the links."
        )
    return f"{text} Of {sample} sampled links, {reached}: change these keys of [trace] in the study."


def _antenna_directions(values: dict[str, Any]) -> str:
    sentences = []
    for number, name in enumerate(values["transmitters"]):
        angles = [
            f"{values[f'{angle}_deg'][number]:+z.1f} deg (standard error {error:.1f} deg) to its {angle}"
            for angle in ("azimuth", "downtilt")
            if (error := values[f"{angle}_error_deg"][number]) > 0
        ]
        sentences.append(f"{name!r}: add {' and '.join(angles)}")
    first = values["transmitters"][0]
    return (
        "Residuals depend on direction, as if antennas did not point in the stated directions. These corrections "
        f"would explain them: {'; '.join(sentences)}. Check the mounting of the antennas, or calibrate parameters such "
        f'as "tx:{first}.azimuth".'
    )


def _ray_mapping(values: dict[str, Any]) -> str:
    if any(name not in values for name in ("misfit_db", "gap_db", "remaining_db", "moved_db")):
        return (
            f"The model does not represent the program: some of its {values['calls']} calls have no path, or no link "
            "with a path, in common. The optimum may be missed, and intervals are approximate. Check why the program's "
            "paths appear or disappear when the materials change, or choose a method that requires no rays."
        )
    # Records of earlier versions lack this value.
    if not values.get("meets_calibrated", True):
        return (
            f"No path of the program interacts with a calibrated material, so the program's {values['calls']} calls do "
            "not show whether the model represents the program. Calibrate materials on the paths, or check the paths."
        )
    assumed = zip(values["names"], values["values"], strict=True)
    constants = ", ".join(f"{name} {value:.3g}" for name, value in assumed)
    surfaces = "half-spaces" if values["half_space"] else "slabs"
    if values["half_spaces"] and not values["half_space"]:
        surfaces = f"slabs, except half-spaces of {' and '.join(values['half_spaces'])},"
    text = (
        f"The model explains the ratios of the ray powers in {values['calls']} calls with a misfit of "
        f"{values['misfit_db']:.3f} dB, and predicted path loss at the last call to within {values['gap_db']:.3f} dB"
    )
    if values["understood"]:
        text = f"The model represents the program. {text}. Its surfaces are {surfaces}"
        text += f" with {constants}." if constants else "."
    else:
        optimum = "the optimum is probably reached" if values["reached"] else "the optimum may be missed"
        if "distant_gap_db" in values:
            text += f", and at a distant call to within {values['distant_gap_db']:.2f} dB"
        text = (
            f"The model does not represent the program. {text}. The model is replaced by a replay that agrees with the "
            f"program at the best call. The minimum of this replay is {values['remaining_db']:.3f} dB below that call, "
            f"and path loss differs by {values['moved_db']:.3f} dB between the two: {optimum}, and intervals are "
            "approximate."
        )
    if values["changed"]:
        text += (
            f" Up to {values['changed']} paths of one call are absent from another; without these paths, the path loss "
            f"of a link changes by up to {values['changed_db']:.2f} dB"
        )
        lost = values.get("lost")
        text += f", and {counted(lost, 'link')} {_have(lost)} no path." if lost else "."
    if rows := values.get("lost_rows"):
        text += f" {counted(len(rows), 'link')} {_have(len(rows))} no path in some of the calls "
        text += f"({rows_text(rows)})."
        if values["excluded"]:
            text += (
                ' Such a call cannot be the best one: set objective.no_path = "censor" and objective.ceiling_db, or '
                "leave these links out."
            )
    return text


def _missing_region(values: dict[str, Any]) -> str:
    return (
        f"Losses of {values['attenuation']:.2g} dB/m within x = {values['west']:.0f} to {values['east']:.0f} m, y = "
        f"{values['south']:.0f} to {values['north']:.0f} m, up to z = {values['height']:.0f} m, on the straight line "
        f"between the ends of {values['links']} links, would explain {percent(values['share'])} of the mean square of "
        f"the residuals (by chance alone: {percent(values['chance'])}). The materials may compensate for part of these "
        "losses, and the verdicts assume that nothing is missing there. Check whether there are trees, or furniture "
        "indoors, and state them under [regions]; a wrong antenna direction can have the same effect."
    )


def _differing_groups(values: dict[str, Any]) -> str:
    rows = list(zip(values["labels"], values["differences_db"], values["errors_db"], strict=True))
    groups = "; ".join(
        f"{label!r} {difference:+z.1f} dB (standard error {error:.1f} dB)"
        for label, difference, error in rows[:SHOWN_GROUPS]
    )
    more = f"; and {len(rows) - SHOWN_GROUPS} more" if len(rows) > SHOWN_GROUPS else ""
    others = f" The same applies to the columns {', '.join(values['others'])}." if values["others"] else ""
    per = ", ".join(f'"{name}"' for name in values["per"])
    return (
        f"Residuals of neighbouring links depend on the column {values['column']!r} more than expected by chance. "
        f"Measured minus modelled path loss, compared with neighbouring links: {groups}{more}.{others} If the column "
        "contains devices, antennas, carriers or days, fit an offset for each: [offset] per = "
        f"{f'[{per}]' if len(values['per']) > 1 else per}."
    )


def _retraced(values: dict[str, Any]) -> str:
    links, lost, total = values["links"], values["lost"], counted(values["of"], "link")
    changes = []
    if links:
        changes.append(
            f"{links:,} of {total} {'changes' if links == 1 else 'change'} by more than {values['tolerance_db']:g} dB "
            f"(fidelity.tolerance_db), by up to {values['largest_db']:.2f} dB"
        )
    if lost:
        changes.append(f"{lost:,} of {total} {_have(lost)} a path in only one of the traces")
    return (
        f"When the scene is traced again with the calibrated values, {', and '.join(changes)}. Values and intervals "
        "depend on which paths were found. Increase fidelity.rounds or, if trace.samples is a number, trace.samples."
    )


def _worse_than_mean(values: dict[str, Any]) -> str:
    order = "the order of the program's answers" if values["program"] else "the rows of the table"
    return (
        f"The calibrated model fits the links worse than a constant: its RMSE is {values['found_db']:.2f} dB, that of "
        f"the mean measured path loss {values['mean_db']:.2f} dB, and that of the log-distance model "
        f"{values['log_distance_db']:.2f} dB. Do not use the result. Check {order}, the units, and the coordinate "
        "frame of links and scene."
    )


def _larger_budget(values: dict[str, Any]) -> str:
    # Results of earlier versions do not name the method.
    return "Use a larger budget (method.options)" + (
        "." if values.get("method") == "auto" else ", or the method 'auto'."
    )


_REMARKS: Final[dict[RemarkKind, Callable[[dict[str, Any]], str]]] = {
    RemarkKind.CORRELATED_NOISE: _noise_remark("Neighbouring links share part of their errors"),
    RemarkKind.HEAVY_TAILS: _noise_remark("The noise has heavy tails, as with outliers"),
    RemarkKind.ERRORS_OUT_OF_SIGHT: _errors_out_of_sight,
    RemarkKind.HETEROGENEITY: _noise_remark(
        "Errors are larger on links that depend more on the materials, as if buildings of one material differed"
    ),
    RemarkKind.UNDECLARED_OFFSET: lambda values: (
        f"The data show an undeclared offset of {values['offset_db']:+z.1f} dB, standard error "
        f"{values['error_db']:.1f} dB. With this offset, the RMSE would be {values['rmse_db']:.2f} instead of "
        f"{values['rmse_without_db']:.2f} dB. Add [offset] if cable losses or antenna gains are uncertain."
    ),
    RemarkKind.RICHER_PATHS: _richer_paths,
    RemarkKind.MISSED_OPTIMUM: lambda values: (
        f"The method missed the optimum: posterior draws reach an objective of {values['draws_db']:.2f} dB, but the "
        f"method reached {values['found_db']:.2f} dB. The intervals describe the optimum, not the values that were "
        f"found. {_larger_budget(values)}"
    ),
    RemarkKind.WORSE_THAN_START: lambda values: (
        f"The method did not improve on the initial values: they have an RMSE of {values['start_db']:.2f} dB, and the "
        f"method's best candidate has {values['found_db']:.2f} dB. "
        + ("The result keeps the initial values. " if values.get("kept") else "Do not use the result. ")
        + _larger_budget(values)
    ),
    RemarkKind.WORSE_THAN_MEAN: _worse_than_mean,
    RemarkKind.OUTSIDE_INTERVAL: _outside_interval,
    RemarkKind.FEW_DRAWS: lambda values: (
        "Independent populations of draws disagree. The intervals are rough, and a range that fits may be missing, so "
        "parameters are at best weakly identified. Calibrate fewer parameters, or give them priors."
    ),
    RemarkKind.APPROXIMATE_INTERVALS: _approximate_intervals,
    RemarkKind.RAY_MAPPING: _ray_mapping,
    RemarkKind.NO_CHEAP_MODEL: lambda values: f"No cheap model is used: {values['cause']}.",
    RemarkKind.RETRACED: _retraced,
    RemarkKind.LOST_PATHS: lambda values: (
        f"{values['calls']} of {values['of']} RT calls cannot be the result, because links that had a path at the "
        f'initial values have no path in these calls ({rows_text(values["rows"])}). Set objective.no_path = "censor" '
        "and objective.ceiling_db, or leave these links out."
    ),
    RemarkKind.GIVEN_ENGINE: lambda values: (
        f"Path loss was computed by the engine {values['engine']}, which was passed to calibrate. Predictions, maps "
        f"and suggestions use the study's engine {values['used']!r}; these are correct only if both engines agree."
    ),
    RemarkKind.NOT_JUDGED: lambda values: NOT_JUDGED,
    RemarkKind.MISSING_REGION: _missing_region,
    RemarkKind.UNREACHED_LINKS: _unreached_links,
    RemarkKind.DIFFERING_GROUPS: _differing_groups,
    RemarkKind.ANTENNA_DIRECTIONS: _antenna_directions,
    RemarkKind.CONFLICT: _conflict,
}


_BASELINES: Final[dict[str, str]] = {
    Model.INITIAL: "the initial materials with fitted nuisances",
    Model.LOG_DISTANCE: "a log-distance model",
    Model.OBSTRUCTION: "a log-distance model with obstruction",
}
"""Names of baselines for use within a sentence, where they differ from the names of the models."""


def judgement_text(judgement: Judgement) -> str:
    """State by how much calibration improves on the best baseline on held-out links, and how certain this gain is."""
    error = f"RMSE {judgement.rmse_db:.2f} dB on {counted(judgement.links, 'held-out link')}"
    certainty = "no bootstrap standard error: one cluster of links"
    if judgement.error_db is not None:
        certainty = f"bootstrap standard error {judgement.error_db:.2f} dB"
    name = _BASELINES.get(judgement.baseline, judgement.baseline)
    baseline = f"than {name}, the best baseline ({certainty})"
    if judgement.gain_db <= 0:
        return f"Calibration did not help on held-out links: {error}, {-judgement.gain_db:.2f} dB more {baseline}."
    verb = "helped" if judgement.helped else "did not clearly help"
    return f"Calibration {verb} on held-out links: {error}, {judgement.gain_db:.2f} dB less {baseline}."


def choice_text(chosen: str, best: str, partner: str | None = None) -> str:
    """State which model was chosen on held-out blocks, and the reason for the choice.

    `best` has the lowest RMSE on these blocks among the models that can predict any link. `partner` is the model with
    which the chosen model is averaged.
    """
    if partner is None:
        used, preferred = f"The chosen model is {str(chosen)!r}", ""
    else:
        used = f"The chosen model is the average of the models {str(chosen)!r} and {str(partner)!r}"
        preferred = (
            f", because the best model on a few blocks is often not the best elsewhere. The model {str(chosen)!r} is "
            "preferred"
        )
    if chosen == best:
        return f"{used}{preferred}, {'as ' if preferred else ''}the best on held-out blocks."
    near = ", which stays near the initial materials" if chosen == Model.PRIOR else ""
    return (
        f"{used}{preferred}{near}. The model {str(best)!r} is better on held-out blocks, but by too little to be "
        "preferred."
    )


def unused_choice_text(chosen: str) -> str:
    """A note that a validation after the run chose a model that predictions do not use."""
    return (
        f"On held-out blocks, the model {str(chosen)!r} is chosen, but predictions do not use this model yet. To use "
        "it, run the study again with [holdout] blocks."
    )


def chosen_model_text(record: Record) -> str:
    """State the held-out accuracy of the prediction model; the text is empty if this is the calibrated model."""
    model, calibrated_db = record.prediction.model, record.accuracy.holdout_rmse_db
    if model.name == Model.CALIBRATED or model.residual_db is None or calibrated_db is None:
        return ""
    return (
        f"On held-out links, the prediction model {str(model.name)!r} has an RMSE of {model.residual_db:.2f} dB, and "
        f"the calibrated model {calibrated_db:.2f} dB."
    )


def remarks(record: Record, choice: str = "") -> tuple[str, ...]:
    """All remarks about a result: warnings, advice, the judgement on held-out links, and the choice of the model.

    `choice` states why the prediction model was chosen, if validation chose it.
    """
    sentences = [
        remark_text(remark)
        for remark in record.uncertainty.remarks
        # A finished result may be validated later.
        if remark.kind != RemarkKind.NOT_JUDGED or record.held_out is None
    ]
    if record.accuracy.judgement is not None:
        sentences.append(judgement_text(record.accuracy.judgement))
    chosen = chosen_model_text(record)
    if chosen:
        sentences.append(f"{choice} {chosen}".strip())
    return tuple(sentences)
