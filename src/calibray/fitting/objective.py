"""What a calibration minimizes.

The objective is the paper's RMSE (eq. 1) over the links that count, weighted if the links are. Nuisances, an offset
or other columns of a linear design, enter the model as path loss + design x coefficients; the best coefficients are
known in closed form for every candidate (variable projection), so that no optimizer ever sees them.

A Gaussian prior of a coefficient adds a row to the residuals, (noise / prior) x coefficient: their sum of squares is
then, but for constants, minus twice the logarithm of the posterior in units of the noise variance. `value` is that
of all rows; `rmse` remains the paper's, of the links alone. Without priors the two are the same number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.fitting.elimination import Elimination
from calibray.fitting.nuisance import Nuisance
from calibray.fitting.sums_of_squares import Share, Sums
from calibray.measurements import Measurements


@dataclass(frozen=True, eq=False)
class Objective:
    """The weighted RMSE between modelled and measured path loss, the nuisance eliminated.

    Attributes:
        measured: Measured path loss [L], [dB].
        weight: Weights of the links; 0 leaves a link out [L].
        nuisance: The nuisance; one without terms for none.
        ceiling_db: Path loss that a link without a path counts as, [dB]; None where such links are left out.
        noise_db: Standard deviation of a link's error, at the mean weight, that priors are weighed against [dB].
    """

    measured: NDArray[np.float64]
    weight: NDArray[np.float64]
    nuisance: Nuisance
    ceiling_db: float | None = None
    noise_db: float = 1.0

    def coefficients(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """The nuisance's coefficients that fit best.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            Coefficients [n, q], [dB] per unit of their columns; where `determined` is false, the value within the
            bounds that is nearest to 0. Links that a candidate has no path for leave its coefficients alone.

        Raises:
            EngineError: No minimum within the bounds was found.
        """
        if not self.nuisance.terms:
            return np.zeros((len(path_loss), 0))
        gap = (self.measured - self.capped(path_loss))[:, self._counted]
        reached = np.isfinite(gap)
        if reached.all():
            return self._elimination.coefficients(gap)
        found = np.empty((len(gap), len(self.nuisance.columns)))
        patterns, which = np.unique(reached, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            weight, mine = np.zeros(len(self.weight)), which.ravel() == number
            weight[self._counted] = np.where(pattern, self._scale**2, 0.0)
            fewer = Elimination.of(self.nuisance, weight, self._ridge)
            found[mine] = fewer.coefficients(gap[mine][:, pattern])
        return found

    def following(
        self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """How the best coefficients of the nuisance follow the parameters.

        Args:
            path_loss: Modelled path loss [n, L], [dB].
            derivative: Its derivatives [n, L, d], [dB] per unit.

        Returns:
            Derivatives of the coefficients [n, q, d].
        """
        if not self.nuisance.terms:
            return np.zeros((len(path_loss), 0, derivative.shape[2]))
        return -self._elimination.taken_up(self._sloped(path_loss, derivative), self.coefficients(path_loss))

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which columns the links that count determine [q].

        Not so a group none of whose links counts, or a slope where a group's links all stand at one distance.
        """
        if not self.nuisance.terms:
            return np.zeros(0, dtype=bool)
        return self._elimination.determined

    @property
    def supported(self) -> NDArray[np.bool_]:
        """Which links have no column that is not determined: the others' model lacks part of the nuisance [L]."""
        return ~((self.nuisance.design != 0) @ ~self.determined)

    def model(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is compared with the measurements.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            The path loss, at most the ceiling, plus the best nuisance [n, L], [dB].
        """
        return self._model(path_loss, self.coefficients(path_loss))

    def residuals(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Residuals whose root mean square is `value`.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            Model minus measurement, scaled by the square root of the weights, and a row for each column of the
            nuisance that has a prior [n, counted links + priors], [dB].
        """
        coefficients = self.coefficients(path_loss)
        links = (self._model(path_loss, coefficients) - self.measured)[:, self._counted] * self._scale
        return np.concatenate([links, (coefficients * self._ridge)[:, self._ridge > 0]], axis=1)

    def jacobian(
        self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Derivatives of the residuals.

        Args:
            path_loss: Modelled path loss [n, L], [dB].
            derivative: Its derivatives [n, L, d], [dB] per unit.

        Returns:
            Derivatives of the residuals [n, counted links + priors, d].
        """
        slope, rows = self._sloped(path_loss, derivative), []
        if self.nuisance.terms:
            taken = self._elimination.taken_up(slope, self.coefficients(path_loss))
            self._elimination.remove(slope, taken)
            if (held := self._ridge > 0).any():
                rows = [-(taken * self._ridge[:, None])[:, held]]
        slope *= self._scale[:, None]
        return np.concatenate([slope, *rows], axis=1) if rows else slope

    def value(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is minimized: the root mean square of the residuals, those of priors included.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            Its value [n], [dB]; the RMSE where no coefficient has a prior; +inf where a link that counts has no path.
        """
        return np.sqrt(np.mean(self.residuals(path_loss) ** 2, axis=1))

    def rmse(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """RMSE of candidates (paper eq. 1), over links alone.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            RMSE [n], [dB]; +inf where a link that counts has no path.
        """
        links = self.residuals(path_loss)[:, : len(self._scale)]
        return np.sqrt(np.mean(links**2, axis=1))

    def shares(self, blocks: Sequence[NDArray[np.int64]]) -> list[Share]:
        """What blocks of links need for their sums.

        Args:
            blocks: Links of every block.

        Returns:
            The share of every block.
        """
        weight, found = np.zeros(len(self.weight)), []
        weight[self._counted] = self._scale**2
        for block in blocks:
            here = np.flatnonzero(weight[block] > 0)
            links = block[here]
            design = self.nuisance.design[links]
            columns = np.unique(design.indices).astype(np.int64)
            found.append(
                Share(here, self.measured[links], weight[links], design[:, columns], columns, self.ceiling_db)
            )
        return found

    def products(self, sums: Sums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Squares and products of residuals and their derivatives, from sums over the links that count.

        Args:
            sums: Sums over all links, by their `shares`.

        Returns:
            What the columns [derivatives, -residuals], rows of priors included, have as squares and products
            [n, k, k], and the sum of squares of the links alone [n], [dB^2].

        Raises:
            EngineError: No minimum of the nuisance within its bounds was found.
        """
        if not self.nuisance.terms:
            return sums.square, sums.square[:, -1, -1]
        side = sums.side
        best = self._elimination.minimum(side[..., -1])
        taken = self._elimination.followed(side[..., :-1], best)
        best = np.concatenate([taken, best[..., None]], axis=2)
        crossed = best.transpose(0, 2, 1) @ side
        inner = np.stack([each.T @ (self._elimination.data @ each) for each in best])
        links = sums.square - crossed - crossed.transpose(0, 2, 1) + inner
        held = best * self._ridge[:, None]
        return links + held.transpose(0, 2, 1) @ held, links[:, -1, -1]

    @property
    def num_rows(self) -> int:
        """Number of residuals: of the links that count, and of coefficients with a prior."""
        return self.num_counted + int(np.count_nonzero(self._ridge > 0))

    @property
    def num_counted(self) -> int:
        """Number of links that count; the rows of the residuals after them belong to priors."""
        return len(self._scale)

    def capped(self, path_loss: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss as it could have been measured: at most the ceiling, if there is one [dB]."""
        return path_loss if self.ceiling_db is None else np.minimum(path_loss, self.ceiling_db)

    def _model(
        self, path_loss: NDArray[np.float64], coefficients: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        model = self.capped(path_loss)
        return model + self.nuisance.contribution(coefficients) if self.nuisance.terms else model

    def _sloped(self, path_loss: NDArray[np.float64], derivative: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives at the links that count; none where the path loss stands at the ceiling."""
        flat = (path_loss >= (np.inf if self.ceiling_db is None else self.ceiling_db))[:, self._counted]
        slope = np.array(derivative[:, self._counted])
        slope[flat] = 0.0
        return slope

    @cached_property
    def _counted(self) -> NDArray[np.int64] | slice:
        """The links that count; a slice where all do, which copies nothing."""
        counted = self.weight > 0
        return slice(None) if counted.all() else np.flatnonzero(counted)

    @cached_property
    def _scale(self) -> NDArray[np.float64]:
        """Roots of the weights of the links that count, their mean square one."""
        weight = self.weight[self._counted]
        return np.sqrt(weight * len(weight) / weight.sum())

    @cached_property
    def _ridge(self) -> NDArray[np.float64]:
        """Standard deviation of the noise by that of the priors [q]; 0 where flat."""
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
    """The objective over some links.

    Args:
        links: All links.
        reached: Which of them a path leads to [L].
        calibrated: Which of them to calibrate on [L].
        nuisance: The nuisance, over all links; none if None.
        ceiling_db: Path loss that a link without a path counts as, [dB]; None leaves such links out.
        noise_db: Standard deviation of a link's error [dB]; needed where a coefficient has a prior.

    Returns:
        The objective.

    Raises:
        InputError: No link is left, the nuisance is of other links, or a prior has no noise to be weighed against.
    """
    counted = calibrated & (reached if ceiling_db is None else True)
    if not counted.any():
        raise InputError(
            f"{links.source}: no path leads to any of {int(calibrated.sum())} links to calibrate on; raise "
            "trace.max_depth, allow refraction or diffraction, or check that positions and scene share a frame"
        )
    nuisance = Nuisance(len(links)) if nuisance is None else nuisance
    if nuisance.num_links != len(links):
        raise InputError(
            f"{links.source}: the nuisance is of {nuisance.num_links} links, must be of {len(links)}"
        )
    if noise_db is None and np.isfinite(nuisance.prior).any():
        raise InputError("nuisance: a prior needs noise_db, the standard deviation of a link's error [dB]")
    return Objective(
        measured=links.path_loss_db,
        weight=np.where(counted, links.weight, 0.0),
        nuisance=nuisance,
        ceiling_db=ceiling_db,
        noise_db=1.0 if noise_db is None else noise_db,
    )
