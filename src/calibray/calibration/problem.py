"""A study ready to be solved: what is minimized, over which search space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibray.engines.observable import PATH_LOSS, Observable
from calibray.engines.protocol import Differentiable, Engine
from calibray.errors import InputError
from calibray.inference.nuisance import Nuisance, make_term
from calibray.inference.objective import Objective, make_objective
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.study import Setup, Study


class Evaluation(NamedTuple):
    """What a problem answers to points of the search space.

    Attributes:
        value: What is minimized [n].
        residuals: Weighted residuals [n, counted links].
        jacobian: Their derivatives by the search coordinates [n, counted links, d], where asked for.
        modelled: What the engine answered [n, L].
    """

    value: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None
    modelled: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Problem:
    """A study ready to be solved.

    Attributes:
        setup: The opened study.
        engine: The engine over all its links.
        objective: What is minimized.
        before: What the engine answers to the values before calibration [L].
        observable: What is measured and modelled.
    """

    setup: Setup
    engine: Engine
    objective: Objective
    before: NDArray[np.float64]
    observable: Observable = PATH_LOSS

    @classmethod
    def of(cls, setup: Setup, engine: Engine, observable: Observable = PATH_LOSS) -> Problem:
        """Set up a study's problem; runs the engine once, on the values before calibration.

        Args:
            setup: The opened study.
            engine: The engine over all its links.
            observable: What is measured and modelled.

        Returns:
            The problem.

        Raises:
            InputError: No link is left to calibrate on, or none of a group of which links are held out.
        """
        study, links, held_out = setup.study, setup.links, setup.held_out
        before = observable.modelled(engine, engine.parameters.start[None])[0]
        objective = make_objective(
            links,
            np.isfinite(before),
            ~held_out,
            nuisance=_nuisance(study, links),
            ceiling_db=study.objective.ceiling_db,
        )
        objective = replace(objective, measured=observable.measured(links))
        _check_groups(links, objective, held_out & np.isfinite(before))
        return cls(setup, engine, objective, before, observable)

    @property
    def parameters(self) -> Parameters:
        """What a candidate's components stand for; they own the search space."""
        return self.engine.parameters

    @property
    def differentiable(self) -> bool:
        """Whether derivatives can be had."""
        return isinstance(self.engine, Differentiable) and self.observable.derivatives is not None

    def evaluate(self, points: NDArray[np.float64], derivatives: bool = False) -> Evaluation:
        """Run the engine on points of the search space.

        Args:
            points: The points [n, d].
            derivatives: Whether the Jacobian is wanted.

        Returns:
            What an optimizer is told, and what the engine answered.
        """
        parameters, objective = self.parameters, self.objective
        candidates = parameters.from_search(points)
        jacobian, with_slopes = None, self.observable.derivatives
        if derivatives and with_slopes is not None and isinstance(self.engine, Differentiable):
            modelled, slope = with_slopes(self.engine, candidates)
            jacobian = objective.jacobian(modelled, slope * parameters.search_slope(candidates)[:, None, :])
        else:
            modelled = self.observable.modelled(self.engine, candidates)
        return Evaluation(objective.value(modelled), objective.residuals(modelled), jacobian, modelled)


def _nuisance(study: Study, links: Measurements) -> Nuisance:
    """The study's offset, for all links or for each group, if it has one."""
    if study.offset is None:
        return Nuisance(len(links))
    return Nuisance(len(links), (make_term(links, "offset", labels=links.group, bounds=study.offset.bounds),))


def _check_groups(links: Measurements, objective: Objective, judged: NDArray[np.bool_]) -> None:
    """Refuse links held out whose offset no link to calibrate on could tell."""
    unknown = links.group_index[judged & ~objective.supported]
    if len(unknown):
        raise InputError(
            f"{links.source}: group {links.group_names[unknown.min()]!r} is held out but has no link to "
            "calibrate its offset on; change [holdout] or [offset]"
        )
