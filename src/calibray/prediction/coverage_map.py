"""Coverage maps: path loss over an area, predicted with the calibrated scene, with prediction intervals.

Path loss to the centre of each cell is predicted in the same way as for any other link. Sionna's radio map solver
instead averages over the rays that cross each cell. In the demo district, the results of the two methods differ by more
than 0.05 dB in 70 % of the cells, and by more than 0.7 dB in 10 % (`python benchmarks/coverage_map.py --solver`).
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.cluster.workers import Workers, check_workers
from calibray.errors import InputError
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE
from calibray.measurements import MIN_DISTANCE, position_columns
from calibray.measurements.placement import TX_COLUMNS
from calibray.prediction.batches import announce, batch_size, predict_links
from calibray.prediction.map_files import CoverageMap
from calibray.prediction.observables import observable_columns
from calibray.prediction.predict import as_links, is_indoors, open_for_links
from calibray.result.held_out import NEW_GROUP, NO_PATH
from calibray.result.record import Record, check_record
from calibray.scenes import Triangles, ground_heights, read_triangles
from calibray.scenes.checks.positions import INSIDE, locate
from calibray.scenes.obstruction import CLUSTER
from calibray.scenes.obstruction import COLUMNS as OBSTRUCTION
from calibray.study import Study
from calibray.study.mounting import mounting_columns
from calibray.study.row_steps import known_frame
from calibray.support.messages import did_you_mean
from calibray.support.progress import Progress, with_total

_LOG: Final = logging.getLogger(__name__)

MOST_CELLS: Final = 1_000_000


def coverage_map(
    result: Record,
    tx: Sequence[float] | None = None,
    *,
    height: float = 1.5,
    cell: float = 5.0,
    bounds: Sequence[float] | None = None,
    level: float | None = 0.9,
    power_dbm: float | None = None,
    samples: int | Literal["auto"] | None = None,
    columns: Mapping[str, object] | None = None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    allow_changed_inputs: bool = False,
) -> CoverageMap:
    """Predict path loss over an area, with an interval for a measurement in each cell.

    Args:
        result: The calibration.
        tx: Position of the transmitter [3], [m]; if None, that of the calibration's only transmitter.
        height: Height of the receivers above the ground or, where the scene has no ground, above the scene's lowest
            point [m].
        cell: Width of the cells [m]; the receivers are at their centres.
        bounds: West, south, east and north bounds of the area [4], [m]; if None, the bounds of the scene.
        level: Probability that the interval contains a measurement; if None, no interval is computed.
        power_dbm: Transmitted power, for a map of received power [dBm]; if None, the map shows path loss. After a
            calibration on RSRP, the default is 0, because the offset contains the transmitted power.
        samples: Number of rays; if None, the number in the study. Too few rays miss paths; the computing time is
            proportional to the number of rays. "auto" adds rays until path loss converges, which is faster than using a
            large number of rays from the start.
        columns: Values that the study's columns for groups, carriers or nuisances have for this transmitter, keyed by
            column name. If all links measured at this transmitter belong to the same offset group, this group is the
            default.
        progress: Function that is called with the stage "tracing" after every launch of rays.
        workers: Workers that trace and predict chunks of cells (see `engines.open_workers`); if None, this process does
            the work.
        allow_changed_inputs: If True, predict even if a scene or antenna file has changed since the calibration.

    Raises:
        InputError: An argument is invalid, a column is missing, the map would have more than a million cells, or
            `Result.predict_interval` rejects the links.
        EngineError: The paths do not fit into memory.
    """
    check_record(result)
    check_workers(workers)
    if samples is not None:
        if isinstance(samples, bool) or not (
            samples == "auto" or (isinstance(samples, Integral) and samples > 0)
        ):
            raise InputError(f"samples: is {samples!r}, must be a number of rays, at least 1, or 'auto'")
        content = result.study.content()
        content["trace"]["samples"] = samples
        result = replace(result, study=Study.from_content(content, result.study.path))
    study = result.study
    transmitter = _transmitter(result, tx)
    constants = _column_values(result, transmitter, columns or {})
    _check_number("height", height, 0.0)
    _check_number("cell", cell, 0.0)
    if power_dbm is None and study.links.quantity == "rsrp":
        power_dbm = 0.0
    if power_dbm is not None:
        _check_number("power_dbm", power_dbm, -np.inf)
    if power_dbm and study.links.quantity == "rsrp":
        _LOG.warning(
            "power %g dBm: after a calibration on RSRP, the offset contains the transmitted power, so the map differs "
            "from RSRP by %+g dB; to map RSRP, omit the power", power_dbm, power_dbm,
        )  # fmt: skip
    frame = known_frame(study)
    # Until the grid is known, the study is opened with a single link, to a receiver 1 m above the transmitter.
    one_link = pd.DataFrame({**position_columns(transmitter, transmitter[None] + np.eye(3)[2]), **constants})
    setup = open_for_links(result, as_links(result, one_link), allow_changed_inputs=allow_changed_inputs)
    triangles = read_triangles(setup.scene)
    place = str(locate(triangles, transmitter[None])[0])
    if place and not (place == INSIDE and is_indoors(result, triangles)):
        _LOG.warning("the transmitter at (%g, %g, %g) m is %s; check its position", *transmitter, place)
    x, y = _grid(triangles, bounds, cell)
    z = ground_heights(triangles, x, y) + height
    east, north = np.meshgrid(x, y)
    rx = np.stack([east, north, z], axis=-1).reshape(-1, 3)
    if bounds is not None and len(triangles.face) and not triangles.left_out:
        low, high = triangles.vertex.min(axis=0)[:2], triangles.vertex.max(axis=0)[:2]
        if beyond := int(((rx[:, :2] < low) | (rx[:, :2] > high)).any(axis=1).sum()):
            _LOG.warning(
                "%d of %d cells are outside the scene, where no buildings are known; give smaller bounds",
                beyond,
                len(rx),
            )
    # In cells at the transmitter itself, path loss is undefined.
    cells = np.flatnonzero(np.linalg.norm(rx - transmitter, axis=1) > MIN_DISTANCE)
    names = ("path_loss_db",) if level is None else ("path_loss_db", "lower_db", "upper_db")
    layers, no_path = np.full((3, len(rx)), np.nan), np.zeros(len(rx), dtype=bool)
    observables = {name: np.full(len(rx), np.nan) for name in observable_columns(study, None)}
    size = batch_size(setup, workers)
    announce(result, len(cells), "cells")
    for start in range(0, len(cells), size):
        batch = cells[start : start + size]
        links = pd.DataFrame({**position_columns(transmitter, rx[batch]), **constants})
        setup = setup.at(as_links(result, links))
        batch_progress = with_total(progress, int(batch[0]), len(rx))
        predictions = predict_links(result, setup, level, batch_progress, workers)
        for layer, name in enumerate(names):
            layers[layer, batch] = predictions[name]
        for name in observables.keys() & set(predictions):
            observables[name][batch] = predictions[name]
        no_path[batch] = predictions["basis"].str.startswith(NO_PATH)
        if not start and predictions["basis"].str.contains(NEW_GROUP).any():
            stated = ", ".join(f"{name} = {value}" for name, value in constants.items())
            _LOG.warning("%s: no link of this group was measured, so the map uses the mean offset", stated)
    # In an outdoor study, the log-distance model is not valid inside buildings.
    without_scene = no_path | (result.prediction.model.parameters is None)
    if without_scene.any() and not is_indoors(result, triangles):
        inside = np.zeros(len(rx), dtype=bool)
        inside[without_scene] = locate(triangles, rx[without_scene]) == INSIDE
        layers[:, inside], no_path[inside] = np.nan, False
    path_loss, lower, upper = layers.reshape(3, *z.shape)
    return CoverageMap(
        transmitter, height, cell, x, y, z, path_loss, lower, upper, no_path.reshape(z.shape), level, power_dbm,
        frame, triangles, {name: values.reshape(z.shape) for name, values in observables.items()},
    )  # fmt: skip


def _transmitter(result: Record, tx: Sequence[float] | None) -> NDArray[np.float64]:
    """The given position [3], [m], of the transmitter or, if None, that of the calibration's only transmitter."""
    if tx is not None:
        position = _numbers(tx)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(f"tx = {tx!r}: must be x, y and z, three finite numbers [m]")
        return position
    names = list(TX_COLUMNS)
    positions = (
        np.unique(result.links[names].to_numpy(float), axis=0) if set(names) <= set(result.links) else []
    )
    if len(positions) != 1:
        cause = f"has {len(positions)} transmitters" if len(positions) else "has no transmitter positions"
        raise InputError(
            f"{result.study.path}: the result {cause}; give the position for the map: --tx X Y Z (tx=[x, y, z])"
        )
    return positions[0]


def _column_values(
    result: Record, tx: NDArray[np.float64], columns: Mapping[str, object]
) -> dict[str, object]:
    """Values of the study's columns by name; each value applies to every link from this transmitter."""
    if not isinstance(columns, Mapping):
        raise InputError(f"columns = {columns!r}: must be a dictionary with a value for each column")
    study, values = result.study, dict(columns)
    groups = study.offset_groups
    if len(groups) == 1 and groups[0] not in values and {"group", "tx_x"} <= set(result.links):
        distance = np.abs(result.links[list(TX_COLUMNS)].to_numpy(float) - tx).max(axis=1)
        labels = set(result.links["group"].astype(str).to_numpy()[distance < MIN_DISTANCE])
        if len(labels) == 1:
            values[groups[0]] = labels.pop()
    needed = [*groups]
    for section in study.nuisance.values():
        by_squares = section.per == CLUSTER and study.cluster_m is not None
        needed += [section.per] if section.per is not None and not by_squares else []
        needed += [section.by] if section.by not in (CONSTANT, LOG_DISTANCE, *OBSTRUCTION) else []
    of_links = [*mounting_columns(study), *([study.links.frequency] if study.links.frequency else [])]
    values |= _measured_values(study, tx, of_links, values)
    needed += of_links
    for name in needed:
        if name not in values:
            raise InputError(
                f"{study.path}: the map needs the links' column {name!r}; give its value for this transmitter: "
                f"--column {shlex.quote(f'{name}=VALUE')} (columns={{{name!r}: value}})"
            )
    if unknown := [name for name in columns if name not in needed]:
        known = [str(name) for name in study.measurements().frame]
        for name in unknown:
            if name not in known:
                raise InputError(
                    f"--column {name}: the links have no such column; {did_you_mean(name, known)}"
                )
    return values


def _measured_values(
    study: Study, tx: NDArray[np.float64], columns: Sequence[str], stated: Mapping[str, object]
) -> dict[str, object]:
    """Column values, such as antennas and carriers, that all links measured at this transmitter have in common."""
    if not set(columns) - set(stated):
        return {}
    links = study.measurements()
    here = np.linalg.norm(links.tx - tx, axis=1) < MIN_DISTANCE
    for name in set(stated) & set(links.frame):
        cells, value = links.frame[name], pd.Series([stated[name]])
        number = pd.to_numeric(value.astype(str), errors="coerce")[0]
        here &= (
            (cells.astype(str) == str(stated[name])) | (pd.to_numeric(cells, errors="coerce") == number)
        ).to_numpy()
    measured = links.frame[here]
    return {
        name: measured[name].iloc[0]
        for name in columns
        if name not in stated and name in measured and measured[name].nunique(dropna=False) == 1
    }


def _grid(
    triangles: Triangles, bounds: Sequence[float] | None, cell: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eastings [nx] and northings [ny] of the cells' centres [m]."""
    if bounds is None:
        if not len(triangles.face):
            raise InputError("the scene has no readable mesh, so its area is unknown; give --bounds")
        ends = np.concatenate([triangles.vertex.min(axis=0)[:2], triangles.vertex.max(axis=0)[:2]])
    else:
        ends = _numbers(bounds)
    if ends.shape != (4,) or not np.isfinite(ends).all() or not (ends[:2] < ends[2:]).all():
        raise InputError(
            f"bounds = {ends.tolist() if bounds is None else bounds!r}: must be west, south, east and north [m], with "
            "west less than east and south less than north"
        )
    # The tolerance keeps rounding errors from adding a cell.
    count = np.maximum(np.ceil((ends[2:] - ends[:2]) / cell - 1e-6), 1.0)
    if count.prod() > MOST_CELLS:
        raise InputError(
            f"cell = {cell:g} m: gives {count.prod():.0f} cells in {np.ptp(ends[::2]):.0f} m x "
            f"{np.ptp(ends[1::2]):.0f} m, must be at most {MOST_CELLS}; use wider cells, or a smaller area (--bounds)"
        )
    eastings, northings = (
        start + cell * (np.arange(int(cells)) + 0.5) for start, cells in zip(ends[:2], count, strict=True)
    )
    return eastings, northings


def _numbers(values: Sequence[float]) -> NDArray[np.float64]:
    """Convert values to numbers [n]; if a value is not a number, the result is a single NaN."""
    try:
        return np.array(values, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        return np.full(1, np.nan)


def _check_number(name: str, value: float, lower: float) -> None:
    if not isinstance(value, Real) or not (np.isfinite(value) and value > lower):
        bound = "" if np.isinf(lower) else f" greater than {lower:g}"
        shown = f"{value:g}" if isinstance(value, float) else repr(value)
        raise InputError(f"{name} = {shown}: must be a finite number{bound}")
