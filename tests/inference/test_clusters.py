"""Buildings that differ: what estimates owe to them, by closed forms and by planted buildings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibray.inference.clusters import moved, shared_covariance, spreads
from calibray.inference.marginal import DIFFERING, NoiseModel, noise_models
from calibray.inference.posterior import Draws
from calibray.inference.verdicts import verdicts

COUNTS = np.array([30, 6, 3, 1])
"""Links that lean on each of four buildings."""

LINK_BUILDING = np.repeat(np.arange(4), COUNTS)
NONE = np.zeros((len(LINK_BUILDING), 0))


def slopes(effect: np.ndarray | float = 1.0) -> np.ndarray:
    """Derivatives of links that lean on one building each [1, m, 4]."""
    return ((LINK_BUILDING[:, None] == np.arange(4)) * np.reshape(effect, (-1, 1)))[None]


def test_many_links_on_one_building_are_one():
    share = COUNTS / COUNTS.sum()
    found = shared_covariance(slopes(), np.zeros(4, int), np.arange(4), NONE, np.zeros(1))
    assert found == pytest.approx(np.sum(share**2))


def test_what_is_no_building_does_not_differ():
    place = np.array([-1, 1, 2, 3])
    found = shared_covariance(slopes(), np.zeros(4, int), place, NONE, np.zeros(1))
    assert found == pytest.approx(np.sum((COUNTS[1:] / COUNTS.sum()) ** 2))


def test_planted_buildings_move_estimates_so_far():
    """With an offset fitted beside; as if every link had a building of its own, it would be said to be far less."""
    random, spread = np.random.default_rng(4), 0.15
    effect = random.uniform(2.0, 20.0, len(LINK_BUILDING))
    design = np.column_stack([effect, np.ones(len(effect))])
    drawn = spread * random.standard_normal((4000, 4))
    estimate = np.linalg.lstsq(design, (effect * drawn[:, LINK_BUILDING]).T, rcond=None)[0][0]
    offset = np.ones((len(effect), 1))
    own = np.zeros(4, int)
    found = shared_covariance(slopes(effect), own, np.arange(4), offset, np.zeros(2))[0, 0]
    assert spread**2 * found == pytest.approx(estimate.var(), rel=0.07)
    single = np.diag(effect)[None]
    many = np.arange(len(effect))
    alone = shared_covariance(single, np.zeros(len(effect), int), many, offset, np.zeros(2))[0, 0]
    assert alone < 0.5 * found


def test_a_prior_holds_what_buildings_could_move():
    free, held = (
        shared_covariance(slopes(), np.zeros(4, int), np.arange(4), NONE, np.array([precision]))[0, 0]
        for precision in (0.0, 1e6)
    )
    assert held < 1e-6 * free


@pytest.fixture
def models() -> tuple[NoiseModel, ...]:
    return noise_models(np.random.default_rng(0).uniform(0, 100, (20, 3)), offset=False)


def weights(models: tuple[NoiseModel, ...], **kinds: float) -> np.ndarray:
    """Weights of the models at 4000 draws, so much for each kind [4000, models]."""
    number = {kind: sum(model.kind == kind for model in models) for kind in kinds}
    row = [kinds.get(model.kind, 0.0) / number.get(model.kind, 1) for model in models]
    return np.tile(row, (4000, 1))


def test_spreads_are_as_likely_as_the_data_say(models):
    apart = spreads(models, weights(models, gaussian=0.2, heterogeneous=0.8), models)
    # Four times as likely now and twice before: the data speak for it by two to one.
    assert np.mean(apart > 0) == pytest.approx(0.8 + 0.2 * 2 / 3, abs=0.03)
    assert np.mean(apart == 0.3) == pytest.approx(0.8 / 3 + 0.2 * 2 / 3 * 0.137, abs=0.03)
    alike = spreads(models, weights(models, gaussian=1.0), models)
    assert np.mean(alike > 0) < 0.01
    # Heavy tails explain all: nothing was learnt of buildings, and they differ as likely as was thought before.
    heavy = spreads(models, weights(models, **{"student-t": 1.0}), models)
    assert np.mean(heavy > 0) == pytest.approx(1 / 2, abs=0.03)


def test_a_study_of_like_buildings_moves_nothing(models):
    alike = tuple(model for model in models if model.kind != DIFFERING)
    share = weights(alike, gaussian=1.0)
    value = np.full((len(share), 2), 5.0)
    spread = spreads(alike, share, alike)
    assert (spread == 0).all()
    there, far = moved(value, spread, np.eye(2))
    assert (there == value).all()
    assert (far == 0).all()


def test_values_are_moved_by_spread_and_covariance():
    covariance = np.array([[0.5, 0.2], [0.2, 0.3]])
    value = np.tile([5.0, 0.1], (20_000, 1))
    there, far = moved(value, np.full(len(value), 0.1), covariance)
    assert np.cov(np.log(there / value).T) == pytest.approx(0.01 * covariance, rel=0.06)
    assert far.mean() == pytest.approx(1.0, abs=0.05)


def test_models_left_out_count_as_unlikely(models):
    """Those that explain little are not evaluated; what is left tells of the others."""
    left = tuple(replace(model) for model in models if model.kind == "gaussian")
    assert np.mean(spreads(left, np.ones((2000, len(left))) / len(left), models) > 0) < 0.01


def test_what_the_links_tell_of_buildings_seen_is_not_called_unknown():
    """Links tell those seen to a tenth of the range; that others may differ widens the interval and says so."""
    random = np.random.default_rng(2)
    seen, means = (
        Draws(point, np.zeros(4000), np.full(4000, 1 / 4000))
        for point in (random.normal(0.5, 0.02, (4000, 1)), random.uniform(0.1, 0.9, (4000, 1)))
    )

    def told(draws: Draws, lean: Draws | None):
        ends = np.zeros(1), np.ones(1)
        return verdicts(draws, lambda points: points * 50.0, ["walls"], *ends, 3.0, seen=lean)[0]

    assert told(means, seen).name == "weakly identified"
    assert "buildings that were seen" in told(means, seen).reason
    assert told(means, seen).pieces == told(means, None).pieces
    assert told(means, None).name == "not identifiable"
    assert told(means, means).name == "not identifiable"
    assert told(seen, seen).name == "identified"
