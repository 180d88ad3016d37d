"""What a calibration found, in sentences that are computed from it and say no more than it knows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from calibray.optimizers.methods import label
from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.reporting.link_survey import residual
from calibray.result.record import Record
from calibray.tables.display import hertz, named
from calibray.tables.text import rows_text
from calibray.validation.validation import Validation

Kind = Literal["plain", "good", "caution"]

CLEAR: Final = 2.0
"""Standard errors beyond which a difference is not taken for chance."""

FEW: Final = 0.05
"""Share of the links below which a material is met by few."""


@dataclass(frozen=True)
class Sentence:
    """One statement.

    Attributes:
        heading: The question that it answers.
        text: The answer.
        kind: Whether it is plain, good to hear, or calls for caution.
    """

    heading: str
    text: str
    kind: Kind = "plain"


def summary(result: Record, meets: Mapping[str, int] | None = None) -> tuple[Sentence, ...]:
    """A calibration in a few sentences.

    Args:
        result: The calibration.
        meets: Links of which any path meets a material, by material; None where no paths are at hand.

    Returns:
        What was calibrated, how well it fits, whether it helped where nothing was fitted, how sure the values are, what
        to measure next, and what calls for caution.
    """
    return (
        _what(result),
        _fit(result),
        _help(result),
        *_sure(result),
        *_next(result, meets),
        *_cautions(result),
    )


def _what(result: Record) -> Sentence:
    study, count = result.study, len(result.parameters)
    materials = list(dict.fromkeys(name.rpartition(".")[0] for name in result.parameters))
    constants = "1 constant" if count == 1 else f"{count} constants"
    return Sentence(
        "What was calibrated",
        f"{constants} of {_list(materials)} at {hertz(study.scene.frequency)}, on "
        f"{result.counts['calibrated_on']:,} measured links, by {label(study.method.name)} on the engine "
        f"{study.engine.name}: {result.rt_calls:,} RT calls, {_seconds(result.cost.seconds)} after "
        f"{_seconds(result.cost.trace_seconds)} of tracing and loading.",
    )


def _fit(result: Record) -> Sentence:
    text = (
        f"On the links it was calibrated on, the RMSE went from {result.initial_rmse_db:.2f} to "
        f"{result.rmse_db:.2f} dB."
    )
    if result.fit.nuisance_only_rmse_db is not None:
        text += f" Fitted offsets with the initial materials give {result.fit.nuisance_only_rmse_db:.2f} dB."
    return Sentence("How well it fits", text)


def _help(result: Record) -> Sentence:
    heading = "Did it help where nothing was fitted?"
    if result.held_out is not None:
        validation = Validation.of(result.held_out)
        text = (
            f"{len(validation.labels)} blocks of links were held out in turn. {validation.sentence} The best model "
            f"there is {validation.best!r}, {validation.table['rmse_db'].min():.2f} dB."
        )
        return Sentence(heading, text, "good" if validation.judgement.helped else "caution")
    after, before = result.holdout_rmse_db, result.accuracy.initial_holdout_rmse_db
    if after is None or before is None:
        return Sentence(
            heading,
            "Not known: no links were held out. A fit looks good on its own links in any case; name some with "
            "[holdout] in the study file and run again.",
            "caution",
        )
    rivals = {
        "the scene before calibration": (before, "before_db"),
        "a log-distance model": (result.accuracy.log_distance_holdout_rmse_db, "log_distance_db"),
    }
    if result.accuracy.nuisance_only_holdout_rmse_db is not None:
        rivals["offsets alone"] = (result.accuracy.nuisance_only_holdout_rmse_db, "offset_only_db")
    known = {name: entry for name, entry in rivals.items() if entry[0] is not None}
    best = min(known, key=lambda name: known[name][0])
    rmse, column = known[best]
    count = result.counts["held_out"]
    text = (
        f"On {count:,} links held out, the RMSE is {after:.2f} dB, against {before:.2f} dB before. "
        f"The best rival there is {best} with {rmse:.2f} dB."
    )
    clear = _clear(result, column) if column in result.links else False
    if after >= rmse:
        return Sentence(heading, f"{text} Calibration did not beat it.", "caution")
    if not clear:
        return Sentence(
            heading,
            f"{text} Calibration is ahead, but these links do not show that it is more than chance.",
            "caution",
        )
    return Sentence(
        heading,
        f"{text} So it helped, by more than chance explains as far as the links' errors are independent.",
        "good",
    )


def _clear(result: Record, rival: str) -> bool:
    """Whether squared errors on the held-out links are less than a rival's by more than chance, link by link."""
    table = result.links[result.links["held_out"].to_numpy(bool)]
    gain = residual(table, rival) ** 2 - residual(table) ** 2
    gain = gain[np.isfinite(gain)]
    if len(gain) < 3:
        return False
    error = gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(gain.mean() > CLEAR * error)


def _sure(result: Record) -> Iterator[Sentence]:
    heading = "How sure are the values?"
    if not result.intervals:
        yield Sentence(
            heading,
            f"Not known: the engine {result.study.engine.name} gives no derivatives, so there are no intervals. "
            "Take the values for the best found, not for the truth.",
            "caution",
        )
        return
    told = _by_verdict(result, "identified")
    if told:
        values = [
            f"{name} {_value(result, name)} ({_number(result.intervals[name].lower)} to "
            f"{_number(result.intervals[name].upper)})"
            for name in told[:6]
        ]
        more = f" and {len(told) - 6} more" if len(told) > 6 else ""
        yield Sentence(
            heading,
            f"The links tell {len(told)} of {len(result.intervals)}: {'; '.join(values)}{more}.",
            "good",
        )
    for verdict, meaning in (
        ("weakly identified", "told roughly: their intervals take up much of their ranges"),
        ("ambiguous", "told to lie in one of several ranges; which of them, these links do not tell"),
        (
            "at bound",
            "at an end of their bounds: the best value may lie beyond, or the model lacks something",
        ),
        ("not identifiable", "not told by these links: any value within the interval fits about as well"),
    ):
        if names := _by_verdict(result, verdict):
            begin = "None is certain. " if not told and verdict == "not identifiable" else ""
            yield Sentence(heading if begin else "", f"{begin}{_list(names)}: {meaning}.", "caution")
    if any(interval.approximate for interval in result.intervals.values()):
        yield Sentence(
            "",
            f"These intervals are approximate: the engine {result.study.engine.name} gives no derivatives, and what it "
            "answered to its calls stands in for it.",
            "caution",
        )


def _next(result: Record, meets: Mapping[str, int] | None) -> Iterator[Sentence]:
    blind = _by_verdict(result, "not identifiable")
    if result.uncertainty.draws and (blind or _by_verdict(result, "ambiguous")):
        yield Sentence(
            "What to measure next?",
            "calibray suggest DIR CANDIDATES ranks places by how much narrower the intervals would become.",
        )
    unsure = list(dict.fromkeys(name.rpartition(".")[0] for name in blind))
    if not unsure:
        return
    heading = "" if result.uncertainty.draws else "What to measure next?"
    if meets is None:
        yield Sentence(heading, f"Links whose strongest paths meet {_list(unsure)}.")
        return
    total = max(len(result.links), 1)
    for place, name in enumerate(unsure):
        count = meets.get(name, 0)
        if count == 0:
            advice = "no path of any link meets it: these links cannot tell it at all; measure where paths do"
        elif count < FEW * total:
            advice = f"paths of only {count:,} of {total:,} links meet it; measure more links where they do"
        else:
            advice = (
                f"paths of {count:,} of {total:,} links meet it, but too weakly, or together with other unknowns; "
                "measure where a path that meets it is the strongest"
            )
        yield Sentence("" if place else heading, f"{name}: {advice}.")


def _cautions(result: Record) -> Iterator[Sentence]:
    heading = "What calls for caution"
    found = []
    lost = result.counts["rows_without_path"]
    if lost:
        found.append(f"No path leads to {len(lost):,} of {len(result.links):,} links ({rows_text(lost)}).")
    if result.provenance.enclosed is not None and not result.provenance.enclosed.indoors:
        for end, rows in (
            ("transmitter", result.provenance.enclosed.tx),
            ("receiver", result.provenance.enclosed.rx),
        ):
            if rows:
                found.append(
                    f"A {end} stands inside a building in {rows_text(list(rows))}: check the positions."
                )
    gap, tolerance = result.fit.retrace_gap_db, result.study.fidelity.tolerance_db
    if gap is not None and gap > tolerance:
        found.append(
            f"Traced again with the values found, a link changes by up to {gap:.2f} dB, more than {tolerance:g} dB."
        )
    if result.nuisance.groups_without_path:
        found.append(
            f"No link with a path in {named(result.nuisance.groups_without_path)}: no offset is known there."
        )
    for place, text in enumerate(found):
        yield Sentence("" if place else heading, text, "caution")


def _by_verdict(result: Record, verdict: str) -> list[str]:
    return [name for name, interval in result.intervals.items() if interval.verdict == verdict]


def _value(result: Record, name: str) -> str:
    unit = PARAMETER_BOUNDS[name.rpartition(".")[2]].unit
    return _number(result.parameters[name]) + ("" if unit == "1" else f" {unit}")


def _number(value: float) -> str:
    return f"{value:.3g}"


def _list(names: Sequence[str]) -> str:
    """Names as in a sentence, the first eight where there are more."""
    if len(names) > 8:
        return f"{named(names, 8)}"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 100 else f"{value / 60:.0f} min"
