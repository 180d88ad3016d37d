"""Intervals on engines without derivatives: functions that pass through the calls, and planted truths within."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import planted
import programs
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares, VectorSurrogate
from calibray.optimizers.multifidelity import discrepancy
from calibray.optimizers.multifidelity.discrepancy import Seen
from calibray.optimizers.multifidelity.sampled_functions import drawn, surprise
from calibray.reporting import result_tables as tables
from calibray.result.wording import reason_text
from calibray.study import Setup, Study
from calibray.tables.text import render
from calibray.uncertainty.assessment import certainty

NOISE_DB = 0.3


class Calls:
    """The program as an engine that can only be called."""

    def __init__(self, setup: Setup) -> None:
        self.parameters, self.materials, self.calls = setup.parameters, setup.scene.materials, 0
        self.links = planted.links()

    def path_loss(self, candidates):
        self.calls += len(candidates)
        return programs.expected(candidates, self.links)


class Exact(Calls):
    """The same with derivatives, by central differences."""

    large, interactions = False, 1

    def path_loss_and_jacobian(self, candidates):
        moved = [(candidates + move, candidates - move) for move in 1e-5 * np.eye(3)]
        slopes = [(self.path_loss(there) - self.path_loss(here)) / 2e-5 for there, here in moved]
        return self.path_loss(candidates), np.stack(slopes, axis=2)


@pytest.fixture(scope="module")
def process() -> discrepancy.Discrepancy:
    """A process through six answers of two links, the response of which is a plane's."""
    unit = np.random.default_rng(2).random((6, 2))
    seen = Seen(unit, 2.0 * (unit - 0.5))
    truth = np.stack([np.sin(4 * unit[:, 0]) + unit[:, 1], np.cos(3 * unit[:, 1])], axis=1)
    return discrepancy.fit(seen, truth, 1.0)


def looked(unit: np.ndarray) -> Seen:
    return Seen(unit, 2.0 * (unit - 0.5))


def test_functions_pass_through_what_was_answered_and_differ_elsewhere_as_the_process_says(process):
    random, unit = np.random.default_rng(0), np.random.default_rng(1).random((40, 2))
    functions = [drawn(process, random) for _ in range(200)]
    for function in functions[:5]:
        assert function.values(process.seen) == pytest.approx(process.remains, abs=2e-2)
    values = np.array([function.values(looked(unit)) for function in functions])
    mean, share = process.predict(looked(unit))
    expected = np.sqrt(np.outer(share, np.sum(process.root**2, axis=0)))
    apart = np.sqrt(np.mean((values - mean) ** 2, axis=0))
    assert np.median(apart / expected) == pytest.approx(1.0, abs=0.15)
    assert np.quantile(apart / expected, (0.05, 0.95)) == pytest.approx([1.0, 1.0], abs=0.4)
    # Without deviations the mean is left.
    assert drawn(process, random, 0.0).values(looked(unit)) == pytest.approx(mean, abs=1e-9)


def test_their_slopes_are_those_of_their_values(process):
    function, unit = drawn(process, np.random.default_rng(4)), np.array([[0.3, 0.6], [0.8, 0.1]])
    slopes = function.slopes(looked(unit), np.broadcast_to(2.0 * np.eye(2), (2, 2, 2)))
    for k, move in enumerate(1e-6 * np.eye(2)):
        difference = function.values(looked(unit + move)) - function.values(looked(unit - move))
        assert slopes[:, :, k] == pytest.approx(difference / 2e-6, rel=1e-4, abs=1e-5)


def test_a_process_that_is_too_sure_is_surprised(process):
    points = np.arange(6)
    surer = discrepancy.solve(process.seen, process.remains, process.hyper - np.log([1e4] * 3 + [1] * 3), 1.0)
    bent = replace(surer, whitened=surer.whitened * 0.1)
    assert surprise(bent, points) > 2.0 > surprise(process, points)


@pytest.fixture(scope="module")
def asked(tmp_path_factory) -> Study:
    """A study of the program, its links noisy, which the scene's replay knows nothing of."""
    folder = tmp_path_factory.mktemp("program")
    content = programs.content(folder) | {
        "method": {"name": "auto", "model": "none", "options": {"budget": 30}}
    }
    links = planted.links()
    noise = NOISE_DB * np.random.default_rng(6).standard_normal(len(links))
    loss = programs.expected(programs.TRUTH, links)[0] + noise
    links.assign(path_loss_db=loss).to_csv(folder / "links.csv", index=False)
    return Study.from_content(content, folder / "study.toml")


def test_an_engine_that_can_only_be_called_gets_intervals_that_hold_the_truth(asked, tmp_path):
    result = calibrate(asked)
    assert len(programs.calls(asked.path.parent)) == result.rt_calls + 1 == 31  # and the start
    setup = Setup.open(asked)
    problem = Problem.of(setup, Exact(setup))
    trail = search(problem, LeastSquares(*problem.parameters.search_bounds, starts=16))
    exact = certainty(problem, trail)
    for name, truth in zip(result.parameters, programs.TRUTH, strict=True):
        found, other = result.intervals[name], exact.intervals[name]
        assert found.lower < truth < found.upper
        assert found.approximate
        assert not other.approximate
        ratio = (found.upper - found.lower) / (other.upper - other.lower)
        assert 1 / 1.5 < ratio < 1.5, name
    result.save(tmp_path)
    loaded = Result.load(tmp_path)
    assert loaded.intervals == result.intervals
    assert (
        json.loads((tmp_path / "result.json").read_text())["uncertainty"]["intervals"][name]["approximate"]
        is True
    )
    told = render(*tables.tables(loaded))
    assert ", approximate" in told
    assert "Intervals are approximate: the engine 'command' gives no derivatives, so 31 of its calls" in told


def test_calls_too_few_to_tell_anything_leave_the_whole_range(asked):
    setup = Setup.open(asked)
    problem = Problem.of(setup, Calls(setup))
    told = certainty(problem, search(problem, VectorSurrogate(*setup.parameters.search_bounds, budget=3)))
    for name, found in told.intervals.items():
        assert [found.lower, found.upper] == planted.BOUNDS
        assert found.verdict == "not identifiable"
        assert found.approximate, name
        assert reason_text(found.reason).startswith("3 calls of the engine are too few")
