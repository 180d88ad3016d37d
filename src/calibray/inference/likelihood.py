"""What a calibration minimizes, and how far its answer can be trusted.

The objective is the paper's RMSE (eq. 1) over the links that count, weighted if the links are. Nuisance offsets
enter the model as path loss + offset; being linear, the best ones are known in closed form for every candidate
(variable projection), so that no optimizer ever sees them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import stdtrit

from calibray.errors import EngineError, InputError
from calibray.measurements import Measurements

CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class Objective:
    """The weighted RMSE between modelled and measured path loss.

    Attributes:
        measured: Measured path loss [L], [dB].
        weight: Weights of the links; 0 leaves a link out [L].
        group: Group of every link, for the offsets [L].
        num_groups: Number of groups; 0 without offsets.
        bounds: Lower and upper bound of the offsets [dB].
        ceiling_db: Path loss that a link without a path counts as, [dB]; None where such links are left out.
    """

    measured: np.ndarray
    weight: np.ndarray
    group: np.ndarray
    num_groups: int
    bounds: tuple[float, float]
    ceiling_db: float | None

    def offsets(self, path_loss: np.ndarray) -> np.ndarray:
        """The offsets that fit best.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            Offset of every group [n, num_groups], [dB]; 0 for a group without a link that counts and has a path.
        """
        gap = self.measured - self.capped(path_loss)
        weight = np.where(np.isfinite(gap), self.weight, 0.0)
        total = self._per_group(weight)
        mean = self._per_group(weight * np.where(weight > 0, gap, 0.0)) / np.where(total > 0, total, 1.0)
        return np.clip(mean, *self.bounds)

    def model(self, path_loss: np.ndarray) -> np.ndarray:
        """What is compared with the measurements.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            The path loss, at most the ceiling, plus the best offsets [n, L], [dB].
        """
        model = self.capped(path_loss)
        return model + self.offsets(path_loss)[:, self.group] if self.num_groups else model

    def residuals(self, path_loss: np.ndarray) -> np.ndarray:
        """Residuals whose root mean square is the RMSE.

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            Model plus offset minus measurement, scaled by the square root of the weights [n, counted links], [dB].
        """
        counted = self.weight > 0
        return (self.model(path_loss) - self.measured)[:, counted] * self._scale()[counted]

    def jacobian(self, path_loss: np.ndarray, derivative: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals.

        Args:
            path_loss: Modelled path loss [n, L], [dB].
            derivative: Its derivatives [n, L, d], [dB] per unit.

        Returns:
            Derivatives of the residuals [n, counted links, d].
        """
        counted = self.weight > 0
        flat = path_loss >= (np.inf if self.ceiling_db is None else self.ceiling_db)
        slope = np.where((flat | ~counted)[..., None], 0.0, derivative)
        if self.num_groups:  # an offset inside its bounds takes up the mean of its group
            offset = self.offsets(path_loss)
            free = (offset > self.bounds[0]) & (offset < self.bounds[1])
            total = self._per_group(self.weight[None])
            mean = np.stack(
                [self._per_group(self.weight * slope[..., k]) for k in range(slope.shape[2])], axis=-1
            )
            mean = mean / np.where(total > 0, total, 1.0)[..., None] * free[..., None]
            slope = slope - mean[:, self.group]
        return slope[:, counted] * self._scale()[counted][:, None]

    def rmse(self, path_loss: np.ndarray) -> np.ndarray:
        """RMSE of candidates (paper eq. 1).

        Args:
            path_loss: Modelled path loss [n, L], [dB].

        Returns:
            RMSE [n], [dB]; +inf where a link that counts has no path.
        """
        return np.sqrt(np.mean(self.residuals(path_loss) ** 2, axis=1))

    def capped(self, path_loss: np.ndarray) -> np.ndarray:
        """Path loss as it could have been measured: at most the ceiling, if there is one [dB]."""
        return path_loss if self.ceiling_db is None else np.minimum(path_loss, self.ceiling_db)

    def _scale(self) -> np.ndarray:
        counted = self.weight > 0
        return np.sqrt(self.weight * counted.sum() / self.weight.sum())

    def _per_group(self, value: np.ndarray) -> np.ndarray:
        return np.stack([value[:, self.group == k].sum(axis=1) for k in range(self.num_groups)], axis=1)


def make_objective(
    links: Measurements,
    reached: np.ndarray,
    calibrated: np.ndarray,
    *,
    offset: bool = False,
    bounds: tuple[float, float] | None = None,
    ceiling_db: float | None = None,
) -> Objective:
    """The objective over some links.

    Args:
        links: All links.
        reached: Which of them a path leads to [L].
        calibrated: Which of them to calibrate on [L].
        offset: Whether offsets are fitted, one per group of `links`.
        bounds: Bounds of the offsets [dB]; unbounded if None.
        ceiling_db: Path loss that a link without a path counts as, [dB]; None leaves such links out.

    Returns:
        The objective.

    Raises:
        InputError: No link is left.
    """
    counted = calibrated & (reached if ceiling_db is None else True)
    if not counted.any():
        raise InputError(
            f"{links.source}: no path leads to any of {int(calibrated.sum())} links to calibrate on; raise "
            "trace.max_depth, allow refraction or diffraction, or check that positions and scene share a frame"
        )
    return Objective(
        measured=links.path_loss_db,
        weight=np.where(counted, links.weight, 0.0),
        group=links.group_index if offset else np.zeros(len(links), dtype=np.int64),
        num_groups=len(links.group_names) if offset else 0,
        bounds=bounds or (-np.inf, np.inf),
        ceiling_db=ceiling_db,
    )


@dataclass(frozen=True)
class Interval:
    """How well the links determine one parameter.

    Attributes:
        standard_error: From the residuals' scatter and the derivatives at the optimum, in the parameter's unit.
        lower: Lower end of the 95 % interval, within the bounds.
        upper: Upper end.
        verdict: "identified", "at bound" or "not identifiable".
    """

    standard_error: float
    lower: float
    upper: float
    verdict: str


def intervals(
    best: np.ndarray,
    residuals: np.ndarray,
    jacobian: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    nuisances: int,
) -> list[Interval]:
    """Confidence intervals of the parameters from the curvature of the sum of squares at the optimum.

    A parameter is called not identifiable when its 95 % interval is wider than half of its bounds. Linear theory:
    other minima, and errors that neighbouring links share, can make the truth wider.

    Args:
        best: The optimum [d].
        residuals: Residuals there, offsets eliminated [m], [dB].
        jacobian: Their derivatives [m, d].
        lower: Lower bounds [d].
        upper: Upper bounds [d].
        nuisances: Number of offsets fitted beside the parameters.

    Returns:
        One interval per parameter.
    """
    freedom = max(len(residuals) - len(best) - nuisances, 1)
    reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2))  # Student's t: standard errors either side
    variance = float(residuals @ residuals) / freedom
    values, vectors = np.linalg.eigh((scaled := jacobian * (upper - lower)).T @ scaled)
    values = np.maximum(values, values.max(initial=0.0) * 1e-12 + 1e-300)
    errors = np.sqrt(variance * ((vectors**2) @ (1 / values))) * (upper - lower)
    found = []
    for value, error, low, high in zip(best, errors, lower, upper, strict=True):
        ends = max(value - reach * error, low), min(value + reach * error, high)
        span = high - low
        verdict = "identified"
        if 2 * reach * error > span / 2:
            verdict = "not identifiable"
        elif min(value - low, high - value) < 1e-6 * span:
            verdict = "at bound"
        found.append(Interval(float(error), float(ends[0]), float(ends[1]), verdict))
    return found


@dataclass(frozen=True)
class LogDistance:
    """The log-distance model that any calibration has to beat: path loss = intercept + slope log10(distance).

    Attributes:
        intercept_db: Path loss at 1 m, [dB].
        slope_db: Loss per decade of distance, [dB]: ten times the path loss exponent.
    """

    intercept_db: float
    slope_db: float

    @classmethod
    def fit(cls, distance: np.ndarray, path_loss_db: np.ndarray, weight: np.ndarray) -> LogDistance:
        """Fit by weighted least squares.

        Args:
            distance: Straight distances [m].
            path_loss_db: Path losses [dB].
            weight: Weights; 0 leaves a link out.

        Returns:
            The model.

        Raises:
            EngineError: Fewer than two links count.
        """
        if np.count_nonzero(weight) < 2:
            raise EngineError("the log-distance model needs at least two links")
        root = np.sqrt(weight)
        design = np.stack([np.ones_like(distance), np.log10(distance)], axis=1)
        (intercept, slope), *_ = np.linalg.lstsq(design * root[:, None], path_loss_db * root, rcond=None)
        return cls(float(intercept), float(slope))

    def path_loss(self, distance: np.ndarray) -> np.ndarray:
        """Path loss at straight distances [m], [dB]."""
        return self.intercept_db + self.slope_db * np.log10(distance)
