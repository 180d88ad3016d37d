"""Links that were not heard: all that is known of their error is that it lies beyond the noise floor.

A link of which a value was measured counts with the density of its error, one that was not heard with the probability
that its error is at least as large as the floor asks (J. Tobin, Econometrica 26, 1958). To leave out those that were
not heard keeps the links that chance made strong. With errors e = s u, u standard normal or of Student's t, and the
nuisance's coefficients b, the logarithm of

    p(b, s) = prod_heard f((y - z.b) / s) / s  x  prod_unheard S((y - z.b) / s)  x  prior(b) / s

is maximized by damped Newton steps in b and log s, and both are integrated out by Laplace's approximation there.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr, stdtr

STEPS: Final = 40
"""Newton steps at most."""

SETTLED: Final = 1e-9
"""Gain of the logarithm that a step must promise, or it is the last."""

FURTHEST: Final = 1e4
"""Errors beyond so many times the median are taken for as large: where no path leads to a link that was not heard."""


class _Terms(NamedTuple):
    """Logarithms of the links' probabilities, and their first and second derivatives by the error [n, m]."""

    value: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def log_survival(error: NDArray[np.float64], freedom: float) -> NDArray[np.float64]:
    """Logarithm of the probability of a larger error.

    Args:
        error: Errors by their scale [...].
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.

    Returns:
        The logarithms [...].

    Example:
        >>> log_survival(np.array([0.0, 40.0]), np.inf).round(2).tolist()
        [-0.69, -804.61]
    """
    return log_ndtr(-error) if np.isinf(freedom) else np.log(np.maximum(stdtr(freedom, -error), 1e-300))


def log_evidence(
    gap: NDArray[np.float64],
    unheard: NDArray[np.bool_],
    design: NDArray[np.float64],
    ridge: NDArray[np.float64],
    freedom: float = np.inf,
    weight: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Log density of errors, some of which are only known to be larger; nuisance and size integrated out.

    Args:
        gap: Measured minus modelled path loss, at links that were not heard the floor's in place of the measured
            [n, m], [dB]; -inf there for one that the model does not hear either.
        unheard: Which links were not heard [m].
        design: Columns of the nuisance [m, q].
        ridge: One over the standard deviations of their priors [q]; 0 where flat.
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.
        weight: Weights of the links, one over the variance by that of the others [n, m]; 1 if None.

    Returns:
        The logarithms [n].
    """
    root = np.ones_like(gap) if weight is None else np.sqrt(weight)
    size = np.maximum(np.median(np.abs(gap[:, ~unheard]), axis=1), 1e-6)
    left = root * np.where(unheard, np.maximum(gap, -FURTHEST * size[:, None]), gap)
    columns = root[:, :, None] * design
    point = _start(left, unheard, columns, ridge)
    value, slope, curvature = joint(point, left, unheard, columns, ridge, freedom)
    damping = np.full(len(gap), 1e-3)
    for _ in range(STEPS):
        step = np.linalg.solve(_damped(curvature, damping), slope[..., None])[..., 0]
        if not (np.sum(step * slope, axis=1) > SETTLED).any():
            break
        trial = np.asarray(point + np.clip(step, -_longest(point), _longest(point)), dtype=np.float64)
        found = joint(trial, left, unheard, columns, ridge, freedom)
        better = found[0] > value
        point, value, slope, curvature = (
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
            for new, old in zip((trial, *found), (point, value, slope, curvature), strict=True)
        )
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-12, 1e12)
    held = ridge > 0
    value = value + np.log(ridge[held]).sum() - 0.5 * held.sum() * np.log(2 * np.pi)
    if weight is not None:
        value = value + 0.5 * np.log(weight[:, ~unheard]).sum(axis=1)
    eigenvalues = np.maximum(np.linalg.eigvalsh(curvature), 1e-12)
    return value + 0.5 * point.shape[1] * np.log(2 * np.pi) - 0.5 * np.log(eigenvalues).sum(axis=1)


def _start(
    left: NDArray[np.float64],
    unheard: NDArray[np.bool_],
    columns: NDArray[np.float64],
    ridge: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Coefficients and the logarithm of the scale by least squares on what was heard [n, q + 1]."""
    heard, known = left[:, ~unheard], columns[:, ~unheard]
    matrix = np.einsum("nmi,nmj->nij", known, known) + np.diag(ridge**2)
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    matrix = matrix + (1e-10 * trace + 1e-12) * np.eye(matrix.shape[1])
    side = np.einsum("nmi,nm->ni", known, heard)
    found = np.linalg.solve(matrix, side[..., None])[..., 0]
    errors = heard - np.einsum("nmi,ni->nm", known, found)
    scale = np.maximum(np.sqrt(np.mean(errors**2, axis=1)), 1e-6)
    return np.column_stack([found, np.log(scale)])


def joint(
    point: NDArray[np.float64],
    left: NDArray[np.float64],
    unheard: NDArray[np.bool_],
    columns: NDArray[np.float64],
    ridge: NDArray[np.float64],
    freedom: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What is maximized, with its derivatives.

    Args:
        point: Coefficients, and the logarithm of the scale [n, q + 1].
        left: Measured minus modelled path loss; the floor's at links that were not heard [n, m], [dB].
        unheard: Which links these are [m].
        columns: Columns of the nuisance [n, m, q].
        ridge: One over the standard deviations of their priors [q]; 0 where flat.
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.

    Returns:
        Its value but for a constant [n], its gradient [n, q + 1], and minus its Hessian [n, q + 1, q + 1].
    """
    found, scale = point[:, :-1], np.exp(point[:, -1])
    error = (left - np.einsum("nmi,ni->nm", columns, found)) / scale[:, None]
    terms = _terms(error, unheard, freedom)
    heard = int((~unheard).sum())
    value = terms.value.sum(axis=1) - heard * point[:, -1] - 0.5 * np.sum((ridge * found) ** 2, axis=1)
    # How an error follows the coefficients and the logarithm of the scale.
    rows = np.concatenate([-columns / scale[:, None, None], -error[..., None]], axis=2)
    slope = np.einsum("nm,nmi->ni", terms.first, rows)
    slope[:, :-1] -= ridge**2 * found
    slope[:, -1] -= heard
    curvature = -np.einsum("nmi,nm,nmj->nij", rows, terms.second, rows)
    # Errors fall with the scale, and so do their derivatives.
    mixed = np.einsum("nm,nmi->ni", terms.first, rows)
    curvature[:, -1, :] += mixed
    curvature[:, :-1, -1] += mixed[:, :-1]
    curvature[:, range(len(ridge)), range(len(ridge))] += ridge**2
    return value, slope, curvature


def _terms(error: NDArray[np.float64], unheard: NDArray[np.bool_], freedom: float) -> _Terms:
    square = error**2
    if np.isinf(freedom):
        density, first, second = -0.5 * (square + np.log(2 * np.pi)), -error, np.full_like(error, -1.0)
    else:
        constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - 0.5 * np.log(freedom * np.pi)
        density = constant - 0.5 * (freedom + 1) * np.log1p(square / freedom)
        first = -(freedom + 1) * error / (freedom + square)
        second = -(freedom + 1) * (freedom - square) / (freedom + square) ** 2
    beyond = log_survival(error[:, unheard], freedom)
    hazard = np.exp(density[:, unheard] - beyond)
    value = density.copy()
    value[:, unheard] = beyond
    # S' = -f, and f' = f first.
    slopes, curves = first.copy(), second.copy()
    slopes[:, unheard] = -hazard
    curves[:, unheard] = -hazard * (first[:, unheard] + hazard)
    return _Terms(value, slopes, curves)


def _damped(curvature: NDArray[np.float64], damping: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minus the Hessian made positive definite, and more so by damping, in the scale of its diagonal."""
    size = np.sqrt(np.maximum(np.abs(np.diagonal(curvature, axis1=1, axis2=2)), 1e-12))
    values, vectors = np.linalg.eigh(curvature / (size[:, :, None] * size[:, None, :]))
    values = np.maximum(np.abs(values), 1e-6) + damping[:, None]
    made = np.einsum("nik,nk,njk->nij", vectors, values, vectors)
    return made * size[:, :, None] * size[:, None, :]


def _longest(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longest step: three scales of a coefficient, and a factor of e."""
    longest = np.repeat(3.0 * np.exp(point[:, -1:]), point.shape[1], axis=1)
    longest[:, -1] = 1.0
    return longest
