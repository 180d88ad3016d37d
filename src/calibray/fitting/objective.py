"""The objective that a calibration minimizes.

The objective is the paper's weighted RMSE (eq. 1) over the links with nonzero weight. Nuisances (an offset or other
columns of a linear design) are added to the model: path loss + design x coefficients. For every candidate, the best
coefficients follow in closed form (variable projection), so optimizers search only the parameters.

A Gaussian prior on a coefficient adds the row (noise / prior) x coefficient to the residuals. Up to constants, the sum
of squares is then minus twice the log posterior, in units of the noise variance. `value` includes these rows; `rmse` is
the paper's RMSE over the links only. Without priors, `value` and `rmse` are equal.

For many links, the objective is summed over chunks of links. For gaps g (measured minus modelled path loss),
derivatives J, weights w and the nuisance's design Z, each chunk returns [J g]' w [J g] and Z' w [J g]. The sums of
these products over all chunks give the normal equations with the nuisance eliminated. With A = [J g] and the best
coefficients X for every column of A,

    (A - Z X)' w (A - Z X) = A'wA - X'Z'wA - A'wZ X + X'Z'wZ X.

From these products we build a few rows whose squares and products equal those of the residuals of all links. Methods
that use only squares and products of the residuals work with these rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibray.errors import InputError
from calibray.fitting.elimination import Elimination
from calibray.fitting.nuisance import UNKNOWN_DB, Nuisance
from calibray.measurements import Measurements


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over links, for n candidates and k columns: first the derivatives, if requested, and then the gap.

    Attributes:
        square: Products A'wA [n, k, k] of the columns; the squared gap is infinite if any link lacks a path.
        side: Products with the design Z'wA [n, q, k].
    """

    square: NDArray[np.float64]
    side: NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Share:
    """The objective's data for one chunk of links; called with their path loss, it returns their sums.

    Attributes:
        links: Indices, within the chunk, of the m links with nonzero weight [m].
        measured: Their measured path loss [m], [dB].
        weight: Weights of these links, normalized as in the objective [m].
        design: The c columns [m, c] of the nuisance with entries at these links.
        columns: Indices [c] of these columns in the nuisance.
        ceiling_db: Path loss assigned to a link without a path [dB]; None if there is no ceiling.
    """

    links: NDArray[np.int64]
    measured: NDArray[np.float64]
    weight: NDArray[np.float64]
    design: sparse.csr_array
    columns: NDArray[np.int64]
    ceiling_db: float | None

    def __call__(self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64] | None = None) -> Sums:
        """Sums over the links of the chunk, from path loss [n, l], [dB], and its derivatives [n, l, d].

        `side` [n, c, k] contains only the columns of the chunk.
        """
        loss = path_loss[:, self.links]
        at_ceiling = loss >= (np.inf if self.ceiling_db is None else self.ceiling_db)
        gap = self.measured - (loss if self.ceiling_db is None else np.minimum(loss, self.ceiling_db))
        lost = np.asarray(~np.isfinite(gap).all(axis=1))
        # Candidates without a path for some link are marked below; their sums must stay finite here.
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


@dataclass(frozen=True, eq=False)
class Objective:
    """The weighted RMSE between modelled and measured path loss, with the nuisance eliminated.

    Attributes:
        measured: Measured path loss [L], [dB].
        weight: Weights of the links [L]; a link with weight 0 is left out.
        nuisance: The nuisance; it may have no terms.
        ceiling_db: Path loss assigned to a link without a path [dB]; if None, these links are left out.
        noise_db: Standard deviation of a link's error at the mean weight, which scales the priors [dB].
    """

    measured: NDArray[np.float64]
    weight: NDArray[np.float64]
    nuisance: Nuisance
    ceiling_db: float | None = None
    noise_db: float = 1.0

    def reweighted(self, weight: NDArray[np.float64]) -> Objective:
        """The objective with other weights [L]; the noise is rescaled so that the links' errors do not change."""
        if not (weight > 0).any():
            return replace(self, weight=weight)
        before, after = (float(each[each > 0].mean()) for each in (self.weight, weight))
        return replace(self, weight=weight, noise_db=self.noise_db * float(np.sqrt(before / after)))

    def coefficients(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best coefficients [n, q] of the nuisance, in dB per unit of their columns, for path loss [n, L], [dB].

        Links without a path for a candidate are left out of the candidate's fit. A coefficient that is not `determined`
        takes the value nearest to 0 within its bounds.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        return self._fitted(self.measured - self.capped(path_loss))

    def completed(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """The coefficients [n, q] for predicting other links, from path loss [n, L], [dB].

        A coefficient that is not `determined` is set to the mean of the determined coefficients of its term. The
        determined coefficients are then fitted again.
        """
        gap = self.measured - self.capped(path_loss)
        coefficients = self._fitted(gap)
        filled = self.nuisance.filled(coefficients, self.determined)
        added_db = self.nuisance.contribution(filled - coefficients)
        if not added_db[:, self._counted].any():
            return filled
        return np.where(self.determined, self._fitted(gap - added_db), filled)

    def _fitted(self, gap: NDArray[np.float64]) -> NDArray[np.float64]:
        """The coefficients [n, q] that best fit the gap [n, L]: measured minus modelled path loss [dB]."""
        if not self.nuisance.terms:
            return np.zeros((len(gap), 0))
        gap = gap[:, self._counted]
        reached = np.isfinite(gap)
        if reached.all():
            return self._elimination.coefficients(gap)
        # Candidates with paths for the same set of links share one elimination.
        coefficients = np.empty((len(gap), len(self.nuisance.columns)))
        patterns, pattern_of = np.unique(reached, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            weight, members = np.zeros(len(self.weight)), pattern_of.ravel() == number
            weight[self._counted] = np.where(pattern, self._scale**2, 0.0)
            elimination = Elimination.of(self.nuisance, weight, self._ridge)
            coefficients[members] = elimination.coefficients(gap[members][:, pattern])
        return coefficients

    def coefficient_slopes(
        self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives [n, q, d] of the best coefficients, from path loss [n, L] and its derivatives [n, L, d]."""
        if not self.nuisance.terms:
            return np.zeros((len(path_loss), 0, derivative.shape[2]))
        slope = self._slopes(path_loss, derivative)
        return -self._elimination.projection(slope, self.coefficients(path_loss))

    def coefficient_root(self) -> NDArray[np.float64]:
        """Root R [q, q] of the coefficients' covariance R R', given path loss; large for undetermined coefficients."""
        wide_prior = np.where(self.determined, np.inf, UNKNOWN_DB)
        gram = self._elimination.data.toarray() + np.diag(self._ridge**2 + (self.noise_db / wide_prior) ** 2)
        return self.noise_db * np.linalg.cholesky(np.linalg.inv(gram))

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Mask [q] of the columns whose coefficients the links with nonzero weight determine.

        Examples of undetermined coefficients are the offset of a group whose links all have weight 0, or the slope of a
        group whose links all have the same distance.
        """
        if not self.nuisance.terms:
            return np.zeros(0, dtype=bool)
        return self._elimination.determined

    @property
    def fitted(self) -> float:
        """Effective number of coefficients that the links determine: the sum of the links' shares in their precision.

        Coefficients whose priors keep them at zero explain no residuals, regardless of the number of groups.
        """
        if not self.nuisance.terms:
            return 0.0
        data = self._elimination.data.diagonal()[self.determined]
        return float(np.sum(data / (data + self._ridge[self.determined] ** 2)))

    @property
    def supported(self) -> NDArray[np.bool_]:
        """Mask [L] of the links whose columns are all determined; the model of other links is incomplete.

        A random effect's deviations are 0 unless links determine them.
        """
        terms = self.nuisance.terms
        deviates = np.repeat([bool(term.around) for term in terms], [len(term.labels) for term in terms])
        return ~((self.nuisance.design != 0) @ ~(self.determined | deviates.astype(bool)))

    def model(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """The full model [n, L], [dB]: path loss [n, L], limited to the ceiling, plus the best nuisance."""
        return self._model(path_loss, self.coefficients(path_loss))

    def residuals(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals [n, links with weight + priors], [dB], for path loss [n, L]; their root mean square is `value`.

        The residuals are (model - measurement) times the square root of the weights, followed by one row per
        coefficient with a prior.
        """
        coefficients = self.coefficients(path_loss)
        links = (self._model(path_loss, coefficients) - self.measured)[:, self._counted] * self._scale
        return np.concatenate([links, (coefficients * self._ridge)[:, self._ridge > 0]], axis=1)

    def jacobian(
        self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives [n, links with weight + priors, d] of the residuals, from derivatives [n, L, d] of path loss."""
        slope, prior_rows = self._slopes(path_loss, derivative), None
        if self.nuisance.terms:
            projection = self._elimination.projection(slope, self.coefficients(path_loss))
            self._elimination.remove(slope, projection)
            has_prior = self._ridge > 0
            if has_prior.any():
                # The derivatives of the best coefficients are minus the projection.
                prior_rows = -(projection * self._ridge[:, None])[:, has_prior]
        slope *= self._scale[:, None]
        return slope if prior_rows is None else np.concatenate([slope, prior_rows], axis=1)

    def value(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """The minimized value [n], [dB]: the root mean square of all residuals, including the rows of priors.

        The value equals the RMSE if no coefficient has a prior, and is +inf if a link with nonzero weight has no path.
        """
        return np.sqrt(np.mean(self.residuals(path_loss) ** 2, axis=1))

    def rmse(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """RMSE [n], [dB], over only the links (paper eq. 1); +inf if a link with nonzero weight has no path."""
        links = self.residuals(path_loss)[:, : len(self._scale)]
        return np.sqrt(np.mean(links**2, axis=1))

    def shares(self, chunks: Sequence[NDArray[np.int64]]) -> list[Share]:
        """The part of the objective for each chunk of links; the chunks can be summed separately."""
        weight, shares = np.zeros(len(self.weight)), []
        weight[self._counted] = self._scale**2
        for chunk in chunks:
            inside = np.flatnonzero(weight[chunk] > 0)
            links = chunk[inside]
            design = self.nuisance.design[links]
            columns = np.unique(design.indices).astype(np.int64)
            share = Share(
                links=inside,
                measured=self.measured[links],
                weight=weight[links],
                design=design[:, columns],
                columns=columns,
                ceiling_db=self.ceiling_db,
            )
            shares.append(share)
        return shares

    def products(self, sums: Sums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Squares and products of the residuals and their derivatives, from sums over all links.

        The results are the products [n, k, k] of the k columns (the derivatives and minus the residuals), including the
        rows of priors, and the sum of squares [n], [dB^2], over only the links.

        Raises:
            EngineError: No minimum of the nuisance within its bounds was found.
        """
        if not self.nuisance.terms:
            return sums.square, sums.square[:, -1, -1]
        side = sums.side
        best = self._elimination.minimum(side[..., -1])
        projection = self._elimination.projection_from_sums(side[..., :-1], best)
        # (A - Z X)' w (A - Z X), with the best coefficients X of all columns.
        best = np.concatenate([projection, best[..., None]], axis=2)
        crossed = best.transpose(0, 2, 1) @ side
        inner = np.stack([candidate.T @ (self._elimination.data @ candidate) for candidate in best])
        links = sums.square - crossed - crossed.transpose(0, 2, 1) + inner
        prior_rows = best * self._ridge[:, None]
        return links + prior_rows.transpose(0, 2, 1) @ prior_rows, links[:, -1, -1]

    @property
    def num_rows(self) -> int:
        """Number of residuals: the links with nonzero weight plus the coefficients with a prior."""
        return self.num_counted + int(np.count_nonzero(self._ridge > 0))

    @property
    def num_counted(self) -> int:
        """Number of links with nonzero weight; the residuals have one row for each, followed by the rows of priors."""
        return len(self._scale)

    def capped(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss limited to the ceiling, if there is one [dB]."""
        return path_loss if self.ceiling_db is None else np.minimum(path_loss, self.ceiling_db)

    def with_nuisance(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [L], [dB], plus the nuisance, which is fitted to the links with nonzero weight.

        Coefficients that these links do not determine are set to the mean of their term.
        """
        return self.capped(path_loss) + self.nuisance.contribution(self.completed(path_loss[None]))[0]

    def _model(
        self, path_loss: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        model = self.capped(path_loss)
        return model + self.nuisance.contribution(coefficients) if self.nuisance.terms else model

    def _slopes(self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]) -> NDArray[np.float64]:
        """Copy of the derivatives at the links with nonzero weight; 0 if the path loss is at the ceiling."""
        at_ceiling = (path_loss >= (np.inf if self.ceiling_db is None else self.ceiling_db))[:, self._counted]
        slope = np.array(derivative[:, self._counted])
        slope[at_ceiling] = 0.0
        return slope

    @cached_property
    def _counted(self) -> NDArray[np.int64] | slice:
        """Indices of the links with nonzero weight; a slice if all links have nonzero weight, which avoids copies."""
        counted = self.weight > 0
        return slice(None) if counted.all() else np.flatnonzero(counted)

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        """Square roots of the links' weights, normalized to a mean square of one."""
        weight = self.weight[self._counted]
        return np.sqrt(weight * len(weight) / weight.sum())

    @cached_property
    def _ridge(self) -> NDArray[np.float64]:
        """Ratio [q] of the standard deviation of the noise to that of each prior; 0 for a flat prior."""
        return self.noise_db / self.nuisance.prior

    @cached_property
    def _elimination(self) -> Elimination:
        weight = np.zeros(len(self.weight))
        weight[self._counted] = self._scale**2
        return Elimination.of(self.nuisance, weight, self._ridge)


def make_objective(
    links: Measurements,
    reached: NDArray[np.bool_],
    calibrated: NDArray[np.bool_],
    *,
    nuisance: Nuisance | None = None,
    ceiling_db: float | None = None,
    noise_db: float | None = None,
) -> Objective:
    """Make the objective for the calibration links.

    Args:
        links: All links.
        reached: Mask [L] of the links with a path.
        calibrated: Mask of the calibration links [L].
        nuisance: The nuisance over all links; None if the model has no nuisance.
        ceiling_db: Path loss assigned to a link without a path [dB]; if None, these links are left out.
        noise_db: Standard deviation of a link's error [dB]; required if a coefficient has a prior.

    Raises:
        InputError: No link is left, the nuisance has a different number of links, or a prior is given without noise_db.
    """
    counted = calibrated & (reached if ceiling_db is None else True)
    if not counted.any():
        raise InputError(
            f"{links.source}: no path reaches any of the {int(calibrated.sum())} calibration links; raise "
            "trace.max_depth, allow refraction or diffraction, or check that positions and scene share a frame"
        )
    nuisance = Nuisance(len(links)) if nuisance is None else nuisance
    if nuisance.num_links != len(links):
        raise InputError(
            f"{links.source}: the nuisance has {nuisance.num_links} links, must have {len(links)}"
        )
    if noise_db is None and np.isfinite(nuisance.prior).any():
        raise InputError("nuisance: a prior requires noise_db, the standard deviation of a link's error [dB]")
    return Objective(
        measured=links.path_loss_db,
        weight=np.where(counted, links.weight, 0.0),
        nuisance=nuisance,
        ceiling_db=ceiling_db,
        noise_db=1.0 if noise_db is None else noise_db,
    )


def total(parts: Sequence[Sums], shares: Sequence[Share], columns: int) -> Sums:
    """Total of the chunks' sums, given in the order of `shares`, for a nuisance with `columns` columns."""
    square = np.zeros_like(parts[0].square)
    side = np.zeros((len(square), columns, square.shape[2]))
    for part, share in zip(parts, shares, strict=True):
        square += part.square
        side[:, share.columns] += part.side
    return Sums(square, side)


def rows(products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices R [n, k, k] with R'R = products, for positive semidefinite products [n, k, k].

    Example:
        >>> root = rows(np.array([[[4.0, 2.0], [2.0, 1.0]]]))
        >>> np.allclose(root[0].T @ root[0], [[4.0, 2.0], [2.0, 1.0]])
        True
    """
    size = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    size = np.where(size > 0, size, 1.0)
    # Scale to a unit diagonal first; otherwise rounding errors in large columns exceed the values in small columns.
    values, vectors = np.linalg.eigh(products / (size[:, :, None] * size[:, None, :]))
    root = np.sqrt(np.maximum(values, 0.0))
    return root[:, :, None] * vectors.transpose(0, 2, 1) * size[:, None, :]
