"""Compressed programs: few weighted paths give the path loss of all within the stated error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synthetic
from calibray.engines import Replay
from calibray.engines.compression import MIN_PATHS, compress, sparse_weights, strongest
from calibray.engines.replay import Computation
from calibray.errors import InputError
from calibray.materials import Material
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths, take

TOLERANCE_DB = 0.01


@pytest.fixture(scope="module", autouse=True)
def _few_rounds():
    """Candidates of two checks, of which these links need one; those of six take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibray.engines.compression.ROUNDS", 2)
        yield


@pytest.fixture(scope="module")
def paths() -> Paths:
    sequences = [
        (Kind.SPECULAR,),
        (Kind.DIFFUSE,),
        (Kind.SPECULAR, Kind.DIFFUSE),
        (Kind.DIFFUSE, Kind.SPECULAR),
    ]
    many = synthetic.program(sequences * 500, seed=1, links=3, materials=synthetic.LAMBERTIAN)
    lonely = np.flatnonzero(many.link == 2)[MIN_PATHS // 2 :]  # the last link keeps few paths
    return take(many, np.setdiff1d(np.arange(many.num_paths), lonely))


@pytest.fixture(scope="module")
def parameters() -> Parameters:
    return Parameters(
        (
            Parameter("walls.relative_permittivity", 1.5, 12.0, start=4.3),
            Parameter("glass.relative_permittivity", 1.5, 12.0, start=6.1),
            Parameter("ground.scattering_coefficient", 0.0, 0.95, start=0.6),
        )
    )


@pytest.fixture(scope="module")
def compressed(paths, parameters):
    return compress(paths, parameters, TOLERANCE_DB)


def test_path_loss_stays_within_the_tolerance_at_fresh_candidates(paths, parameters, compressed) -> None:
    assert compressed.paths.num_paths < paths.num_paths / 8
    assert compressed.error_db.max() <= TOLERANCE_DB
    unit = np.random.default_rng(99).random((200, 3))
    unit[100:] = np.where(np.random.default_rng(98).random((100, 3)) < 0.5, unit[100:].round(), unit[100:])
    candidates = parameters.from_unit(unit)
    full, few = (
        Replay(some, parameters, computation=Computation(np.float64)) for some in (paths, compressed.paths)
    )
    gap = np.abs(full.path_loss(candidates) - few.path_loss(candidates))
    assert gap.max() <= TOLERANCE_DB
    assert (compressed.error_db[:2] > 0).all()  # the error is measured
    assert gap.max(axis=0)[:2] == pytest.approx(compressed.error_db[:2], rel=1.5)  # and of the right size
    at, step = candidates[:20], 1e-3 * np.eye(3)
    exact, slope = (
        np.stack([some.path_loss(at + each) - some.path_loss(at - each) for each in step])
        for some in (full, few)
    )
    scale = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(slope - exact) < 0.02 * scale).all()


def test_a_link_of_few_paths_is_left_alone(paths, compressed) -> None:
    before, after = (take(some, np.flatnonzero(some.link == 2)) for some in (paths, compressed.paths))
    assert compressed.error_db[2] == 0
    np.testing.assert_array_equal(after.spreading, before.spreading)


def test_without_weights_the_same_paths_would_not_do(paths, parameters, compressed) -> None:
    """The negative control: what is kept matters by its weights."""
    plain = replace(compressed.paths, spreading=np.full(compressed.paths.num_paths, 0.02))
    candidates = parameters.from_unit(np.random.default_rng(3).random((20, 3)))
    full, few = (Replay(some, parameters, computation=Computation(np.float64)) for some in (paths, plain))
    gap = full.path_loss(candidates)[:, :2] - few.path_loss(candidates)[:, :2]
    assert np.ptp(gap, axis=0).min() > 10 * TOLERANCE_DB  # not even up to a constant


def test_a_link_that_scatters_nothing_at_some_candidate_has_no_path_there(parameters) -> None:
    only = synthetic.program([(Kind.DIFFUSE,)] * 400, seed=2, links=1, materials=synthetic.LAMBERTIAN)
    only = replace(only, material=np.full(400, list(only.materials).index("ground"), dtype=np.int32))
    few = compress(only, parameters, TOLERANCE_DB).paths
    loss = Replay(few, parameters).path_loss(np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.5]]))
    assert np.isposinf(loss[0, 0])
    assert np.isfinite(loss[1, 0])


def test_a_link_behind_metal_has_no_path_before_and_after(parameters) -> None:
    """No power passes a metal sheet, whatever the candidate."""
    metal = Material(1.0, 1e7, 0.1)
    shut = synthetic.program([(Kind.REFRACTION,)] * 200, seed=3, links=1, materials=synthetic.LAMBERTIAN)
    material = np.full(200, list(shut.materials).index("ground"), dtype=np.int32)
    shut = replace(shut, material=material, materials={**shut.materials, "ground": metal})
    only = replace(parameters, items=parameters.items[:2])
    few = compress(shut, only, TOLERANCE_DB).paths
    for some in (shut, few):
        assert np.isposinf(Replay(some, only).path_loss(np.array([[4.0, 4.0]]))).all()


def test_weights_that_cannot_exist_are_not_made_up() -> None:
    found = sparse_weights(
        np.array([[1.0, 0.5], [-1.0, -0.5]]), 1e-3
    )  # no non-negative sum is 1 in both rows
    assert (found >= 0).all()
    exact = sparse_weights(np.array([[0.2, 0.8], [0.8, 0.2]]), 1e-12)
    assert exact == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("tolerance_db", [0.0, -1.0, np.nan, np.inf])
def test_a_tolerance_that_is_none_is_refused(paths, parameters, tolerance_db: float) -> None:
    with pytest.raises(InputError, match="tolerance_db"):
        compress(paths, parameters, tolerance_db)


def test_paths_left_out_carry_less_than_their_share(paths, parameters) -> None:
    share = 0.05
    kept = strongest(paths, parameters, share)
    assert kept.num_paths < 0.95 * paths.num_paths
    assert kept.num_links == paths.num_links
    candidates = parameters.from_unit(np.random.default_rng(4).random((50, 3)))
    full, fewer = (
        Replay(some, parameters, computation=Computation(np.float64)).path_loss(candidates)
        for some in (paths, kept)
    )
    loss_db = fewer - full
    assert loss_db.min() >= -1e-9
    assert loss_db.max() < -10 * np.log10(1 - share)
    assert np.mean(loss_db) < 0.05
    # Without a share to lose, only paths without power go.
    every = strongest(paths, parameters, 0.0)
    assert Replay(every, parameters, computation=Computation(np.float64)).path_loss(
        candidates
    ) == pytest.approx(full, abs=1e-9)
