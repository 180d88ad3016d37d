"""Path loss at links that were never measured, with the calibrated scene and nuisances, and how sure it is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibray import fields
from calibray.engines.kinds.replay import replay
from calibray.errors import InputError
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE, OFFSET, UNKNOWN_DB, transmitters
from calibray.measurements import Measurements, SourceTable
from calibray.prediction.position_checks import PLACES, remarks
from calibray.prediction.quantity import as_measured
from calibray.prediction.residual_field import carried, measured_errors
from calibray.result.prediction_model import PredictionModel
from calibray.result.record import Record
from calibray.study import Setup
from calibray.support.progress import Progress
from calibray.validation.held_out_statistics import FEWEST_FOR_RANKS, interval_half_width

TRANSMITTER: Final = "transmitter"
"""What a term of the model that was chosen has an offset for each of, without a column that says so."""

BESIDE: Final = 0.1
"""Share of their neighbours' common errors from which on links are said to lie beside these."""

KnownTerm = tuple[str, NDArray[np.float64], "NDArray[np.str_] | None", dict[str, float]]
"""Name of a nuisance, its column [n], labels of the groups [n] if it has any, and the coefficient of each."""


def predict(
    result: Record,
    links: Measurements | pd.DataFrame,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> NDArray[np.float64]:
    """Path loss at links that were never measured.

    Args:
        result: The calibration.
        links: The links, or a table with columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m], or else with those that
            the study names for positions, and with its group column, if it has one. The study's column of
            frequencies gives the links' carriers; without it all links have the scene's.
        progress: Called with the stage "tracing" after every launch.
        allow_changed_inputs: Predict although a file of the scene or an antenna changed since the calibration.

    Returns:
        Path loss, offsets included [n], [dB]; +inf where no path leads.

    Raises:
        InputError: A column is missing, a position cannot be used, a group has no calibrated offset, or a file of the
            scene or an antenna changed since the calibration.
    """
    return _path_loss(
        result, opened(result, as_links(result, links), allow_changed_inputs=allow_changed_inputs), progress
    )


def opened(result: Record, links: Measurements, *, allow_changed_inputs: bool = False) -> Setup:
    """The study of a calibration, opened for links that were never measured.

    Args:
        result: The calibration.
        links: The links.
        allow_changed_inputs: Open it although a file of the scene or an antenna changed since the calibration.

    Returns:
        The opened study.

    Raises:
        InputError: The scene or the parameters cannot be used, or such a file changed.
    """
    setup = Setup.open(result.study, links=links)
    if not allow_changed_inputs:
        _check_files(result, setup)
    return setup


def _path_loss(result: Record, setup: Setup, progress: Progress | None) -> NDArray[np.float64]:
    links, study = setup.links, result.study
    beside = _beside(result, links)[0]
    if result.prediction.model is not None:
        loss, shift = _chosen(result, result.prediction.model, setup, progress, strangers=False)
        return loss + shift.value[0] + beside
    shift = _shift(_terms(result, links), links, {}).value[0] + beside
    paths = setup.trace(result.materials, progress)
    if links.frequency is None:
        return fields.path_loss(paths, None, study.objective.combining, study.scene.bandwidth) + shift
    values = np.array([[result.parameters[name] for name in setup.parameters.names]])
    return replay(setup, paths).path_loss(values)[0] + shift


def predict_interval(
    result: Record,
    links: Measurements | pd.DataFrame,
    level: float = 0.9,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> pd.DataFrame:
    """Path loss at links that were never measured, with the interval that a measurement there would lie in.

    Three things make it wide: errors of single links, of the size that they have where nothing was fitted if the
    calibration held links out; parameters, over all values that explain the links about as well; and for a group that
    was never measured the spread of those that were.

    Args:
        result: The calibration.
        links: The links, or a table, as for `predict`; groups need not have been measured.
        level: Probability that a measurement lies within.
        progress: Called with the stage "tracing" after every launch.
        allow_changed_inputs: Predict although a file of the scene or an antenna changed since the calibration.

    Returns:
        One row per link: path_loss_db, lower_db, upper_db, and basis, what the interval was taken from. Where no path
        leads, the path loss is infinite and the ends are missing. Where not path loss was measured, the three follow as
        what was. Last, a remark on links that end beyond the scene, under the ground or inside a building.

    Raises:
        InputError: What `predict` refuses but for groups, the level is not between 0 and 1, or the calibration had too
            few links to tell the size of errors.
    """
    setup = opened(result, as_links(result, links), allow_changed_inputs=allow_changed_inputs)
    told = interval(result, setup, level, progress)
    own = as_measured(result.study, setup.links, told)
    return told.assign(**own, remark=remarks(result, setup))


def interval(
    result: Record, setup: Setup, level: float | None = 0.9, progress: Progress | None = None
) -> pd.DataFrame:
    """What `predict_interval` gives, of links that are opened already.

    Args:
        result: The calibration.
        setup: Its study, opened for the links.
        level: Probability that a measurement lies within; None for path loss alone.
        progress: Called with the stage "tracing" after every launch.

    Returns:
        One row per link: path_loss_db and, with a level, lower_db, upper_db and basis.

    Raises:
        InputError: The level is not between 0 and 1, or the calibration had too few links to tell the size of errors.
    """
    links = setup.links
    if level is None:
        return pd.DataFrame({"path_loss_db": _path_loss(result, setup, progress)})
    if not 0 < level < 1:
        raise InputError(f"level = {level:g}: must lie between 0 and 1, as 0.9")
    added, share = _beside(result, links)
    if (chosen := result.prediction.model) is not None:
        loss, shift = _chosen(result, chosen, setup, progress, strangers=True)
        best, variance, basis = loss + shift.value[0], shift.spread**2, chosen.basis
        size, sizes, freedom = chosen.residual_db, np.array(chosen.sizes_db), chosen.links
    else:
        size, basis, sizes = _residual(result)
        shift = _shift(_terms(result, links), links, result.uncertainty.draws, strangers=True)
        names = setup.parameters.names
        values = np.array([[result.parameters[name] for name in names]])
        if result.uncertainty.draws:
            values = np.vstack([values, np.stack([result.uncertainty.draws[name] for name in names], axis=1)])
        modelled = replay(setup, setup.trace(result.materials, progress)).path_loss(values) + shift.value
        best, reached = modelled[0], np.isfinite(modelled).all(axis=0)
        drawn = np.where(reached, modelled[1:] - np.where(reached, best, 0.0), 0.0)
        variance = shift.spread**2 + (np.mean(drawn**2, axis=0) if len(drawn) else 0.0)
        best = np.where(reached, best, np.inf)
        freedom = max(result.counts["calibrated_on"] - len(names), 1)
        basis += "" if len(drawn) else ", parameters as if known"
    # Beside measured links only their own part of the errors is left open.
    own = (
        size
        if result.prediction.residual_field is None
        else min(result.prediction.residual_field.own_db, size)
    )
    deviation = np.sqrt((1.0 - share) * size**2 + share * own**2 + variance)
    factor = (
        float(stdtrit(freedom, (1 + level) / 2))
        if len(sizes) < FEWEST_FOR_RANKS
        else interval_half_width(sizes, level) / max(size, 1e-9)
    )
    said = np.where(shift.spread > 0, f"{basis}, group never measured", basis)
    said = np.where(share > BESIDE, np.char.add(said, ", beside measured links"), said)
    half = np.where(np.isfinite(best), factor * deviation, np.nan)
    best = best + added
    return pd.DataFrame(
        {
            "path_loss_db": best,
            "lower_db": best - half,
            "upper_db": best + half,
            "basis": np.where(np.isfinite(best), said, "no path"),
        }
    )


def _beside(result: Record, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What measured links nearby add to path loss [n], [dB], and the share of their common errors known then [n]."""
    field = result.prediction.residual_field
    if field is None or links.frequency is not None or not set(PLACES) <= set(result.links):
        return np.zeros(len(links)), np.zeros(len(links))
    known, errors = measured_errors(result.links)
    measured = result.links[list(PLACES)].to_numpy(float)[known]
    return carried(field, measured, errors, np.hstack([links.tx, links.rx]))


def as_links(result: Record, links: Measurements | pd.DataFrame | SourceTable) -> Measurements:
    """Links to predict at, of a table or rows of a file.

    Args:
        result: The calibration.
        links: The links, a table as `predict` takes it, or rows of a file that holds one.

    Returns:
        The links, grouped as the study's offset is, with carriers if it has a column of them.

    Raises:
        InputError: A column is missing, or a position is not finite.
    """
    if isinstance(links, Measurements):
        return links
    if not isinstance(links, SourceTable):
        links = SourceTable(links.reset_index(drop=True), source="links")
    return result.study.places(links)


def check_groups(result: Record, links: Measurements) -> None:
    """Refuse links of which a nuisance is not known, before anything is traced.

    Args:
        result: The calibration.
        links: The links.

    Raises:
        InputError: A group has no calibrated offset, or a column is missing.
    """
    terms = (
        _terms(result, links)
        if result.prediction.model is None
        else _chosen_terms(result.prediction.model, links)
    )
    _shift(terms, links, {})


def _residual(result: Record) -> tuple[float, str, NDArray[np.float64]]:
    """Standard deviation of single links' errors [dB], what it was taken from, and sizes of errors held out [k]."""
    if result.accuracy.residual_db is not None:
        table, sizes = result.links, np.zeros(0)
        if result.accuracy.residual_basis.endswith("links held out"):
            away = np.abs(table["after_db"].to_numpy(float) - table["measured_db"].to_numpy(float))
            sizes = np.sort(away[table["held_out"].to_numpy(bool) & np.isfinite(away)])
        return result.accuracy.residual_db, f"errors of {result.accuracy.residual_basis}", sizes
    count = result.counts["calibrated_on"]
    freedom = count - len(result.parameters) - len(result.nuisance.offsets_db)
    if freedom < 1:
        raise InputError(
            f"{result.study.path}: {count} links are too few to tell the size of errors; measure more, or predict "
            "without a level"
        )
    size = result.rmse_db * float(np.sqrt(count / freedom))
    return size, f"errors of {count} calibration links", np.zeros(0)


class Shift(NamedTuple):
    """What nuisances add to path loss.

    Attributes:
        value: By the best coefficients, then by each draw [1 + draws, n], [dB].
        spread: Standard deviation at links of groups that were never seen, else 0 [n], [dB].
    """

    value: NDArray[np.float64]
    spread: NDArray[np.float64]


def _chosen(
    result: Record, chosen: PredictionModel, setup: Setup, progress: Progress | None, strangers: bool
) -> tuple[NDArray[np.float64], Shift]:
    """Path loss by the model that was chosen, without its nuisances [n], [dB], and these."""
    links = setup.links
    shift = _shift(_chosen_terms(chosen, links), links, {}, strangers)
    if chosen.parameters is None:
        carrier = result.study.scene.frequency if links.frequency is None else links.frequency
        return 20 * np.log10(np.full(len(links), carrier) / result.study.scene.frequency), shift
    values = np.array([[chosen.parameters[name] for name in setup.parameters.names]])
    loss = replay(setup, setup.trace(result.materials, progress)).path_loss(values)[0]
    ceiling = result.study.objective.ceiling_db
    return loss if ceiling is None else np.minimum(loss, ceiling), shift


def _chosen_terms(chosen: PredictionModel, links: Measurements) -> Iterator[KnownTerm]:
    for term in chosen.terms:
        labels = None
        if term.per == TRANSMITTER:
            labels = transmitters(links)
        elif term.per:
            labels = links.group if term.per == OFFSET else links.table.labels(term.per)
        yield term.name, _column(links, term.by, term.centre), labels, term.coefficients


def _shift(
    terms: Iterator[KnownTerm], links: Measurements, draws: dict[str, list[float]], strangers: bool = False
) -> Shift:
    count = 1 + len(next(iter(draws.values()), ()))
    value, variance = np.zeros((count, len(links))), np.zeros(len(links))
    for name, column, labels, known in terms:
        best = np.array(list(known.values()))
        every = np.stack([
            np.array([known[label], *draws.get(f"{name}[{label}]" if label else name, [known[label]] * (count - 1))])
            for label in known
        ], axis=1)  # fmt: skip
        given = np.full(len(links), "") if labels is None else labels
        order = {label: place for place, label in enumerate(known)}
        place = np.array([order.get(str(label), -1) for label in given])
        if (place < 0).any() and not strangers:
            stranger = str(given[int(np.argmax(place < 0))])
            raise InputError(
                f"{links.source}: group {stranger!r} has no calibrated {name}; known: {', '.join(known)}"
            )
        mean = every.mean(axis=1, keepdims=True)
        value += column * np.where(place >= 0, every[:, place], mean)
        size = np.std(best, ddof=1) if len(best) > 1 else UNKNOWN_DB
        variance += np.where(place >= 0, 0.0, (column * size) ** 2 * (1 + 1 / len(best)))
    return Shift(value, np.sqrt(variance))


def _terms(result: Record, links: Measurements) -> Iterator[KnownTerm]:
    """Name, column, labels at the links and coefficients of every nuisance."""
    for name, coefficients in result.nuisance.coefficients.items():
        if not coefficients:
            continue
        if name == OFFSET:
            grouped = result.study.offset is not None and result.study.offset.per is not None
            yield name, np.ones(len(links)), links.group if grouped else None, coefficients
        else:
            section = result.study.nuisance[name]
            labels = None if section.per is None else links.table.labels(section.per)
            centre = result.nuisance.centres.get(name, 0.0)
            yield name, _column(links, section.by, centre), labels, coefficients


def _column(links: Measurements, by: str, centre: float) -> NDArray[np.float64]:
    if by == CONSTANT:
        return np.ones(len(links))
    return (np.log10(links.distance) if by == LOG_DISTANCE else links.table.numbers(by)) - centre


def _check_files(result: Record, setup: Setup) -> None:
    """Refuse a scene that is not the one that was calibrated; results of the version before cannot tell."""
    if not result.provenance.files:
        return
    # By name, for the folder may have moved as a whole.
    before, now = (
        sorted((Path(file).name, digest) for file, digest in files.items())
        for files in (result.provenance.files, setup.files)
    )
    changed = sorted({name for name, _ in set(before) ^ set(now)})
    if changed:
        raise InputError(
            f"{result.study.path}: {', '.join(changed[:5])} changed since the calibration, which may no longer hold; "
            "calibrate again, or give --allow-changed-inputs (allow_changed_inputs=True)"
        )
