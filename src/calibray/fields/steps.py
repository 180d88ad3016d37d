"""Which interactions of which paths are evaluated side by side, and one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths import Kind, Paths

_LETTERS: Final = "?csd"  # by number; 0 stands for none

Step = tuple[str, NDArray[np.int64]]
"""A letter, and the interactions of a group's n paths: [n], or of several in a row [k, n] with -1 where there is none.
Letters: c reflection or transmission, r several of these in a row, s scattering, d diffraction."""


@dataclass(frozen=True)
class Steps:
    """Paths in groups, and the steps of each group.

    Attributes:
        index: Paths of every group.
        of: Steps of every group.
    """

    index: tuple[NDArray[np.int64], ...]
    of: tuple[tuple[Step, ...], ...]

    @classmethod
    def exact(cls, paths: Paths) -> Steps:
        """Group paths with the same sequence of interactions.

        Args:
            paths: The path program.

        Returns:
            The groups, none of which has a row.
        """
        index = _equal(_code(paths, _numbers(paths)))
        return cls(index, tuple(_one_by_one(paths, some) for some in index))

    @classmethod
    def padded(cls, paths: Paths) -> Steps:
        """Group paths that agree once reflections and transmissions in a row are counted as one.

        Args:
            paths: The path program.

        Returns:
            The groups, paths with most reflections and transmissions first; a row is as long as that of the path with
            the most, the others' are filled up.
        """
        number = _numbers(paths)
        depth, at = np.diff(paths.first), np.arange(paths.num_interactions)
        path = np.repeat(np.arange(paths.num_paths), depth)
        special = number != 1
        before = np.concatenate([[0], np.cumsum(special)])
        row = before[:-1] - before[paths.first[path]]
        last = np.maximum.accumulate(np.where(special, at, -1))
        rank = at - np.maximum(last + 1, paths.first[path])  # within its row
        longest = np.bincount(path, number == 1, paths.num_paths)
        # Paths with more to fill up stand last, so that most of a row's places that stay empty are at its end.
        index = [some[np.argsort(-longest[some], kind="stable")]
                 for some in _equal(_code(paths, np.where(special, number, 0)))]  # fmt: skip
        group, column = np.zeros((2, paths.num_paths), dtype=np.int64)
        for place, some in enumerate(index):
            group[some], column[some] = place, np.arange(len(some))
        of = []
        for place, some in enumerate(index):
            mine = at[group[path] == place]
            where = row[mine], rank[mine], column[path[mine]]
            of.append(_rows(mine, number[mine], where, len(some)))
        return cls(tuple(index), tuple(of))


def _rows(
    interaction: NDArray[np.int64],
    number: NDArray[np.int64],
    where: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    size: int,
) -> tuple[Step, ...]:
    row, rank, column = where
    steps: list[Step] = []
    for turn in range(int(row.max(initial=-1)) + 2):
        in_row = (row == turn) & (number == 1)
        at = np.full((int(rank[in_row].max(initial=-1)) + 1, size), -1, dtype=np.int64)
        at[rank[in_row], column[in_row]] = interaction[in_row]
        if len(at):
            steps.append(("r", at))
        if (ends := (row == turn) & (number != 1)).any():
            one = np.empty(size, dtype=np.int64)
            one[column[ends]] = interaction[ends]
            steps.append((_LETTERS[number[ends][0]], one))
    return tuple(steps)


def _one_by_one(paths: Paths, some: NDArray[np.int64]) -> tuple[Step, ...]:
    depth = int(np.diff(paths.first)[some[0]])
    at = paths.first[some] + np.arange(depth)[:, None]
    numbers = _numbers(paths)[at[:, 0]]
    return tuple((_LETTERS[number], one) for number, one in zip(numbers, at, strict=True))


def _numbers(paths: Paths) -> NDArray[np.int64]:
    return np.select([paths.kind == Kind.DIFFUSE, paths.kind == Kind.DIFFRACTION], [2, 3], 1).astype(np.int64)


def _code(paths: Paths, number: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers of every path's interactions as one number, in which zeros leave no trace [P]."""
    depth, code = np.diff(paths.first), np.zeros(paths.num_paths, dtype=np.int64)
    for step in range(int(depth.max(initial=0))):
        deep = np.flatnonzero(depth > step)
        here = number[paths.first[:-1][deep] + step]
        code[deep] = np.where(here > 0, code[deep] * 4 + here, code[deep])
        if step % 16 == 15:  # a path may be longer than 64 bits
            code = np.unique(code, return_inverse=True)[1].reshape(-1)
    return code


def _equal(code: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    return tuple(np.flatnonzero(code == value) for value in np.unique(code))
