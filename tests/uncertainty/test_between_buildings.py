"""Draws of means, buildings and spread against closed forms."""

import numpy as np
import pytest
from scipy.stats import norm

from calibray.parameters import NO_PRIOR, LogNormal, Parameter, Parameters
from calibray.uncertainty import between_buildings as module
from calibray.uncertainty.between_buildings import (
    EFFECTIVE,
    MEAN_SPREAD,
    SPREAD_BOUNDS,
    Hierarchy,
    remaining_models,
    sample_means,
)
from calibray.uncertainty.importance_sampling import Draws
from calibray.uncertainty.noise_models import Marginal, NoiseModel

GAUSSIAN = NoiseModel("gaussian", 1.0)
LOWER, UPPER = 1.5, 12.0
COUNT, SWEEPS = 400, 11


def _parameters(scale="linear"):
    return Parameters(
        (Parameter("walls.relative_permittivity", lower=LOWER, upper=UPPER, start=5.0, scale=scale),)
    )


def _even(parameters, count=4000):
    """Draws of a uniform density."""
    lower, upper = parameters.search_bounds
    point = np.random.default_rng(1).uniform(lower, upper, (count, len(lower)))
    return Draws(point, np.zeros(count), np.full(count, 1.0 / count))


def _marginal(links):
    return Marginal.of(
        np.zeros((links, 0)), np.zeros(0), np.ones(links), np.zeros((links, 3)), 1.0, (GAUSSIAN,)
    )


def _hierarchy(parameters, gaps, links, buildings=6, priors=NO_PRIOR, spread=None, centred=True):
    return Hierarchy(
        parameters,
        np.zeros(buildings, dtype=int),
        np.arange(buildings),
        np.array([centred]),
        gaps,
        _marginal(links),
        priors,
        spread,
    )


def _silent(point, logarithms):
    """Uninformative links: the same gaps everywhere."""
    return np.tile([1.0, -1.0, 2.0, -2.0], (len(point), 1))


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("spread", [0.7, None])
def test_undetermined_means_are_uniform(scale, spread):
    parameters = _parameters(scale)
    silent = _hierarchy(parameters, _silent, 4, buildings=2, spread=spread)
    found = sample_means(silent, _even(parameters), 2 * COUNT, SWEEPS, seed=2)
    lower, upper = parameters.search_bounds
    unit = ((found.point - lower) / (upper - lower))[:, 0]
    assert np.quantile(unit, [0.1, 0.25, 0.5, 0.75, 0.9]) == pytest.approx(
        [0.1, 0.25, 0.5, 0.75, 0.9], abs=0.03
    )
    assert not found.flattened


def test_undetermined_means_without_buildings_are_uniform():
    parameters = _parameters()
    found = sample_means(
        _hierarchy(parameters, _silent, 4, centred=False), _even(parameters), COUNT, SWEEPS, seed=2
    )
    assert np.quantile(found.point, [0.25, 0.75]) == pytest.approx([4.125, 9.375], abs=0.4)


def test_undetermined_means_follow_a_declared_prior():
    parameters, prior = _parameters(), LogNormal((0,), (4.0,), (0.1,))
    flat = _even(parameters)
    density = -0.5 * prior.residuals(flat.point)[:, 0] ** 2
    weight = np.exp(density)
    alike = Draws(flat.point, density, weight / weight.sum())
    found = sample_means(_hierarchy(parameters, _silent, 4, priors=prior), alike, COUNT, SWEEPS, seed=3)
    # Flat in x and normal in log x: the mean of log x is larger by the variance.
    assert np.log(found.point).mean() == pytest.approx(np.log(4.0) + 0.01, abs=0.01)
    assert np.log(found.point).std() == pytest.approx(0.1, rel=0.1)


BUILDINGS, EACH, SLOPE = 6, 10, 20.0
"""Buildings, links dominated by each, and derivative of path loss by the logarithm of its constant [dB]."""


def _planted(spread, seed=4):
    """Measured path loss of links dominated by one building each, linear in its constant, with 1 dB of noise."""
    random = np.random.default_rng(seed)
    own = np.log(4.0) + spread * random.standard_normal(BUILDINGS)
    return SLOPE * np.repeat(own, EACH) + random.standard_normal(BUILDINGS * EACH)


def _straight(parameters, measured):
    def gaps(point, logarithms):
        constants = np.log(parameters.from_unit(point)) + logarithms
        return measured - SLOPE * np.repeat(constants, EACH, axis=1)

    return gaps


def _closed(measured, spreads, weights):
    """Density of log x over a grid: y ~ N(slope log x, size^2 I + (slope s)^2 within buildings), size as 1 / size."""
    at = np.linspace(np.log(LOWER), np.log(UPPER), 2001)
    own = measured.reshape(BUILDINGS, EACH)
    within = np.sum((own - own.mean(axis=1)[:, None]) ** 2)
    found = np.zeros(len(at))
    for size in np.geomspace(0.5, 2.0, 61):
        for spread, weight in zip(spreads, weights, strict=True):
            deviation = np.sqrt(size**2 / EACH + (SLOPE * spread) ** 2)
            between = norm.logpdf(own.mean(axis=1)[:, None], SLOPE * at, deviation).sum(axis=0)
            log_within = -0.5 * within / size**2 - BUILDINGS * (EACH - 1) * np.log(size)
            found += weight * np.exp(between + log_within + 100.0)
    return at, found / found.sum()


def _alike(parameters, gaps):
    """Draws with equal buildings."""
    flat = _even(parameters, 200_000)
    gap = gaps(parameters.to_unit(parameters.from_search(flat.point)), np.zeros((1, BUILDINGS)))
    density = _marginal(gap.shape[1]).densities(gap)[:, 0]
    weight = np.exp(density - density.max())
    return Draws(flat.point, density, weight / weight.sum())


def _moments(at, share):
    mean = np.sum(share * at)
    return mean, np.sqrt(np.sum(share * (at - mean) ** 2))


@pytest.mark.parametrize("known", [0.15, None])
@pytest.mark.parametrize("planted", [0.15, 0.0])
def test_means_agree_with_the_closed_form(known, planted):
    parameters, measured = _parameters("log"), _planted(planted)
    gaps = _straight(parameters, measured)
    alike = _alike(parameters, gaps)
    spreads = [known] if known else np.linspace(*SPREAD_BOUNDS, 400)
    weights = np.exp(-np.array(spreads) / MEAN_SPREAD)
    mean, deviation = _moments(*_closed(measured, spreads, weights))
    found = sample_means(
        _hierarchy(parameters, gaps, len(measured), BUILDINGS, spread=known), alike, COUNT, SWEEPS, seed=5
    )
    assert found.point.mean() == pytest.approx(mean, abs=0.2 * deviation)
    assert found.point.std() == pytest.approx(deviation, rel=0.2)
    # Where they differ, draws that take buildings as alike are far too sure.
    if planted:
        assert _moments(alike.point[:, 0], alike.weight)[1] < 0.5 * deviation


def test_links_on_one_building_determine_the_mean_only_to_the_spread():
    parameters, measured = _parameters("log"), _planted(0.15)
    gaps = _straight(parameters, measured)
    first = slice(0, EACH)  # all links lean on the first building

    def of_one(point, logarithms):
        return gaps(point, logarithms)[:, first]

    alike = _alike(parameters, of_one)
    one = sample_means(
        _hierarchy(parameters, of_one, EACH, BUILDINGS, spread=0.15), alike, COUNT, SWEEPS, seed=6
    )
    assert one.point.std() == pytest.approx(np.hypot(0.15, 1.0 / SLOPE / np.sqrt(EACH)), rel=0.2)


def test_correlated_means_agree_with_the_closed_form():
    """Links that determine the product of two constants well and their ratio badly, with nearly equal buildings."""
    names = ("walls.relative_permittivity", "ground.relative_permittivity")
    parameters = Parameters(
        tuple(Parameter(name, lower=LOWER, upper=UPPER, start=5.0, scale="log") for name in names)
    )
    slope = np.where(np.arange(40)[:, None] % 2, [10.0, 10.0], [1.0, -1.0])
    measured = slope @ np.log([4.0, 5.0]) + np.random.default_rng(11).standard_normal(40)

    def gaps(point, logarithms):
        constants = np.log(parameters.from_unit(point))
        constants[:, 0] += logarithms.mean(axis=1)
        return measured - constants @ slope.T

    flat = _even(parameters, 200_000)
    density = _marginal(40).densities(
        gaps(parameters.to_unit(parameters.from_search(flat.point)), np.zeros((1, 2)))
    )[:, 0]
    weight = np.exp(density - density.max())
    alike = Draws(flat.point, density, weight / weight.sum())
    both = Hierarchy(parameters, np.zeros(2, dtype=int), np.arange(2), np.array([True, False]), gaps,
                     _marginal(40), NO_PRIOR, 0.004)  # fmt: skip
    found = sample_means(both, alike, COUNT, SWEEPS, seed=12)
    for sign in (1.0, -1.0):
        mean, deviation = _moments(alike.point @ [1.0, sign], alike.weight)
        told = found.point @ [1.0, sign]
        assert told.mean() == pytest.approx(mean, abs=0.2 * deviation)
        assert told.std() == pytest.approx(deviation, rel=0.2)


def test_weights_without_moves_lead_to_the_posterior(monkeypatch):
    """Draws of one building without moves: the mean is the building's constant plus the spread."""
    monkeypatch.setattr(module, "WEIGHT_POWER", 1.0)
    parameters, measured = _parameters("log"), _planted(0.15)
    gaps = _straight(parameters, measured)

    def of_one(point, logarithms):
        return gaps(point, np.repeat(logarithms[:, :1], BUILDINGS, axis=1))[:, :EACH]

    alike = _alike(parameters, of_one)
    found = sample_means(_hierarchy(parameters, of_one, EACH, 1, spread=0.03), alike, 20_000, 0, seed=9)
    mean, deviation = _moments(alike.point[:, 0], alike.weight)
    told = found.point
    assert told.mean() == pytest.approx(mean, abs=0.005)
    assert told.std() == pytest.approx(np.hypot(deviation, 0.03), rel=0.06)


def test_each_step_leaves_half_of_the_draws_effective():
    told = 30.0 * np.random.default_rng(10).standard_normal(1000)
    power = module._next_power(told, 0.1)
    weight = np.exp((power - 0.1) * told)
    assert 0.1 < power < 0.2
    assert np.sum(weight) ** 2 / np.sum(weight**2) == pytest.approx(EFFECTIVE * len(told), rel=0.01)
    assert module._next_power(0.01 * told, 0.1) == 1.0


def test_draws_are_the_same_for_a_seed():
    parameters = _parameters()
    one, two, other = (
        sample_means(_hierarchy(parameters, _silent, 4), _even(parameters), 64, SWEEPS, seed=seed).point
        for seed in (7, 7, 8)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_gaussian_errors_are_always_tried_with_buildings():
    tried = tuple(
        NoiseModel(kind, 0.25, offset=offset)
        for kind in ("gaussian", "heterogeneous")
        for offset in (False, True)
    )
    correlated = NoiseModel("correlated", 0.2, range_m=30.0, share=0.4)
    found = remaining_models((correlated, tried[2]), tried)
    assert [(model.kind, model.offset) for model in found] == [
        ("correlated", False),
        ("gaussian", False),
        ("gaussian", True),
    ]
    # A study that states how much buildings differ leaves no other model.
    assert [model.kind for model in remaining_models(tried[2:], tried[2:])] == ["gaussian", "gaussian"]
