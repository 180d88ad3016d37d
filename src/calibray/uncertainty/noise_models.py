"""How well parameters explain the measurements, whatever the noise: models of it, their unknowns integrated out.

Errors of links may be independent and Gaussian, shared by neighbours, heavy-tailed, or larger where materials matter
more, for walls of one material differ from building to building; and an offset may have been forgotten. No one knows
which beforehand, and choosing one by its fit forgets that another fits nearly as well. So every model gets a prior
weight, and the density of the data under each stands beside the others'; what is reported averages over them.

The size of the noise has the prior 1/size and nuisances their own, flat unless stated. With Gaussian noise whose
covariance is C times an unknown variance both integrals are closed (D. A. Harville, Biometrika 61, 1974): with whitened
errors y and design Z, ridge R, A = Z'Z + R'R and S = y'y - y'Z A^-1 Z'y,

    p = (2 pi)^(-f/2) Gamma(f/2) / 2 (S/2)^(-f/2) |C|^(-1/2) |A|^(-1/2) |R|,

f being the number of links less that of columns with a flat prior. With heavy tails both are taken by Laplace's
approximation (`tails.py`).

Heterogeneity: where a material's constant differs from building to building by a factor exp(tau z), a link's path loss
is another one on average, and varies about it. Both are taken from the corners of a two-level factorial design,
theta_k exp(+-tau) (R. L. Plackett and J. P. Burman, Biometrika 33, 1946): the mean is right to the second order in tau,
and so is the variance, which is added to the noise; and where reflections inside walls make path loss wave with the
constant, they stay within the wave, as no derivative does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard
from scipy.special import gammaln

from calibray.uncertainty.censoring import log_evidence
from calibray.uncertainty.correlation import Whitener, pairwise, whitener
from calibray.uncertainty.heavy_tails import evidence, gross, products, regular, student

OFFSET_DB: Final = 6.0
"""Standard deviation of an offset that was forgotten, as of a cable or an antenna's gain [dB]."""

HELD: Final = 1e3
"""One over the standard deviation of an offset that is none, where others have one [1/dB]."""

SHARES: Final = (0.4, 0.7, 0.95)
"""Shares of the variance that neighbours have in common, where they have."""

RANGES: Final = 4
"""Ranges of correlation, from the distance of neighbours to a third of the campaign."""

FREEDOMS: Final = (2.0, 4.0)
"""Degrees of freedom of heavy-tailed noise."""

SPREADS: Final = (0.07, 0.15, 0.3)
"""Spreads of a material between buildings."""

DEPARTURE: Final = 2.0
"""Weight of each departure from independent Gaussian errors, beside theirs of one: measured errors rarely are."""

NEGLIGIBLE: Final = 1e-3
"""Weight of a model below which it is left out."""

# Of errors with heavy tails, whichever they have.
GAUSSIAN, CORRELATED, HEAVY, DIFFERING = "gaussian", "correlated", "student-t", "heterogeneous"


def corners(parameters: int) -> NDArray[np.float64]:
    """Corners whose averages tell each parameter's effect by itself.

    Args:
        parameters: Number of parameters d.

    Returns:
        Signs [k, d], the columns orthogonal to each other and to a constant.

    Example:
        >>> corners(2).tolist()
        [[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]
    """
    count = 1 << parameters.bit_length()
    return np.asarray(hadamard(count)[:, 1 : parameters + 1], dtype=np.float64)


class Differing(NamedTuple):
    """What buildings that differ do to path loss, at one spread.

    Attributes:
        shift: Change of the mean [n, m], [dB], times the roots of the weights.
        variance: Variance about it [n, m], [dB^2], times the weights.
    """

    shift: NDArray[np.float64]
    variance: NDArray[np.float64]


@dataclass(frozen=True)
class NoiseModel:
    """One model of the errors.

    Attributes:
        kind: "gaussian", "correlated", "student-t" or "heterogeneous".
        weight: Its weight before anything was measured.
        offset: Whether a forgotten offset is part of it.
        range_m: Range of correlation [m], if "correlated".
        share: Share of the variance that neighbours have in common, if "correlated".
        freedom: Degrees of freedom, if "student-t".
        gross: Whether errors are Gaussian but for some gross ones in place of Student's, if "student-t".
        spread: Spread of a material between buildings, if "heterogeneous".
    """

    kind: str
    weight: float
    offset: bool = False
    range_m: float = 0.0
    share: float = 0.0
    freedom: float = np.inf
    gross: bool = False
    spread: float = 0.0


def noise_models(
    position: NDArray[np.float64],
    *,
    kind: str | None = None,
    range_m: float | None = None,
    spread: float | None = None,
    offset: bool = True,
    unheard: bool = False,
) -> tuple[NoiseModel, ...]:
    """The models of noise that are tried, each departure from independent Gaussian errors weighed alike.

    Args:
        position: Where the links' ends stand [m, 3 or 6], [m].
        kind: "gaussian" or "student-t" if it is known; both are tried if None.
        range_m: Range of correlation [m], 0 for none; several are tried if None.
        spread: Spread of materials between buildings, 0 for none; several are tried if None.
        offset: Whether an offset may have been forgotten.
        unheard: Whether some links were not heard: how likely that is, is not told where some errors are gross.

    Returns:
        The models; their weights add up to one.
    """
    found = []
    if kind != HEAVY and not range_m and not spread:
        found.append([NoiseModel(GAUSSIAN, 1.0)])
    ranges = _ranges(position) if range_m is None else (range_m,) * (range_m > 0)
    if kind != HEAVY and ranges and not spread:
        found.append([NoiseModel(CORRELATED, 1.0, range_m=r, share=s) for r in ranges for s in SHARES])
    if kind != GAUSSIAN and not range_m and not spread:
        tails = [NoiseModel(HEAVY, 1.0, freedom=freedom) for freedom in FREEDOMS]
        found.append(tails if kind == HEAVY or unheard else [*tails, NoiseModel(HEAVY, 1.0, gross=True)])
    if kind != HEAVY and spread != 0 and not range_m:
        found.append(
            [NoiseModel(DIFFERING, 1.0, spread=s) for s in (SPREADS if spread is None else (spread,))]
        )
    choices = {False: 1.0, True: DEPARTURE} if offset else {False: 1.0}
    whole = sum(choices.values())
    size = [1.0 if group[0].kind == GAUSSIAN else DEPARTURE for group in found]
    return tuple(
        replace(model, weight=part / sum(size) / len(group) * likely / whole, offset=extra)
        for part, group in zip(size, found, strict=True)
        for model in group
        for extra, likely in choices.items()
    )


def _ranges(position: NDArray[np.float64]) -> tuple[float, ...]:
    distance = pairwise(position)
    np.fill_diagonal(distance, np.inf)
    near = distance.min(axis=1)
    near = near[near > 0]
    distance[~np.isfinite(distance)] = 0.0
    if len(near) < 3:
        return ()
    low, high = float(np.median(near)), float(distance.max()) / 3
    return tuple(np.geomspace(low, max(high, 2 * low), RANGES).tolist())


@dataclass(frozen=True, eq=False)
class Marginal:
    """Density of the measurements given the parameters, under several models of the noise.

    Attributes:
        design: Columns of the nuisance, rows scaled as the gaps are [m, q].
        ridge: Size of the noise over the standard deviations of their priors [q]; 0 where flat.
        column: The column of a forgotten offset, scaled likewise [m].
        noise_db: Size of the noise that priors and the spread of materials are stated against [dB].
        models: The models.
        whiteners: What makes the errors of a correlated model independent, by its range and share.
        unheard: Which links were not heard, so that their gaps are lower limits [m]; no model is "correlated" then.
    """

    design: NDArray[np.float64]
    ridge: NDArray[np.float64]
    column: NDArray[np.float64]
    noise_db: float
    models: tuple[NoiseModel, ...]
    whiteners: dict[tuple[float, float], Whitener]
    unheard: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        design: NDArray[np.float64],
        ridge: NDArray[np.float64],
        scale: NDArray[np.float64],
        position: NDArray[np.float64],
        noise_db: float,
        models: Sequence[NoiseModel],
        unheard: NDArray[np.bool_] | None = None,
    ) -> Marginal:
        """Set up the models over some links.

        Args:
            design: Columns of the nuisance at the links, not scaled [m, q].
            ridge: Size of the noise over the standard deviations of their priors [q]; 0 where flat.
            scale: Roots of the links' weights, their mean square one [m].
            position: Where the links' ends stand [m, 3 or 6], [m].
            noise_db: Size of the noise, about [dB].
            models: The models.
            unheard: Which links were not heard [m]; none if None.

        Returns:
            The density.
        """
        unheard = np.zeros(len(scale), dtype=bool) if unheard is None else unheard
        places = {(model.range_m, model.share) for model in models if model.kind == CORRELATED}
        made = {place: whitener(position, scale, *place) for place in sorted(places)}
        return cls(design * scale[:, None], ridge, scale, noise_db, tuple(models), made, unheard)

    @property
    def spread(self) -> float:
        """Spread of materials that a model asks for, the middle one of several; 0 where none does."""
        spreads = sorted({model.spread for model in self.models if model.kind == DIFFERING})
        return spreads[len(spreads) // 2] if spreads else 0.0

    def densities(self, gap: NDArray[np.float64], differing: Differing | None = None) -> NDArray[np.float64]:
        """Logarithm of each model's weight times the density of the measurements.

        Args:
            gap: Measured minus modelled path loss, without the nuisance, times the roots of the weights [n, m], [dB].
            differing: What materials that differ by `spread` do to path loss; needed where that is not 0.

        Returns:
            The logarithms [n, models]; -inf where a gap is not finite.

        Raises:
            ValueError: A model asks what differing materials do, and it is not given.
        """
        found = np.full((len(gap), len(self.models)), -np.inf)
        good = np.asarray((np.isfinite(gap) | (self.unheard & (gap < 0))).all(axis=1))
        if not good.any():
            return found
        gap, white = gap[good], {}
        for index, model in enumerate(self.models):
            design, ridge = self._with_offset(model.offset)
            if self.unheard.any():
                value = self._censored(gap, model, design, ridge, differing, good)
            elif model.kind == HEAVY:
                tail = gross() if model.gross else student(model.freedom)
                value = evidence(gap, design, ridge / self.noise_db, tail)
            elif model.kind == DIFFERING:
                shift, weight = self._spread_out(model, differing, good)
                value = _weighted(gap - shift, design, ridge, weight)
            elif model.kind == CORRELATED:
                place = (model.range_m, model.share)
                filter_ = self.whiteners[place]
                if place not in white:
                    white[place] = filter_.apply(gap.T).T
                value = _plain(white[place], filter_.apply(design), ridge) - 0.5 * filter_.log_determinant
            else:
                value = _plain(gap, design, ridge)
            found[good, index] = value + np.log(model.weight)
        return found

    def form(self, model: NoiseModel) -> tuple[NDArray[np.float64], float, float]:
        """The quadratic form that the density is a power of, under Gaussian noise, whose links may share errors.

        Args:
            model: The model, "gaussian" or "correlated".

        Returns:
            The matrix Q [m, m], and c and h: the logarithm of the density of gaps g is c - h log g'Q g.
        """
        design, ridge = self._with_offset(model.offset)
        white, shift = np.eye(len(design)), 0.0
        if model.kind == CORRELATED:
            filter_ = self.whiteners[model.range_m, model.share]
            white, shift = filter_.apply(white), 0.5 * filter_.log_determinant
        square, freedom = white.T @ white, len(design) - int((ridge == 0).sum())
        if len(ridge):
            columns = white @ design
            matrix, side = regular(columns.T @ columns + np.diag(ridge**2)), columns.T @ white
            square -= side.T @ np.linalg.solve(matrix, side)
            shift += 0.5 * float(np.linalg.slogdet(matrix)[1])
        return square, _constant(freedom, ridge) - shift, 0.5 * freedom

    def heavy(self, gap: NDArray[np.float64], models: Sequence[NoiseModel]) -> NDArray[np.float64]:
        """Logarithm of the density under heavy tails, of all gaps together.

        Args:
            gap: As `densities` takes them, all finite [n, m].
            models: The model of each, "student-t"; all with gross errors or none [n].

        Returns:
            The logarithms [n], without the models' weights.
        """
        offset = np.array([model.offset for model in models])
        design, ridge = self._with_offset(bool(offset.any()))
        each = np.tile(ridge / self.noise_db, (len(gap), 1))
        if offset.any():
            each[~offset, -1] = HELD
        freedom = np.array([model.freedom for model in models])
        return evidence(gap, design, each, gross() if models[0].gross else student(freedom))

    def reduced(self, densities: NDArray[np.float64]) -> Marginal:
        """The same without the models that cannot matter.

        Args:
            densities: What `densities` gave for points that explain the data [n, models].

        Returns:
            The density under the others.
        """
        best = densities.max(axis=0)
        kept = best - best.max() > np.log(NEGLIGIBLE)
        return replace(
            self, models=tuple(model for model, keep in zip(self.models, kept, strict=True) if keep)
        )

    def _censored(
        self,
        gap: NDArray[np.float64],
        model: NoiseModel,
        design: NDArray[np.float64],
        ridge: NDArray[np.float64],
        differing: Differing | None,
        good: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Log density where some links were not heard [n]."""
        if model.kind != DIFFERING:
            return log_evidence(gap, self.unheard, design, ridge / self.noise_db, model.freedom)
        shift, weight = self._spread_out(model, differing, good)
        there = np.isfinite(shift) & np.isfinite(weight)  # Not where a corner loses a link's only path.
        gap, weight = gap - np.where(there, shift, 0.0), np.where(there, weight, 1.0)
        return log_evidence(gap, self.unheard, design, ridge / self.noise_db, weight=weight)

    def _spread_out(
        self, model: NoiseModel, differing: Differing | None, good: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Shift of the mean [n, m] and weights [n, m] where materials differ."""
        if differing is None:
            raise ValueError("a heterogeneous model needs what differing materials do")
        # Both grow with the square of the spread, to the second order.
        part = (model.spread / self.spread) ** 2
        weight = 1.0 / (1.0 + part / self.noise_db**2 * differing.variance[good])
        return part * differing.shift[good], weight

    def _with_offset(self, extra: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if not extra:
            return self.design, self.ridge
        return np.column_stack([self.design, self.column]), np.append(self.ridge, self.noise_db / OFFSET_DB)


def _constant(freedom: int, ridge: NDArray[np.float64]) -> float:
    half = 0.5 * freedom
    return float(gammaln(half) - half * np.log(np.pi) - np.log(2.0) + np.log(ridge[ridge > 0]).sum())


def _plain(
    gap: NDArray[np.float64], design: NDArray[np.float64], ridge: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density of whitened Gaussian errors, nuisance and size integrated out [n]."""
    freedom = gap.shape[1] - int((ridge == 0).sum())
    square, log_root = np.sum(gap**2, axis=1), 0.0
    if design.shape[1]:
        factor = np.linalg.cholesky(regular(design.T @ design + np.diag(ridge**2)))
        square = square - np.sum(np.linalg.solve(factor, design.T @ gap.T) ** 2, axis=0)
        log_root = float(np.log(np.diag(factor)).sum())
    return _constant(freedom, ridge) - 0.5 * freedom * np.log(np.maximum(square, 1e-300)) - log_root


def _weighted(
    gap: NDArray[np.float64],
    design: NDArray[np.float64],
    ridge: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The same with weights of the links that differ from point to point [n, m]."""
    freedom = gap.shape[1] - int((ridge == 0).sum())
    square, log_root = np.sum(weight * gap**2, axis=1), 0.0
    if design.shape[1]:
        matrix = regular(products(design, weight) + np.diag(ridge**2))
        side = (weight * gap) @ design
        square = square - np.einsum("nq,nq->n", side, np.linalg.solve(matrix, side[..., None])[..., 0])
        log_root = 0.5 * np.linalg.slogdet(matrix)[1]
    log_weight = 0.5 * np.log(weight).sum(axis=1)
    return (
        _constant(freedom, ridge) + log_weight - 0.5 * freedom * np.log(np.maximum(square, 1e-300)) - log_root
    )
