"""Predictions in pieces of links, and in blocks on the workers of a cluster; path losses come back, paths do not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from calibray.engines.cluster.chunks import CHUNK_LINKS, for_each_chunk, select_links, stated_chunk_size
from calibray.engines.cluster.workers import InProcess, Workers
from calibray.measurements import Measurements, PiecedTable
from calibray.prediction.position_checks import remarks
from calibray.prediction.predict import as_links, check_groups, interval, opened
from calibray.result.record import Record
from calibray.study import Setup
from calibray.support.progress import Progress, with_total

PIECE: Final = 10_000
"""Links that are traced and evaluated at once."""

DIFFUSE_PIECE: Final = 50
"""The same with diffuse reflection, which makes tens of thousands of paths a link."""

BLOCKS: Final = 100
"""Blocks that workers are given at once."""


@dataclass(frozen=True, eq=False)
class _Shared:
    """What a worker needs to predict: the calibration, its study opened, and what is asked for."""

    result: Record
    setup: Setup
    level: float | None
    remarked: bool


def piece_size(setup: Setup, workers: Workers | None) -> int:
    """Links to predict at once, so that memory does not grow with their number.

    Args:
        setup: The opened study.
        workers: Where blocks live; None for this process.

    Returns:
        The number.
    """
    if workers is not None:
        return BLOCKS * _block_size(setup)
    return DIFFUSE_PIECE if setup.study.trace.diffuse_reflection else PIECE


def predicted(
    result: Record,
    setup: Setup,
    level: float | None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    *,
    remarked: bool = False,
) -> pd.DataFrame:
    """Path loss at links, its interval and remarks on their places, here or on the workers of a cluster.

    Args:
        result: The calibration.
        setup: Its study, opened for the links.
        level: Probability that a measurement lies within the interval; None for path loss alone.
        progress: Called with the stage "tracing" as links are traced.
        workers: Where blocks live; None for this process.
        remarked: Whether places are remarked on.

    Returns:
        What `interval` gives, and a column `remark`, empty where nothing is to be said or nothing was asked for.

    Raises:
        InputError: What `interval` refuses.
        EngineError: There are more paths than fit into memory, or workers die again and again.
    """
    links = setup.links
    if workers is None and len(links) > piece_size(setup, None):
        workers = InProcess(at_most=0)
    if workers is None:
        return _predicted(_Shared(result, setup, level, remarked), links, progress)
    # Neither the steps of the search nor the paths have a say in predictions.
    light = replace(result, history=result.history.iloc[:0], paths=None, scene=None)
    shared = _Shared(light, setup.at(select_links(links, np.array([0]))), level, remarked)
    parts = for_each_chunk(workers, _predicted, shared, links, _block_size(setup), progress)
    place = np.concatenate([block for block, _ in parts])
    joined = pd.concat([told for _, told in parts], ignore_index=True)
    return joined.iloc[np.argsort(place)].reset_index(drop=True)


def predicted_in_pieces(
    result: Record,
    table: PiecedTable,
    level: float | None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    *,
    allow_changed_inputs: bool = False,
) -> Iterator[tuple[Measurements, pd.DataFrame]]:
    """Predict at the links of a table, some at a time, so that memory does not grow with their number.

    All rows are checked before any is traced.

    Args:
        result: The calibration.
        table: The table, with the columns that `predict` takes.
        level: Probability that a measurement lies within the interval; None for path loss alone.
        progress: Called with the stages "checking" and "tracing", the links done and all of them.
        workers: Where blocks live; None for this process.
        allow_changed_inputs: Predict although a file of the scene or an antenna changed since the calibration.

    Yields:
        Links, and what `predicted` tells of them, in the order of the table.

    Raises:
        InputError: What `predict` and `predict_interval` refuse.
        EngineError: There are more paths than fit into memory, or workers die again and again.
    """
    setup, done = None, 0
    for rows in table.pieces(PIECE):
        links = as_links(result, rows)
        if setup is None:
            setup = opened(result, links, allow_changed_inputs=allow_changed_inputs)
        setup.parameters.check_carriers([frequency for frequency, _ in links.carriers])
        if level is None:
            check_groups(result, links)
        done += len(links)
        if progress is not None:
            progress("checking", done, table.rows)
    if setup is None:
        return
    done, size = 0, PIECE if workers is None else piece_size(setup, workers)
    for rows in table.pieces(size):
        setup = setup.at(as_links(result, rows))
        told = predicted(result, setup, level, with_total(progress, done, table.rows), workers, remarked=True)
        done += len(rows)
        yield setup.links, told


def _block_size(setup: Setup) -> int:
    return stated_chunk_size(setup) or (
        DIFFUSE_PIECE if setup.study.trace.diffuse_reflection else CHUNK_LINKS
    )


def _predicted(shared: _Shared, links: Measurements, progress: Progress | None = None) -> pd.DataFrame:
    here = shared.setup.at(links)
    told = interval(shared.result, here, shared.level, progress)
    return told.assign(remark=remarks(shared.result, here) if shared.remarked else "")
