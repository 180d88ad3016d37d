"""Effects on a path program: extra loss against closed forms and finite differences."""

import numpy as np
import pytest

import planted
from calibray import fields
from calibray.engines import Replay
from calibray.parameters import Parameter, Parameters
from calibray.paths import take

LENGTH_SEED = 5
TREES, HEDGE = "region:trees.specific_attenuation", "region:hedge.specific_attenuation"


@pytest.fixture(scope="module")
def paths():
    return planted.engine().paths


@pytest.fixture(scope="module")
def lengths(paths):
    random = np.random.default_rng(LENGTH_SEED)
    return random.uniform(0, 40, (2, paths.num_paths)) * (random.random((2, paths.num_paths)) < 0.7)


@pytest.fixture(scope="module")
def parameters():
    materials = planted.engine().parameters.items
    extra = [Parameter(name, 0.0, 3.0, 0.4) for name in (TREES, HEDGE)]
    return Parameters((extra[0], *materials, extra[1]), planted.engine().parameters.frequency)


@pytest.fixture(scope="module", params=["power", "coherent"])
def replay(request, paths, lengths, parameters):
    effects = (fields.ExtraLoss(lengths[0], 30.0, 0), fields.ExtraLoss(lengths[1], 60.0, 1))
    return Replay(paths, parameters, request.param, effects=effects)


def candidates(parameters, count=3):
    unit = np.random.default_rng(8).uniform(0.1, 0.9, (count, len(parameters)))
    return parameters.from_unit(unit)


def test_extra_loss_is_the_closed_form(replay, paths, lengths, parameters):
    values = candidates(parameters)
    found = replay.path_loss(values)
    kind = replay._combining.kind
    for value, loss in zip(values, found, strict=True):
        materials = parameters.materials(value, paths.materials)
        gain = fields.path_gains(paths, materials)
        extra_db = sum(
            maximum * (1 - np.exp(-length * specific / maximum))
            for length, specific, maximum in zip(lengths, value[[0, -1]], (30.0, 60.0), strict=True)
        )
        gain = (gain * 10 ** (-extra_db / 20)).reshape(-1, 1, 1)
        combining = fields.Combining.make(kind, paths.link, paths.delay)
        expected = fields.path_loss_of_gains(
            gain, paths.link, paths.delay, paths.num_links, paths.frequency, combining
        )
        assert loss == pytest.approx(expected, abs=1e-9)


def test_derivatives_agree_with_finite_differences(replay, parameters):
    value = candidates(parameters, 1)
    _, jacobian = replay.path_loss_and_jacobian(value)
    for index in range(len(parameters)):
        step = 1e-5 * np.eye(len(parameters))[index]
        above, below = replay.path_loss(np.vstack([value + step, value - step]))
        assert jacobian[0, :, index] == pytest.approx((above - below) / 2e-5, rel=1e-5, abs=1e-6)
    assert np.abs(jacobian[0, :, 0]).max() > 1.0


def test_without_attenuation_nothing_changes(paths, lengths):
    plain = planted.engine()
    value = plain.parameters.start[None]
    nothing = Replay(paths, plain.parameters, effects=(fields.ExtraLoss(lengths[0], 30.0, None, 0.0),))
    assert nothing.path_loss(value) == pytest.approx(plain.path_loss(value), abs=1e-12)
    fixed = Replay(paths, plain.parameters, effects=(fields.ExtraLoss(lengths[0], 30.0, None, 1.0),))
    assert (fixed.path_loss(value) > plain.path_loss(value) + 0.5).any()
    loss, jacobian = fixed.path_loss_and_jacobian(value)
    assert jacobian.shape == (1, paths.num_links, 3)
    assert loss == pytest.approx(fixed.path_loss(value), abs=1e-9)


def test_links_that_no_path_reaches_have_no_slope(paths, parameters):
    """Also if that is true of all links, as in a chunk of links behind a building."""
    none = take(paths, np.zeros(0, dtype=np.int64))
    effects = (fields.ExtraLoss(np.zeros(0), 30.0, 0), fields.ExtraLoss(np.zeros(0), 60.0, 1))
    loss, jacobian = Replay(none, parameters, effects=effects).path_loss_and_jacobian(candidates(parameters))
    assert np.isposinf(loss).all()
    np.testing.assert_array_equal(jacobian, np.zeros((3, paths.num_links, len(parameters))))
