"""Predict many links with bounded memory: batch by batch, and in chunks on workers, which do not return paths."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from calibray.engines.cluster.chunks import CHUNK_LINKS, for_each_chunk, select_links, stated_chunk_size
from calibray.engines.cluster.workers import InProcess, Workers
from calibray.errors import InputError
from calibray.measurements import Measurements, PiecedTable
from calibray.prediction.predict import (
    add_remarks,
    as_links,
    check_groups,
    interval,
    open_for_links,
    refuse_far_links,
)
from calibray.result.record import Record
from calibray.scenes import read_triangles
from calibray.study import Setup
from calibray.support.messages import duration
from calibray.support.progress import Progress, with_total
from calibray.tracing.trace_plan import LANES_PER_SECOND

BATCH: Final = 10_000
"""Maximum number of links that are traced and evaluated together."""

DIFFUSE_BATCH: Final = 50
"""Maximum number of links that are traced together if diffuse reflection is on, because it yields tens of thousands of
paths per link."""

CHUNKS_PER_BATCH: Final = 100
"""Number of chunks that are sent to the workers at a time."""


@dataclass(frozen=True, eq=False)
class _Task:
    """The input of a worker: the calibration, the opened study, and the requested columns."""

    result: Record
    setup: Setup
    level: float | None
    with_remarks: bool


def batch_size(setup: Setup, workers: Workers | None) -> int:
    """Number of links to predict together, limited so that memory use does not depend on the total number of links."""
    if workers is not None:
        return CHUNKS_PER_BATCH * _chunk_size(setup)
    return DIFFUSE_BATCH if setup.study.trace.diffuse_reflection else BATCH


def predict_links(
    result: Record,
    setup: Setup,
    level: float | None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    *,
    with_remarks: bool = False,
) -> pd.DataFrame:
    """Predict path loss, intervals and remarks, in this process or on workers.

    The result is the table that `interval` returns, with a further column `remark`. This column is empty for links
    without a remark and, if `with_remarks` is False, for all links. `progress` is called with the stage "tracing".

    Raises:
        InputError: `interval` rejects the input.
        EngineError: The paths do not fit into memory, or workers fail repeatedly.
    """
    links = setup.links
    if workers is None and len(links) > batch_size(setup, None):
        workers = InProcess(at_most=0)
    if workers is None:
        return _predict_chunk(_Task(result, setup, level, with_remarks), links, progress)
    # Predictions need neither the history nor the paths, so neither is sent to the workers.
    light = replace(result, history=result.history.iloc[:0], paths=None, scene=None)
    task = _Task(light, setup.at(select_links(links, np.array([0]))), level, with_remarks)
    chunks = for_each_chunk(workers, _predict_chunk, task, links, _chunk_size(setup), progress)
    # Restore the order of the links.
    order = np.argsort(np.concatenate([link_indices for link_indices, _ in chunks]))
    table = pd.concat([predictions for _, predictions in chunks], ignore_index=True)
    return table.iloc[order].reset_index(drop=True)


def predict_batches(
    result: Record,
    table: PiecedTable,
    level: float | None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> Iterator[tuple[Measurements, pd.DataFrame]]:
    """Predict the links of a table batch by batch, so that memory use does not grow with the number of links.

    All rows are checked before the first link is traced. The table must have the columns that `predict` reads.
    `progress` is called with the stages "checking" and "tracing".

    Yields:
        Links with their predictions, as `predict_links` returns them, in the order of the table.

    Raises:
        InputError: See `predict` and `predict_interval`.
        EngineError: The paths do not fit into memory, or workers fail repeatedly.
    """
    setup, triangles, checked, count, far, near = None, None, 0, 0, None, False
    for rows in table.pieces(BATCH):
        links = as_links(result, rows)
        if setup is None or triangles is None:
            setup = open_for_links(result, links, allow_changed_inputs=allow_changed_inputs)
            triangles = read_triangles(setup.scene)
        try:
            refuse_far_links(result, links, triangles)
            near = True
        except InputError as error:
            far = error  # raised only if all batches are far
        setup.parameters.check_carriers([frequency for frequency, _ in links.carriers])
        if level is None:
            check_groups(result, links)
        checked, count = checked + len(rows), count + len(links)
        if progress is not None:
            progress("checking", checked, table.rows)
    if far is not None and not near:
        raise far
    if setup is None:
        return
    announce(result, count)
    done, size = 0, BATCH if workers is None else batch_size(setup, workers)
    for rows in table.pieces(size):
        setup = setup.at(as_links(result, rows))
        batch_progress = with_total(progress, done, count)
        predictions = predict_links(result, setup, level, batch_progress, workers, with_remarks=True)
        done += len(setup.links)
        yield setup.links, predictions


def _chunk_size(setup: Setup) -> int:
    default = DIFFUSE_BATCH if setup.study.trace.diffuse_reflection else CHUNK_LINKS
    return stated_chunk_size(setup) or default


def _predict_chunk(task: _Task, links: Measurements, progress: Progress | None = None) -> pd.DataFrame:
    setup = task.setup.at(links)
    predictions = interval(task.result, setup, task.level, progress)
    if not task.with_remarks:
        return predictions.assign(remark="")
    return add_remarks(task.result, setup, predictions)


LOG: Final = logging.getLogger(__name__)
"""Logger for the expected cost, which is logged before the work starts and printed by the command line."""


def announce(result: Record, links: int, what: str = "links") -> None:
    """Log how many links are to be traced, and approximately how long this will take."""
    counted = f"{links:,} {what.removesuffix('s') if links == 1 else what}"
    if result.prediction.model.parameters is None:
        LOG.info("%s, predicted without a trace: the log-distance model uses no scene", counted)
        return
    if result.study.engine.external:
        LOG.info(
            "%s: the program is called %s per batch; the result's RT calls do not include these calls",
            counted, "once" if result.prediction.model.averaged is None else "twice",
        )  # fmt: skip
        return
    calibrated, seconds = len(result.links), _seconds(result, links)
    adaptive = result.study.trace.adaptive
    most = f"{'' if adaptive else 'up to '}about {duration(seconds)}"
    LOG.info(
        "Tracing %s: %s at the rate of the %s calibration links, less if the paths are cached%s",
        counted, most if seconds >= 2 else "less than 2 seconds", f"{calibrated:,}",
        ", much longer if the calibration read its paths from the cache" if adaptive else "",
    )  # fmt: skip


def _seconds(result: Record, links: int) -> float:
    """Estimated duration of a trace [s].

    If the calibration read its trace from the cache, the recorded tracing time is too short. The estimate is therefore
    no shorter than the time that follows from the number of rays. If rays are added until path loss converges, the
    number of rays is not known in advance.
    """
    settings = result.study.trace
    lanes = 0 if settings.adaptive else settings.rays * max(settings.max_depth, 1) * links
    return max(result.cost.trace_seconds * links / len(result.links), lanes / LANES_PER_SECOND)
