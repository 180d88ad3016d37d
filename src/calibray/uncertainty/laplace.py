"""Laplace's approximation for error densities whose integrals over nuisance and scale have no closed form.

There are two models of heavy tails. Either the errors follow Student's t, with tails that decrease gradually, or most
errors are Gaussian and a few are gross, for example because a link's position was recorded incorrectly. Gross errors
are Gaussian with a larger standard deviation (J. W. Tukey, in: Contributions to Probability and Statistics, 1960). We
fit both distributions by iteratively reweighted least squares (K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am.
Stat. Assoc. 84 (1989) 881) and integrate around the mode, using the Fisher information.

Of a censored link, it is known only that its power is below the noise floor. A measured link contributes the density of
its error. A censored link contributes the probability that its error is at least as large as the floor requires (J.
Tobin, Econometrica 26, 1958). Without the censored links, only links with favourable errors would remain near the
floor. For errors e = s u, with u standard normal or Student's t, and nuisance coefficients b, damped Newton steps in b
and log s maximize the logarithm of

    p(b, s) = prod_measured f((y - z.b) / s) / s  x  prod_censored S((y - z.b) / s)  x  prior(b) / s.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr, stdtr

CENSORED_TOLERANCE: Final = 1e-9
"""Predicted gain in log density below which the iteration ends."""

LARGEST: Final = 1e4
"""Maximum magnitude of a censored link's error, in units of the median absolute error. Without this limit, the error of
a censored link without a path would be infinite."""


class _Terms(NamedTuple):
    """Log probabilities of the links, and their first and second derivatives with respect to the error [n, m]."""

    value: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def log_survival(error: NDArray[np.float64], freedom: float) -> NDArray[np.float64]:
    """Log probability that a Student's t variable exceeds an error; a Gaussian variable if `freedom` is infinite.

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
    """Log density of errors for data with censored links, with nuisance and noise level integrated out.

    Args:
        gap: Measured minus modelled path loss; for a censored link, path loss at the floor minus modelled path loss
            [n, m], [dB]; -inf for a censored link without a modelled path.
        censored: Mask of the censored links [m].
        design: Columns of the nuisance [m, q].
        ridge: Inverse standard deviations [q] of the coefficients' priors; 0 for a flat prior.
        freedom: Degrees of freedom of Student's t; +inf for a Gaussian.

    Returns:
        The log densities [n].
    """
    size = np.maximum(np.median(np.abs(gap[:, ~censored]), axis=1), 1e-6)
    gap = np.where(censored, np.maximum(gap, -LARGEST * size[:, None]), gap)
    point = _start(gap, censored, design, ridge)
    value, slope, curvature = joint(point, gap, censored, design, ridge, freedom)
    damping = np.full(len(gap), 1e-3)
    for _ in range(40):
        step = np.linalg.solve(_damped(curvature, damping), slope[..., None])[..., 0]
        if not (np.sum(step * slope, axis=1) > CENSORED_TOLERANCE).any():
            break
        trial = np.asarray(point + np.clip(step, -_longest(point), _longest(point)), dtype=np.float64)
        trial_value, trial_slope, trial_curvature = joint(trial, gap, censored, design, ridge, freedom)
        # As in Levenberg's method, reduce the damping after a step that raises the density, and increase it otherwise.
        better = trial_value > value
        point = np.where(better[:, None], trial, point)
        value = np.where(better, trial_value, value)
        slope = np.where(better[:, None], trial_slope, slope)
        curvature = np.where(better[:, None, None], trial_curvature, curvature)
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-12, 1e12)
    has_prior = ridge > 0
    value = value + np.log(ridge[has_prior]).sum() - 0.5 * has_prior.sum() * np.log(2 * np.pi)
    # Laplace's approximation: the density at the mode times (2 pi)^(k/2) |minus the Hessian|^(-1/2), with k = q + 1.
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

    For coefficients and log scale [n, q + 1], the results are the value of the log density up to a constant [n], its
    gradient [n, q + 1], and its negative Hessian [n, q + 1, q + 1].
    """
    coefficients, scale = point[:, :-1], np.exp(point[:, -1])
    error = (gap - coefficients @ design.T) / scale[:, None]
    terms = _terms(error, censored, freedom)
    measured = int((~censored).sum())
    penalty = 0.5 * np.sum((ridge * coefficients) ** 2, axis=1)
    value = terms.value.sum(axis=1) - measured * point[:, -1] - penalty
    # Derivatives of the errors with respect to coefficients and log scale.
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
    """The negative Hessian, made positive definite and damped relative to its diagonal."""
    size = np.sqrt(np.maximum(np.abs(np.diagonal(curvature, axis1=1, axis2=2)), 1e-12))
    values, vectors = np.linalg.eigh(curvature / (size[:, :, None] * size[:, None, :]))
    values = np.maximum(np.abs(values), 1e-6) + damping[:, None]
    damped = np.einsum("nik,nk,njk->nij", vectors, values, vectors)
    return damped * size[:, :, None] * size[:, None, :]


def _longest(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Maximum step: three scales for a coefficient, and a factor of e for the scale."""
    longest = np.repeat(3.0 * np.exp(point[:, -1:]), point.shape[1], axis=1)
    longest[:, -1] = 1.0
    return longest


MAX_STEPS: Final = 25
"""Maximum number of steps to the mode."""

TOLERANCE: Final = 1e-3
"""Change of errors and scale, relative to the scale, at which the iteration ends. The density is flat at the mode, so a
smaller limit is not needed."""

GROSS_SHARE: Final = 0.1
"""Share of gross errors."""

GROSS_RATIO: Final = 7.0
"""Ratio of the standard deviations of gross and ordinary errors."""

OfSquare = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""A function of the squared errors, in units of the squared scale."""


class Tail(NamedTuple):
    """A distribution of errors with unit scale, either the same for all gaps or different for each gap.

    Attributes:
        log_density: Log density as a function of the squared errors.
        weight: Minus the derivative of the log density with respect to half the square; 1 for a Gaussian.
        location: Fisher information of an error about its mean; a number or an array [n].
        size: Fisher information of an error about the logarithm of its scale; a number or an array [n].
        by_weights: Whether to update the scale with the sum of the weights instead of the number of links, which
            converges faster.
        select: Function that returns the distributions for the gaps with given indices.
    """

    log_density: OfSquare
    weight: OfSquare
    location: float | NDArray[np.float64]
    size: float | NDArray[np.float64]
    by_weights: bool
    select: Callable[[NDArray[np.intp]], Tail]


def student(freedom: float | NDArray[np.float64]) -> Tail:
    """Student's t distribution with the same degrees of freedom for all gaps, or with one value per gap [n]."""
    constant = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - 0.5 * np.log(freedom * np.pi)
    return _student(
        np.asarray(freedom, dtype=np.float64)[..., None], np.asarray(constant, dtype=np.float64)[..., None]
    )


def _student(freedom: NDArray[np.float64], constant: NDArray[np.float64]) -> Tail:
    """Student's t from its degrees of freedom and the constant of its log density, each [1] or [n, 1]."""
    same_for_all, values = freedom.ndim < 2, freedom[..., 0]
    tail = Tail(
        log_density=lambda square: constant - 0.5 * (freedom + 1) * np.log1p(square / freedom),
        weight=lambda square: (freedom + 1.0) / (freedom + square),
        location=(values + 1) / (values + 3),
        size=2 * values / (values + 3),
        by_weights=True,  # X.-L. Meng, D. van Dyk, J. R. Stat. Soc. B 59 (1997) 511.
        select=lambda rows: tail if same_for_all else _student(freedom[rows], constant[rows]),
    )
    return tail


@cache
def gross() -> Tail:
    """Gaussian errors, a fraction `GROSS_SHARE` of which have a standard deviation `GROSS_RATIO` times as large."""
    share, times = GROSS_SHARE, GROSS_RATIO
    ratio, fall = share / (1.0 - share) / times, 0.5 * (1.0 - 1.0 / times**2)
    constant = float(np.log1p(-share) - 0.5 * np.log(2 * np.pi))

    def odds(square: NDArray[np.float64]) -> NDArray[np.float64]:
        """Odds that an error is gross."""
        return np.asarray(ratio * np.exp(np.minimum(fall * square, 600.0)), dtype=np.float64)

    def log_density(square: NDArray[np.float64]) -> NDArray[np.float64]:
        return constant + np.logaddexp(-0.5 * square, np.log(ratio) - 0.5 * square / times**2)

    def weight(square: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1.0 - 2.0 * fall * (1.0 - 1.0 / (1.0 + odds(square)))

    # Fisher information by numerical integration.
    error = np.linspace(0.0, 10.0 * times, 20_001)
    density, slope = 2.0 * np.exp(log_density(error**2)), error * weight(error**2)
    location = float(np.trapezoid(density * slope**2, error))
    size = float(np.trapezoid(density * (1.0 - error * slope) ** 2, error))
    tail = Tail(log_density, weight, location, size, False, lambda _: tail)
    return tail


def evidence(
    gap: NDArray[np.float64], design: NDArray[np.float64], ridge: NDArray[np.float64], tail: Tail
) -> NDArray[np.float64]:
    """Log density of heavy-tailed errors, with nuisance and scale integrated out.

    Args:
        gap: Measured minus modelled path loss, without the nuisance [n, m], [dB].
        design: Columns of the nuisance [m, q].
        ridge: Inverse standard deviations of the coefficients' priors, either the same for all gaps [q] or for each gap
            [n, q]; 0 for a flat prior.
        tail: The distribution of the errors.

    Returns:
        The log densities [n].
    """
    links, columns = gap.shape[1], design.shape[1]
    ridge = np.broadcast_to(ridge, (len(gap), columns))
    prior = np.square(ridge)[:, :, None] * np.eye(columns)
    # Start at a robust scale: 1.2 times the median absolute deviation, but at least 5 % of the root mean square.
    size = np.maximum(np.median(np.abs(gap - np.median(gap, axis=1)[:, None]), axis=1) * 1.2, 1e-9)
    size = np.maximum(size, 0.05 * np.sqrt(np.mean(gap**2, axis=1)) + 1e-12)
    errors, coefficients, size = _mode(gap, design, prior, size, tail)
    # Add the log density at the mode, the log prior, and Laplace's term for the log scale and the coefficients.
    value = tail.log_density((errors / size[:, None]) ** 2).sum(axis=1) - links * np.log(size)
    has_prior = ridge > 0
    value += np.log(ridge, where=has_prior, out=np.zeros(ridge.shape)).sum(axis=1)
    value -= 0.5 * np.sum((coefficients * ridge) ** 2, axis=1) + 0.5 * np.log(2 * np.pi) * has_prior.sum(
        axis=1
    )
    value += 0.5 * np.log(2 * np.pi) - 0.5 * np.log(links * tail.size)
    if columns:
        information = np.asarray(tail.location / size**2)[:, None, None]
        matrix = information * (design.T @ design) + prior
        value += 0.5 * columns * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(regular(matrix))[1]
    return value


def _mode(
    gap: NDArray[np.float64],
    design: NDArray[np.float64],
    prior: NDArray[np.float64],
    size: NDArray[np.float64],
    tail: Tail,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Errors [n, m], coefficients [n, q] and scale [n] at the mode, from an initial scale and the prior precisions."""
    links, columns = design.shape
    outer = (design[:, :, None] * design[:, None, :]).reshape(links, -1)
    errors, coefficients, change = gap, np.zeros((len(gap), columns)), np.float64(0.0)
    # A gap leaves the iteration once it has converged; `rows` contains the indices of the remaining gaps.
    mode, rows = (gap.copy(), coefficients.copy(), size.copy()), np.arange(len(gap))
    for step in range(MAX_STEPS):
        variance = size**2
        weight = tail.weight(errors**2 / variance[:, None])
        if columns:
            # Weighted normal equations, multiplied by the variance.
            matrix = (weight @ outer).reshape(-1, columns, columns) + variance[:, None, None] * prior
            side = (weight * gap) @ design
            coefficients = np.linalg.solve(regular(matrix), side[..., None])[..., 0]
            before, errors = errors, gap - coefficients @ design.T
            change = np.abs(errors - before).max(axis=1)
        number = weight.sum(axis=1) if tail.by_weights else links
        after = np.maximum(np.sqrt((weight * errors**2).sum(axis=1) / number), 1e-12)
        moving = np.maximum(np.abs(after - size), change) > TOLERANCE * after
        size = after
        if step + 1 < MAX_STEPS and moving.all():
            continue
        for target, values in zip(mode, (errors, coefficients, size), strict=True):
            target[rows] = values
        if not moving.any():
            break
        rows, tail = rows[moving], tail.select(np.flatnonzero(moving))
        gap, prior = gap[moving], prior[moving]
        errors, coefficients, size = errors[moving], coefficients[moving], size[moving]
    return mode


def regular(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normal equations [..., q, q] with a slightly increased diagonal, to allow for linearly dependent columns."""
    size = matrix.shape[-1]
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
    return matrix + (1e-10 * trace / size + 1e-300) * np.eye(size)
