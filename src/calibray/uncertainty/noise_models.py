"""Noise models, and the marginal density of the measurements under each model.

Errors may be independent and Gaussian, correlated between neighbouring links, larger out of sight, or heavy-tailed.
There may be an undeclared offset. Larger errors out of sight are a discrepancy of the digital twin (M. C. Kennedy and
A. O'Hagan, J. Royal Statistical Society B 63, 2001): paths that the twin lacks change the path loss of its weak links
(`excess_db`). The right model is unknown, and choosing the best-fitting model would ignore models that fit nearly as
well. Every model therefore has a prior weight, and results are averages over all models (Bayesian model averaging). A
discrepancy that the data do not support receives almost no weight and so does not absorb effects that the parameters
explain.

The noise level has the prior 1/level. The priors of nuisances are flat unless the study declares them. For Gaussian
noise with covariance C times an unknown variance, the integrals over noise level and nuisances have closed forms (D. A.
Harville, Biometrika 61, 1974): with whitened errors y and design Z, ridge R, A = Z'Z + R'R and S = y'y - y'Z A^-1 Z'y,

    p = (2 pi)^(-f/2) Gamma(f/2) / 2 (S/2)^(-f/2) |C|^(-1/2) |A|^(-1/2) |R|,

where f is the number of links minus the number of columns with a flat prior. For heavy tails, both integrals use
Laplace's approximation (`laplace.py`).

Paths that the twin lacks, such as paths through buildings, add power. These paths hardly change the power of
line-of-sight links. For links out of sight, the twin underestimates the power by the contribution of these paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from calibray.fitting.problem import Problem
from calibray.uncertainty.laplace import evidence, gross, log_evidence, regular, student
from calibray.uncertainty.residual_correlation import (
    EXACT,
    Whitener,
    nearest_earlier,
    pairwise,
    shared,
    whitener,
)

CANDIDATES: Final = 16
"""Number of candidates within the bounds; the median of a link's path loss over these candidates is the scene's
prediction."""

STRONGEST: Final = 0.05
"""Quantile of the excess loss that represents the strongest links, which are the line-of-sight links if there are
any."""


def excess_db(problem: Problem) -> NDArray[np.float64]:
    """Excess [L], [dB], over free-space loss of links out of sight, relative to the excess of the strongest links.

    The excess is the median over candidates within the bounds. It is minus infinity for line-of-sight links and for
    links without a path.
    """
    from scipy.stats import qmc  # takes 0.4 s

    links, (lower, upper) = problem.setup.with_obstruction().links, problem.parameters.search_bounds
    points = qmc.scale(qmc.Sobol(len(lower), rng=0).random(CANDIDATES), lower, upper)
    # Free-space loss is 20 log10(distance x frequency) plus a constant that cancels below.
    electrical = np.maximum(links.distance, 1e-3) * (1.0 if links.frequency is None else links.frequency)
    excess = np.median(problem.modelled(points), axis=0) - 20.0 * np.log10(electrical)
    strongest = np.quantile(excess[problem.objective.weight > 0], STRONGEST)
    weak = (links.table.numbers("out_of_sight") > 0) & np.isfinite(excess)
    return np.where(weak, excess - strongest, -np.inf)


def missing_db(excess: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Change in path loss [dB], at the given excess losses, due to missing power `level` dB below the line of sight."""
    # 10 log10(1 + 10^((excess - level) / 10)), without overflow.
    return 10.0 * np.logaddexp(0.0, (excess - level) * (0.1 * np.log(10.0))) / np.log(10.0)


OFFSET_DB: Final = 6.0
"""Prior standard deviation [dB] of an undeclared offset, for example from a cable or an antenna gain."""

NO_OFFSET: Final = 1e3
"""Inverse prior standard deviation [1/dB] that keeps an offset at 0."""

SHARES: Final = (0.4, 0.7, 0.95)
"""Trial values of the correlated fraction of the variance."""

RANGES: Final = 4
"""Number of trial correlation ranges, from the distance between neighbours to a third of the campaign's extent."""

SAME_PLACE: Final = 0.01
"""Correlation range, relative to the distance between neighbours, for errors shared only by links at the same
position."""

FREEDOMS: Final = (2.0, 4.0)
"""Trial values of the degrees of freedom of Student's t."""

DEPARTURE: Final = 2.0
"""Prior weight of an offset, relative to no offset, and of correlated or heavy-tailed errors, relative to independent
Gaussian errors. Measured errors are rarely independent and Gaussian. Larger errors out of sight have a prior weight of
one. If the twin lacks refraction, the posterior weight of larger errors out of sight exceeds 0.9 in five of nine
development runs."""

IMPROBABLE: Final = 50.0
"""With many links, a model is left out if the log odds against it at the optimum reach this value. At its own optimum,
the model can gain only a few units per parameter, which is far less than this limit."""

LEVELS: Final = (5.0, 15.0, 25.0)
"""Trial levels of the power that the twin lacks out of sight, in dB below the power in sight. In three development
districts with twins that lack refraction, the missing power is 2 to 35 dB below the power in sight."""

COMMON: Final = 0.5
"""Fraction of the variance of errors out of sight that all links share. Errors have a shared part because missing paths
can only add power."""

# Kinds of noise; "student-t" includes Gaussian noise with gross errors.
GAUSSIAN, CORRELATED, OUT_OF_SIGHT, HEAVY = "gaussian", "correlated", "out_of_sight", "student-t"

DIFFERING: Final = "heterogeneous"
"""Name of the hypothesis that buildings differ; like the kinds of noise, it has a posterior weight."""

OFFSET: Final = "offset"
"""Name of the hypothesis of an undeclared offset; like the kinds of noise, it has a posterior weight."""


@dataclass(frozen=True)
class NoiseModel:
    """One model of the errors.

    Attributes:
        kind: "gaussian", "correlated", "out_of_sight" (larger out of sight) or "student-t".
        weight: Its prior weight.
        offset: Whether the model includes an undeclared offset.
        range: Correlation range, if "correlated" [m]; level of the power that the twin lacks, if "out_of_sight" [dB].
        share: Correlated fraction of the variance, if "correlated".
        freedom: Degrees of freedom, if "student-t".
        gross: Whether the errors are Gaussian with a few gross errors instead of Student's t, if "student-t".
    """

    kind: str
    weight: float
    offset: bool = False
    range: float = 0.0
    share: float = 0.0
    freedom: float = np.inf
    gross: bool = False


def noise_models(
    position: NDArray[np.float64],
    *,
    kind: str | None = None,
    range_m: float | None = None,
    offset: bool = True,
    censored: bool = False,
    out_of_sight: bool = False,
) -> tuple[NoiseModel, ...]:
    """The noise models to try, with their prior weights.

    Args:
        position: Positions of the links' ends [m, 3 or 6], [m].
        kind: "gaussian" or "student-t" if declared; both are tried if None.
        range_m: Correlation range [m]; 0 for no correlation; several ranges are tried if None.
        offset: Whether to try an undeclared offset.
        censored: Whether any links are censored; if so, gross errors are left out, because their probability of
            censoring is not implemented.
        out_of_sight: Whether to try larger errors of links out of sight.

    Returns:
        The models; their weights sum to one.
    """
    # A declared range excludes independent errors, and a range of 0 excludes correlated errors.
    kinds = [[NoiseModel(GAUSSIAN, 1.0)]] if kind != HEAVY and not range_m else []
    ranges = _ranges(position) if range_m is None else (range_m,) * (range_m > 0)
    if kind != HEAVY and ranges:
        kinds.append([NoiseModel(CORRELATED, 1.0, range=r, share=s) for r in ranges for s in SHARES])
    if kind != HEAVY and out_of_sight:
        kinds.append([NoiseModel(OUT_OF_SIGHT, 1.0, range=level) for level in LEVELS])
    if kind != GAUSSIAN and not range_m:
        tails = [NoiseModel(HEAVY, 1.0, freedom=freedom) for freedom in FREEDOMS]
        # A declared Student's t excludes gross errors.
        if kind != HEAVY and not censored:
            tails.append(NoiseModel(HEAVY, 1.0, gross=True))
        kinds.append(tails)
    offset_weights = {False: 1.0, True: DEPARTURE} if offset else {False: 1.0}
    kind_weights = [DEPARTURE if models[0].kind in (CORRELATED, HEAVY) else 1.0 for models in kinds]
    return tuple(
        replace(
            model,
            weight=weight / sum(kind_weights) / len(models) * offset_weight / sum(offset_weights.values()),
            offset=with_offset,
        )
        for weight, models in zip(kind_weights, kinds, strict=True)
        for model in models
        for with_offset, offset_weight in offset_weights.items()
    )


def _ranges(position: NDArray[np.float64]) -> tuple[float, ...]:
    """Correlation ranges to try; empty for fewer than three positions.

    If several links share a position, a model with errors that only these links share is also tried.
    """
    places = np.unique(position, axis=0)
    distance = pairwise(places)
    if len(distance) < 3:
        return ()
    high = float(distance.max()) / 3
    np.fill_diagonal(distance, np.inf)
    # Typical distance to the nearest other position.
    low = float(np.median(distance.min(axis=1)))
    repeated = (SAME_PLACE * low,) if len(places) < len(position) else ()
    return (*repeated, *np.geomspace(low, max(high, 2 * low), RANGES).tolist())


@dataclass(frozen=True, eq=False)
class Marginal:
    """Marginal density of the measurements for given path loss, under several noise models.

    Attributes:
        design: Columns [m, q] of the nuisance, times the square roots of the weights.
        ridge: Ratio of the noise level to each coefficient's prior standard deviation [q]; 0 for a flat prior.
        column: The column [m] of an undeclared offset, multiplied by the same square roots.
        noise_db: Approximate noise level, which scales priors [dB].
        models: The noise models.
        whiteners: Whitener of each "correlated" or "out_of_sight" model, by kind, range and share.
        censored: Mask [m] of the censored links, whose gaps are lower limits; if any link is censored, no model has a
            whitener.
    """

    design: NDArray[np.float64]
    ridge: NDArray[np.float64]
    column: NDArray[np.float64]
    noise_db: float
    models: tuple[NoiseModel, ...]
    whiteners: dict[tuple[str, float, float], Whitener]
    censored: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        design: NDArray[np.float64],
        ridge: NDArray[np.float64],
        scale: NDArray[np.float64],
        position: NDArray[np.float64],
        noise_db: float,
        models: Sequence[NoiseModel],
        censored: NDArray[np.bool_] | None = None,
        excess_db: NDArray[np.float64] | None = None,
    ) -> Marginal:
        """Set up the density over m links.

        Args:
            design: Columns [m, q] of the nuisance, unscaled.
            ridge: Ratio of the noise level to each coefficient's prior standard deviation [q]; 0 for a flat prior.
            scale: Square roots [m] of the links' weights, with a mean square of one.
            position: Positions of the links' ends [m, 3 or 6], [m].
            noise_db: Approximate noise level [dB].
            models: The noise models.
            censored: Mask [m] of the censored links; if None, no link is censored.
            excess_db: Values of the function `excess_db` at these links [m], [dB]; None if no model is "out_of_sight".
        """
        censored = np.zeros(len(scale), dtype=bool) if censored is None else censored
        whiteners = {}
        keys = sorted({(model.kind, model.range, model.share) for model in models})
        # One search for neighbours serves all ranges.
        many = len(position) > EXACT and any(kind == CORRELATED for kind, _, _ in keys)
        near = nearest_earlier(position) if many else None
        for kind, range_, share in keys:
            if kind == CORRELATED:
                whiteners[kind, range_, share] = whitener(position, scale, range_, share, neighbours=near)
            elif kind == OUT_OF_SIGHT and excess_db is not None:
                error = scale * missing_db(excess_db, range_) / noise_db
                whiteners[kind, range_, share] = shared(error, COMMON)
        return cls(design * scale[:, None], ridge, scale, noise_db, tuple(models), whiteners, censored)

    def without_improbable(self, gap: NDArray[np.float64]) -> Marginal:
        """The density, without models that fit the gaps [1, m] at the optimum much worse than the best model."""
        density = self.densities(gap)[0]
        kept = np.flatnonzero(density > density.max() - IMPROBABLE)
        return replace(self, models=tuple(self.models[k] for k in kept)) if len(kept) else self

    def densities(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density of the measurements plus log weight of the model [n, models]; -inf if a gap is not finite.

        Gaps [n, m], [dB], are measured minus modelled path loss, without the nuisance, times the square roots of the
        weights.
        """
        log_density = np.full((len(gap), len(self.models)), -np.inf)
        finite = np.asarray((np.isfinite(gap) | (self.censored & (gap < 0))).all(axis=1))
        if not finite.any():
            return log_density
        gap, white = gap[finite], {}
        for index, model in enumerate(self.models):
            design, ridge = self._with_offset(model.offset)
            if self.censored.any():
                value = log_evidence(gap, self.censored, design, ridge / self.noise_db, model.freedom)
            elif model.kind == HEAVY:
                tail = gross() if model.gross else student(model.freedom)
                value = evidence(gap, design, ridge / self.noise_db, tail)
            elif (key := (model.kind, model.range, model.share)) in self.whiteners:
                filter_ = self.whiteners[key]
                if key not in white:
                    white[key] = filter_.apply(gap.T).T
                value = _plain(white[key], filter_.apply(design), ridge) - 0.5 * filter_.log_determinant
            else:
                value = _plain(gap, design, ridge)
            log_density[finite, index] = value + np.log(model.weight)
        return log_density

    def is_gaussian(self, model: NoiseModel) -> bool:
        """Whether the errors of a model are Gaussian, independent or not."""
        return model.kind == GAUSSIAN or (model.kind, model.range, model.share) in self.whiteners

    def form(self, model: NoiseModel) -> tuple[NDArray[np.float64], float, float]:
        """Matrix Q [m, m] and constants c and h of a Gaussian model: the log density of gaps g is c - h log g'Q g."""
        design, ridge = self._with_offset(model.offset)
        white, shift = np.eye(len(design)), 0.0
        if model.kind != GAUSSIAN:
            filter_ = self.whiteners[model.kind, model.range, model.share]
            white, shift = filter_.apply(white), 0.5 * filter_.log_determinant
        square, freedom = white.T @ white, len(design) - int((ridge == 0).sum())
        if len(ridge):
            # The quadratic form is S in the module's docstring; the shift contains |C| and |A|.
            columns = white @ design
            matrix, side = regular(columns.T @ columns + np.diag(ridge**2)), columns.T @ white
            square -= side.T @ np.linalg.solve(matrix, side)
            shift += 0.5 * float(np.linalg.slogdet(matrix)[1])
        return square, _constant(freedom, ridge) - shift, 0.5 * freedom

    def heavy(self, gap: NDArray[np.float64], models: Sequence[NoiseModel]) -> NDArray[np.float64]:
        """Log density [n] of finite gaps [n, m], each under its own "student-t" model, without the models' weights.

        Either all or none of the models have gross errors.
        """
        offset = np.array([model.offset for model in models])
        design, ridge = self._with_offset(bool(offset.any()))
        by_gap = np.tile(ridge / self.noise_db, (len(gap), 1))
        if offset.any():
            # A ridge this large fixes the offset at 0. The normalization of the offset's prior cancels the integral
            # over the offset.
            by_gap[~offset, -1] = NO_OFFSET
        freedom = np.array([model.freedom for model in models])
        return evidence(gap, design, by_gap, gross() if models[0].gross else student(freedom))

    def _with_offset(self, offset: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Design and ridge, with an undeclared offset as the last column if requested."""
        if not offset:
            return self.design, self.ridge
        return np.column_stack([self.design, self.column]), np.append(self.ridge, self.noise_db / OFFSET_DB)


def _constant(freedom: int, ridge: NDArray[np.float64]) -> float:
    """Logarithm of (2 pi)^(-f/2) Gamma(f/2) / 2 x 2^(f/2) x |R|."""
    half = 0.5 * freedom
    return float(gammaln(half) - half * np.log(np.pi) - np.log(2.0) + np.log(ridge[ridge > 0]).sum())


def _plain(
    gap: NDArray[np.float64], design: NDArray[np.float64], ridge: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density p [n] of whitened Gaussian errors (see the module's docstring); the caller adds the term of |C|."""
    freedom = gap.shape[1] - int((ridge == 0).sum())
    square, log_root = np.sum(gap**2, axis=1), 0.0
    if design.shape[1]:
        # With A = F F', y'Z A^-1 Z'y is the square of F^-1 Z'y, and |A|^(1/2) is the product of the diagonal of F.
        factor = np.linalg.cholesky(regular(design.T @ design + np.diag(ridge**2)))
        square = square - np.sum(np.linalg.solve(factor, design.T @ gap.T) ** 2, axis=0)
        log_root = float(np.log(np.diag(factor)).sum())
    return _constant(freedom, ridge) - 0.5 * freedom * np.log(np.maximum(square, 1e-300)) - log_root
