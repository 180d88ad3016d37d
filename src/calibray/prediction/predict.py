"""Path loss of new links with the calibrated scene and nuisances, and an interval for a measurement of each link."""

from __future__ import annotations

import logging
from collections.abc import Container, Mapping
from dataclasses import replace
from numbers import Real
from typing import Final, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import stdtrit

from calibray.engines.kinds.replay import replay
from calibray.engines.protocol import Answering, Engine
from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.measurements import Measurements, SourceTable
from calibray.measurements.table_files import with_index_columns
from calibray.parameters import fixed_constant, split_name
from calibray.paths import take_links
from calibray.prediction.corrections import (
    calibration_residuals,
    fill_missing,
    krige_residuals,
    model_terms,
    nuisance_shift,
)
from calibray.prediction.observables import Replayed, as_measured, further_observables
from calibray.result.files import changed_files
from calibray.result.held_out import AVERAGES, NEW_GROUP, WITHOUT_MATERIALS, Model, PredictionModel
from calibray.result.record import Record
from calibray.scenes import Triangles, read_triangles
from calibray.scenes.checks.positions import INSIDE, locate
from calibray.scenes.obstruction import CLUSTER, OUT_OF_SIGHT
from calibray.scenes.obstruction import COLUMNS as OBSTRUCTION
from calibray.study import Setup
from calibray.study.calibration_sections import OFFSET
from calibray.study.link_checks import refuse_far_receivers
from calibray.study.mounting import check_mounting_columns
from calibray.support.messages import type_name
from calibray.support.progress import Progress
from calibray.tables import hertz
from calibray.validation.models import without_scene

_LOG: Final = logging.getLogger(__name__)

NEIGHBOURS: Final = (0.125, 0.5)
"""Displacements at which antennas are traced, as shares of the largest displacement. If the largest is 8 m, these
displacements are 1 m and 4 m."""

NEAR_SHARE: Final = 0.1
"""A link counts as near measured links if they explain more than this share of the residual field's variance."""

WEAKER_DB: Final = 10.0
"""A prediction gets a remark if it exceeds the largest calibrated path loss by more than this value [dB]. In a
synthetic town with wrong building heights, predictions above this limit had errors of up to 46 dB."""


SAME_ANSWER_DB: Final = 0.01
"""Calibray warns if a program's path loss for a calibration link differs from the stored value by more than this
[dB]."""


def predict(
    result: Record,
    links: Measurements | pd.DataFrame,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> NDArray[np.float64]:
    """Predict the path loss of new links; see `Result.predict`.

    Raises:
        InputError: A column is missing, a position cannot be used, all receivers are far from the scene, a group has no
            calibrated offset, or a scene or antenna file has changed since the calibration.
    """
    setup = open_for_links(result, as_links(result, links), allow_changed_inputs=allow_changed_inputs)
    refuse_far_links(result, setup.links, read_triangles(setup.scene))
    return interval(result, setup, None, progress)["path_loss_db"].to_numpy()


def predict_interval(
    result: Record,
    links: Measurements | pd.DataFrame,
    level: float = 0.9,
    progress: Progress | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> pd.DataFrame:
    """Predict the path loss of new links, with an interval for a measurement; see `Result.predict_interval`.

    The width of the interval has up to three parts. The first part is the typical size of the residuals of individual
    links, taken from held-out links if the calibration has any. The second part is the scatter of the draws; if blocks
    were held out, this part is omitted, because their residuals include it. The third part, for links of a group
    without measurements, is the spread between groups.

    Raises:
        InputError: `predict` would reject the input for a reason other than an unknown group, the level is not between
            0 and 1, or the calibration had too few links to estimate the size of residuals.
    """
    setup = open_for_links(result, as_links(result, links), allow_changed_inputs=allow_changed_inputs)
    refuse_far_links(result, setup.links, read_triangles(setup.scene))
    table = interval(result, setup, level, progress)
    table = add_remarks(result, setup, table.assign(**as_measured(result.study, setup.links, table)))
    # pandas aligns assigned columns by index, so predictions for a sorted or filtered table need the index of that
    # table.
    if isinstance(links, pd.DataFrame) and len(links) == len(table):
        return table.set_axis(links.index, axis="index")
    return table


def as_links(result: Record, links: Measurements | pd.DataFrame | SourceTable) -> Measurements:
    """Read new links from a table or from rows of a file; the study names the columns of their groups and carriers.

    Raises:
        InputError: The links are not a table, a column for groups, carriers or antennas is missing, or a position is
            not finite.
    """
    if isinstance(links, Measurements):
        return links
    if isinstance(links, pd.DataFrame):
        if links.columns.has_duplicates:
            name = links.columns[links.columns.duplicated()][0]
            raise InputError(f"links: several columns are named {name!r}; keep one")
        links = SourceTable(with_index_columns(links).infer_objects(), source="links")
    if not isinstance(links, SourceTable):
        raise InputError(
            f"links: is a {type_name(links)}, must be a pandas DataFrame, such as pandas.read_csv(file) for a file, or "
            "table.to_pandas() for a table from another package"
        )
    placed = result.study.places(links)
    check_mounting_columns(result.study, placed.table)
    return _with_measured_spellings(result.prediction.model, placed)


def _with_measured_spellings(model: PredictionModel, links: Measurements) -> Measurements:
    """Restore the measurements' spelling of labels; for example, a numeric column turns the label 007 into 7."""
    for term in model.terms:
        spelling: dict[str, set[str]] = {}
        for label in term.coefficients:
            spelling.setdefault(_as_number(label), set()).add(label)
        known = {read: labels.pop() for read, labels in spelling.items() if len(labels) == 1}
        if term.name == OFFSET and links.group is not None:
            links = replace(links, group=_spelled(links.group, term.coefficients, known))
        elif term.per in links.frame:
            labels = _spelled(links.table.labels(term.per), term.coefficients, known)
            links = replace(links, table=links.table.assign(**{term.per: labels}))
    return links


def _spelled(
    labels: NDArray[np.str_], measured: Container[str], known: Mapping[str, str]
) -> NDArray[np.str_]:
    return np.array([label if label in measured else known.get(label, label) for label in labels.tolist()])


def _as_number(label: str) -> str:
    """The form of a label after reading, if the columns from which the label is composed contain only numbers."""
    parts = []
    for part in label.split(" "):
        try:
            # Python reads 1_2 as 12, but tables keep 1_2 as text.
            parts.append(part if "_" in part else str(float(part)).removesuffix(".0"))
        except ValueError:
            parts.append(part)
    return " ".join(parts)


def open_for_links(result: Record, links: Measurements, *, allow_changed_inputs: bool = False) -> Setup:
    """Open the study of a calibration for new links.

    Raises:
        InputError: The scene or the parameters cannot be used, or a scene or antenna file has changed since the
            calibration.
    """
    warn_of_carriers(result, links)
    setup = Setup.open(result.study, links=links).placed_at(result.parameters, NEIGHBOURS)
    check_inputs(result, setup, allow_changed_inputs)
    return setup


def warn_of_carriers(result: Record, links: Measurements) -> None:
    """Warn if the links lack the study's column of carriers, or have carriers at which no link was measured."""
    column = result.study.links.frequency
    if column is not None and links.frequency is None:
        _LOG.warning(
            "%s: lacks the column of carriers %r, so all links are predicted at scene.frequency = %s; for other "
            "carriers, add the column", links.source, column, hertz(result.study.scene.frequency),
        )  # fmt: skip
    if links.frequency is not None and "frequency" in result.links:
        low, high = result.links["frequency"].min(), result.links["frequency"].max()
        beyond = (links.frequency < 0.99 * low) | (links.frequency > 1.01 * high)
        if beyond.any():
            measured = f"other than the measured {hertz(low)}"
            if low < high:
                measured = f"outside the measured range of {hertz(low)} to {hertz(high)}"
            _LOG.warning(
                "%s: %d of %d links have carriers %s; materials are extrapolated, and the intervals do not account for "
                "this", links.source, beyond.sum(), len(links), measured,
            )  # fmt: skip


def refuse_far_links(result: Record, links: Measurements, triangles: Triangles) -> None:
    """Reject links if all their receivers are far from the scene, given the triangles of the scene.

    No links are rejected if some triangles are unknown, because the size of the scene is then unknown.

    Raises:
        InputError: All receivers are far from the scene.
    """
    if triangles.left_out or not len(triangles.face):
        return
    corners, section = triangles.corners, result.study.links
    bounds = np.concatenate([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    is_geographic = section.position == "geographic" and any(name in links.frame for name in section.rx)
    refuse_far_receivers(bounds, links.rx, links.source, is_geographic)


def traced_materials(result: Record, materials: dict[str, Material] | None) -> dict[str, Material] | None:
    """The materials for the trace if the paths depend on them; otherwise None, because one trace serves all materials.

    The tracer's sampling depends on the materials only with refraction or diffuse reflection. The powers of
    rays from an external program always depend on the materials.
    """
    trace, rays = result.study.trace, result.study.engine.exports_rays
    return materials if trace.refraction or trace.diffuse_reflection or rays else None


def check_groups(result: Record, links: Measurements) -> None:
    """Before anything is traced, reject links of groups without a coefficient.

    Raises:
        InputError: A group has no calibrated coefficient, or a column is missing.
    """
    model = result.prediction.model
    own = tuple(term for term in model.terms if not {term.by, term.per} & {*OBSTRUCTION, CLUSTER})
    nuisance_shift(model_terms(replace(model, terms=own), links), links)


def _with_columns(result: Record, setup: Setup) -> Setup:
    """Add the columns that are computed from the scene, if the prediction model or its errors require these columns."""
    model = result.prediction.model
    used = any({term.by, term.per} & {*OBSTRUCTION, CLUSTER} for term in model.terms)
    differ = model.blocks is not None and model.blocks.out_of_sight > 1
    return setup.with_obstruction() if used or differ else setup


def interval(
    result: Record, setup: Setup, level: float | None, progress: Progress | None = None
) -> pd.DataFrame:
    """Predict path loss and its interval for the links of an opened study.

    The table has one row per link, with the columns path_loss_db, basis and, with a level, lower_db and upper_db.

    Raises:
        InputError: The level is not between 0 and 1, or the calibration had too few links to estimate the size of
            residuals.
    """
    if level is not None and not (isinstance(level, Real) and 0 < level < 1):
        raise InputError(f"level = {level!r}: must be between 0 and 1, such as 0.9")
    setup = _with_columns(result, setup)
    links, field, model = setup.links, result.prediction.residual_field, result.prediction.model
    if level is None:
        # A group without a coefficient is rejected before anything is traced.
        shift = nuisance_shift(model_terms(model, links), links)
        replayed = _replay(result, setup, {}, progress)
        field_db, _ = _residual_field(result, links)
        path_loss_db = _modelled(result, links, replayed)[0] + shift.value_db[0] + field_db
        basis = np.full(len(path_loss_db), str(model.name), dtype=object)
        table = pd.DataFrame({"path_loss_db": path_loss_db, "basis": basis})
        table = table.assign(**further_observables(result, replayed))
        return fill_missing(result.prediction, result.study, links, table)
    if model.residual_db is None:
        raise InputError(
            f"{result.study.path}: too few links ({result.counts['calibrated_on']}) to estimate the size of residuals; "
            "measure more links, or predict without a level"
        )
    field_db, known_share = _residual_field(result, links)
    # Only the calibrated model has draws; errors on held-out blocks already include the uncertainty of the parameters.
    # Adding a validation to a finished result does not change the model's errors.
    by_blocks = result.study.holds_out_blocks
    draws = result.uncertainty.draws if model.name == Model.CALIBRATED and not by_blocks else {}
    shift = nuisance_shift(model_terms(model, links), links, draws, new_groups=True)
    replayed = _replay(result, setup, draws, progress)
    modelled = _modelled(result, links, replayed) + shift.value_db
    best, reached = modelled[0], np.isfinite(modelled).all(axis=0)
    # Deviations are measured from the best value, so they include its difference from the mean of the draws.
    deviation = np.where(reached, modelled[1:] - np.where(reached, best, 0.0), 0.0)
    factor, between = _quantiles(model, level)
    # The interval is scaled by `factor`, the quantile for links; `between` converts this quantile to that for blocks.
    variance = (between * shift.spread_db) ** 2 + (np.mean(deviation**2, axis=0) if draws else 0.0)
    best = np.where(reached, best, np.inf)
    basis = model.basis
    if not by_blocks and model.parameters is not None and not draws:
        basis += ", without uncertainty of the parameters"
    # Near measured links, the residual field is known, and only the uncorrelated part of the residual remains.
    far_db = _residual_db(result, links, between)
    near_db = far_db if field is None else np.minimum(field.own_db, far_db)
    total_db = np.sqrt((1.0 - known_share) * far_db**2 + known_share * near_db**2 + variance)
    link_basis = np.where(shift.spread_db > 0, f"{basis}, {NEW_GROUP}", basis)
    link_basis = np.where(
        known_share > NEAR_SHARE, np.char.add(link_basis, ", near measured links"), link_basis
    )
    half_width = factor * total_db
    best = best + field_db
    table = pd.DataFrame(
        {
            "path_loss_db": best,
            "lower_db": best - half_width,
            "upper_db": best + half_width,
            "basis": link_basis.astype(object),
            **further_observables(result, replayed, level),
        }
    )
    return fill_missing(result.prediction, result.study, links, table, level, half_width)


def _quantiles(model: PredictionModel, level: float) -> tuple[float, float]:
    """Quantile of Student's t for errors of links, and the quantile for errors of blocks divided by that for links.

    The variances within and between blocks are estimates, each with its own degrees of freedom. Errors of blocks have
    as many degrees of freedom as there are blocks, because these errors are deviations from zero, not from an estimated
    mean.
    """
    count = 0 if model.blocks is None else model.blocks.blocks
    factor = float(stdtrit(max(model.links - count, 1), (1 + level) / 2))
    return factor, float(stdtrit(count, (1 + level) / 2)) / factor if count else 1.0


def _residual_db(result: Record, links: Measurements, ratio: float) -> NDArray[np.float64]:
    """Standard deviation of the model's errors on new links [links], [dB]; `ratio` scales the part between blocks.

    For links farther than `BlockErrors.reach_m` from all calibration links, the variance between blocks is raised by a
    factor of up to two. The error of a link this far away may differ from those of the blocks as much as the blocks'
    errors differ from each other. The contribution of random effects is subtracted, because for links of a new group,
    `nuisance_shift` adds the spread of these effects.
    """
    model, ends = result.prediction.model, result.ends
    if model.blocks is None or ends is None:
        return np.full(len(links), float(model.residual_db or 0.0))
    rows, _ = calibration_residuals(result.links)
    distance = KDTree(ends[rows]).query(np.hstack([links.tx, links.rx]))[0]
    beyond = np.clip(distance / max(model.blocks.reach_m, 1e-9) - 1.0, 0.0, 1.0)
    within, between = model.blocks.within_db**2, model.blocks.between_db**2 * (1.0 + beyond)
    total_db = np.sqrt(within + ratio**2 * np.maximum(between - model.blocks.groups_db**2, 0.0))
    if model.blocks.out_of_sight == 1:
        return total_db
    return total_db * np.where(links.table.numbers(OUT_OF_SIGHT) > 0, model.blocks.out_of_sight, 1.0)


def with_constants(result: Record, setup: Setup) -> Setup:
    """Add the scene's constants that vary in the draws to the parameters of an opened study.

    Returns:
        The study with these constants after its own parameters. The study is unchanged for a program that returns rays,
        because only the constants of that program vary in the draws. A constant that differs between carriers is not
        added.
    """
    if result.study.engine.exports_rays:
        return setup
    spread, carriers = result.study.noise.constants_spread, [setup.scene.materials, *setup.carriers.values()]
    items = []
    for name in (name for name in result.uncertainty.constants_db if name in result.uncertainty.draws):
        material, constant = split_name(name)
        values = {float(getattr(materials[material], constant)) for materials in carriers}
        item = None if len(values) > 1 else fixed_constant(name, values.pop(), spread)
        items += [] if item is None else [item]
    return setup.with_parameters(replace(setup.parameters, items=(*setup.parameters.items, *items)))


def _replay(
    result: Record, setup: Setup, draws: dict[str, list[float]], progress: Progress | None
) -> Replayed | None:
    """The engine for opened links, with values of the prediction model and all draws; None if the model uses no scene.

    A program is called for the values of the prediction model (for both sets of values if the model is an average),
    because the program may differ from the replay in antennas and physics. The replay provides the change in path loss
    for each draw.
    """
    prediction, names = result.prediction, setup.parameters.names
    if prediction.model.parameters is None:
        return None
    every = (prediction.model.parameters, prediction.model.averaged)
    values = np.array([[each[name] for name in names] for each in every if each is not None])
    averaged = len(values)
    if draws:
        setup = with_constants(result, setup)
        names = setup.parameters.names
        # Only the calibrated model has draws, and this model is not averaged, so `values` has one row.
        scene_values = setup.parameters.start[None, values.shape[1] :]
        drawn = np.stack([draws[name] for name in names], axis=1)
        values = np.vstack([np.hstack([values, scene_values]), drawn])
    answers, count, rays = None, len(setup.links), result.study.engine.exports_rays
    asked, stored_db = _with_calibration_link(result, setup)
    if result.study.engine.external and not rays:
        program = setup.study.engine.open(asked, None, None, None)
        answers = _answers(program, values[:averaged, : len(prediction.model.parameters)])
        _warn_of_changed_program(result, answers[0, count:], stored_db)
        answers = answers[:, :count]
        if not draws and not result.study.observables:
            return Replayed(program, values, averaged, answers)
    paths = (asked if rays else setup).trace(traced_materials(result, prediction.materials), progress)
    if rays:
        _warn_of_changed_program(result, replay(asked, paths).path_loss(values[:1])[0, count:], stored_db)
        paths = take_links(paths, np.arange(count))
    engine = replay(setup, paths)
    if rays and averaged > 1:
        second = replay(
            setup, setup.trace(setup.parameters.materials(values[1], setup.scene.materials), progress)
        )
        answers = np.vstack([engine.path_loss(values[:1]), second.path_loss(values[1:])])
    return Replayed(engine, values, averaged, answers)


def _with_calibration_link(result: Record, setup: Setup) -> tuple[Setup, NDArray[np.float64]]:
    """Append one calibration link to the new links; return the opened study and this link's stored path loss [1], [dB].

    The weakest link with a path is used, because most parts of a program affect the path loss of a weak link. If
    the engine is not a program, or no link with a path has a carrier of the new links, the setup is unchanged, and the
    stored path loss is empty [0].
    """
    links, ends, table = setup.links, result.ends, result.links
    stored_db = table["scene_db"].to_numpy(float)
    carrier = np.full(len(table), result.study.scene.frequency)
    if "frequency" in table:
        carrier = table["frequency"].to_numpy(float)
    known = [result.study.scene.frequency] if links.frequency is None else links.frequency
    stored_db = np.where(np.isin(carrier, known) & np.isfinite(stored_db), stored_db, -np.inf)
    index = int(np.argmax(stored_db))
    if not result.study.engine.external or ends is None or np.isneginf(stored_db[index]):
        return setup, np.empty(0)
    extended = Measurements(
        np.vstack([links.tx, ends[index, :3]]),
        np.vstack([links.rx, ends[index, 3:]]),
        np.full(len(links) + 1, np.nan),
        frequency=None if links.frequency is None else np.append(links.frequency, carrier[index]),
    )
    return replace(setup, links=extended), stored_db[[index]]


def _warn_of_changed_program(
    result: Record, answer_db: NDArray[np.float64], stored_db: NDArray[np.float64]
) -> None:
    """Warn if the path loss that a program returns for a calibration link [0 or 1] differs from the stored value."""
    for answer, stored in zip(answer_db.tolist(), stored_db.tolist(), strict=True):
        if not abs(answer - stored) <= SAME_ANSWER_DB:
            _LOG.warning(
                "%s: at the calibrated values, the program returns %.2f dB for a calibration link, but the result has "
                "%.2f dB (allowed difference: %g dB): the program or its files changed since the calibration, or its "
                "answers are random. Offsets and intervals do not apply to the changed program; run the study again "
                "into a new folder", result.study.path, answer, stored, SAME_ANSWER_DB,
            )  # fmt: skip


def _answers(program: Engine, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss [n, links], [dB], that a program returns for the values [n, d] of its parameters.

    Raises:
        EngineError: A call failed.
    """
    answers = list(cast(Answering, program).answers(values))
    if failure := next((answer.failure for answer in answers if answer.failure), ""):
        raise EngineError(
            f"{failure}. The prediction requires this call: correct the program, and predict again"
        )
    return np.stack([each.path_loss_db for each in sorted(answers, key=lambda each: each.index)])


def _modelled(result: Record, links: Measurements, replayed: Replayed | None) -> NDArray[np.float64]:
    """Path loss [1 + draws, links], [dB], without nuisances, of the prediction model and then of every draw."""
    if replayed is None:
        return without_scene(result.study, links)[None]
    path_loss_db = _path_loss(replayed)
    # As in the fit and on held-out links, path loss is limited to the ceiling.
    ceiling_db = result.study.objective.ceiling_db
    path_loss_db = path_loss_db if ceiling_db is None else np.minimum(path_loss_db, ceiling_db)
    best_db, average = path_loss_db[0], AVERAGES.get(result.prediction.model.name)
    if average is not None and average.second in WITHOUT_MATERIALS:
        best_db = average.of(best_db, without_scene(result.study, links))
    elif average is not None and replayed.averaged > 1:
        best_db = average.of(best_db, path_loss_db[1])
    return np.vstack([best_db, path_loss_db[replayed.averaged :]])


def _path_loss(replayed: Replayed) -> NDArray[np.float64]:
    """Path loss [n, links], [dB], for all values; for a program, its answers plus the changes computed by replay."""
    if (answers := replayed.answers) is None:
        return replayed.engine.path_loss(replayed.values)
    if len(replayed.values) == len(answers):
        return answers
    path_loss_db = replayed.engine.path_loss(replayed.values)
    present = np.isfinite(path_loss_db).all(axis=0)
    change_db = np.where(present, path_loss_db[1:] - np.where(present, path_loss_db[0], 0.0), 0.0)
    return np.vstack([answers, answers[0] + change_db])


def _residual_field(result: Record, links: Measurements) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Krige the residual field [links], [dB], at new links, and compute the known share [links] of its variance."""
    field, ends = result.prediction.residual_field, result.ends
    if field is None or links.frequency is not None or ends is None:
        return np.zeros(len(links)), np.zeros(len(links))
    rows, residuals = calibration_residuals(result.links)
    return krige_residuals(field, ends[rows], residuals, np.hstack([links.tx, links.rx]))


def check_inputs(result: Record, setup: Setup, allow_changed: bool) -> None:
    """Reject the study if a scene or antenna file has changed since the calibration.

    Raises:
        InputError: A file has changed.
    """
    if not allow_changed and (changed := changed_files(result, setup.files)):
        raise InputError(
            f"{result.study.path}: {', '.join(changed[:5])} changed since the calibration, which may be invalid for "
            "the changed file; calibrate again, or give --allow-changed-inputs (allow_changed_inputs=True)"
        )


def add_remarks(result: Record, setup: Setup, predictions: pd.DataFrame) -> pd.DataFrame:
    """Add a column of remarks on the ends of each link or, if the ends need no remark, on its path loss.

    If most calibrated receivers are inside a building, remarks on ends inside a building are omitted.
    """
    links, triangles, by_end = setup.links, read_triangles(setup.scene), []
    if len(triangles.face):
        indoors = is_indoors(result, triangles)
        for end, points in (("transmitter", links.tx), ("receiver", links.rx)):
            locations = locate(triangles, points).tolist()
            by_end.append(
                [f"{end} {at}" if at and not (indoors and at == INSIDE) else "" for at in locations]
            )
    weak = _weak(result, predictions["path_loss_db"].to_numpy(float))
    # A remark on a position takes precedence, because the position can explain why a link is weak.
    remarks = [", ".join(filter(None, ends)) or other for *ends, other in zip(*by_end, weak, strict=True)]
    return predictions.assign(remark=np.array(remarks, dtype=np.str_))


def _weak(result: Record, path_loss_db: NDArray[np.float64]) -> list[str]:
    """The remark [links] on each link that is far weaker than all links used in the calibration; otherwise empty.

    The model was not fitted to links this weak. Measured links near the noise floor are ignored here, because the
    calibration does not use them.
    """
    measured_db = result.links["measured_db"].to_numpy(float)
    if "faint" in result.links:
        measured_db = measured_db[~result.links["faint"].to_numpy(bool)]
    weak = path_loss_db > measured_db.max(initial=-np.inf) + WEAKER_DB
    return np.where(weak, f"over {WEAKER_DB:g} dB weaker than all links used in the calibration", "").tolist()


def is_indoors(result: Record, triangles: Triangles) -> bool:
    """Whether most calibrated receivers are inside a building; False if their positions are unknown."""
    if result.ends is None:
        return False
    return bool(np.mean(locate(triangles, result.ends[:, 3:]) == INSIDE) > 0.5)
