"""What a calibrated scene has to beat: models that know distances and measurements only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from calibray.errors import EngineError, InputError
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE, UNBOUNDED, Nuisance, make_term
from calibray.fitting.objective import Objective
from calibray.measurements import Measurements
from calibray.uncertainty.noise import fit_correlation

LARGEST: Final = 1000
"""Links that are kriged from: the matrix is factored some hundred times."""


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
    def fit(
        cls, distance: NDArray[np.float64], path_loss_db: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> LogDistance:
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

    def path_loss(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss at straight distances [m], [dB]."""
        return self.intercept_db + self.slope_db * np.log10(distance)


def log_distance(links: Measurements, objective: Objective, frequency: float) -> NDArray[np.float64]:
    """Path loss of a log-distance model with the twin's nuisances, fitted to the links that count.

    Where the twin has an offset per group, so has this model: an intercept for each. A group that it was not fitted to
    has the mean of the others'. Over carriers it rises as in free space.

    Args:
        links: All links.
        objective: What the twin is fitted by.
        frequency: Carrier of the study, which the law is stated for [Hz].

    Returns:
        Its path loss at all links [L], [dB].

    Raises:
        EngineError: Fewer than two links count.
    """
    law, rise = fitted_law(links, objective, frequency)
    filled, _ = law.nuisance.filled(law.coefficients(rise[None]), objective.weight > 0)
    return law.nuisance.contribution(filled)[0] + rise


def fitted_law(
    links: Measurements, objective: Objective, frequency: float
) -> tuple[Objective, NDArray[np.float64]]:
    """The log-distance model as an objective of its own, whose terms are all that it has.

    Args:
        links: All links.
        objective: What the twin is fitted by.
        frequency: Carrier of the study [Hz].

    Returns:
        The objective, and what it is fitted beside: the rise over carriers in free space [L], [dB].

    Raises:
        EngineError: Fewer than two links count.
    """
    rise = np.zeros(len(links)) if links.frequency is None else 20 * np.log10(links.frequency / frequency)
    if np.count_nonzero(objective.weight) < 2:
        raise EngineError("the log-distance model needs at least two links")
    # Intercepts are no offsets: bounds of these say nothing about them.
    terms = [replace(term, bounds=UNBOUNDED) for term in objective.nuisance.terms]
    kinds = [(term.by, term.labels) for term in terms]
    names = {term.name for term in terms}
    for by in (CONSTANT, LOG_DISTANCE):
        if (by, ("",)) not in kinds:
            name = next(each for each in (by, f"{by} of all", f"{by} of all links") if each not in names)
            terms.append(make_term(links, name, by))
    return replace(objective, nuisance=Nuisance(len(links), tuple(terms)), ceiling_db=None), rise


def kriging(links: Measurements, objective: Objective, law: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss between measured points: a log-distance model, and what neighbours say beside it.

    Args:
        links: All links.
        objective: What the twin is fitted by; the links that count are those kriged from.
        law: Path loss of the log-distance model fitted to them [L], [dB].

    Returns:
        Path loss at all links [L], [dB].

    Raises:
        InputError: There are too few links, or more than `LARGEST`, or all stand at one place.
        EngineError: The errors of the law are all zero.
    """
    counted = objective.weight > 0
    if (count := int(counted.sum())) > LARGEST:
        raise InputError(f"kriging: {count} links, at most {LARGEST}")
    place = np.hstack([links.rx, links.tx])
    known, left = place[counted], (objective.measured - law)[counted]
    design = np.stack([np.ones(count), np.log10(links.distance[counted])], axis=1)
    field = fit_correlation(left, known, design=design if np.ptp(design[:, 1]) > 0 else design[:, :1])
    weights = np.linalg.solve(field.covariance(known), left)
    return law + field.shared_db**2 * np.exp(-cdist(place, known) / field.range_m) @ weights
