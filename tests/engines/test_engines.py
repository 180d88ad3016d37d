"""Engines: the same answer whichever way, batches that do not show, exact derivatives, and every call counted."""

from __future__ import annotations

import numpy as np
import pytest

import planted
from calibray import engines
from calibray.engines import Engine, Replay, Retrace
from calibray.engines.replay import Computation
from calibray.errors import InputError
from calibray.fields import path_loss
from calibray.measurements.observables import Statistic
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study

TRUTH = np.array([list(planted.TRUTH.values())])


def candidates(count: int) -> np.ndarray:
    """Candidates spread over the bounds [count, 3]."""
    return np.random.default_rng(count).uniform(*planted.BOUNDS, (count, 3))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The planted campaign as a study in a folder."""
    return planted.study(tmp_path_factory.mktemp("engines"), planted.campaign())


@pytest.fixture(scope="module")
def retrace(study) -> Retrace:
    """The ray tracer itself."""
    return engines.make(study, "retrace")


def test_both_are_engines(retrace):
    assert isinstance(planted.engine(), Engine)
    assert isinstance(retrace, Engine)
    assert retrace.parameters == planted.engine().parameters


def test_retracing_and_replaying_agree(retrace):
    few = np.vstack([TRUTH, candidates(2)])
    assert retrace.path_loss(few) == pytest.approx(planted.engine().path_loss(few), abs=0.01)
    assert retrace.calls == 3
    # The two do differ between candidates by far more than they may differ from one another.
    assert np.ptp(planted.engine().path_loss(few), axis=0).min() > 0.1


def test_the_demo_is_replayed_as_it_is_traced():
    """To 0.0005 dB, and 0.002 dB near a Brewster angle, where Sionna's single precision shows.

    Paths computed from their other end would differ by 0.012 dB there. A tenth of the rays finds paths enough.
    """
    content = Study.load(demo_study_path()).content()
    content["trace"]["samples"] = 50_000
    setup = Study.from_content(content, demo_study_path()).opened()
    replay, traced = (engines.make(setup, name) for name in ("replay", "retrace"))
    lower, upper = replay.parameters.lower, replay.parameters.upper
    few = lower + np.random.default_rng(0).random((2, len(lower))) * (upper - lower)
    difference = np.abs(replay.path_loss(few) - traced.path_loss(few))
    assert np.quantile(difference, 0.98) < 5e-4
    assert difference.max() < 2e-3


def test_a_replay_is_that_of_the_fields():
    replay = planted.engine()
    materials = replay.parameters.materials(TRUTH[0], replay.materials)
    assert replay.path_loss(TRUTH)[0] == pytest.approx(path_loss(replay.paths, materials), abs=1e-9)


@pytest.mark.parametrize("count", [1, 3, 8, 33, 70])
def test_a_batch_is_its_candidates_one_by_one_and_each_is_one_call(count):
    replay, batch = planted.engine(), candidates(count)
    calls = replay.calls
    together = replay.path_loss(batch)
    assert replay.calls - calls == count
    assert together == pytest.approx(
        np.vstack([replay.path_loss(batch[k : k + 1]) for k in range(count)]), abs=1e-9
    )
    assert replay.calls - calls == 2 * count


@pytest.mark.parametrize("derivatives", [False, True])
@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_a_candidate_with_further_observables_is_one_call(combining, derivatives):
    replay = planted.engine()
    replay = Replay(replay.paths, replay.parameters, combining)
    replay.respond(candidates(3), (Statistic("rms_delay_spread"),), derivatives)
    assert replay.calls == 3


def test_derivatives_are_the_central_differences():
    replay, batch, step = planted.engine(), candidates(3), 1e-5
    calls = replay.calls
    loss, jacobian = replay.path_loss_and_jacobian(batch)
    assert replay.calls - calls == 3
    assert loss == pytest.approx(replay.path_loss(batch), abs=1e-9)
    for k in range(3):
        ahead, behind = batch + step * np.eye(3)[k], batch - step * np.eye(3)[k]
        numeric = (replay.path_loss(ahead) - replay.path_loss(behind)) / (2 * step)
        assert jacobian[..., k] == pytest.approx(numeric, rel=1e-5, abs=1e-7)
    assert np.abs(jacobian).max(axis=(0, 1)).min() > 0.01


def test_a_link_without_a_path_is_infinitely_lossy_and_has_no_slope():
    loss, jacobian = planted.engine(blocked=True).path_loss_and_jacobian(candidates(2))
    assert np.isinf(loss).sum(axis=1).tolist() == [1, 1]
    assert np.isinf(loss[:, planted.INSIDE]).all()
    assert np.isfinite(np.delete(jacobian, planted.INSIDE, axis=1)).all()
    assert not jacobian[:, planted.INSIDE].any()


def test_single_precision_is_within_a_hundredth_of_a_decibel():
    replay = planted.engine()
    single = Replay(replay.paths, replay.parameters, computation=Computation(np.float32))
    assert single.path_loss(TRUTH) == pytest.approx(replay.path_loss(TRUTH), abs=0.01)
    assert (single.path_loss(TRUTH) != replay.path_loss(TRUTH)).any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.ones(3), r"shape \(3,\); it must have shape \(n, 3\) with n at least 1"),
        (np.ones((2, 2)), r"shape \(2, 2\)"),
        (np.ones((0, 3)), r"shape \(0, 3\)"),
        (np.array([[1.0, np.nan, 2.0]]), "not finite"),
    ],
)
def test_candidates_that_are_none_are_refused_and_not_counted(retrace, wrong, message):
    for engine in (planted.engine(), retrace):
        calls = engine.calls
        with pytest.raises(InputError, match=message):
            engine.path_loss(wrong)
        assert engine.calls == calls


def test_an_unknown_engine_is_refused(study):
    with pytest.raises(InputError, match="engine 'replya': must be one of command, replay, retrace"):
        engines.make(study, "replya")


def test_the_scene_is_traced_with_the_starts_unless_told_otherwise(tmp_path):
    start = {"marble.scattering_coefficient": {"bounds": [0.0, 0.9], "start": 0.7}}
    setup = Setup.open(planted.study(tmp_path, planted.campaign(), parameters=start))
    assert setup.scene.materials["marble"].scattering_coefficient == 0.7
    assert setup.trace().materials == setup.scene.materials
    calibrated = setup.scene.materials | {"marble": setup.scene.materials["wood"]}
    assert setup.trace(calibrated).materials["marble"].scattering_coefficient == 0.0
    assert setup.trace().materials == setup.scene.materials


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.inf, "a value is not finite"),
        (2 + 1j, "complex128; they must be real"),
    ],
)
def test_candidates_that_are_no_real_numbers_are_refused(value, message):
    candidate = np.full((1, 3), 2.0, dtype=complex if isinstance(value, complex) else float)
    candidate[0, 1] = value
    with pytest.raises(InputError, match=message):
        planted.engine().path_loss(candidate)
    with pytest.raises(InputError, match="must be real numbers"):
        planted.engine().path_loss([["a", "b", "c"]])
