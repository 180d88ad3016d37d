"""The replay of a study's scene as the cheap model of an engine without derivatives."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import planted
import programs
from calibray.calibration.calibrate import calibrate
from calibray.engines import Replay
from calibray.engines.rays.compile import powers
from calibray.errors import InputError
from calibray.fitting import cheap_replay
from calibray.fitting.cheap_replay import (
    DEEPER,
    ProblemRows,
    ReplayedModel,
    further_layers,
    make_cheap_replay,
    with_constants,
    with_layers,
)
from calibray.fitting.nuisance import Nuisance
from calibray.fitting.problem import Problem
from calibray.fitting.search import choose, rounds
from calibray.materials import Material
from calibray.optimizers import LeastSquares
from calibray.optimizers.multifidelity import space_mapping
from calibray.parameters import Parameter, Parameters
from calibray.paths import Kind, Paths, take
from calibray.reporting.result_tables import costs
from calibray.study import Setup, Study
from calibray.tables import render

PRIOR = {"prior": {"value": 4.0, "spread": 0.3}}


class Calls:
    """The planted paths as an engine without derivatives."""

    def __init__(self) -> None:
        self.calls = 0
        self.parameters, self.materials = planted.engine().parameters, planted.engine().materials

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        self.calls += len(candidates)
        return planted.engine().path_loss(candidates) + 1.5  # what a cable takes


PRIORS = {
    name: {"bounds": planted.BOUNDS, **(PRIOR if k == 0 else {})} for k, name in enumerate(planted.TRUTH)
}


def problem(folder: Path, **sections) -> Problem:
    """A problem with this engine; the study's engine traces for every candidate."""
    table = planted.campaign(noise_db=1.0)
    sections = {"engine": {"name": "retrace"}, **sections}
    return Problem.of(Setup.open(planted.study(folder, table, **sections)), Calls())


@pytest.fixture(scope="module")
def asked(tmp_path_factory) -> Problem:
    """A problem with offsets and priors."""
    sections = {"offset": {"per": "half", "prior_db": 3.0}, "noise": {"std_db": 1.0}, "parameters": PRIORS}
    return problem(tmp_path_factory.mktemp("asked"), **sections)


@pytest.fixture(scope="module")
def model(asked) -> ReplayedModel:
    """Its cheap model."""
    found = make_cheap_replay(asked).model
    assert found is not None
    return found


def test_the_replay_leads_to_the_optimum_in_a_few_calls(asked, model):
    optimizer, calls = choose(asked, model), asked.engine.calls
    values = []
    for _, told in islice(rounds(optimizer, asked.evaluate), 4):
        values += told.value.tolist()
    assert asked.engine.calls - calls == 4
    exact = replace(
        asked, engine=planted.engine()
    )  # offsets take up what the cable takes, but for their prior
    best = LeastSquares(*exact.parameters.search_bounds, starts=16)
    for _ in rounds(best, exact.evaluate):
        pass
    assert min(values) - best.best.y < 0.05 < 1.0 < values[0] - best.best.y + 1.0
    assert min(values) < 1.01 * asked.evaluate(best.best.x[None]).value[0]


def check_derivatives(asked: Problem, model: ReplayedModel) -> None:
    """Compare the derivatives of a cheap model's residuals with central differences."""
    point = asked.parameters.to_search(asked.parameters.start)[None] + 0.3
    constants = model.constants.centre[None] + 0.1
    answer, size = model.answer(point, constants), constants.shape[1]
    assert answer.residuals == pytest.approx(model.residuals(point, constants))
    for k in range(3 + size):
        move = 1e-5 * np.eye(3 + size)[k]
        above, below = (
            model.residuals(point + sign * move[:3], constants + sign * move[3:]) for sign in (1, -1)
        )
        slope = answer.by_point[0, :, k] if k < 3 else answer.by_constant[0, :, k - 3]
        assert slope == pytest.approx((above - below)[0] / 2e-5, rel=1e-3, abs=1e-4)


def test_derivatives_of_the_cheap_model_agree_with_its_residuals(asked, model):
    check_derivatives(asked, model)
    point = asked.parameters.to_search(asked.parameters.start)[None]
    answer = model.answer(point, model.constants.centre[None])
    assert answer.residuals.shape[1] == len(model.known) == planted.LINKS + 3
    assert model.known.sum() == planted.LINKS


@pytest.fixture(scope="module")
def own(asked) -> Paths:
    """The paths that the study's settings find."""
    return asked.setup.trace()


@pytest.fixture(scope="module")
def richer(asked) -> Paths:
    """The paths with up to two more interactions than the study allows, and with diffraction."""
    trace = asked.setup.study.trace
    return asked.setup.with_trace(
        replace(trace, max_depth=trace.max_depth + DEEPER, diffraction=True)
    ).trace()


@pytest.fixture(scope="module")
def layers(asked, richer) -> tuple[Paths, ...]:
    """All paths that the study leaves out, weak ones too."""
    trace = asked.setup.study.trace
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cheap_replay, "WEAK", 0.0)
        return further_layers(richer, trace.max_depth, trace.diffraction)


def with_further(asked: Problem, own: Paths, layers: tuple[Paths, ...]) -> ReplayedModel:
    """A cheap model with further paths."""
    paths = with_layers(own, layers)
    parameters = with_constants(asked.parameters, paths.materials)
    return ReplayedModel(Replay(paths, parameters), 3, ProblemRows(asked), len(layers))


@pytest.fixture(scope="module")
def layered(asked, own, layers) -> ReplayedModel:
    """A cheap model with all further paths."""
    return with_further(asked, own, layers)


@pytest.fixture(scope="module")
def stronger(asked, own, richer) -> ReplayedModel:
    """A cheap model with the stronger of the further paths, which is faster."""
    trace = asked.setup.study.trace
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cheap_replay, "WEAK", 1e-4)
        return with_further(asked, own, further_layers(richer, trace.max_depth, trace.diffraction))


def test_the_study_and_the_layers_have_the_paths_of_the_richer_trace(asked, own, richer, layers, monkeypatch):
    monkeypatch.setattr(cheap_replay, "WEAK", 0.0)
    depth = asked.setup.study.trace.max_depth
    assert len(layers) == 3
    assert own.num_paths + sum(layer.num_paths for layer in layers) == richer.num_paths
    deeper, deepest, diffracted = layers
    assert set(np.diff(deeper.first)) == {depth + 1}
    assert set(np.diff(deepest.first)) == {depth + 2}
    assert (np.add.reduceat(diffracted.kind == Kind.DIFFRACTION, diffracted.first[:-1]) == 1).all()
    assert not (deeper.kind == Kind.DIFFRACTION).any()
    assert len(further_layers(richer, depth, True)) == 2
    assert further_layers(own, depth, False) == ()


def test_weak_paths_are_left_out_of_the_layers(asked, richer, layers, monkeypatch):
    monkeypatch.setattr(cheap_replay, "WEAK", 1e-3)
    trace, power = asked.setup.study.trace, powers(richer)
    total = np.bincount(richer.link, power)
    strong = further_layers(richer, trace.max_depth, trace.diffraction)
    assert all((powers(layer) >= 1e-3 * total[layer.link]).all() for layer in strong)
    left_out = sum(layer.num_paths for layer in layers) - sum(layer.num_paths for layer in strong)
    assert left_out == sum((powers(layer) < 1e-3 * total[layer.link]).sum() for layer in layers) > 0


def test_gains_scale_the_power_of_the_layers(asked, own, richer, layered):
    parameters = layered.engine.parameters
    point = asked.parameters.to_search(asked.parameters.start)[None]
    constants = layered.constants.centre[: len(parameters) - 3]
    candidate = parameters.from_search(np.hstack([point, constants[None]]))
    all_paths, study_paths = (
        asked.residuals(candidate[:, :3], Replay(part, parameters).path_loss(candidate))
        for part in (richer, own)
    )
    for log_gain, expected in ((0.0, all_paths), (-40.0, study_paths)):
        gains = np.full(layered.layers, log_gain)
        answer = layered.residuals(point, np.hstack([constants, gains])[None])
        assert answer == pytest.approx(expected, abs=1e-6)
    assert np.abs(all_paths - study_paths).max() > 0.05


def test_derivatives_with_further_paths_agree_with_the_residuals(asked, stronger):
    check_derivatives(asked, stronger)
    gains = stronger.answer(
        asked.parameters.to_search(asked.parameters.start)[None], stronger.constants.centre[None]
    ).by_constant[0, :, -stronger.layers :]
    assert (np.abs(gains).max(axis=0) > 1e-3).all()


class Richer(Calls):
    """An engine without derivatives that finds more paths than the study's settings."""

    def __init__(self, paths: Paths, parameters: Parameters) -> None:
        super().__init__()
        self.replay = Replay(paths, parameters)

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
        return self.replay.path_loss(candidates)


def test_answers_show_whether_the_engine_has_the_paths_of_the_layers(
    asked, own, richer, stronger, monkeypatch
):
    monkeypatch.setattr(space_mapping, "FIRST_SEARCHES", 8)
    gain = []
    for paths in (richer, own):
        engine = replace(asked, engine=Richer(paths, asked.parameters))
        optimizer = choose(engine, stronger)
        for _ in islice(rounds(optimizer, engine.evaluate), 5):
            pass
        gain.append(np.exp(optimizer.corrected.constants[-stronger.layers :]))
    assert gain[0].max() > 0.5
    assert gain[1].max() < 0.1


def test_links_that_only_the_engine_reaches_are_unknown_to_the_model(asked):
    paths = planted.engine().paths
    kept = paths.link != 3

    fewer = Replay(take(paths, np.flatnonzero(kept)), with_constants(asked.parameters, paths.materials))
    plain = replace(asked, objective=replace(asked.objective, nuisance=Nuisance(planted.LINKS)))
    model = ReplayedModel(fewer, 3, ProblemRows(plain))
    assert np.flatnonzero(~model.known).tolist() == [3, planted.LINKS]
    point = asked.parameters.to_search(asked.parameters.start)[None]
    told = model.answer(point, model.constants.centre[None])
    assert np.isfinite(told.residuals).all()
    assert told.residuals[0, 3] == 0.0
    assert not told.by_point[0, 3].any()


def test_constants_are_those_that_are_not_calibrated():
    wall = Parameter("walls.relative_permittivity", 1.5, 12.0, 5.0)
    materials = {
        "walls": Material(5.0, 0.1, 0.3),
        "metal": Material(1.0, 1e7, 0.01),
        "air": Material(1.1, 0.0, 0.1),
    }
    names = with_constants(Parameters((wall,)), materials).names
    assert names == ("walls.relative_permittivity", "walls.thickness", "walls.conductivity", "air.thickness")
    assert with_constants(Parameters((wall,)), materials, one_carrier=False).names[1:] == (
        "walls.thickness",
        "air.thickness",
    )


def test_a_scene_that_cannot_be_traced_gives_a_remark(tmp_path, monkeypatch):
    def missing(*_, **__):
        raise InputError("no libLLVM was found")

    content = programs.content(tmp_path) | {"method": {"name": "auto", "options": {"budget": 9}}}
    study = Study.from_content(content, tmp_path / "study.toml")
    monkeypatch.setattr(Setup, "trace", missing)
    result = calibrate(study)
    assert result.cost.cheap_replays == 0
    assert (
        result.remarks[0] == "No cheap model is used: the scene cannot be traced here (no libLLVM was found)."
    )
    other = content | {"method": {"name": "vector-surrogate", "options": {"budget": 9}}}
    named = calibrate(Study.from_content(other, study.path), seed=0)
    assert not any("cheap model" in remark for remark in named.remarks)


@pytest.mark.parametrize("method", [{"model": "none"}, {"name": "random"}])
def test_nothing_is_traced_without_a_cheap_model(tmp_path, monkeypatch, method):
    asked = problem(tmp_path, method=method)
    monkeypatch.setattr(Setup, "trace", lambda *_, **__: pytest.fail("traced"))
    assert make_cheap_replay(asked).model is None
    assert make_cheap_replay(asked).remark is None


def test_the_engine_decides_whether_a_cheap_model_is_needed(tmp_path):
    asked = problem(tmp_path, engine={"name": "replay"})
    assert make_cheap_replay(asked).model is not None
    assert make_cheap_replay(replace(asked, engine=planted.engine())).model is None


def test_a_killed_run_is_repeated_from_its_ledger(tmp_path):
    """The program differs from the scene, so the candidates depend on its answers; a restart repeats them."""
    content = programs.content(tmp_path) | {"method": {"name": "auto", "options": {"budget": 3}}}
    study = Study.from_content(content, tmp_path / "study.toml")
    first = calibrate(study, out=tmp_path / "out")
    again = calibrate(study, out=tmp_path / "out", overwrite=True)
    assert (first.rt_calls, first.cost.ledger_hits) == (3, 0)
    assert first.cost.cheap_replays > 100
    assert f"{first.cost.cheap_replays:,} in" in render(costs(first))
    assert (again.rt_calls, again.cost.ledger_hits) == (3, 3)
    assert again.history.rmse_db.tolist() == first.history.rmse_db.tolist()
    assert again.parameters == first.parameters
