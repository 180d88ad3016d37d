"""Sums of squares and products over blocks of links: all that least squares asks of them, however many they are.

For gaps g (measured minus modelled path loss), derivatives J, weights w and a nuisance's design Z, a block gives
[J g]' w [J g] and Z' w [J g]. Their sums over all blocks hold the normal equations with the nuisance eliminated: with
best coefficients X of every column, (A - Z X)' w (A - Z X) = A'wA - X'Z'wA - A'wZ X + X'Z'wZ X.

From these a few rows are made that have the same squares and products as the residuals of all links, for methods that
take residuals and use nothing else of them.
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
    """Sums over links for candidates, k columns: the derivatives, if asked for, then the gap.

    Attributes:
        square: Columns times weights times columns [n, k, k]; infinite where a candidate loses a link's path.
        side: Design times weights times columns [n, q, k].
    """

    square: NDArray[np.float64]
    side: NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Share:
    """What a block needs of the objective; called with its path loss, it gives its sums.

    Attributes:
        links: Links of the block that count, by place in the block [m].
        measured: Their measured path loss [m], [dB].
        weight: Their weights, as in the objective [m].
        design: The nuisance's columns that any of them has [m, c].
        columns: Places of these columns among all [c].
        ceiling_db: Path loss that a link without a path counts as [dB], if any.
    """

    links: NDArray[np.int64]
    measured: NDArray[np.float64]
    weight: NDArray[np.float64]
    design: sparse.csr_array
    columns: NDArray[np.int64]
    ceiling_db: float | None

    def __call__(self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64] | None = None) -> Sums:
        """The sums of a block.

        Args:
            path_loss: Modelled path loss of the block's links [n, l], [dB].
            derivative: Its derivatives [n, l, d], [dB] per unit.

        Returns:
            The sums; `side` of the block's own columns alone [n, c, k].
        """
        loss = path_loss[:, self.links]
        flat = loss >= (np.inf if self.ceiling_db is None else self.ceiling_db)
        gap = self.measured - (loss if self.ceiling_db is None else np.minimum(loss, self.ceiling_db))
        lost = np.asarray(~np.isfinite(gap).all(axis=1))
        column = np.where(lost[:, None], 0.0, gap)[..., None]
        if derivative is not None:
            slope = np.where((flat | lost[:, None])[..., None], 0.0, derivative[:, self.links])
            column = np.concatenate([slope, column], axis=2)
        weighted = column * self.weight[:, None]
        square = weighted.transpose(0, 2, 1) @ column
        square[lost, -1, -1] = np.inf
        side = [self.design.T @ each for each in weighted] if len(self.columns) else []
        shape = len(column), len(self.columns), column.shape[2]
        return Sums(square, np.stack(side) if side else np.zeros(shape))


def total(parts: Sequence[Sums], shares: Sequence[Share], columns: int) -> Sums:
    """The sums over all blocks, added in their order.

    Args:
        parts: The sums of every block.
        shares: What they are sums of.
        columns: Number of columns of the nuisance q.

    Returns:
        The sums over all links.
    """
    square = np.zeros_like(parts[0].square)
    side = np.zeros((len(square), columns, square.shape[2]))
    for part, share in zip(parts, shares, strict=True):
        square += part.square
        side[:, share.columns] += part.side
    return Sums(square, side)


def rows(products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows that have given squares and products.

    Args:
        products: Positive semidefinite matrices [n, k, k].

    Returns:
        Matrices R with R'R = products [n, k, k].

    Example:
        >>> found = rows(np.array([[[4.0, 2.0], [2.0, 1.0]]]))
        >>> np.allclose(found[0].T @ found[0], [[4.0, 2.0], [2.0, 1.0]])
        True
    """
    size = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    size = np.where(size > 0, size, 1.0)
    # Columns of one size, or the small ones would drown in the rounding of the large.
    values, vectors = np.linalg.eigh(products / (size[:, :, None] * size[:, None, :]))
    root = np.sqrt(np.maximum(values, 0.0))
    return root[:, :, None] * vectors.transpose(0, 2, 1) * size[:, None, :]
