"""Errors with heavy tails: how well they explain what was measured, nuisance and size integrated out.

Errors of Student's t have tails that fall evenly. Where most errors are ordinary and a few gross, as where a link was
measured at the wrong place, the ordinary ones are Gaussian and tell as much as such do: a share of the errors is then a
number of times as large as the others (J. W. Tukey, in: Contributions to Probability and Statistics, 1960). Either is
fitted by least squares, each link weighed by how ordinary its error is (K. L. Lange, R. J. A. Little, J. M. G. Taylor,
J. Am. Stat. Assoc. 84 (1989) 881), and integrated by Laplace's approximation there, with Fisher's information.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

STEPS: Final = 25
"""Steps to the mode, at most."""

CLOSE: Final = 1e-3
"""Change of the errors and of their size, by that size, below which it is there: there the density is flat."""

SHARE: Final = 0.1
"""Share of gross errors, where some are."""

TIMES: Final = 7.0
"""How many times as large as the others they are."""

Each = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Something of the square of every error, in units of their size."""


class Tail(NamedTuple):
    """A distribution of errors of size one, or one for every gap.

    Attributes:
        log_density: Logarithm of its density, by the errors' squares.
        weight: Minus the derivative of that by half the square: 1 for a Gaussian.
        location: Fisher's information of an error on its mean, of one size or [n].
        size: That on the logarithm of its size, likewise.
        quick: Whether the sum of the weights, in place of the number of links, makes steps of the size quicker.
        some: The same for some of the gaps alone.
    """

    log_density: Each
    weight: Each
    location: float | NDArray[np.float64]
    size: float | NDArray[np.float64]
    quick: bool
    some: Callable[[NDArray[np.intp]], Tail]


def student(freedom: float | NDArray[np.float64]) -> Tail:
    """Student's t.

    Args:
        freedom: Its degrees of freedom, the same for all gaps or those of each [n].

    Returns:
        The distribution.
    """
    constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - 0.5 * np.log(freedom * np.pi)
    each, constants = (np.asarray(value, dtype=np.float64)[..., None] for value in (freedom, constant))
    return _student(each, constants)


def _student(freedom: NDArray[np.float64], constant: NDArray[np.float64]) -> Tail:
    """The same by what its density has in common, of one size or [n, 1]."""
    alike, each = freedom.ndim < 2, freedom[..., 0]
    tail = Tail(
        lambda square: constant - 0.5 * (freedom + 1) * np.log1p(square / freedom),
        lambda square: (freedom + 1.0) / (freedom + square),
        (each + 1) / (each + 3),
        2 * each / (each + 3),
        True,  # X.-L. Meng, D. van Dyk, J. R. Stat. Soc. B 59 (1997) 511.
        lambda rows: tail if alike else _student(freedom[rows], constant[rows]),
    )
    return tail


@cache
def gross(share: float = SHARE, times: float = TIMES) -> Tail:
    """Gaussian errors, some of them gross.

    Args:
        share: The share of these.
        times: How many times as large they are.

    Returns:
        The distribution.
    """
    ratio, fall = share / (1.0 - share) / times, 0.5 * (1.0 - 1.0 / times**2)
    constant = float(np.log1p(-share) - 0.5 * np.log(2 * np.pi))

    def odds(square: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(ratio * np.exp(np.minimum(fall * square, 600.0)), dtype=np.float64)

    def log_density(square: NDArray[np.float64]) -> NDArray[np.float64]:
        return constant + np.logaddexp(-0.5 * square, np.log(ratio) - 0.5 * square / times**2)

    def weight(square: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1.0 - 2.0 * fall * (1.0 - 1.0 / (1.0 + odds(square)))

    error = np.linspace(0.0, 10.0 * times, 20_001)
    density, slope = 2.0 * np.exp(log_density(error**2)), error * weight(error**2)
    location = float(np.trapezoid(density * slope**2, error))
    size = float(np.trapezoid(density * (1.0 - error * slope) ** 2, error))
    tail = Tail(log_density, weight, location, size, False, lambda _: tail)
    return tail


def evidence(
    gap: NDArray[np.float64], design: NDArray[np.float64], ridge: NDArray[np.float64], tail: Tail
) -> NDArray[np.float64]:
    """Log density of errors with a tail.

    Args:
        gap: Measured minus modelled path loss, without the nuisance [n, m], [dB].
        design: Columns of the nuisance [m, q].
        ridge: One over the standard deviations of their priors [q], or of those at every gap [n, q]; 0 where flat.
        tail: The distribution of the errors.

    Returns:
        The logarithms [n].
    """
    links, columns = gap.shape[1], design.shape[1]
    ridge = np.broadcast_to(ridge, (len(gap), columns))
    known = np.square(ridge)[:, :, None] * np.eye(columns)
    size = np.maximum(np.median(np.abs(gap - np.median(gap, axis=1)[:, None]), axis=1) * 1.2, 1e-9)
    size = np.maximum(size, 0.05 * np.sqrt(np.mean(gap**2, axis=1)) + 1e-12)
    left, found, going = gap.copy(), np.zeros((len(gap), columns)), np.arange(len(gap))
    for _ in range(STEPS):
        here, before, moved = gap[going], size[going], np.zeros(len(going))
        weight = tail.some(going).weight((left[going] / before[:, None]) ** 2)
        if columns:
            matrix = regular(products(design, weight) + before[:, None, None] ** 2 * known[going])
            found[going] = np.linalg.solve(matrix, ((weight * here) @ design)[..., None])[..., 0]
            there = here - found[going] @ design.T
            moved, left[going] = np.abs(there - left[going]).max(axis=1), there
        number = np.sum(weight, axis=1) if tail.quick else links
        after = np.maximum(np.sqrt(np.sum(weight * left[going] ** 2, axis=1) / number), 1e-12)
        size[going] = after
        going = going[np.maximum(np.abs(after - before), moved) > CLOSE * after]
        if not len(going):
            break
    value = tail.log_density((left / size[:, None]) ** 2).sum(axis=1) - links * np.log(size)
    stated = ridge > 0
    value += np.log(ridge, where=stated, out=np.zeros(ridge.shape)).sum(axis=1)
    value -= 0.5 * np.sum((found * ridge) ** 2, axis=1) + 0.5 * np.log(2 * np.pi) * stated.sum(axis=1)
    value += 0.5 * np.log(2 * np.pi) - 0.5 * np.log(links * tail.size)
    if columns:
        information = np.asarray(tail.location / size**2)[:, None, None]
        matrix = information * (design.T @ design) + known
        value += 0.5 * columns * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(regular(matrix))[1]
    return value


def products(design: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of products of columns, weighed.

    Args:
        design: The columns [m, q].
        weight: Weights [n, m].

    Returns:
        Design^T diag(weight) design for every row of weights [n, q, q].
    """
    links, columns = design.shape
    outer = (design[:, :, None] * design[:, None, :]).reshape(links, -1)
    return (weight @ outer).reshape(-1, columns, columns)


def regular(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """A little on the diagonal, for columns that others make up.

    Args:
        matrix: Normal equations [..., q, q].

    Returns:
        The same with the diagonal raised by rounding.
    """
    size = matrix.shape[-1]
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
    return matrix + (1e-10 * trace / size + 1e-300) * np.eye(size)
