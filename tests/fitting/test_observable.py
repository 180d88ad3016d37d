"""Calibration on another observable than path loss, with the same loop."""

from __future__ import annotations

import numpy as np
import pytest

import planted
from calibray.engines.protocol import PATH_LOSS, Observable
from calibray.errors import InputError
from calibray.fields.channel import channel_statistics
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose, search
from calibray.study import Setup


def delay_spread(engine, candidates):
    """RMS delay spread of every link [n, L], [ns]."""
    every = [engine.parameters.materials(candidate, engine.materials) for candidate in candidates]
    return 1e9 * np.stack([channel_statistics(engine.paths, each).delay_spread for each in every])


SPREAD = Observable("delay spread", "ns", lambda links: links.frame["spread_ns"].to_numpy(), delay_spread)


def setup_of(tmp_path, values, **method):
    table = planted.links().assign(path_loss_db=90.0, spread_ns=values)
    return Setup.open(planted.study(tmp_path, table, method=method))


def test_a_calibration_on_delay_spreads(tmp_path):
    engine = planted.engine()
    truth = np.array([planted.TRUTH[name] for name in engine.parameters.names])
    measured = delay_spread(engine, truth[None])[0]
    setup = setup_of(tmp_path, measured, name="vector-surrogate", options={"budget": 90})
    problem = Problem.of(setup, engine, SPREAD)
    assert not problem.differentiable
    trail = search(problem, choose(problem))
    before = np.sqrt(np.mean((problem.before - measured) ** 2))
    assert trail.best_rmse_db < 0.05 * before
    assert trail.best_modelled == pytest.approx(delay_spread(engine, trail.best[None])[0])
    # Path loss, which the table gives as 90 dB everywhere, is another matter.
    assert not np.allclose(Problem.of(setup, engine, PATH_LOSS).before, problem.before, rtol=0.5)


def test_a_method_with_derivatives_is_refused_for_an_observable_without(tmp_path):
    setup = setup_of(tmp_path, 90.0, name="least-squares")
    with pytest.raises(InputError, match="needs derivatives"):
        choose(Problem.of(setup, planted.engine(), SPREAD))
