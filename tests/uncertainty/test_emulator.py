"""Emulated intervals of engines without derivatives cover planted values."""

from __future__ import annotations

import json

import numpy as np
import pytest

import planted
import programs
from calibray.calibration.calibrate import calibrate
from calibray.calibration.result import Result
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.optimizers import LeastSquares, VectorSurrogate
from calibray.reporting import result_tables as tables
from calibray.result.wording import reason_text
from calibray.study import Setup, Study
from calibray.tables import render
from calibray.uncertainty.assessment import certainty

NOISE_DB = 0.3


class Calls:
    """The program as an engine without derivatives."""

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


class Rippled(Calls):
    """The program with fading that a few calls cannot show."""

    def path_loss(self, candidates):
        ripple = np.random.default_rng(1).uniform(3.0, 6.0, (3, len(self.links)))
        return super().path_loss(candidates) + 2.0 * np.sin(candidates @ ripple)


@pytest.fixture(scope="module")
def asked(tmp_path_factory) -> Study:
    """A study of the program with noisy links, without a cheap model."""
    folder = tmp_path_factory.mktemp("program")
    content = programs.content(folder) | {
        "method": {"name": "auto", "model": "none", "options": {"budget": 30}}
    }
    links = planted.links()
    noise = NOISE_DB * np.random.default_rng(6).standard_normal(len(links))
    loss = programs.expected(programs.TRUTH, links)[0] + noise
    links.assign(path_loss_db=loss).to_csv(folder / "links.csv", index=False)
    return Study.from_content(content, folder / "study.toml")


def test_emulated_intervals_cover_the_truth(asked, tmp_path):
    result = calibrate(asked)
    assert len(programs.calls(asked.path.parent)) == result.rt_calls + 1 == 31  # and the start
    setup = Setup.open(asked)
    problem = Problem.of(setup, Exact(setup))
    trail = search(problem, LeastSquares(*problem.parameters.search_bounds, starts=16))
    exact = certainty(problem, trail)
    for name, truth in zip(result.parameters, programs.TRUTH, strict=True):
        found, other = result.intervals[name], exact.record.intervals[name]
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
    assert "an emulator was fitted to 31 engine calls" in " ".join(told.split())


def test_too_few_calls_give_the_whole_range(asked):
    setup = Setup.open(asked)
    problem = Problem.of(setup, Calls(setup))
    told = certainty(problem, search(problem, VectorSurrogate(*setup.parameters.search_bounds, budget=3)))
    for name, found in told.record.intervals.items():
        assert [found.lower, found.upper] == planted.BOUNDS
        assert found.verdict == "not identifiable"
        assert found.approximate, name
        assert reason_text(found.reason).startswith("too few engine calls (3)")


def test_calls_that_do_not_predict_one_another_give_the_whole_range(asked):
    """Otherwise, a posterior would be narrow at the best call, where alone an emulator is exact."""
    setup = Setup.open(asked)
    problem = Problem.of(setup, Rippled(setup))
    trail = search(problem, VectorSurrogate(*setup.parameters.search_bounds, budget=6))
    assessed = certainty(problem, trail)
    assert assessed.posterior is None
    for found in assessed.record.intervals.values():
        assert [found.lower, found.upper] == planted.BOUNDS
        assert found.reason.values["error_db"] > 0.5 * trail.best_value
        assert "predictions of each call from the others have an error of" in reason_text(found.reason)
