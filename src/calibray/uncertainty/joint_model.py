"""The joint model of all unknowns: parameters, fixed constants, buildings and errors.

- The study's parameters have flat priors over their bounds, or the priors that the study declares.
- Constants that the scene fixes for the calibrated materials, such as thickness, are not known exactly. Such constants
  have a log-normal prior around the scene's value. A scattering coefficient of 0 is assumed to be exact with a
  probability of one half.
- A wall constant of building b is x exp(s z_b), where x is the material's mean and z_b is standard normal. The
  between-building spread s is zero with probability `ALIKE`; otherwise it is exponentially distributed.
- Errors follow one of several noise models (`noise_models.py`). The noise level, the nuisances and an undeclared offset
  are integrated out.

`sequential_monte_carlo.py` draws from the posterior.

For Gaussian noise, correlated or not, integrating out the noise level and the nuisance gives a density that is a power
of a quadratic form of the gaps. The matrix of this form is computed once, unless there are many links. For heavy-tailed
noise, gaps with and without an offset are evaluated together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calibray.fitting.nuisance import CONSTANT
from calibray.fitting.problem import Problem
from calibray.measurements import FEW
from calibray.parameters import (
    SCATTERING_SPREAD,
    LogNormal,
    Parameter,
    Parameters,
    fixed_constant,
    split_name,
)
from calibray.uncertainty.buildings import can_split, replayed_materials, split_replay
from calibray.uncertainty.noise_models import HEAVY, Marginal, excess_db, noise_models

MAX_LINKS: Final = 300
"""Maximum number of links for which the matrices are stored; the matrices of 26 Gaussian models then occupy 19 MB."""


@dataclass(frozen=True, eq=False)
class QuadraticForms:
    """A marginal density, prepared for evaluating each gap under its own noise model.

    Attributes:
        marginal: The density.
        group: Group [models] of each model; models of one group are evaluated together. The group is -1 for Student's
            t, -2 for gross errors, and otherwise the model's own index.
        square: For each Gaussian model, the matrix [m, m], constant and exponent of its quadratic form; None for other
            models. Empty if there are too many links or if any link is censored.
    """

    marginal: Marginal
    group: NDArray[np.int64]
    square: tuple[tuple[NDArray[np.float64], float, float] | None, ...]

    @classmethod
    def of(cls, marginal: Marginal) -> QuadraticForms:
        """Compute the forms of a density."""
        models = marginal.models
        group = [(-2 if model.gross else -1) if model.kind == HEAVY else k for k, model in enumerate(models)]
        if len(marginal.column) > MAX_LINKS or marginal.censored.any():
            return cls(marginal, np.array(group), ())
        square = (marginal.form(model) if marginal.is_gaussian(model) else None for model in models)
        return cls(marginal, np.array(group), tuple(square))

    def densities(self, gap: NDArray[np.float64], model: NDArray[np.int64]) -> NDArray[np.float64]:
        """Like `Marginal.densities`, but each gap is evaluated only under the model with the given index [n]."""
        models, log_density = self.marginal.models, np.full(len(gap), -np.inf)
        log_weight = np.log([other.weight for other in models])[model]
        if not self.square:
            for index in np.unique(model).tolist():
                rows = model == index
                log_density[rows] = self._without_form(gap[rows], index)
            return log_density + log_weight
        finite = np.isfinite(gap).all(axis=1)
        group = self.group[model]
        for index in np.unique(group[finite]).tolist():
            rows = finite & (group == index)
            if index < 0:
                log_density[rows] = self.marginal.heavy(gap[rows], [models[k] for k in model[rows].tolist()])
            elif (form := self.square[index]) is None:
                log_density[rows] = self._without_form(gap[rows], index)
            else:
                square, constant, exponent = form
                value = np.sum((gap[rows] @ square) * gap[rows], axis=1)
                log_density[rows] = constant - exponent * np.log(np.maximum(value, 1e-300))
        return log_density + log_weight

    def _without_form(self, gap: NDArray[np.float64], index: int) -> NDArray[np.float64]:
        """Log density [n] of gaps [n, m] under the model `index`, without the model's weight."""
        model = replace(self.marginal.models[index], weight=1.0)
        return replace(self.marginal, models=(model,)).densities(gap)[:, 0]


FIXED_FIELDS: Final = ("thickness", "conductivity", "scattering_coefficient")
"""Material constants that are taken from the scene if they are not parameters."""

NO_EFFECT: Final = 0.02
"""A constant from the scene stays fixed if changing it by one standard deviation changes path loss by less than this
fraction of the noise level. The constant would then add less than 0.04 % to the noise variance."""

ALIKE: Final = 0.5
"""Prior probability that all buildings have equal constants."""

MEAN_SPREAD: Final = 0.15
"""Mean of the exponential prior of the between-building spread if buildings differ."""

SPREAD_BOUNDS: Final = (0.004, 0.8)
"""Range of the between-building spread if buildings differ."""

GRID: Final = 2001
"""Number of points at which the prior of a parameter is tabulated over its range."""


Gaps = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Maps points of the unit cube [n, d + k] and the log factors of the buildings' constants [n, c] to gaps [n, m], [dB].
A gap is measured minus modelled path loss, without the nuisance, times the square root of the link's weight."""


@dataclass(frozen=True, eq=False)
class JointModel:
    """The joint model of all unknowns; its points are in the unit cube of its parameters.

    Attributes:
        study: The study's d parameters.
        parameters: The study's parameters, then k constants that the scene fixes.
        priors: Log-normal priors, in addition to flat priors over the unit cube.
        gaps: Computes the gaps, measured minus modelled path loss; see `Gaps`.
        loss: Path loss of all links for values of the parameters [n, d + k] and equal buildings [n, L], [dB].
        marginal: The density of the gaps under every noise model.
        parameter_of: Index [c] of the parameter to which each of the c constants of individual buildings belongs.
        building_of: Index [c] of the building to which each of these constants belongs.
        only_buildings: Indices of the parameters whose constants all belong to buildings, so that these parameters
            affect path loss only through the buildings' constants.
        spread: The between-building spread if the study declares it; otherwise None.
        interactions: Number of interactions per evaluation.
        effects_db: Change in path loss [dB] when each fixed constant changes by one standard deviation.
        observed: For each further observable, the number of its rows, its degrees of freedom, and whether its rows are
            in units of a stated error. These rows follow the m gaps of path loss.
    """

    study: Parameters
    parameters: Parameters
    priors: LogNormal
    gaps: Gaps
    loss: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    marginal: Marginal
    parameter_of: NDArray[np.int64]
    building_of: NDArray[np.int64]
    only_buildings: NDArray[np.int64]
    spread: float | None = None
    interactions: int = 1
    effects_db: dict[str, float] = field(default_factory=dict)
    observed: tuple[tuple[int, int, bool], ...] = ()

    def densities(self, gaps: NDArray[np.float64], model: NDArray[np.int64]) -> NDArray[np.float64]:
        """Log likelihood of gaps, each under the noise model with the given index, plus the model's log weight [n]."""
        links, further = self._split(gaps)
        return self.forms.densities(links, model) + further

    def densities_by_model(self, gaps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log likelihood of gaps under every noise model, plus the model's log weight [n, models]."""
        links, further = self._split(gaps)
        return self.marginal.densities(links) + further[:, None]

    def _split(self, gaps: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weighted gaps [n, m] of path loss, and the log likelihood [n] of the further observables.

        If the study does not state an observable's error, the error is integrated out, with a prior inversely
        proportional to the error.
        """
        last = gaps.shape[1] - sum(count for count, _, _ in self.observed)
        links, further = gaps[:, :last], np.zeros(len(gaps))
        for count, freedom, stated in self.observed:
            square = np.sum(gaps[:, last : last + count] ** 2, axis=1)
            # A stated error is the unit of the rows. Otherwise the integral over the error is square^(-freedom / 2).
            further += -0.5 * square if stated else -0.5 * freedom * np.log(np.maximum(square, 1e-300))
            last += count
        return links, further

    @cached_property
    def forms(self) -> QuadraticForms:
        """The density of the gaps, each under its own noise model."""
        return QuadraticForms.of(self.marginal)

    def at_scene_constants(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log posterior [n] at points of the study's search space [n, d], up to a constant.

        All buildings are equal, and further constants have the scene's values. The posterior is averaged over noise
        models.
        """
        constants = [item.start for item in self.parameters.items[len(self.study) :]]
        values = np.hstack([self.study.from_search(points), np.tile(constants, (len(points), 1))])
        unit = self.parameters.to_unit(values)
        gaps = self.gaps(unit, np.zeros((len(points), len(self.parameter_of))))
        return np.logaddexp.reduce(self.densities_by_model(gaps), axis=1) + self.log_prior(unit)

    def log_prior(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm [n] of the prior density at points of the unit cube [n, d + k], up to a constant."""
        if not len(self.priors):
            return np.zeros(len(points))
        values = self.parameters.from_unit(points)
        density = -0.5 * np.sum(self.priors.residuals(values) ** 2, axis=1)
        return density - self.priors.log_normalization(values, self.parameters)

    def draw_prior(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw points from the prior [count, d + k]."""
        grid = np.linspace(0.0, 1.0, GRID)
        line = np.tile(grid[:, None], (1, len(self.parameters)))
        # Inverse transform sampling, one parameter at a time.
        density = np.ones_like(line)
        if len(self.priors):
            residual = self.priors.residuals(self.parameters.from_unit(line))
            density[:, list(self.priors.index)] = np.exp(-0.5 * residual**2)
        cumulative = np.cumsum(0.5 * (density[1:] + density[:-1]), axis=0)
        points = np.empty((count, len(self.parameters)))
        for index in range(len(self.parameters)):
            total = np.append(0.0, cumulative[:, index])
            points[:, index] = np.interp(random.random(count) * total[-1], total, grid)
        if self.priors.like:
            drawn, _ = np.array(self.priors.like).T
            values = self.priors.draw_like(self.parameters.from_unit(points), self.parameters, random)
            points[:, drawn] = self.parameters.to_unit(values)[:, drawn]
        return points

    def draw_spread(self, count: int, random: np.random.Generator) -> NDArray[np.float64]:
        """Draw between-building spreads [count] from their prior, with 0 for equal buildings."""
        if self.spread is not None or not len(self.parameter_of):
            return np.full(count, self.spread or 0.0)
        differing = np.clip(random.exponential(MEAN_SPREAD, count), *SPREAD_BOUNDS)
        return np.where(random.random(count) < ALIKE, 0.0, differing)


def joint_model(problem: Problem, best: NDArray[np.float64], square: float, freedom: int) -> JointModel:
    """Set up the joint model of all unknowns, from the optimum `best` in the search space [d].

    `square` is the mean square of the residuals at the optimum [dB^2]. `freedom` is the number of residuals minus the
    number of unknowns.
    """
    objective, links, section = problem.objective, problem.setup.links, problem.setup.study.noise
    weight, censored = _weights_and_censoring(problem)
    counted = np.flatnonzero(weight > 0)
    weight, censored = weight[counted], censored[counted]
    # As in the objective, the mean square is one, so the noise level refers to a link of mean weight.
    scale = np.sqrt(weight * len(weight) / weight.sum())
    noise_db = float(np.sqrt(square * (freedom + problem.unknowns) / freedom))
    nuisance, position = objective.nuisance, np.hstack([links.rx, links.tx])[counted]
    coefficients = objective.coefficients(problem.modelled(best[None]))[0]
    # A coefficient at its bound stays at the bound; the other coefficients are integrated over the real line.
    at_bound = (coefficients <= nuisance.lower) | (coefficients >= nuisance.upper)
    design = nuisance.design[counted].toarray() if nuisance.terms else np.zeros((len(counted), 0))
    used = objective.determined & ~at_bound
    # Too few links can neither distinguish noise models nor reveal differences between buildings, so only stated noise
    # is used.
    few = len(counted) < FEW
    # With correlated errors, the probability of censoring is a joint integral over all censored links.
    uncorrelated = bool(censored.any()) or (few and section.range_m == "auto")
    out_of_sight = not uncorrelated and section.range_m == "auto"
    models = noise_models(
        position,
        kind=section.kind if section.kind != "auto" else "gaussian" if few else None,
        range_m=0.0 if uncorrelated else None if section.range_m == "auto" else float(section.range_m),
        offset=not has_offset(problem),
        censored=bool(censored.any()),
        out_of_sight=out_of_sight,
    )
    excess = excess_db(problem)[counted] if out_of_sight else None
    ridge = noise_db / nuisance.prior[used] if nuisance.terms else np.zeros(0)
    marginal = Marginal.of(design[:, used], ridge, scale, position, noise_db, models, censored, excess)
    measured = objective.measured[counted] - design[:, at_bound] @ coefficients[at_bound]

    def gap(loss: NDArray[np.float64]) -> NDArray[np.float64]:
        return (measured - objective.capped(loss)[:, counted]) * scale

    def loss_of(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return problem.respond(values).path_loss

    def gaps_of(points: NDArray[np.float64], _: NDArray[np.float64]) -> NDArray[np.float64]:
        values = problem.parameters.from_unit(points)
        answer = problem.respond(values)
        return np.hstack([gap(answer.path_loss), *_further(problem, answer.observed)])

    if len(counted) > MAX_LINKS:
        marginal = marginal.without_improbable(gap(loss_of(problem.parameters.from_search(best[None]))))
    none = np.zeros(0, dtype=np.int64)
    spread = float(section.heterogeneity) if section.heterogeneity != "auto" else 0.0 if few else None
    model = JointModel(
        problem.parameters,
        problem.parameters,
        problem.priors,
        gaps_of,
        loss_of,
        marginal,
        none,
        none,
        none,
        spread,
        max(int(getattr(problem.engine, "interactions", 1)), 1),
        observed=tuple(
            (len(each.used(objective.weight)), each.freedom(objective.weight), each.stated)
            for each in problem.observed
        ),
    )
    return _with_constants(model, problem, best, gap) if can_split(problem) else model


def _with_constants(
    model: JointModel,
    problem: Problem,
    best: NDArray[np.float64],
    gap: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> JointModel:
    """Extend the model by the buildings and by the scene's fixed constants that affect path loss."""
    study, known_to = model.study, problem.setup.study.noise.constants_spread
    fixed = _fixed_constants(problem)
    every = replace(study, items=(*study.items, *fixed))
    replay, effects = split_replay(problem, every, by_building=model.spread != 0), {}

    def loss_at(values: NDArray[np.float64], factors: NDArray[np.float64]) -> NDArray[np.float64]:
        # Use the same compiled program as for the gaps.
        return replay.respond(values, factors, problem.statistics).path_loss

    if fixed:
        values = np.append(study.from_search(best), [item.start for item in fixed])
        # Each row increases one fixed constant by one standard deviation.
        one = np.eye(len(values))[len(study) :]
        larger = values * np.exp(known_to * one) + SCATTERING_SPREAD * one * (values == 0)
        alike = np.ones((len(values) - len(study) + 1, len(replay.parameter_of)))
        gaps = gap(loss_at(np.vstack([values, larger]), alike))
        with np.errstate(invalid="ignore"):  # inf - inf for a censored link without a path
            change = gaps[1:] - gaps[:1]
        effect_db = np.sqrt(np.mean(np.where(np.isfinite(change), change, 0.0) ** 2, axis=1))
        effects = dict(zip((item.name for item in fixed), effect_db.tolist(), strict=True))
    varied = [item for item in fixed if effects[item.name] > NO_EFFECT * model.marginal.noise_db]
    parameters = replace(study, items=(*study.items, *varied))
    index = [every.names.index(name) for name in parameters.names]

    def full(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values, completed with the constants that have no effect."""
        all_values = np.tile([item.start for item in every.items], (len(values), 1))
        all_values[:, index] = values
        return all_values

    # Constants that the scene fixes have the same value for all buildings.
    of_building = np.flatnonzero((replay.building_of >= 0) & (replay.parameter_of < len(study)))
    parameter_of = replay.parameter_of[of_building]
    constants = np.bincount(replay.parameter_of, minlength=len(every))[: len(study)]
    of_buildings = np.bincount(parameter_of, minlength=len(study))

    def gaps_of(points: NDArray[np.float64], logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        factors = np.ones((len(points), len(replay.parameter_of)))
        factors[:, of_building] = np.exp(logarithms)
        values = full(parameters.from_unit(points))
        answer = replay.respond(values, factors, problem.statistics)
        return np.hstack([gap(answer.path_loss), *_further(problem, answer.observed)])

    return replace(
        model,
        parameters=parameters,
        priors=model.priors.extended(
            range(len(study), len(parameters)), [item.start for item in varied], known_to
        ),
        gaps=gaps_of,
        loss=lambda values: loss_at(full(values), np.ones((len(values), len(replay.parameter_of)))),
        parameter_of=parameter_of,
        building_of=np.unique(replay.building_of[of_building], return_inverse=True)[1],
        only_buildings=np.flatnonzero((constants == of_buildings) & (constants > 0)),
        effects_db={item.name: effects[item.name] for item in varied},
        interactions=max(replay.interactions, 1),
    )


def _further(problem: Problem, observed: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Rows [n, m] of each further observable, in units of the observable's error if the study states it."""
    rows = []
    for index, each in enumerate(problem.observed):
        residuals, _ = each.residuals(observed[:, index], problem.objective.weight)
        rows.append(residuals / each.std if each.stated else residuals)
    return rows


def has_offset(problem: Problem) -> bool:
    """Whether the study declares an offset, or a constant term without a prior."""
    constant = any(
        term.by == CONSTANT and not np.isfinite(term.prior) for term in problem.objective.nuisance.terms
    )
    return problem.setup.study.offset is not None or constant


def _fixed_constants(problem: Problem) -> list[Parameter]:
    """Constants of the calibrated materials that the scene fixes and that are equal at all carrier frequencies.

    If the study states a scattering coefficient of 0, this value is exact for the material and its facades.
    """
    study = problem.setup.study
    materials, spread = problem.engine.materials, study.noise.constants_spread
    smooth = {name for name, stated in study.materials.items() if stated.scattering_coefficient == 0}
    smooth |= {name for name, facade in study.facades.items() if facade.of in smooth}
    replayed = replayed_materials(problem)
    calibrated, _ = problem.parameters.at_carrier(problem.parameters.frequency)
    names = [
        f"{material}.{field_name}"
        for material in dict.fromkeys(
            parameter.material for parameter in problem.parameters if not parameter.is_effect
        )
        for field_name in FIXED_FIELDS
    ]
    items = []
    for name in names:
        material, field_name = split_name(name)
        value = getattr(materials[material], field_name)
        constant = fixed_constant(name, float(value), spread)
        varies = any(getattr(each[material], field_name) != value for each in replayed)
        exact = field_name == "scattering_coefficient" and value == 0 and material in smooth
        if name not in calibrated.names and constant is not None and not varies and not exact:
            items.append(constant)
    return items


def _weights_and_censoring(problem: Problem) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Weights [L] of the links in the likelihood, and the mask [L] of the censored links.

    If the likelihood contains censored links, it also contains the links measured near the noise floor, because
    otherwise links would be selected by their measured values.
    """
    objective, links = problem.objective, problem.setup.links
    if links.censored is None or problem.faint is None:
        return objective.weight, np.zeros(len(links), dtype=bool)
    # A censored link without a path agrees with the model for all parameter values.
    informative = problem.faint & ~problem.setup.held_out & np.isfinite(problem.before)
    return np.where(informative, links.weight, objective.weight), links.censored
