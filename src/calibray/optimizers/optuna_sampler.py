"""SGWO-IM as a sampler for Optuna, for use with Optuna's storages, dashboard and workers.

Every candidate is stored in the trial that receives it. A new sampler with the same seed can therefore resume a stored
study: it generates the same candidates again, uses the stored answers, and continues where the study stopped. Trials
that the sampler did not propose, such as enqueued trials or the trials of another sampler, are added to the archive and
can become leaders of the pack. A failed trial is treated as a failed evaluation.

The pack cannot move before all candidates of an iteration are evaluated. If every open candidate is under evaluation,
one that another process is evaluating is returned again, because that process might have ended. If no other process is
evaluating a candidate, the trial evaluates a random point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from threading import Lock
from typing import TYPE_CHECKING, Any, cast, final

import numpy as np

from calibray.errors import InputError
from calibray.optimizers.grey_wolf import SGWOIM
from calibray.support.lazy_imports import library

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
    from optuna.samplers import BaseSampler
    from optuna.study import Study
    from optuna.trial import FrozenTrial, TrialState

    Numeric = FloatDistribution | IntDistribution
else:
    optuna = library("optuna", "optimizers")
    BaseSampler = optuna.samplers.BaseSampler
    FloatDistribution = optuna.distributions.FloatDistribution
    IntDistribution = optuna.distributions.IntDistribution
    TrialState = optuna.trial.TrialState

CANDIDATE = "sgwo-im:candidate"
"""System attribute of a trial that stores the candidate in search coordinates."""


@final
class SGWOIMSampler(BaseSampler):
    """The paper's optimizer (SGWO-IM) for an Optuna study with one objective.

    Args:
        search_space: The parameters and their distributions, float or integer. If None, the search space is inferred
            from the trials, so the first trial is a random point. Categorical parameters are then sampled at random.
        seed: Seed.
        **settings: Further settings of `SGWOIM`.

    Raises:
        InputError: A distribution is neither float nor integer, or a setting is out of range.

    Example:
        >>> import optuna
        >>> optuna.logging.set_verbosity(optuna.logging.ERROR)
        >>> space = {"a": optuna.distributions.FloatDistribution(1.0, 9.0)}
        >>> study = optuna.create_study(sampler=SGWOIMSampler(space, seed=1, population=6, iterations=8))
        >>> study.optimize(lambda trial: (trial.suggest_float("a", 1.0, 9.0) - 4.0) ** 2)
        >>> len(study.trials), round(study.best_params["a"])
        (45, 4)
    """

    def __init__(
        self, search_space: Mapping[str, BaseDistribution] | None = None, *, seed: int = 0, **settings: Any
    ) -> None:
        self._space = dict(search_space or {})
        for name, distribution in self._space.items():
            if not isinstance(distribution, FloatDistribution | IntDistribution):
                raise InputError(
                    f"{name}: {distribution} is neither float nor integer; remove it from the search space"
                )
        self._settings = {"seed": seed, **settings}
        self._inferred = optuna.search_space.IntersectionSearchSpace()
        self._random = optuna.samplers.RandomSampler(seed=seed)
        self._optimizer: SGWOIM | None = None
        self._told: set[int] = set()
        self._proposed: set[int] = set()
        self._lock = Lock()
        SGWOIM([0.0] * max(len(self._space), 1), [1.0] * max(len(self._space), 1), **self._settings)

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """The distributions of the parameters that the pack searches, by name."""
        if self._space:
            return self._space
        inferred = self._inferred.calculate(study)
        numeric = (FloatDistribution, IntDistribution)
        return {name: d for name, d in inferred.items() if isinstance(d, numeric) and not d.single()}

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Return a candidate of the pack, preferably one not yet under evaluation; empty for a random point.

        Raises:
            InputError: The study has several objectives.
        """
        if len(study.directions) != 1:
            raise InputError(
                f"the study has {len(study.directions)} objectives, but SGWO-IM supports one objective: choose one"
            )
        if not search_space:
            return {}
        with self._lock:
            optimizer = self._synchronized(study, search_space)
            if optimizer.done:
                return {}
            running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            taken = {other.number: other.system_attrs.get(CANDIDATE) for other in running}
            ours = [taken[number] for number in self._proposed & taken.keys()]
            candidates = optimizer.ask().tolist()
            free = [x for x in candidates if x not in taken.values()]
            free = free or [x for x in candidates if x not in ours]
            if not free:
                return {}
            candidate = free[0]
            self._proposed.add(trial.number)
            study._storage.set_trial_system_attr(trial._trial_id, CANDIDATE, candidate)
        values = zip(search_space.items(), candidate, strict=True)
        return {name: _value(cast("Numeric", distribution), x) for (name, distribution), x in values}

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Draw a random value for a parameter that the pack does not search."""
        return self._random.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Record the answer of a trial, and stop the study after the last iteration."""
        with self._lock:
            if self._optimizer is None:
                return
            self._take(self._optimizer, study, trial, state, values)
            if self._optimizer.done:
                with suppress(RuntimeError):  # a study used through `ask` and `tell` cannot be stopped
                    study.stop()

    def _synchronized(self, study: Study, space: Mapping[str, BaseDistribution]) -> SGWOIM:
        """Pass every finished trial of the study to the optimizer, in order, and return the optimizer."""
        if self._optimizer is None or self._space != space:
            bounds = np.array([_bounds(cast("Numeric", distribution)) for distribution in space.values()])
            self._optimizer, self._space, self._told = SGWOIM(*bounds.T, **self._settings), dict(space), set()
        for trial in study.get_trials(deepcopy=False):
            if trial.state.is_finished():
                self._take(self._optimizer, study, trial, trial.state, trial.values)
        return self._optimizer

    def _take(
        self,
        optimizer: SGWOIM,
        study: Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        """Pass a finished trial to the optimizer, unless the optimizer has already received it."""
        if trial.number in self._told or optimizer.done:
            return
        self._told.add(trial.number)
        optimizer.ask()  # the iteration must begin before `tell` receives answers, even if all answers are stored
        x = np.array(trial.system_attrs.get(CANDIDATE, self._foreign(trial)), dtype=float)
        if x.shape != optimizer.box.lower.shape or not np.array_equal(x, optimizer.box.clip(x)):
            return
        sign = -1.0 if study.direction == optuna.study.StudyDirection.MAXIMIZE else 1.0
        answer = sign * values[0] if state == TrialState.COMPLETE and values else np.inf
        # Optuna accepts infinite values, but no search can improve on -inf, so an infinite value counts as a failure.
        optimizer.tell([x], [answer if np.isfinite(answer) else np.inf])

    def _foreign(self, trial: FrozenTrial) -> list[float]:
        """Search coordinates of a trial that the pack did not propose; empty if the trial lacks a parameter."""
        if not self._space.keys() <= trial.params.keys():
            return []
        return [
            _coordinate(cast("Numeric", distribution), trial.params[name])
            for name, distribution in self._space.items()
        ]


def _bounds(distribution: Numeric) -> tuple[float, float]:
    """Bounds of the search coordinate; each value on a grid corresponds to an interval one step wide."""
    margin = 0.5 * (distribution.step or 0.0)
    return _coordinate(distribution, distribution.low - margin), _coordinate(
        distribution, distribution.high + margin
    )


def _coordinate(distribution: Numeric, value: float) -> float:
    return float(np.log(value)) if distribution.log else float(value)


def _value(distribution: Numeric, coordinate: float) -> float | int:
    value = float(np.exp(coordinate)) if distribution.log else coordinate
    if distribution.step is not None:
        value = distribution.low + round((value - distribution.low) / distribution.step) * distribution.step
    value = min(max(value, distribution.low), distribution.high)
    return round(value) if isinstance(distribution, IntDistribution) else value
