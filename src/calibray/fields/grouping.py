"""Groups of paths that are evaluated together, and the sequence of their interactions.

The paths of a group have interactions of the same kinds in the same order, so every step of a group is a dense array.
With padding, paths that differ only in the lengths of their runs of reflections and transmissions belong to the same
group. Shorter runs are padded with interactions that have no effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.paths import Kind, Paths

COEFFICIENT: Final = "c"
"""A reflection or a transmission."""

RUN: Final = "r"
"""A run: several reflections or transmissions in succession."""

SCATTERING: Final = "s"
"""A diffuse reflection."""

DIFFRACTION: Final = "d"

_LETTERS: Final = ("?", COEFFICIENT, SCATTERING, DIFFRACTION)
"""Letters, indexed by the results of `_numbers`."""

_COEFFICIENT_NUMBER: Final = _LETTERS.index(COEFFICIENT)

Step = tuple[str, NDArray[np.int64]]
"""The letter of a step, and the interactions of a group's n paths at this step: [n], or [k, n] for a run of k, with -1
where a path has no interaction."""


@dataclass(frozen=True)
class PathGroup:
    """Paths that are evaluated together: their indices [n], and their interactions step by step."""

    paths: NDArray[np.int64]
    steps: tuple[Step, ...]


def exact_groups(paths: Paths) -> list[PathGroup]:
    """Group paths with the same sequence of interactions, without runs."""
    number = _numbers(paths)
    groups = []
    for members in _equal(_sequence_codes(paths, number)):
        depth = int(np.diff(paths.first)[members[0]])
        interactions = paths.first[members] + np.arange(depth)[:, None]  # [depth, n]
        letters = [_LETTERS[value] for value in number[interactions[:, 0]]]
        groups.append(PathGroup(members, tuple(zip(letters, interactions, strict=True))))
    return groups


def padded_groups(paths: Paths) -> list[PathGroup]:
    """Group paths whose sequences are equal when each run of reflections and transmissions counts as one interaction.

    Within a group, the path with the most reflections and transmissions comes first. Each run is padded to the length
    of the longest corresponding run in the group.
    """
    number, interaction = _numbers(paths), np.arange(paths.num_interactions)
    path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    is_coefficient = number == _COEFFICIENT_NUMBER
    # Index of the run that an interaction belongs to or ends: the number of earlier diffuse reflections and
    # diffractions on its path.
    others_before = np.concatenate([[0], np.cumsum(~is_coefficient)])
    run = others_before[:-1] - others_before[paths.first[path]]
    last_other = np.maximum.accumulate(np.where(is_coefficient, -1, interaction))
    rank = interaction - np.maximum(last_other + 1, paths.first[path])  # within its run
    count = np.bincount(path, is_coefficient, paths.num_paths)
    # Paths with fewer reflections and transmissions come last, so that most empty positions are at the end of a line.
    members = [
        group[np.argsort(-count[group], kind="stable")]
        for group in _equal(_sequence_codes(paths, np.where(is_coefficient, 0, number)))
    ]
    group_of_path, column_of_path = np.zeros((2, paths.num_paths), dtype=np.int64)
    for index, group in enumerate(members):
        group_of_path[group], column_of_path[group] = index, np.arange(len(group))
    groups = []
    for index, group in enumerate(members):
        inside = interaction[group_of_path[path] == index]
        steps: list[Step] = []
        for turn in range(int(run[inside].max(initial=-1)) + 2):
            in_turn = inside[run[inside] == turn]
            in_run, end = in_turn[is_coefficient[in_turn]], in_turn[~is_coefficient[in_turn]]
            lines = np.full((int(rank[in_run].max(initial=-1)) + 1, len(group)), -1, dtype=np.int64)
            lines[rank[in_run], column_of_path[path[in_run]]] = in_run
            if len(lines):
                steps.append((RUN, lines))
            if len(end):  # every path of the group has it
                ends = np.empty(len(group), dtype=np.int64)
                ends[column_of_path[path[end]]] = end
                steps.append((_LETTERS[number[end[0]]], ends))
        groups.append(PathGroup(group, tuple(steps)))
    return groups


def _numbers(paths: Paths) -> NDArray[np.int64]:
    """Index [I] of every interaction's letter in `_LETTERS`."""
    return np.select(
        [paths.kind == Kind.DIFFUSE, paths.kind == Kind.DIFFRACTION], [2, 3], _COEFFICIENT_NUMBER
    ).astype(np.int64)


def _sequence_codes(paths: Paths, number: NDArray[np.int64]) -> NDArray[np.int64]:
    """Code [P] of each path; paths with the same sequence of nonzero numbers have the same code."""
    depth, code = np.diff(paths.first), np.zeros(paths.num_paths, dtype=np.int64)
    for step in range(int(depth.max(initial=0))):
        deep = np.flatnonzero(depth > step)
        digit = number[paths.first[:-1][deep] + step]
        code[deep] = np.where(digit > 0, code[deep] * 4 + digit, code[deep])
        if step % 16 == 15:
            # Each step takes two bits, so codes are renumbered before that of a long path exceeds 64 bits. The last
            # digit of the new codes is 0, so that a longer path cannot get the code of a path that ends here.
            code = 4 * np.unique(code, return_inverse=True)[1].reshape(-1)
    return code


def _equal(code: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Groups of indices with equal codes."""
    return [np.flatnonzero(code == value) for value in np.unique(code)]
