"""Likelihood of censored links, whose path loss is only known to be above the noise floor.

A measured link contributes the density of its error, and a censored one the probability that its error is at least as
large as the floor requires (J. Tobin, Econometrica 26, 1958). Without the censored links, only those with favourable
errors would remain near the floor. For errors e = s u, with u standard normal or Student's t, and nuisance coefficients
b, damped Newton steps in b and log s maximise the logarithm of

    p(b, s) = prod_measured f((y - z.b) / s) / s  x  prod_censored S((y - z.b) / s)  x  prior(b) / s.

Laplace's approximation at the maximum integrates out both.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr, stdtr

MAX_STEPS: Final = 40
"""Largest number of Newton steps."""

TOLERANCE: Final = 1e-9
"""Predicted gain of the log density at which the iteration ends."""

LARGEST: Final = 1e4
"""Limit for errors, in median errors; applies to a censored link without a path, whose error is infinite."""


class _Terms(NamedTuple):
    """Log probabilities of the links, and their first and second derivatives with respect to the error [n, m]."""

    value: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def log_survival(error: NDArray[np.float64], freedom: float) -> NDArray[np.float64]:
    """Log probability of larger errors than given, in units of their scale; Gaussian with infinite degrees of freedom.

    Example:
        >>> log_survival(np.array([0.0, 40.0]), np.inf).round(2).tolist()
        [-0.69, -804.61]
    """
    return log_ndtr(-error) if np.isinf(freedom) else np.log(np.maximum(stdtr(freedom, -error), 1e-300))


def log_evidence(
    gap: NDArray[np.float64],
    censored: NDArray[np.bool_],
    design: NDArray[np.float64],
    ridge: NDArray[np.float64],
    freedom: float = np.inf,
) -> NDArray[np.float64]:
    """Log density of errors with censored links; nuisance and noise level integrated out.

    Args:
        gap: Measured minus modelled path loss; for a censored link, path loss at the floor minus modelled path loss
            [n, m], [dB]; -inf for a censored link without a modelled path.
        censored: Mask of the censored links [m].
        design: Columns of the nuisance [m, q].
        ridge: Inverse standard deviations of the coefficients' priors [q]; 0 for a flat prior.
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.

    Returns:
        The log densities [n].
    """
    size = np.maximum(np.median(np.abs(gap[:, ~censored]), axis=1), 1e-6)
    gap = np.where(censored, np.maximum(gap, -LARGEST * size[:, None]), gap)
    point = _start(gap, censored, design, ridge)
    value, slope, curvature = joint(point, gap, censored, design, ridge, freedom)
    damping = np.full(len(gap), 1e-3)
    for _ in range(MAX_STEPS):
        step = np.linalg.solve(_damped(curvature, damping), slope[..., None])[..., 0]
        if not (np.sum(step * slope, axis=1) > TOLERANCE).any():
            break
        trial = np.asarray(point + np.clip(step, -_longest(point), _longest(point)), dtype=np.float64)
        trial_value, trial_slope, trial_curvature = joint(trial, gap, censored, design, ridge, freedom)
        better = trial_value > value
        point = np.where(better[:, None], trial, point)
        value = np.where(better, trial_value, value)
        slope = np.where(better[:, None], trial_slope, slope)
        curvature = np.where(better[:, None, None], trial_curvature, curvature)
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-12, 1e12)
    has_prior = ridge > 0
    value = value + np.log(ridge[has_prior]).sum() - 0.5 * has_prior.sum() * np.log(2 * np.pi)
    eigenvalues = np.maximum(np.linalg.eigvalsh(curvature), 1e-12)
    return value + 0.5 * point.shape[1] * np.log(2 * np.pi) - 0.5 * np.log(eigenvalues).sum(axis=1)


def _start(
    gap: NDArray[np.float64],
    censored: NDArray[np.bool_],
    design: NDArray[np.float64],
    ridge: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Coefficients and log scale by least squares on the measured links [n, q + 1]."""
    measured, design = gap[:, ~censored], design[~censored]
    matrix = design.T @ design + np.diag(ridge**2)
    matrix += (1e-10 * np.trace(matrix) + 1e-12) * np.eye(len(matrix))
    coefficients = np.linalg.solve(matrix, design.T @ measured.T).T
    errors = measured - coefficients @ design.T
    scale = np.maximum(np.sqrt(np.mean(errors**2, axis=1)), 1e-6)
    return np.column_stack([coefficients, np.log(scale)])


def joint(
    point: NDArray[np.float64],
    gap: NDArray[np.float64],
    censored: NDArray[np.bool_],
    design: NDArray[np.float64],
    ridge: NDArray[np.float64],
    freedom: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The joint log density of errors, coefficients and log scale, with its derivatives; see `log_evidence`.

    At coefficients and log scale [n, q + 1], the results are its value up to a constant [n], its gradient [n, q + 1],
    and minus its Hessian [n, q + 1, q + 1].
    """
    coefficients, scale = point[:, :-1], np.exp(point[:, -1])
    error = (gap - coefficients @ design.T) / scale[:, None]
    terms = _terms(error, censored, freedom)
    measured = int((~censored).sum())
    penalty = 0.5 * np.sum((ridge * coefficients) ** 2, axis=1)
    value = terms.value.sum(axis=1) - measured * point[:, -1] - penalty
    # Derivatives of the errors by coefficients and log scale.
    rows = np.concatenate([-design / scale[:, None, None], -error[..., None]], axis=2)
    slope = np.einsum("nm,nmi->ni", terms.first, rows)
    slope[:, :-1] -= ridge**2 * coefficients
    slope[:, -1] -= measured
    curvature = -np.einsum("nmi,nm,nmj->nij", rows, terms.second, rows)
    # Second derivatives of the errors: e and -z / s are both proportional to 1 / s.
    mixed = np.einsum("nm,nmi->ni", terms.first, rows)
    curvature[:, -1, :] += mixed
    curvature[:, :-1, -1] += mixed[:, :-1]
    curvature[:, range(len(ridge)), range(len(ridge))] += ridge**2
    return value, slope, curvature


def _terms(error: NDArray[np.float64], censored: NDArray[np.bool_], freedom: float) -> _Terms:
    square = error**2
    if np.isinf(freedom):
        density, first, second = -0.5 * (square + np.log(2 * np.pi)), -error, np.full_like(error, -1.0)
    else:
        constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - 0.5 * np.log(freedom * np.pi)
        density = constant - 0.5 * (freedom + 1) * np.log1p(square / freedom)
        first = -(freedom + 1) * error / (freedom + square)
        second = -(freedom + 1) * (freedom - square) / (freedom + square) ** 2
    survival = log_survival(error[:, censored], freedom)
    hazard = np.exp(density[:, censored] - survival)
    value = density.copy()
    value[:, censored] = survival
    # The survival function S of the density f has S' = -f, and f' = f x `first`.
    slopes, curves = first.copy(), second.copy()
    slopes[:, censored] = -hazard
    curves[:, censored] = -hazard * (first[:, censored] + hazard)
    return _Terms(value, slopes, curves)


def _damped(curvature: NDArray[np.float64], damping: NDArray[np.float64]) -> NDArray[np.float64]:
    """Minus the Hessian, made positive definite and damped, relative to its diagonal."""
    size = np.sqrt(np.maximum(np.abs(np.diagonal(curvature, axis1=1, axis2=2)), 1e-12))
    values, vectors = np.linalg.eigh(curvature / (size[:, :, None] * size[:, None, :]))
    values = np.maximum(np.abs(values), 1e-6) + damping[:, None]
    damped = np.einsum("nik,nk,njk->nij", vectors, values, vectors)
    return damped * size[:, :, None] * size[:, None, :]


def _longest(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longest step: three scales for a coefficient, a factor of e for the scale."""
    longest = np.repeat(3.0 * np.exp(point[:, -1:]), point.shape[1], axis=1)
    longest[:, -1] = 1.0
    return longest
