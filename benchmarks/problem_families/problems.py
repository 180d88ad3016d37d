"""Problems with a known minimum for comparing methods: landscapes in closed form, and planted problems."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibray.comparison.method_runs import ComparisonProblem
from calibray.engines import Replay
from calibray.fitting.cheap_replay import ReplayedModel, with_constants, with_layers
from calibray.fitting.problem import Evaluation
from calibray.measurements.observables import Statistic
from problem_families import landscapes
from problem_families.family import PlantedProblem, problem
from problem_families.numpy_replay import NumpyReplay


def landscape_problem(name: str) -> ComparisonProblem:
    """A landscape of `problem_families.landscapes`, given the name of the function that makes it."""
    land: landscapes.Landscape = getattr(landscapes, name)()

    def evaluate(points: NDArray[np.float64], derivatives: bool) -> Evaluation:
        value, residuals, jacobian = land.evaluate(points)
        return Evaluation(value, residuals, jacobian if derivatives else None, residuals, value)

    minimum = float(np.nan_to_num(land.minimum, nan=np.inf))
    middle = 0.5 * (land.lower + land.upper)
    digest = hashlib.sha256(name.encode())
    for part in (land.lower, land.upper, *land.evaluate(middle[None])):
        digest.update(np.round(part, 9).astype("<f8").tobytes())
    return ComparisonProblem(
        name, digest.hexdigest(), land.lower, land.upper, None, None, False, minimum, evaluate
    )


def planted_problem(kind: str, seed: int) -> ComparisonProblem:
    """A planted problem of `problem_families.family`, whose lowest objective is known.

    Args:
        kind: "district" or "office".
        seed: Seed of the problem.

    Returns:
        The problem.

    Raises:
        InputError: There is no such family.
    """
    planted = problem(seed, kind)

    def evaluate(points: NDArray[np.float64], derivatives: bool) -> Evaluation:
        answer = planted.evaluate(points, derivatives)
        return Evaluation(*answer, answer.residuals, answer.value)

    # Runs with the cheap model also depend on its answers and on the ranges of its constants.
    middle = planted.parameters.from_search(0.5 * (planted.lower + planted.upper)[None])
    constants = with_constants(planted.parameters, planted.cheap.paths.materials)
    digest = hashlib.sha256(planted.fingerprint.encode())
    further = [NumpyReplay(part, planted.parameters).path_loss(middle) for part in planted.further]
    for part in (planted.cheap.path_loss(middle), *further, *constants.search_bounds):
        digest.update(np.round(part, 6).astype("<f8").tobytes())
    return ComparisonProblem(
        f"{kind}-{seed}",
        digest.hexdigest(),
        planted.lower,
        planted.upper,
        planted.parameters.to_search(planted.parameters.start),
        None,
        False,
        planted.minimum_rmse_db,
        evaluate,
        lambda: cheap_model(planted),
        planted.differences.wrong_constants,
    )


@dataclass(frozen=True, eq=False)
class PlantedRows:
    """The residuals of a planted problem, with each transmitter's offset eliminated.

    Attributes:
        planted: The problem.
    """

    planted: PlantedProblem

    @property
    def wanted(self) -> tuple[Statistic, ...]:
        """No further observables."""
        return ()

    @property
    def filling(self) -> NDArray[np.float64]:
        """The measured path loss [L], [dB]."""
        return self.planted.measured

    def known(self, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See `Rows.known`."""
        return reached

    def residuals(
        self, candidates: NDArray[np.float64], path_loss: NDArray[np.float64], observed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `Rows.residuals`."""
        return self.planted.residuals(path_loss)

    def slopes(
        self,
        candidates: NDArray[np.float64],
        path_loss: NDArray[np.float64],
        slope: NDArray[np.float64],
        observed_slope: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """See `Rows.slopes`; residuals are linear in the path loss minus the measurements."""
        rows = np.moveaxis(slope, 1, -1)
        return np.moveaxis(self.planted.residuals(self.planted.measured + rows), -1, 1)


def cheap_model(planted: PlantedProblem) -> ReplayedModel:
    """The cheap model of a planted problem, with its nominal constants."""
    rows = PlantedRows(planted)
    return ReplayedModel(_compiled(planted), len(planted.parameters), rows, len(planted.further))


@lru_cache(maxsize=1)
def _compiled(planted: PlantedProblem) -> Replay:
    """The replay of a cheap model, compiled once for all runs of a problem."""
    paths = planted.cheap.paths
    parameters = with_constants(planted.parameters, paths.materials)
    return Replay(with_layers(paths, planted.further), parameters)
