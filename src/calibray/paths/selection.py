"""Selecting paths or links of a path program, and joining programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibray.paths.interactions import Diffraction, Diffuse, Kind
from calibray.paths.program import Paths

Table = TypeVar("Table", Diffuse, Diffraction)

_PATH_ARRAYS = ("link", "delay", "spreading", "departure", "arrival", "tx_field", "rx_field")
_INTERACTION_ARRAYS = ("kind", "material", "cos_incidence", "rotation", "vertex")


def take(paths: Paths, index: NDArray[np.int64]) -> Paths:
    """The program of some of its paths [n], in a given order, over the same links."""
    index = np.asarray(index, dtype=np.int64)
    depth = np.diff(paths.first)[index]
    first = np.concatenate([[0], np.cumsum(depth)]).astype(np.int64)
    interaction = np.arange(first[-1]) - np.repeat(first[:-1], depth) + np.repeat(paths.first[index], depth)
    return replace(
        paths,
        **{name: getattr(paths, name)[index] for name in _PATH_ARRAYS},
        **{name: getattr(paths, name)[interaction] for name in _INTERACTION_ARRAYS},
        first=first,
        correction=None if paths.correction is None else paths.correction[index],
        diffuse=_rows(paths.diffuse, paths.kind == Kind.DIFFUSE, interaction),
        diffraction=_rows(paths.diffraction, paths.kind == Kind.DIFFRACTION, interaction),
    )


def take_links(paths: Paths, links: NDArray[np.int64]) -> Paths:
    """The program of some links [n], in a given order; a link may be used more than once."""
    links = np.asarray(links, dtype=np.int64)
    start = np.searchsorted(paths.link, np.arange(paths.num_links + 1))
    count = np.diff(start)[links]
    end = np.cumsum(count)
    index = np.arange(count.sum()) + np.repeat(start[links] - (end - count), count)
    return replace(
        take(paths, index),
        link=np.repeat(np.arange(len(links)), count).astype(paths.link.dtype),
        tx_position=paths.tx_position[links],
        rx_position=paths.rx_position[links],
    )


def concatenate(parts: Sequence[Paths]) -> Paths:
    """Join path programs of the same links, and sort their paths by link; within a link, the order is that of `parts`.

    All share frequency, materials and link table.
    """
    offsets = np.cumsum([0, *(part.num_interactions for part in parts)])
    first = [part.first[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    joined = replace(
        parts[0],
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in _PATH_ARRAYS + _INTERACTION_ARRAYS
        },
        first=np.concatenate([*first, offsets[-1:]]),
        correction=_joined_corrections(parts),
        diffuse=_joined([part.diffuse for part in parts]),
        diffraction=_joined([part.diffraction for part in parts]),
    )
    return take(joined, np.argsort(joined.link, kind="stable"))


def join_links(parts: Sequence[tuple[NDArray[np.int64], Paths]]) -> Paths:
    """Join path programs of different links, each with the indices of its links in the joined program.

    Together they contain every link once. All share frequency and materials; the settings are those of the first.
    """
    num_links = sum(len(links) for links, _ in parts)
    tx, rx = np.empty((num_links, 3)), np.empty((num_links, 3))
    for links, part in parts:
        tx[links], rx[links] = part.tx_position, part.rx_position
    return concatenate(
        [
            replace(part, link=links[part.link].astype(part.link.dtype), tx_position=tx, rx_position=rx)
            for links, part in parts
        ]
    )


def _rows(table: Table, has_row: NDArray[np.bool_], interaction: NDArray[np.int64]) -> Table:
    """The rows of some interactions in the table of their kind; `has_row` marks the interactions of that kind [I]."""
    row = (np.cumsum(has_row) - 1)[interaction[has_row[interaction]]]
    return type(table)(*(getattr(table, field.name)[row] for field in fields(table)))


def _joined_corrections(parts: Sequence[Paths]) -> NDArray[np.float64] | None:
    """Corrections of all paths; None if no part has any."""
    if all(part.correction is None for part in parts):
        return None
    return np.concatenate(
        [np.ones(part.num_paths) if part.correction is None else part.correction for part in parts]
    )


def _joined(tables: Sequence[Table]) -> Table:
    table_type = type(tables[0])
    return table_type(
        *(np.concatenate([getattr(table, field.name) for table in tables]) for field in fields(table_type))
    )
