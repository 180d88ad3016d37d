"""How many nodes tables of coefficients need.

A sheet of plasterboard at 2 GHz needs some hundred intervals, a thick slab at 60 GHz thousands. Each pair of material
and mode is looked at by itself, for some candidates that stand for all of them; what none of them foretold, the check
of every candidate finds (`tabulation.table_error`).
"""

from __future__ import annotations

from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.fields import slab, tabulation
from calibray.fields.program import coefficients_of, material_table
from calibray.paths import Paths

TRIED: Final = (1024, 8192, 65536)
"""Intervals of a row at most: the finer ones are looked at only where the coarser ones fail."""

FINEST: Final = TRIED[-1]
"""Intervals of a row at most."""

COARSEST: Final = 16
"""Intervals of a row at least."""

MARGIN: Final = 0.1
"""Share of the tolerance that candidates looked at may use up."""


def table_intervals(paths: Paths, tables: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """How many intervals each row of the tables needs.

    Args:
        paths: The path program.
        tables: Material constants of candidates that stand for all [n, M, 8].
        tolerance: Largest error of a tabulated coefficient.

    Returns:
        Intervals by material and mode [M, 3], powers of two up to `FINEST`; 0 where there is no such row.
    """
    material, mode, _ = coefficients_of(paths)
    needed = np.zeros((tables.shape[1], tabulation.MODES), dtype=np.int64)
    wavelength = speed_of_light / paths.frequency
    root = tabulation.roots(material_table(paths), wavelength)
    for row in np.unique(material.astype(np.int64) * tabulation.MODES + mode).tolist():
        which, how = divmod(row, tabulation.MODES)
        every = np.unique(tables[:, which], axis=0)
        needed[which, how] = max(
            _needed(table, how, int(root[which]), wavelength, MARGIN * tolerance) for table in every
        )
    return needed


def _needed(table: NDArray[np.float64], mode: int, root: int, wavelength: float, tolerance: float) -> int:
    for finest in TRIED:
        gaps = np.asarray(_gaps(table[None], mode, root, wavelength, finest))
        enough = np.flatnonzero(gaps <= tolerance)
        if len(enough):
            return COARSEST << int(enough[0])
    return FINEST


@partial(jax.jit, static_argnums=4)
def _gaps(
    table: jax.Array, mode: jax.Array, root: jax.Array, wavelength: jax.Array, finest: int
) -> jax.Array:
    """Largest error of a row with `COARSEST` intervals, with twice as many, and so on up to `finest`."""
    cosine = jnp.maximum((jnp.arange(2 * finest + 1) / (2 * finest)) ** root, tabulation.GRAZING)
    nowhere = jnp.zeros(cosine.shape, dtype=jnp.int32)
    te, tm = tabulation.evaluate(
        cosine, table, nowhere, wavelength, mode == tabulation.TRANSMITTED, mode != 0
    )
    value = slab.keep(jnp.stack([*te, *tm], axis=-1), wavelength)
    gaps, step = [], finest // COARSEST
    while step:
        node, middle = value[:: 2 * step], value[step :: 2 * step]
        node = jnp.concatenate([node[1:2], node])  # even functions of the root of the cosine
        guess = 9 / 16 * (node[1:-2] + node[2:-1]) - 1 / 16 * (node[:-3] + node[3:])
        gaps.append(jnp.abs(middle[:-1] - guess).max())
        step //= 2
    return jnp.stack(gaps)
