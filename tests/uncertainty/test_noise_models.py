"""Densities of the measurements against numerical integrals, and posterior weights for planted errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from scipy.stats import norm
from scipy.stats import t as student

import planted
from calibray.engines import Replay
from calibray.fitting.problem import Problem
from calibray.study import Setup, Study
from calibray.uncertainty import laplace as tails
from calibray.uncertainty.joint_model import joint_model
from calibray.uncertainty.noise_models import (
    IMPROBABLE,
    OFFSET_DB,
    Marginal,
    NoiseModel,
    excess_db,
    missing_db,
    noise_models,
)
from calibray.uncertainty.residual_correlation import EXACT, shared, whitener
from link_tables import links_from_frame

RANDOM = np.random.default_rng(1)
COUNT = 6
POSITION = RANDOM.uniform(0, 100, (COUNT, 3))
GAP = RANDOM.normal(0, 2, COUNT)


def marginal(models, design=None, ridge=None, position=POSITION, noise_db=2.0, excess=None) -> Marginal:
    design = np.zeros((len(position), 0)) if design is None else design
    ridge = np.zeros(design.shape[1]) if ridge is None else ridge
    return Marginal.of(design, ridge, np.ones(len(position)), position, noise_db, models, None, excess)


def integral(log_density) -> float:
    """Integral over the log noise level and one coefficient."""
    size, coefficient = np.linspace(-2.5, 4, 261), np.linspace(-30, 30, 601)
    value = log_density(coefficient[:, None, None], np.exp(size)[None, :, None])
    return float(logsumexp(value) + np.log((size[1] - size[0]) * (coefficient[1] - coefficient[0])))


@pytest.mark.parametrize(
    ("model", "covariance"),
    [
        (NoiseModel("gaussian", 1.0), np.eye(COUNT)),
        (
            NoiseModel("correlated", 1.0, range=50.0, share=0.7),
            0.7 * np.exp(-cdist(POSITION, POSITION) / 50) + 0.3 * np.eye(COUNT),
        ),
    ],
)
def test_gaussian_densities_are_the_integrals(model, covariance):
    precision, determinant = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]

    def log_density(offset, size):
        left = GAP - offset
        square = np.einsum("...i,ij,...j->...", left, precision, left)
        normal = COUNT * (np.log(size[..., 0]) + 0.5 * np.log(2 * np.pi)) + 0.5 * determinant
        return -0.5 * square / size[..., 0] ** 2 - normal

    found = marginal((model,), np.ones((COUNT, 1))).densities(GAP[None])
    assert found[0, 0] == pytest.approx(integral(log_density), abs=1e-3)


def test_an_undeclared_offset_has_its_prior():
    def log_density(offset, size):
        prior = norm.logpdf(offset, 0, OFFSET_DB * size / 2.0)[..., 0]
        return norm.logpdf(GAP, offset, size).sum(axis=-1) + prior

    found = marginal((NoiseModel("gaussian", 1.0, offset=True),)).densities(GAP[None])
    assert found[0, 0] == pytest.approx(integral(log_density), abs=1e-3)


def _mixed(error):
    return np.logaddexp(np.log(0.9) + norm.logpdf(error), np.log(0.1) + norm.logpdf(error, scale=7.0))


@pytest.mark.parametrize(
    ("model", "tail", "within"),
    [
        (NoiseModel("student-t", 1.0, freedom=4.0), lambda error: student.logpdf(error, 4), 0.25),
        (NoiseModel("student-t", 1.0, gross=True), _mixed, 0.25),
    ],
)
def test_heavy_tailed_densities_are_near_the_integral(model, tail, within):
    """For 40 links with four gross errors; for fewer links, Laplace's approximation is rough."""
    random = np.random.default_rng(3)
    gap = 2.0 * random.standard_normal(40) + 20.0 * (np.arange(40) < 4)

    def log_density(offset, size):
        return (tail((gap - offset) / size) - np.log(size)).sum(axis=-1)

    many = random.uniform(0, 100, (40, 3))
    found = marginal((model,), np.ones((40, 1)), position=many).densities(gap[None])
    assert found[0, 0] == pytest.approx(integral(log_density), abs=within)


@pytest.mark.parametrize("tail", [tails.student(4.0), tails.gross()])
def test_tails_are_normalised_and_have_their_fisher_information(tail):
    """By quadrature; the weight is the derivative of the log density."""
    error = np.linspace(-200, 200, 400_001)
    density = np.exp(tail.log_density(error**2))
    assert np.trapezoid(density, error) == pytest.approx(1.0, abs=1e-3)
    slope = np.gradient(np.log(density), error)
    near = np.abs(error) < 30
    assert (-error * tail.weight(error**2))[near] == pytest.approx(slope[near], abs=1e-3)
    assert np.trapezoid(density * slope**2, error) == pytest.approx(tail.location, rel=1e-3)
    assert np.trapezoid(density * (1 + error * slope) ** 2, error) == pytest.approx(tail.size, rel=2e-3)


@pytest.mark.parametrize("tail", [tails.student(2.0), tails.student(4.0), tails.gross()])
@pytest.mark.parametrize("columns", [0, 3])
def test_the_iteration_converges_to_the_mode(tail, columns, monkeypatch):
    """Compared with many more steps, for errors with some gross ones."""
    random = np.random.default_rng(5)
    gap = 3.0 * random.standard_normal((64, 60)) + 20.0 * (random.random((64, 60)) < 0.1)
    design, ridge = random.standard_normal((60, columns)), np.full(columns, 0.2)
    found = tails.evidence(gap, design, ridge, tail)
    monkeypatch.setattr(tails, "MAX_STEPS", 400)
    monkeypatch.setattr(tails, "TOLERANCE", 1e-9)
    assert found == pytest.approx(tails.evidence(gap, design, ridge, tail), abs=0.02)


def test_each_gap_may_have_its_degrees_of_freedom_and_priors():
    random = np.random.default_rng(6)
    gap = 3.0 * random.standard_normal((40, 30)) + 20.0 * (random.random((40, 30)) < 0.1)
    design, freedom = random.standard_normal((30, 2)), random.choice([2.0, 4.0, 8.0], 40)
    ridge = random.uniform(0.1, 1.0, (40, 2))
    found = tails.evidence(gap, design, ridge, tails.student(freedom))
    alone = [
        tails.evidence(gap[k : k + 1], design, ridge[k], tails.student(freedom[k]))[0] for k in range(40)
    ]
    assert found == pytest.approx(np.array(alone), abs=1e-6)
    assert np.ptp(found) > 1.0


def test_gross_errors_are_recognized():
    """With one link of ten 20 dB off, the model with gross errors has the largest weight."""
    random = np.random.default_rng(5)
    position = random.uniform(0, 600, (60, 2))
    gap = 3 * random.standard_normal(60) + 20.0 * (np.arange(60) % 10 == 0)
    models = noise_models(position, offset=False)
    found = marginal(models, position=position, noise_db=3.0).densities(gap[None])[0]
    assert models[int(np.argmax(found))].gross
    assert not any(model.gross for model in noise_models(position, censored=True))
    assert not any(model.gross for model in noise_models(position, kind="student-t"))


def test_nearest_neighbours_approximate_the_exact_whitener():
    random = np.random.default_rng(0)
    position, scale = random.uniform(0, 1000, (300, 3)), random.uniform(0.5, 2, 300)
    exact, near = (whitener(position, scale, 80.0, 0.8, exact=exact) for exact in (300, 10))
    errors = np.linalg.solve(exact.factor, random.standard_normal((300, 20)))
    assert near.log_determinant == pytest.approx(exact.log_determinant, abs=1.0)
    assert (near.apply(errors) ** 2).sum(axis=0) == pytest.approx(
        (exact.apply(errors) ** 2).sum(axis=0), rel=0.01
    )


PLANTED = ("gaussian", "correlated", "out_of_sight", "student-t")


def test_every_kind_is_planted():
    assert {model.kind for model in noise_models(POSITION, out_of_sight=True)} == set(PLANTED)


@pytest.mark.parametrize("kind", PLANTED)
def test_planted_errors_favour_their_kind(kind):
    """For 150 links, the planted kind gets the largest weight; a planted offset is recognized."""
    random = np.random.default_rng(8)
    position, excess = random.uniform(0, 600, (150, 2)), random.normal(15, 8, 150)
    excess[::2] = -np.inf  # in sight
    errors = {
        "gaussian": 3 * random.standard_normal(150),
        "correlated": 3
        * np.linalg.cholesky(np.exp(-cdist(position, position) / 60) + 1e-6 * np.eye(150))
        @ random.standard_normal(150),
        # Missing power some 15 dB below that in sight, differing by 6 dB.
        "out_of_sight": -missing_db(excess + 6 * random.standard_normal(150), 15.0)
        + random.standard_normal(150),
        "student-t": 3 * random.standard_t(2.5, 150),
    }[kind]
    models = noise_models(position, out_of_sight=True)
    assert sum(model.weight for model in models) == pytest.approx(1.0)
    assert sum(model.weight for model in models if model.offset) == pytest.approx(2 / 3)
    density = marginal(models, position=position, noise_db=2.0, excess=excess)

    def weights(gap):
        found = density.densities(gap[None])[0]
        share = np.exp(found - logsumexp(found))
        kinds = {model.kind: 0.0 for model in models}
        for model, each in zip(models, share, strict=True):
            kinds[model.kind] += each
        return kinds, sum(each for model, each in zip(models, share, strict=True) if model.offset)

    kinds, offset = weights(errors)
    assert max(kinds, key=kinds.get) == kind
    if kind == "gaussian":
        assert offset < 0.5 < weights(errors + 4.0)[1]


def test_declared_properties_are_fixed():
    def kinds(**stated):
        return {model.kind for model in noise_models(POSITION, **stated)}

    assert kinds(kind="gaussian", range_m=0.0) == {"gaussian"}
    assert kinds(kind="student-t") == {"student-t"}
    assert {model.range for model in noise_models(POSITION, range_m=60.0)} == {60.0}
    assert not any(model.offset for model in noise_models(POSITION, offset=False))


def test_links_of_one_position_share_errors():
    """Repeated rows: without a range for them, three rows of each place would count as three independent ones."""
    random = np.random.default_rng(3)
    place = random.uniform(0, 400, (40, 3))
    repeated = np.repeat(place, 3, axis=0)
    assert min(model.range for model in noise_models(repeated) if model.kind == "correlated") < 1.0
    assert min(model.range for model in noise_models(place) if model.kind == "correlated") > 5.0
    models = noise_models(repeated, offset=False)
    density = marginal(models, position=repeated, noise_db=3.0)
    log = density.densities(
        np.repeat(3.0 * random.standard_normal(40), 3)[None] + 0.3 * random.standard_normal(120)
    )
    best = models[int(np.argmax(log[0]))]
    assert (best.kind, best.share) == ("correlated", 0.95)
    assert best.range < 1.0
    # Measurements of one place with independent errors favour no shared ones.
    log = density.densities(3.0 * random.standard_normal((1, 120)))
    assert models[int(np.argmax(log[0]))].kind == "gaussian"


def test_weak_links_out_of_sight_have_excess_loss():
    out_of_sight = np.arange(planted.LINKS) % 2
    study = Study.from_content(planted.content("links.csv", noise=None))
    table = planted.links().assign(out_of_sight=out_of_sight)
    problem = Problem.of(Setup.open(study, links=links_from_frame(table)), planted.engine())
    excess = excess_db(problem)
    assert np.isneginf(excess[::2]).all()
    # With a tenth of the power, a link has 10 dB more loss.
    paths = problem.engine.paths
    spreading = np.where(paths.link == 1, np.sqrt(0.1), 1.0) * paths.spreading
    weaker = excess_db(
        replace(problem, engine=Replay(replace(paths, spreading=spreading), problem.parameters))
    )
    assert weaker[1::2] - excess[1::2] == pytest.approx(10.0 * (np.arange(1, planted.LINKS, 2) == 1))
    # Equal powers add 3 dB; in sight nothing is missing.
    assert missing_db(np.array([-np.inf, 15.0, 45.0]), 15.0) == pytest.approx([0.0, 3.01, 30.0], abs=0.01)


def test_errors_of_missing_paths_are_shared():
    """The exact whitener is that of the covariance; beyond its number of links, the parts are independent."""
    error = np.random.default_rng(3).uniform(0, 4, 5)
    filter_ = shared(error, 0.5)
    covariance = np.eye(5) + 0.5 * np.diag(error**2) + 0.5 * np.outer(error, error)
    assert filter_.factor @ covariance @ filter_.factor.T == pytest.approx(np.eye(5))
    assert filter_.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1])
    many = np.resize(error, EXACT + 1)
    filter_ = shared(many, 0.5)
    assert filter_.apply(many) == pytest.approx(many / np.sqrt(1 + many**2))
    assert filter_.log_determinant == pytest.approx(np.log(1 + many**2).sum())


def test_models_far_less_probable_are_left_out():
    """Strongly correlated errors of many links: models without shared errors explain them far worse."""
    random = np.random.default_rng(5)
    position = random.uniform(0, 200, (200, 3))
    common = np.linalg.cholesky(np.exp(-cdist(position, position) / 120) + 1e-9 * np.eye(200))
    gap = (6.0 * common @ random.standard_normal(200) + 0.5 * random.standard_normal(200))[None]
    density = marginal(noise_models(position), position=position)
    fewer = density.without_improbable(gap)
    assert {model.kind for model in fewer.models} == {"correlated"}
    assert set(fewer.models) < set(density.models)
    best = density.densities(gap).max()
    assert fewer.densities(gap).min() > best - IMPROBABLE
    assert fewer.densities(gap).max() == best


@pytest.mark.parametrize("stated_db", [0.5, 5.0])
def test_priors_of_nuisances_have_their_declared_deviation_whatever_error_is_stated(stated_db):
    """The level is that of the residuals, with all unknowns; the prior is in units of it."""
    sections = {"offset": {"per": "half", "prior_db": 3.0}, "nuisance": {"slope": {"by": "log_distance"}}}
    noise = {"std_db": stated_db, "heterogeneity": 0, "constants_spread": 0}
    study = Study.from_content(planted.content("links.csv", noise=noise, **sections))
    setup = Setup.open(study, links=links_from_frame(planted.links(), group="half"))
    problem = Problem.of(setup, planted.engine())
    measured = planted.campaign(noise_db=2.0).path_loss_db.to_numpy()
    problem = replace(problem, objective=replace(problem.objective, measured=measured))
    best = problem.parameters.to_search(np.array(list(planted.TRUTH.values())))
    optimum = problem.squares(best[None])
    freedom = optimum.num_rows - problem.unknowns
    model = joint_model(problem, best, float(optimum.value[0] ** 2), freedom)
    squares = float(np.sum(optimum.residuals**2))
    assert model.marginal.noise_db == pytest.approx(np.sqrt(squares / freedom))
    deviation_db = model.marginal.noise_db / model.marginal.ridge[:2]
    assert deviation_db == pytest.approx([3.0, 3.0])
