"""Chunked replay gives the same sums and the same calibration as replay of all links; `test_dask.py` has workers."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import two_ray
from calibray import calibrate, engines
from calibray.engines import ChunkedReplay, InProcess
from calibray.engines.cluster.chunks import cut
from calibray.engines.kinds.replay import trace_and_replay
from calibray.errors import InputError
from calibray.fitting.nuisance import Nuisance, make_term
from calibray.fitting.objective import make_objective, total
from calibray.fitting.problem import Problem
from calibray.measurements import Measurements
from calibray.study import Setup

VARIANTS = {
    "plain": {},
    "offset": {"offset": {"bounds": [-10.0, 10.0]}},
    "offsets of groups, one at its bound, and a slope": {
        "offset": {"per": "half", "bounds": [-10.0, 0.2]},
        "nuisance": {"clutter": {"by": "log_distance", "prior": 3.0}},
        "noise": {"std_db": 1.0},
    },
    "priors": {
        "parameters": {
            name: {"bounds": bounds, "prior": {"value": 4.0, "spread": 0.3}}
            for name, bounds in two_ray.BOUNDS.items()
        },
        "noise": {"std_db": 1.0},
    },
    "observables": {
        "offset": {},
        "observables": {
            "spread": {"kind": "rms_delay_spread", "column": "rx_x", "unit": "ns", "std": 2.0},
            "flight": {"kind": "time_of_flight", "column": "rx_x", "unit": "ns", "bias": "half", "std": 3.0},
        },
        "noise": {"std_db": 1.0},
    },
    "censored": {"objective": {"combining": "coherent", "no_path": "censor", "ceiling_db": 80.0}},
}


@pytest.mark.parametrize("name", VARIANTS)
def test_sums_over_chunks_equal_sums_over_all_links(tmp_path, name):
    whole, chunked = (
        Problem.of(setup, engines.make(setup))
        for setup in (
            Setup.open(
                two_ray.study(tmp_path, noise_db=3.0, free=2, **VARIANTS[name], **engine), two_ray.TwoRay
            )
            for engine in ({}, {"engine": {"name": "replay", "chunk_links": 12}})
        )
    )
    assert len(chunked.engine.chunks) == 3
    lower, upper = whole.parameters.search_bounds
    points = lower + np.random.default_rng(1).random((6, len(lower))) * (upper - lower)
    expected, found = whole.evaluate(points, derivatives=True), chunked.squares(points, derivatives=True)
    assert found.value == pytest.approx(expected.value, rel=1e-12)
    assert found.rmse_db == pytest.approx(expected.rmse_db, rel=1e-12)
    assert found.residuals.shape == (6, len(lower) + 1)
    share = found.num_rows / found.residuals.shape[1]
    assert found.num_rows == expected.residuals.shape[1]
    for k in range(6):
        told, want = found.slopes[k], expected.slopes[k]
        assert share * told.T @ told == pytest.approx(want.T @ want, rel=1e-10, abs=1e-10)
        gradient = want.T @ expected.residuals[k]
        assert share * told.T @ found.residuals[k] == pytest.approx(gradient, rel=1e-9, abs=1e-9)
    assert chunked.squares(points).value == pytest.approx(expected.value, rel=1e-12)
    assert chunked.modelled(points) == pytest.approx(expected.modelled, rel=1e-12)
    # With room for one chunk, the other two are opened again for each question.
    engine = ChunkedReplay(
        InProcess(at_most=1), chunked.setup, chunked.engine.chunks, partial(trace_and_replay, None)
    )
    assert replace(chunked, engine=engine).modelled(points) == pytest.approx(expected.modelled, rel=1e-12)


def test_depth_and_power_of_paths_are_those_of_all_links(tmp_path):
    few = {"method": {"name": "least-squares", "options": {"starts": 2}}}
    whole, chunked = (
        calibrate(Setup.open(two_ray.study(tmp_path, noise_db=1.0, **few, **engine), two_ray.TwoRay))
        for engine in ({}, {"engine": {"name": "replay", "chunk_links": 12}})
    )
    assert set(whole.fit.power_shares) == {"ground", "line of sight"}
    for name, by_kind in whole.fit.power_shares.items():
        assert chunked.fit.power_shares[name] == pytest.approx(by_kind, rel=1e-9)
    np.testing.assert_array_equal(chunked.links["depth"], whole.links["depth"])


def made_up(count: int) -> tuple[Measurements, np.ndarray, np.ndarray]:
    """Links to three transmitters, with path loss and derivatives of two candidates drawn at random."""
    rng = np.random.default_rng(2)
    links = Measurements(
        tx=np.array([[0.0, 0, 9], [50, 0, 9], [0, 50, 9]])[np.arange(count) % 3],
        rx=rng.uniform(-40, 40, (count, 3)),
        path_loss_db=rng.uniform(70, 110, count),
        weight=rng.uniform(0.5, 2.0, count),
    )
    return links, rng.uniform(70, 110, (2, count)), rng.standard_normal((2, count, 4))


def test_what_comes_back_does_not_grow_with_the_links():
    sizes = []
    for count in (12, 1200):
        links, loss, slope = made_up(count)
        objective = make_objective(links, np.ones(count, bool), np.ones(count, bool))
        (share,) = objective.shares([np.arange(count)])
        sizes.append(len(pickle.dumps(share(loss, slope))))
    assert sizes[0] == sizes[1] < 1000


def test_a_lost_path_and_a_link_left_out_are_as_in_one_piece():
    links, loss, slope = made_up(30)
    loss[1, 7] = np.inf
    nuisance = Nuisance(30, (make_term(links, "offset", labels=np.arange(30) % 3, bounds=(-2.0, 2.0)),))
    counted = np.arange(30) != 11
    objective = make_objective(links, np.ones(30, bool), counted, nuisance=nuisance)
    chunks = cut(links, 9)
    assert sorted(np.concatenate(chunks)) == list(range(30))
    shares = objective.shares(chunks)
    parts = [share(loss[:, chunk], slope[:, chunk]) for share, chunk in zip(shares, chunks, strict=True)]
    products, square = objective.products(total(parts, shares, 3))
    residuals, jacobian = objective.residuals(loss), objective.jacobian(loss, slope)
    assert square[0] == pytest.approx(np.sum(residuals[0] ** 2), rel=1e-12)
    assert products[0, :-1, :-1] == pytest.approx(jacobian[0].T @ jacobian[0], rel=1e-12, abs=1e-12)
    assert -products[0, :-1, -1] == pytest.approx(jacobian[0].T @ residuals[0], rel=1e-10, abs=1e-10)
    assert np.isinf(square[1])
    assert np.isinf(objective.rmse(loss)[1])


@pytest.mark.parametrize("workers", [0, 300_000])
def test_processes_that_no_machine_can_use_are_refused(tmp_path, workers):
    setup = Setup.open(two_ray.study(tmp_path), two_ray.TwoRay)
    with (
        pytest.raises(InputError, match=f"--workers {workers}: must be at"),
        engines.open_workers(workers) as opened,
    ):
        engines.make(setup, workers=opened)
