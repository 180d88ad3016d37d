"""Sums of squares and products over chunks of links, which are all that least squares needs.

For gaps g (measured minus modelled path loss), derivatives J, weights w and a nuisance's design Z, a chunk returns [J
g]' w [J g] and Z' w [J g]. Their sums over all chunks give the normal equations with the nuisance eliminated. With A =
[J g] and the best coefficients X of every column,

    (A - Z X)' w (A - Z X) = A'wA - X'Z'wA - A'wZ X + X'Z'wZ X.

From these products we build a few rows with the same squares and products as the residuals of all links, for methods
that use residuals in no other way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over links for n candidates and k columns: the derivatives, if requested, then the gap.

    Attributes:
        square: Columns' products A'wA [n, k, k]; infinite for the gap if a candidate loses the path of a link.
        side: Products with the design Z'wA [n, q, k].
    """

    square: NDArray[np.float64]
    side: NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Share:
    """The objective's data of one chunk of links; called with the path loss of the chunk, it returns its sums.

    Attributes:
        links: Indices within the chunk of its m links with weight [m].
        measured: Their measured path loss [m], [dB].
        weight: Their weights, normalised as in the objective [m].
        design: The c columns of the nuisance with entries at these links [m, c].
        columns: Indices of these columns in the nuisance [c].
        ceiling_db: Path loss of a link without a path [dB]; None if there is no ceiling.
    """

    links: NDArray[np.int64]
    measured: NDArray[np.float64]
    weight: NDArray[np.float64]
    design: sparse.csr_array
    columns: NDArray[np.int64]
    ceiling_db: float | None

    def __call__(self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64] | None = None) -> Sums:
        """Sums over the links of the chunk, from path loss [n, l], [dB], and its derivatives [n, l, d].

        `side` has only the columns of the chunk [n, c, k].
        """
        loss = path_loss[:, self.links]
        at_ceiling = loss >= (np.inf if self.ceiling_db is None else self.ceiling_db)
        gap = self.measured - (loss if self.ceiling_db is None else np.minimum(loss, self.ceiling_db))
        lost = np.asarray(~np.isfinite(gap).all(axis=1))
        columns = np.where(lost[:, None], 0.0, gap)[..., None]
        if derivative is not None:
            slope = np.where((at_ceiling | lost[:, None])[..., None], 0.0, derivative[:, self.links])
            columns = np.concatenate([slope, columns], axis=2)
        weighted = columns * self.weight[:, None]
        square = weighted.transpose(0, 2, 1) @ columns
        square[lost, -1, -1] = np.inf
        if not len(self.columns):
            return Sums(square, np.zeros((len(columns), 0, columns.shape[2])))
        return Sums(square, np.stack([self.design.T @ candidate for candidate in weighted]))


def total(parts: Sequence[Sums], shares: Sequence[Share], columns: int) -> Sums:
    """Add the sums of all chunks, in the order of their shares, for `columns` columns of the nuisance."""
    square = np.zeros_like(parts[0].square)
    side = np.zeros((len(square), columns, square.shape[2]))
    for part, share in zip(parts, shares, strict=True):
        square += part.square
        side[:, share.columns] += part.side
    return Sums(square, side)


def rows(products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices R [n, k, k] with R'R = products, which are positive semidefinite [n, k, k].

    Example:
        >>> root = rows(np.array([[[4.0, 2.0], [2.0, 1.0]]]))
        >>> np.allclose(root[0].T @ root[0], [[4.0, 2.0], [2.0, 1.0]])
        True
    """
    size = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    size = np.where(size > 0, size, 1.0)
    # Scale to a unit diagonal first: otherwise small columns drown in the rounding of large ones.
    values, vectors = np.linalg.eigh(products / (size[:, :, None] * size[:, None, :]))
    root = np.sqrt(np.maximum(values, 0.0))
    return root[:, :, None] * vectors.transpose(0, 2, 1) * size[:, None, :]
