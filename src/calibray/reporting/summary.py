"""The summary of a report: questions about a calibration, with answers computed from the record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, cast

from calibray.parameters.parameter import PARAMETER_BOUNDS
from calibray.reporting.wording import (
    block_sentence,
    carriers_text,
    engine_text,
    group_text,
    method_text,
    prediction_text,
    scene_alone_text,
    usable_link_text,
)
from calibray.result.record import Record
from calibray.result.verdict import RemarkKind, Verdict
from calibray.result.wording import NOT_JUDGED, UNKNOWN_BEST, judgement_text, remark_text, unused_choice_text
from calibray.support.messages import counted
from calibray.tables import named, rows_text
from calibray.validation.validation import Validation

Kind = Literal["plain", "good", "caution"]

RARE: Final = 0.05
"""If a smaller share of the links than this has a path that interacts with a material, the advice is to measure more
such links."""

LISTED_VALUES: Final = 6
"""Maximum number of identified values that are listed."""

MEANINGS: Final = {
    Verdict.WEAKLY_IDENTIFIED: "weakly identified: the interval covers much of the range",
    Verdict.AMBIGUOUS: "ambiguous: several separate ranges fit the links, or the best fit is outside the interval",
    Verdict.AT_BOUND: "at a bound: the best value may lie outside the bounds, or the model is incomplete",
    Verdict.NOT_IDENTIFIABLE: "not identifiable: all values within the interval fit the links about equally well",
}


@dataclass(frozen=True)
class Sentence:
    """One statement of the summary.

    Attributes:
        heading: The question that the sentence answers; empty if it continues the previous answer.
        text: The answer.
        kind: The kind of answer: neutral, favourable, or a warning.
    """

    heading: str
    text: str
    kind: Kind = "plain"


def summary(result: Record, links_by_material: Mapping[str, int] | None = None) -> tuple[Sentence, ...]:
    """Summarize a calibration in a few sentences: prediction model, fit, benefit, certainty, advice, and warnings.

    `links_by_material` contains, for each material, the number of links with a path that interacts with it; it is None
    if there are no paths.
    """
    return (
        Sentence("What do predictions use?", f"{prediction_text(result)} {scene_alone_text(result)}".strip()),
        _scope(result),
        _fit(result),
        _held_out_accuracy(result),
        *_certainty(result),
        *_advice(result, links_by_material),
        *_cautions(result),
    )


def _scope(result: Record) -> Sentence:
    study = result.study
    materials = list(dict.fromkeys(name.rpartition(".")[0] for name in result.parameters))
    return Sentence(
        "What was calibrated?",
        f"{counted(len(result.parameters), 'constant')} of {_list(materials)} at {carriers_text(result)}, on "
        f"{counted(result.counts['calibrated_on'], 'link')}, by {method_text(result, study.method.name)} with the "
        f"engine {engine_text(result)}: {counted(result.rt_calls, 'RT call')} in {_seconds(result.cost.seconds)}, "
        f"after {_seconds(result.cost.trace_seconds)} of tracing and loading.",
    )


def _fit(result: Record) -> Sentence:
    text = (
        f"On the calibration links, the RMSE is {result.rmse_db:.2f} dB after calibration and "
        f"{result.initial_rmse_db:.2f} dB before."
    )
    if result.fit.nuisance_only_rmse_db is not None:
        text += (
            " With the initial materials and fitted offsets or other nuisances, the RMSE is "
            f"{result.fit.nuisance_only_rmse_db:.2f} dB."
        )
    return Sentence("How well does it fit?", text)


def _held_out_accuracy(result: Record) -> Sentence:
    heading = "Did calibration help on held-out links?"
    judgement, text = result.accuracy.judgement, ""
    if result.held_out is not None:
        validation = Validation.of(result.held_out)
        judgement = validation.judgement
        best_db = validation.table["rmse_db"].min()
        text = f"{block_sentence(validation)} The best model is {validation.best!r}, with an RMSE of {best_db:.2f} dB."
        if validation.chosen != result.prediction.model.name:
            text += f" {unused_choice_text(validation.chosen)}"
    if judgement is None:
        by_filter = f"{UNKNOWN_BEST} Hold out links with [holdout] where."
        return Sentence(heading, NOT_JUDGED if result.study.allows_blocks else by_filter, "caution")
    return Sentence(
        heading, f"{judgement_text(judgement)} {text}".strip(), "good" if judgement.helped else "caution"
    )


def _certainty(result: Record) -> Iterator[Sentence]:
    heading = "How certain are the values?"
    if not result.intervals:
        yield Sentence(
            heading,
            f"Unknown: the engine {engine_text(result)} provides no derivatives, so there are no intervals. "
            "The values fit best among those that were tried; the true values can be very different.",
            "caution",
        )
        return
    identified = _by_verdict(result, Verdict.IDENTIFIED)
    if identified:
        values = [
            f"{name} {_value(result, name)} ({_number(result.intervals[name].lower)} to "
            f"{_number(result.intervals[name].upper)})"
            for name in identified[:LISTED_VALUES]
        ]
        rest = len(identified) - LISTED_VALUES
        more = f" and {rest} more" if rest > 0 else ""
        yield Sentence(
            heading,
            f"The links identify {len(identified)} of {len(result.intervals)} parameters: {'; '.join(values)}{more}.",
            "good",
        )
    else:
        yield Sentence(heading, "No parameter is identified.", "caution")
    for verdict, meaning in MEANINGS.items():
        if names := _by_verdict(result, verdict):
            verb = "is" if len(names) == 1 else "are"
            yield Sentence("", f"{_list(names)} {verb} {meaning}.", "caution")
    for remark in result.uncertainty.remarks:
        if remark.kind == RemarkKind.OUTSIDE_INTERVAL:
            names = _list(cast("list[str]", remark.values["names"]))
            yield Sentence(
                "",
                f"Calibrated values outside their intervals: {names}. These values have the lowest RMSE, but nearly "
                "all probable values are inside the intervals. Do not use the calibrated values as material constants.",
                "caution",
            )


def _advice(result: Record, links_by_material: Mapping[str, int] | None) -> Iterator[Sentence]:
    heading = "What should be measured next?"
    unidentified = _by_verdict(result, Verdict.NOT_IDENTIFIABLE)
    owners = dict.fromkeys(name.rpartition(".")[0] for name in unidentified)
    # Some parameters belong, for example, to antennas, which are not materials with which paths interact.
    materials = [name for name in owners if name in result.materials]
    sentences = []
    # Suggestions need derivatives, which external programs do not provide.
    ranked = result.uncertainty.draws and not result.study.engine.external
    if ranked and (unidentified or _by_verdict(result, Verdict.AMBIGUOUS)):
        sentences.append(
            "calibray suggest DIR CANDIDATES ranks candidate positions by how much a measurement there should narrow "
            "the intervals."
        )
    if materials and links_by_material is None:
        sentences.append(f"Measure links whose strongest paths interact with {_list(materials)}.")
    elif links_by_material is not None:
        total = max(len(result.links), 1)
        sentences += [f"{name}: {_coverage(links_by_material.get(name, 0), total)}." for name in materials]
    yield from _headed(heading, sentences, "plain")


def _coverage(count: int, total: int) -> str:
    """Advice about an unidentifiable material, based on the number of links that have a path that interacts with it."""
    if count == 0:
        return (
            "no path of any link interacts with this material, so the links cannot identify it; measure links that "
            "have such paths"
        )
    verb = "has" if count == 1 else "have"
    links = f"{count:,} of {counted(total, 'link')} {verb} paths that interact with this material"
    if count < RARE * total:
        return f"only {links}; measure more such links"
    return (
        f"{links}, but the errors are too large, these paths are too weak, or other unknowns compensate; measure links "
        "on which such a path is the strongest"
    )


def _cautions(result: Record) -> Iterator[Sentence]:
    sentences = []
    without_path = result.counts["rows_without_path"]
    if without_path:
        verb, count = "has" if len(without_path) == 1 else "have", counted(len(result.links), "link")
        sentences.append(f"{len(without_path):,} of {count} {verb} no path ({rows_text(without_path)}).")
    enclosed = result.provenance.enclosed
    if enclosed is not None:
        for end, rows, below in enclosed.ends:
            if rows and not enclosed.indoors:
                sentences.append(
                    f"The {end} is inside a building in {rows_text(list(rows))}: check the positions."
                )
            if below:
                sentences.append(
                    f"The {end} is below the ground in {rows_text(list(below))}: check the heights."
                )
    sentences += [
        remark_text(remark) for remark in result.uncertainty.remarks if remark.kind == RemarkKind.RETRACED
    ]
    if result.nuisance.groups_without_path:
        groups = named(group_text(result, group) for group in result.nuisance.groups_without_path)
        sentences.append(
            f"No calibration link of {groups} has {usable_link_text(result)}, so the offset is unknown."
        )
    yield from _headed("What calls for caution?", sentences, "caution")


def _headed(heading: str, sentences: Sequence[str], kind: Kind) -> Iterator[Sentence]:
    for number, text in enumerate(sentences):
        yield Sentence("" if number else heading, text, kind)


def _by_verdict(result: Record, verdict: Verdict) -> list[str]:
    return [name for name, interval in result.intervals.items() if interval.verdict == verdict]


def _value(result: Record, name: str) -> str:
    unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
    return _number(result.parameters[name]) + ("" if unit == "1" else f" {unit}")


def _number(value: float) -> str:
    return f"{value:.3g}"


def _list(names: Sequence[str]) -> str:
    """Join names with commas, and with "and" before the last; if there are more than eight names, list only eight."""
    if len(names) > 8:
        return named(names, 8)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _seconds(value: float) -> str:
    # With two significant digits, values of at least 99.5 would be printed as 1e+02.
    return f"{value:.2g} s" if value < 99.5 else f"{value / 60:.0f} min"
