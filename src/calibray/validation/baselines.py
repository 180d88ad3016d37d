"""Baselines without paths: the log-distance model, also with the obstruction of the direct line, and kriging."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from calibray.errors import EngineError, InputError
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE, UNBOUNDED, Nuisance, Term, make_term
from calibray.fitting.objective import Objective
from calibray.measurements import Measurements
from calibray.scenes.obstruction import OUT_OF_SIGHT, WALLS
from calibray.study.model import StudyModel
from calibray.study.mounting import direct_gain
from calibray.uncertainty.residual_correlation import fit_correlation

OUT_OF_SIGHT_DB: Final = (10.0, 10.0)
"""Mean and standard deviation of the prior of the loss out of sight [dB]: 3GPP TR 38.901 (UMi) gives 10 dB at 20 m and
20 dB at 100 m. Without a prior, links in sight alone would contain no information about those out of sight."""

WALL_DB: Final = 2.0
"""Standard deviation of the prior of the loss per wall crossed, around zero [dB]. Indoors, walls dominate with any
prior. Outdoors, waves go around buildings; with 5 dB, the error on one cluster of Boulder kept apart was 17 dB."""

ROUNDS: Final = 4
"""Number of rounds in which the errors and the losses under their priors are fitted; more rounds change 0.01 dB."""

LEAST_NOISE_DB: Final = 1.0
"""Smallest error of the log-distance model against which priors are weighed [dB]."""

MOST_KRIGED: Final = 1000
"""Largest number of links for kriging: fitting the correlation factors their covariance some hundred times."""


def without_scene(study: StudyModel, links: Measurements) -> NDArray[np.float64]:
    """The part of path loss [links], [dB], that needs no scene: the rise over carriers, minus the antennas' gain.

    Path loss rises by 20 log10(f / f0) from the study's carrier f0, as in free space. The gain is that of the stated
    antennas, with the columns of the links, along the straight line.

    Raises:
        InputError: A column of the antennas is missing or malformed.
    """
    carrier = study.scene.frequency if links.frequency is None else links.frequency
    rise_db = 20 * np.log10(np.full(len(links), carrier) / study.scene.frequency)
    return rise_db - direct_gain(study, links)


class Baseline(NamedTuple):
    """A model without paths: all its unknowns are nuisance coefficients, and its links with a weight determine them.

    Attributes:
        objective: The model as an objective.
        known_db: Known part of its path loss [links], [dB].
    """

    objective: Objective
    known_db: NDArray[np.float64]

    def path_loss_db(self) -> NDArray[np.float64]:
        """Path loss at all links [links], [dB]; a group without links of a weight gets the mean of the others."""
        return self.objective.with_nuisance(self.known_db)


def log_distance(links: Measurements, objective: Objective, known_db: NDArray[np.float64]) -> Baseline:
    """The log-distance model with the study's nuisances; an offset per group becomes an intercept per group.

    The weights of the study's objective select the fitted links; `known_db` is the part of path loss from
    `without_scene` [links], [dB].

    Raises:
        EngineError: Fewer than two links have a weight.
    """
    if np.count_nonzero(objective.weight) < 2:
        raise EngineError("the log-distance model needs at least two calibration links")
    # An intercept is no offset, so the bounds of the study's offset do not apply to it.
    terms = [replace(term, bounds=UNBOUNDED) for term in objective.nuisance.terms]
    present = [(term.by, term.labels) for term in terms]
    for by in (CONSTANT, LOG_DISTANCE):
        if (by, ("",)) not in present:
            terms.append(make_term(links, _free_name(by, terms), by))
    nuisance = Nuisance(len(links), tuple(terms))
    return Baseline(replace(objective, nuisance=nuisance, ceiling_db=None), known_db)


def has_obstruction(links: Measurements) -> bool:
    """Whether the links have the columns that follow from a scene, and the lines of some are blocked."""
    return OUT_OF_SIGHT in links.frame and bool(links.table.numbers(OUT_OF_SIGHT).any())


def obstructed(links: Measurements, objective: Objective, known_db: NDArray[np.float64]) -> Baseline:
    """The log-distance model with a loss out of sight and a loss per wall, by the columns that follow from the scene.

    The loss out of sight has a prior around a mean. The mean is part of the known path loss, and the rest is a
    coefficient. Arguments are those of `log_distance`.

    Raises:
        EngineError: Fewer than two links have a weight.
    """
    model, known_db = log_distance(links, objective, known_db)
    terms, present = list(model.nuisance.terms), {term.by for term in model.nuisance.terms}
    for by, prior_db in ((OUT_OF_SIGHT, OUT_OF_SIGHT_DB[1]), (WALLS, WALL_DB)):
        if by not in present:
            terms.append(make_term(links, _free_name(by, terms), by, prior=prior_db))
    if OUT_OF_SIGHT not in present:
        known_db = known_db + OUT_OF_SIGHT_DB[0] * links.table.numbers(OUT_OF_SIGHT)
    nuisance = Nuisance(len(links), tuple(terms))
    model = replace(model, nuisance=nuisance)
    # The priors are weighed against the errors that remain with the losses that these errors give.
    for _ in range(ROUNDS):
        model = replace(model, noise_db=max(float(model.rmse(known_db[None])[0]), LEAST_NOISE_DB))
    return Baseline(model, known_db)


def _free_name(by: str, terms: Sequence[Term]) -> str:
    """A name for a term by a column that no other term has."""
    names = {term.name for term in terms}
    plain = by.replace("_", " ") if by in (OUT_OF_SIGHT, WALLS) else by
    return next(name for name in (plain, f"{plain} of all", f"{plain} of all links") if name not in names)


def kriging(links: Measurements, objective: Objective, trend_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Path loss of a model at all links [links], [dB], plus its residuals, kriged from the links with a weight.

    The model was fitted to these links; its path loss is `trend_db` [links], [dB].

    Raises:
        InputError: There are too few links, or more than `MOST_KRIGED`, or all have the same position.
        EngineError: All residuals are zero.
    """
    counted = objective.weight > 0
    count = int(counted.sum())
    if count > MOST_KRIGED:
        raise InputError(f"kriging: {count} links, at most {MOST_KRIGED}")
    position = np.hstack([links.rx, links.tx])
    measured, residual = position[counted], (objective.measured - trend_db)[counted]
    design = np.stack([np.ones(count), np.log10(links.distance[counted])], axis=1)
    if np.ptp(design[:, 1]) == 0:
        design = design[:, :1]
    field = fit_correlation(residual, measured, design=design)
    weights = np.linalg.solve(field.covariance(measured), residual)
    return trend_db + field.shared_db**2 * np.exp(-cdist(position, measured) / field.range_m) @ weights
