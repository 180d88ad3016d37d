"""The paper's experiment in the demo district: RT calls, the global optimum, files and figures."""

import json
import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.optimize import minimize
from typer.testing import CliRunner

from calibray import engines
from calibray.cli.app import app
from calibray.comparison import demo as module
from calibray.comparison.demo import FIGURES, MAPPING, METHODS, run_demo, trust, write_demo
from calibray.fitting.problem import Problem
from calibray.scenarios import demo_study_path
from calibray.study import Setup, Study
from changed import changed

space_mapping = module._space_mapping


def mapping_with_few_rays(setup, *arguments):
    """Space mapping whose ray tracer sends a tenth of the rays."""
    content = setup.study.content()
    content["trace"]["samples"] = 10_000
    return space_mapping(Setup.open(Study.from_content(content, setup.study.path)), *arguments)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The experiment; one noise model, equal buildings and exact constants make its intervals quick."""
    out, study = tmp_path_factory.mktemp("demo"), tmp_path_factory.mktemp("study") / "district"
    shutil.copytree(demo_study_path().parent, study)
    with (study / "study.toml").open("a") as file:
        file.write('\n[noise]\nkind = "gaussian"\nrange_m = 0\nheterogeneity = 0\nconstants_spread = 0\n')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "demo_study_path", lambda: study / "study.toml")
        patch.setattr(module, "MAPPING_CALLS", 1)  # each is a trace
        patch.setattr(module, "_space_mapping", mapping_with_few_rays)
        stages = []
        finished = run_demo(progress=lambda stage, *_: stages.append(stage))
    # After the search, a method's intervals are drawn, which takes longer.
    assert {"GWO, drawing", "SGWO-IM, drawing", "auto (least squares), drawing"} <= set(stages)
    return finished, out, write_demo(finished, out)


@pytest.fixture(scope="module")
def problem():
    setup = Study.load(demo_study_path()).opened()
    return Problem.of(setup, engines.make(setup, "replay"))


def test_rt_calls_are_the_papers(demo):
    finished, *_ = demo
    assert {method: finished.results[method].rt_calls for method in METHODS} == {"gwo": 600, "sgwo-im": 225}
    assert [len(finished.results[method].history) for method in METHODS] == [600, 225]


def test_auto_reaches_the_global_optimum_of_an_exhaustive_scan(demo, problem):
    engine = problem.engine
    axes = [
        np.linspace(low, high, 16)
        for low, high in zip(engine.parameters.lower, engine.parameters.upper, strict=True)
    ]
    grid = np.array(list(product(*axes)))
    rmse = problem.objective.rmse(engine.path_loss(grid))
    best = demo[0].results["auto"].rmse_db

    def objective(point):
        return float(problem.objective.rmse(engine.path_loss(point[None]))[0])

    bounds = list(zip(engine.parameters.lower, engine.parameters.upper, strict=True))
    polished = [
        minimize(objective, grid[k], bounds=bounds, method="Nelder-Mead").fun for k in np.argsort(rmse)[:8]
    ]
    assert best <= min(polished) + 1e-3
    assert min(polished) <= best + 1e-2  # the scan finds the same valley
    assert np.median(rmse) > best + 0.5  # negative control: a random guess does not


def test_methods_of_the_paper_improve_on_the_start_and_not_on_the_optimum(demo):
    finished, *_ = demo
    for method in METHODS:
        result = finished.results[method]
        assert finished.optimum_db - 1e-9 <= result.rmse_db < result.initial_rmse_db - 1


def test_space_mapping_runs_on_the_ray_tracer_itself(demo):
    finished, *_ = demo
    mapped = finished.results[MAPPING]
    assert mapped.rt_calls == 1
    assert mapped.cost.cheap_replays > 100
    assert finished.optimum_db - 1e-3 < mapped.rmse_db < mapped.initial_rmse_db


def test_soil_is_not_identifiable_and_concrete_is(demo):
    intervals = demo[0].results["auto"].intervals
    soil = intervals["soil.relative_permittivity"]
    assert soil.verdict == "not identifiable"
    # The reason is how much the links change over the whole range.
    assert "change_db" in soil.reason.values
    concrete = intervals["concrete.relative_permittivity"]
    assert concrete.verdict in ("identified", "weakly identified")
    assert concrete.upper - concrete.lower < 0.5 * (concrete.upper + concrete.lower)


def test_every_piece_of_an_interval_is_shown(demo):
    """The table lists both ranges of an interval with a gap, not the range from the lowest to the highest end."""
    auto, name = demo[0].results["auto"], "glass.relative_permittivity"
    pieces = ((4.05, 4.5), (5.25, 6.5))
    interval = replace(auto.intervals[name], lower=4.05, upper=6.5, pieces=pieces)
    (row,) = trust(changed(auto, intervals={name: interval})).rows
    assert row[2] == "4.05 to 4.5, 5.25 to 6.5"


def test_files_exist_and_open(demo):
    finished, out, page = demo
    for name in FIGURES:
        assert imread(out / name).shape[0] > 400
    content = json.loads((out / "result.json").read_text())
    assert content["methods"]["gwo"]["cost"]["rt_calls"] == 600
    assert content["methods"]["auto"]["excess_rmse_db"] == 0
    for method in finished.results:
        assert (out / method / "result-scene.xml").is_file()
    assert [len(table.rows) for table in finished.tables()] == [4, 3, 4, 3]
    assert page == out / "report.html"
    assert "glass.relative_permittivity" in page.read_text("utf-8")


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("calibray.comparison.demo.run_demo", lambda *_: pytest.fail("it was run"))
    outcome = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "file" / "demo")])
    assert outcome.exit_code == 2
    assert "output folder" in outcome.stderr
