"""Draws of means, buildings, spread and noise models against closed forms."""

from dataclasses import dataclass, field, replace

import dynesty
import numpy as np
import pytest

from calibray.parameters import NO_PRIOR, LogNormal, Parameter, Parameters, fixed_constant
from calibray.result.verdict import Cause
from calibray.uncertainty import sequential_monte_carlo as module
from calibray.uncertainty.assessment import remaining_widths
from calibray.uncertainty.joint_model import ALIKE, MEAN_SPREAD, SPREAD_BOUNDS, JointModel
from calibray.uncertainty.noise_models import Marginal, NoiseModel, noise_models
from calibray.uncertainty.sequential_monte_carlo import EFFECTIVE, draw_posterior

GAUSSIAN = NoiseModel("gaussian", 1.0)
LOWER, UPPER = 1.5, 12.0
LARGE = 3_000_000
"""Interactions with which a population is as small as it can be."""


def _parameters(scale="linear", names=("walls.relative_permittivity",)):
    return Parameters(
        tuple(Parameter(name, lower=LOWER, upper=UPPER, start=5.0, scale=scale) for name in names)
    )


def _marginal(links, models=(GAUSSIAN,)):
    return Marginal.of(np.zeros((links, 0)), np.zeros(0), np.ones(links), np.zeros((links, 3)), 1.0, models)


def _model(parameters, gaps, links, buildings=6, priors=NO_PRIOR, spread=None, **changes):
    arguments = {
        "parameter_of": np.zeros(buildings, dtype=int),
        "building_of": np.arange(buildings),
        "only_buildings": np.zeros(1, dtype=int)[:buildings],
    }
    marginal = _marginal(links, changes.pop("models", (GAUSSIAN,)))
    no_loss = lambda values: np.zeros((len(values), links))  # noqa: E731
    return JointModel(
        parameters, parameters, priors, gaps, no_loss, marginal, spread=spread, **arguments | changes
    )


def _uninformative(point, logarithms):
    """The same gaps everywhere."""
    return np.tile([1.0, -1.0, 2.0, -2.0], (len(point), 1))


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("spread", [0.7, None])
def test_undetermined_means_are_uniform(scale, spread):
    parameters = _parameters(scale)
    posterior = draw_posterior(_model(parameters, _uninformative, 4, buildings=2, spread=spread), seed=2)
    lower, upper = parameters.search_bounds
    unit = ((posterior.means.point - lower) / (upper - lower))[:, 0]
    assert np.quantile(unit, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.05)
    if spread is None:
        assert np.mean(posterior.spread == 0) == pytest.approx(ALIKE, abs=0.07)
        differing = posterior.spread[posterior.spread > 0]
        assert differing.mean() == pytest.approx(MEAN_SPREAD, rel=0.15)
    assert posterior.means.agree


def test_moves_beyond_the_bounds_are_rejected_without_a_replay():
    points = []

    def gaps(point, logarithms):
        points.append(point)
        return _uninformative(point, logarithms)

    draw_posterior(_model(_parameters(), gaps, 4, buildings=0), seed=6)
    every = np.concatenate(points)
    assert len(every) > 1000
    assert ((every > 0.0) & (every < 1.0)).all()


def test_undetermined_means_follow_a_declared_prior():
    prior = LogNormal((0,), (4.0,), (0.1,))
    draws = draw_posterior(_model(_parameters(), _uninformative, 4, priors=prior), seed=3).means
    # Flat in x and normal in log x: the mean of log x is larger by the variance.
    assert np.log(draws.point).mean() == pytest.approx(np.log(4.0) + 0.01, abs=0.015)
    assert np.log(draws.point).std() == pytest.approx(0.1, rel=0.12)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_undetermined_members_of_a_population_scatter_around_their_common_value(scale):
    names = ("walls.relative_permittivity", "shops.relative_permittivity")
    parameters = _parameters(scale, names)
    prior = LogNormal((1,), (1.0,), (0.1,), like=((1, 0),))
    model = _model(parameters, _uninformative, 4, buildings=0, priors=prior)
    posterior = draw_posterior(model, seed=5).means
    walls, shops = parameters.from_search(posterior.point).T
    # The common value stays uniform in the search space, whatever the normalization of the members' density.
    unit = parameters.to_unit(np.column_stack([walls, shops]))[:, 0]
    assert np.quantile(unit, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.06)
    middle = (walls > 2.5) & (walls < 8.0)
    ratio = np.log(shops / walls)[middle]
    assert ratio.mean() == pytest.approx(0.01 if scale == "linear" else 0.0, abs=0.015)
    assert ratio.std() == pytest.approx(0.1, rel=0.12)


BUILDINGS, EACH, SLOPE = 6, 10, 20.0
"""Buildings, links dominated by each, and derivative of path loss by the logarithm of its constant [dB]."""


def _planted(spread, seed=4):
    """Measured path loss of links dominated by one building each, linear in its constant, with 1 dB of noise."""
    random = np.random.default_rng(seed)
    own = np.log(4.0) + spread * random.standard_normal(BUILDINGS)
    return SLOPE * np.repeat(own, EACH) + random.standard_normal(BUILDINGS * EACH)


def _linear(parameters, measured):
    def gaps(point, logarithms):
        constants = np.log(parameters.from_unit(point)) + logarithms
        return measured - SLOPE * np.repeat(constants, EACH, axis=1)

    return gaps


def _closed_form(measured, spreads, weights):
    """Density of log x over a grid: y ~ N(slope log x, size^2 I + (slope s)^2 within buildings), size as 1 / size."""
    at = np.linspace(np.log(LOWER), np.log(UPPER), 2001)
    own = measured.reshape(BUILDINGS, EACH)
    within = np.sum((own - own.mean(axis=1)[:, None]) ** 2)
    square = np.sum((own.mean(axis=1)[:, None] - SLOPE * at) ** 2, axis=0)
    density = np.zeros((len(spreads), len(at)))
    for size in np.geomspace(0.5, 2.0, 61):
        for index, (spread, weight) in enumerate(zip(spreads, weights, strict=True)):
            deviation = np.sqrt(size**2 / EACH + (SLOPE * spread) ** 2)
            between = -0.5 * square / deviation**2 - BUILDINGS * np.log(deviation)
            log_within = -0.5 * within / size**2 - BUILDINGS * (EACH - 1) * np.log(size)
            density[index] += weight * np.exp(between + log_within + 100.0)
    total = density.sum()
    return at, density.sum(axis=0) / total, density.sum(axis=1) / total


def _moments(at, share):
    mean = np.sum(share * at)
    return mean, np.sqrt(np.sum(share * (at - mean) ** 2))


@pytest.mark.parametrize("known", [0.15, None])
@pytest.mark.parametrize("planted", [0.15, 0.0])
def test_means_agree_with_the_closed_form(known, planted):
    parameters, measured = _parameters("log"), _planted(planted)
    spreads, weights = [known], [1.0]
    if known is None:
        grid = np.linspace(*SPREAD_BOUNDS, 80)
        density = np.exp(-grid / MEAN_SPREAD)
        spreads, weights = [0.0, *grid], [ALIKE, *((1 - ALIKE) * density / density.sum())]
    at, share, by_spread = _closed_form(measured, spreads, weights)
    mean, deviation = _moments(at, share)
    model = _model(parameters, _linear(parameters, measured), len(measured), BUILDINGS, spread=known)
    posterior = draw_posterior(model, seed=5)
    draws = posterior.means.point[:, 0]
    weight = posterior.means.weight
    assert weight @ draws == pytest.approx(mean, abs=0.25 * deviation)
    assert np.sqrt(weight @ (draws - weight @ draws) ** 2) == pytest.approx(deviation, rel=0.25)
    if known is None:
        assert weight @ (posterior.spread == 0) == pytest.approx(by_spread[0], abs=0.15)
        # Negative control: where buildings differ, those that were seen say more than the mean of all.
        if planted:
            assert by_spread[0] < 0.05
            seen = posterior.seen.point[:, 0]
            assert np.std(seen) < 0.6 * deviation


def test_the_width_without_differing_buildings_is_that_of_equal_ones():
    parameters, measured = _parameters("log"), _planted(0.03, seed=8)
    model = _model(parameters, _linear(parameters, measured), len(measured), BUILDINGS)
    posterior = draw_posterior(model, seed=5)
    (without,) = remaining_widths(model, posterior)
    _, equal = _moments(*_closed_form(measured, [0.0], [1.0])[:2])
    weight, draws = posterior.means.weight, posterior.means.point[:, 0]
    total = np.sqrt(weight @ (draws - weight @ draws) ** 2)
    assert without == {Cause.BUILDINGS: pytest.approx(equal / total, rel=0.25)}
    stated = replace(model, spread=0.0)
    assert remaining_widths(stated, draw_posterior(stated, seed=5)) == [{}]


def test_the_width_without_constants_is_that_of_exact_ones():
    """Path loss that is linear in the logarithms of a parameter and of a constant known to 10 %."""
    known_to, links = 0.1, 40
    names = ("walls.relative_permittivity", "walls.thickness")
    items = (
        Parameter(names[0], LOWER, UPPER, 5.0, "log"),
        Parameter(names[1], 0.2 * np.exp(-0.4), 0.2 * np.exp(0.4), 0.2, "log"),
    )
    study, parameters = Parameters(items[:1]), Parameters(items)
    noise = np.random.default_rng(2).standard_normal(links)

    def gaps(point, _):
        first, second = np.log(parameters.from_unit(point)).T
        return noise - SLOPE * (first - np.log(4.0) + second - np.log(0.2))[:, None]

    prior = LogNormal((1,), (0.2,), (known_to,))
    model = replace(_model(parameters, gaps, links, buildings=0, priors=prior), study=study)
    (without,) = remaining_widths(model, draw_posterior(model, seed=3))
    exact = noise.std() / SLOPE / np.sqrt(links)
    assert without == {Cause.CONSTANTS: pytest.approx(exact / np.hypot(exact, known_to), rel=0.3)}


def test_the_width_without_a_constant_that_may_be_exactly_0_is_that_of_exact_ones():
    """Draws of 0 are one value for the regression, although the search space has an interval for it."""
    links, name = 40, "walls.scattering_coefficient"
    walls, scattering = _parameters("log").items[0], fixed_constant(name, 0.0, 0.15)
    study, parameters = Parameters((walls,)), Parameters((walls, scattering))
    noise = np.random.default_rng(2).standard_normal(links)

    def gaps(point, _):
        permittivity, coefficient = parameters.from_unit(point).T
        return noise - SLOPE * (np.log(permittivity / 4.0) - coefficient)[:, None]

    priors = NO_PRIOR.extended([1], [0.0], 0.15)
    model = replace(_model(parameters, gaps, links, buildings=0, priors=priors), study=study)
    posterior = draw_posterior(model, seed=3)
    assert np.mean(parameters.from_unit(posterior.joint)[:, 1] == 0) == pytest.approx(0.5, abs=0.1)
    (without,) = remaining_widths(model, posterior)
    exact = noise.std() / SLOPE / np.sqrt(links)
    # 0 or the positive half of a Gaussian, with the mean s / sqrt(2 pi) and the mean square s^2 / 2.
    known_to = 0.25 * np.sqrt(0.5 - 0.5 / np.pi)
    assert without == {Cause.CONSTANTS: pytest.approx(exact / np.hypot(exact, known_to), rel=0.3)}


def test_a_constant_of_0_keeps_its_interval_next_to_a_population():
    """Members that are drawn around their common value change no other coordinate."""
    names = ("walls.relative_permittivity", "shops.relative_permittivity")
    scattering = fixed_constant("walls.scattering_coefficient", 0.0, 0.15)
    parameters = Parameters((*_parameters("log", names).items, scattering))
    priors = LogNormal((1,), (1.0,), (0.1,), like=((1, 0),)).extended([2], [0.0], 0.15)
    drawn = _model(parameters, _uninformative, 4, priors=priors).draw_prior(4000, np.random.default_rng(1))
    zero = drawn[parameters.from_unit(drawn)[:, 2] == 0, 2]
    end = parameters.to_unit(parameters.start)[2]
    assert len(zero) == pytest.approx(2000, abs=150)
    assert np.quantile(zero / end, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.05)


def test_links_on_one_building_determine_the_mean_only_to_the_spread():
    parameters, measured = _parameters("log"), _planted(0.15)
    gaps = _linear(parameters, measured)

    def of_one(point, logarithms):
        return gaps(point, logarithms)[:, :EACH]

    draws = draw_posterior(_model(parameters, of_one, EACH, BUILDINGS, spread=0.15), seed=6).means
    assert draws.point.std() == pytest.approx(np.hypot(0.15, 1.0 / SLOPE / np.sqrt(EACH)), rel=0.2)


def test_distant_ranges_get_their_shares():
    """Two permittivities with the same path loss, one with twice the prior; and a needle in five dimensions."""
    parameters = _parameters(names=[f"m{k}.relative_permittivity" for k in range(5)])
    random = np.random.default_rng(1)
    noise, weights = random.standard_normal(30), random.standard_normal((5, 30))
    prior = LogNormal((0,), (4.0,), (np.log(2.0) / np.sqrt(2.0 * np.log(2.0)),))

    def gaps(point, _):
        values = parameters.from_unit(point)
        first = np.minimum(np.abs(values[:, 0] - 4.0), np.abs(values[:, 0] - 8.0))
        rest = np.column_stack([5.0 * first, values[:, 1:] - 6.0])
        return noise + 2.0 * rest @ weights

    posterior = draw_posterior(_model(parameters, gaps, 30, buildings=0, priors=prior), seed=7)
    first = posterior.means.point[:, 0]
    low = posterior.means.weight @ (first < 6.0)
    # A log-normal prior has half its density a factor of two from its centre.
    assert low == pytest.approx(2 / 3, abs=0.15)
    assert np.abs(first - np.where(first < 6.0, 4.0, 8.0)).max() < 0.5
    assert np.abs(posterior.means.point[:, 1:] - 6.0).max() < 1.0


@dataclass(frozen=True)
class Exact:
    """Gaps that are log densities themselves."""

    models: tuple[NoiseModel, ...] = (GAUSSIAN,)
    column: np.ndarray = field(default_factory=lambda: np.zeros(1))
    censored: np.ndarray = field(default_factory=lambda: np.ones(1, dtype=bool))

    def densities(self, gap):
        return gap


@pytest.mark.parametrize("size", [0.006, 0.003])
def test_many_narrow_modes_of_each_parameter_are_all_sampled(size):
    """As from reflections inside walls: six modes for each of four parameters, 1296 together."""
    places, share = np.array([0.1, 0.263, 0.419, 0.58, 0.741, 0.9]), np.arange(1.0, 7.0) / 21.0

    def log_density(point, _):
        each = np.log(share) - 0.5 * ((point[..., None] - places) / size) ** 2
        return np.logaddexp.reduce(each, axis=2).sum(axis=1)[:, None]

    parameters = _parameters(names=[f"m{k}.relative_permittivity" for k in range(4)])
    model = replace(_model(parameters, log_density, 1, buildings=0), marginal=Exact())
    draws = draw_posterior(model, seed=1).means
    for value in ((draws.point - LOWER) / (UPPER - LOWER)).T:
        near = np.abs(value[:, None] - places) < 5 * size
        assert draws.weight @ near == pytest.approx(share, abs=0.08)


def test_the_noise_models_get_their_posterior_weights():
    heavy = NoiseModel("student-t", 0.5, freedom=2.0)
    models = (NoiseModel("gaussian", 0.5), heavy)
    gaps = np.array([0.3, -0.5, 0.8, -0.2, 1.1, -0.9, 3.5, 0.1])
    marginal = _marginal(8, models)
    log = marginal.densities(gaps[None])[0]
    expected = 1.0 / (1.0 + np.exp(log[0] - log[1]))
    model = _model(_parameters(), lambda point, _: np.tile(gaps, (len(point), 1)), 8, models=models)
    posterior = draw_posterior(model, seed=8)
    assert 0.1 < expected < 0.9
    assert posterior.means.weight @ (posterior.model == 1) == pytest.approx(expected, abs=0.06)


def test_populations_that_disagree_are_reported():
    """A likelihood that depends on the order of evaluation has no posterior that populations could agree on."""
    turn = [0]

    def gaps(point, _):
        turn[0] += 1
        centre = 3.0 if turn[0] < first else 10.0
        return 20.0 * (_parameters().from_unit(point) - centre) + np.linspace(-1, 1, 20)

    first = np.inf
    model = _model(_parameters(), gaps, 20, buildings=0, interactions=LARGE)
    assert draw_posterior(model, seed=1).means.agree
    first, turn[0] = turn[0] // 2, 0
    posterior = draw_posterior(model, seed=1)
    assert not posterior.means.agree
    half = len(posterior.means.weight) // 2
    assert posterior.means.weight[:half].sum() == pytest.approx(0.5)


@pytest.mark.parametrize(("interactions", "pairs"), [(1, 4), (30_000, 2), (LARGE, 1)])
def test_more_populations_are_drawn_while_their_halves_disagree(monkeypatch, interactions, pairs):
    """The halves agree at the third comparison, of eight populations, if the budget allows as many."""
    distances = iter([1.0, 1.0, 0.0])
    monkeypatch.setattr(module, "_distance", lambda *_: next(distances))
    monkeypatch.setattr(module, "SIZE", (64, 64))
    model = _model(_parameters(), _uninformative, 4, buildings=0, interactions=interactions)
    draws = draw_posterior(model, seed=1).means
    assert draws.agree == (pairs == 4)
    monkeypatch.setattr(module, "_distance", lambda *_: 0.0)
    assert len(draws.weight) == pairs * len(draw_posterior(model, seed=1).means.weight)


@pytest.mark.parametrize(("agree", "factor", "members"), [(False, 4, 256), (True, 4, 64), (False, 1, 64)])
def test_small_populations_that_disagree_are_replaced_by_larger_ones(monkeypatch, agree, factor, members):
    monkeypatch.setattr(module, "_distance", lambda *_: 0.0 if agree else 1.0)
    model = _model(_parameters(), _uninformative, 4, buildings=0, interactions=1_000)
    budget = 2 * module.EVALUATIONS * 64 * 1_000
    posterior = draw_posterior(model, seed=1, budget=budget, largest_budget=factor * budget)
    alone = draw_posterior(model, seed=1, budget=budget if members == 64 else factor * budget)
    assert posterior.shape[2] == members
    np.testing.assert_array_equal(posterior.joint, alone.joint)
    # The first populations were evaluated too.
    assert (posterior.replays > alone.replays) == (members == 256)


def test_members_move_longer_where_draws_are_few_or_cheap(monkeypatch):
    monkeypatch.setattr(module, "LAST_SWEEPS", (8, 48))
    small, large, cheap = (
        draw_posterior(
            _model(_parameters(), _uninformative, 4, buildings=0, interactions=interactions), seed=1
        )
        for interactions in (LARGE, 20_000, 1)
    )
    # Without longer moves, it would have a quarter of the draws.
    assert 4 * small.shape[2] == large.shape[2] == cheap.shape[2]
    assert len(small.joint) >= 0.7 * len(large.joint)
    assert len(cheap.joint) >= 5 * len(large.joint)


def test_each_step_leaves_half_of_the_members_effective():
    log_likelihood = 30.0 * np.random.default_rng(10).standard_normal(1000)
    power = module._next_power(log_likelihood, 0.1)
    weight = np.exp((power - 0.1) * log_likelihood)
    assert 0.1 < power < 0.2
    assert np.sum(weight) ** 2 / np.sum(weight**2) == pytest.approx(EFFECTIVE * 1000, rel=0.01)
    assert module._next_power(0.01 * log_likelihood, 0.1) == 1.0


def test_progress_rises_during_the_last_sweeps_too():
    shares = []
    draw_posterior(_model(_parameters(), _uninformative, 4, buildings=0), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert max(np.diff([0.0, *shares])) < 0.3


def test_draws_are_the_same_for_a_seed():
    one, two, other = (
        draw_posterior(_model(_parameters(), _uninformative, 4, interactions=LARGE), seed=seed).means.point
        for seed in (7, 7, 8)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_draws_agree_with_nested_sampling():
    """An independent sampler (dynesty) on a posterior with several ranges, with and without an undeclared offset.

    Distribution functions of 500 independent draws differ from the true one by at most 0.06 in 19 of 20 cases; draws of
    either sampler are worth about as many.
    """
    random = np.random.default_rng(8)
    pattern, names = random.standard_normal((3, 24)), ("walls", "panes", "roofs")
    parameters = _parameters(names=tuple(f"{name}.relative_permittivity" for name in names))

    def modelled(point):
        shape = np.stack(
            [np.sin(9.0 * point[:, 0]), 2.0 * point[:, 1], 12.0 * (point[:, 2] - 0.5) ** 2], axis=1
        )
        return shape @ pattern

    measured = modelled(np.array([[0.3, 0.6, 0.85]]))[0] + random.standard_normal(24)
    places = np.column_stack([random.uniform(0, 300, (24, 2)), np.zeros(24)])
    models = noise_models(places, kind="gaussian", range_m=0.0)
    model = _model(parameters, lambda point, _: measured - modelled(point), 24, buildings=0, models=models)
    draws = draw_posterior(model, seed=1).means
    unit = (draws.point - LOWER) / (UPPER - LOWER)

    def log_likelihood(point):
        return float(
            np.logaddexp.reduce(model.densities_by_model(measured - modelled(point[None])), axis=1)[0]
        )

    sampler = dynesty.NestedSampler(
        log_likelihood,
        lambda point: point,
        3,
        nlive=200,
        sample="unif",
        bootstrap=0,
        rstate=np.random.default_rng(2),
    )
    sampler.run_nested(print_progress=False, dlogz=0.1)
    found = sampler.results
    weight = np.exp(found.logwt - found.logz[-1])
    at = np.linspace(0.0, 1.0, 201)
    for index in range(3):
        own = draws.weight @ (unit[:, index, None] <= at)
        other = weight @ (found.samples[:, index, None] <= at) / weight.sum()
        assert np.abs(own - other).max() < 0.085
    # The posterior has parts in ranges that a local sampler does not leave.
    assert 0.2 < draws.weight @ (unit[:, 2] < 0.5) < 0.8
