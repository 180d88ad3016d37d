"""Groups of links, such as those of one device, whose residuals differ from those of their neighbours.

Only links of one transmitter and one place are compared: residuals and membership are taken relative to their means
over clusters of neighbouring links. A column that is constant in a place, such as a street, therefore shows nothing,
and errors that neighbours share cancel. Each cluster is one observation of the difference, so that correlated errors
within it do not count as independent (K.-Y. Liang, S. L. Zeger, Biometrika 73, 1986).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from calibray.validation.held_out_statistics import CLUSTER_LINKS, MOST_CLUSTERS, spatial_blocks

MOST_LABELS: Final = 50
"""Largest number of groups of a column; more would be names of links or of positions."""

TX_SCALE: Final = 1000.0
"""Factor of the transmitters' coordinates, so that clusters rarely contain links of two transmitters [1]."""

FEWEST_CLUSTERS: Final = 8
"""Smallest number of clusters with links inside and outside a group."""

MIXED: Final = 0.5
"""Share of the variance of membership within clusters above which a group is not a place."""

SIGNIFICANCE: Final = 0.01
"""Probability that any group of any column is reported if none differs."""

SMALLEST_DB: Final = 0.05
"""Smallest improvement of the RMSE for which a group is reported [dB]."""


@dataclass(frozen=True)
class Difference:
    """A group whose residuals differ from those of neighbouring links of other groups.

    Attributes:
        column: The column.
        label: The group's label in it.
        difference_db: Mean residual of the group minus that of its neighbours [dB].
        error_db: Standard error [dB].
        chance: Probability of a difference as significant by chance, times the number of groups that were tested.
    """

    column: str
    label: str
    difference_db: float
    error_db: float
    chance: float


def differing_groups(
    residual_db: NDArray[np.float64], ends: NDArray[np.float64], columns: Mapping[str, NDArray[np.str_]]
) -> list[Difference]:
    """The groups that differ significantly, the most significant first.

    Args:
        residual_db: Residuals [n], [dB].
        ends: Positions of transmitter and receiver [n, 6], [m].
        columns: Labels [n] by column.
    """
    count = min(max(len(ends) // CLUSTER_LINKS, 1), MOST_CLUSTERS)
    cluster = spatial_blocks(ends * np.repeat([TX_SCALE, 1.0], 3), count)
    size = np.bincount(cluster)
    residual = residual_db - (np.bincount(cluster, residual_db) / size)[cluster]
    mean_square = float(np.mean(residual_db**2))
    tested: list[Difference] = []
    for column, labels in columns.items():
        names = np.unique(labels)
        for name in names if 2 <= len(names) <= MOST_LABELS else ():
            member = (labels == name).astype(float)
            inside = member - (np.bincount(cluster, member) / size)[cluster]
            square, variance = np.bincount(cluster, inside**2), float(np.var(member))
            mixed = int(np.count_nonzero(square))
            if mixed < FEWEST_CLUSTERS or square.sum() < MIXED * variance * len(member):
                continue
            difference = float(inside @ residual / square.sum())
            score = np.bincount(cluster, inside * residual) - square * difference
            error = float(np.sqrt(np.sum(score**2) * mixed / (mixed - 1)) / square.sum())
            improved = np.sqrt(mean_square) - np.sqrt(max(mean_square - variance * difference**2, 0.0))
            chance = 1.0
            if improved >= SMALLEST_DB:
                chance = 2 * float(stdtr(mixed - 1, -abs(difference) / max(error, 1e-12)))
            tested.append(Difference(column, str(name), difference, error, chance))
    # Bonferroni's correction for the number of groups.
    corrected = [replace(group, chance=group.chance * len(tested)) for group in tested]
    significant = [group for group in corrected if group.chance < SIGNIFICANCE]
    return sorted(significant, key=lambda group: group.chance)
