"""Methods at equal budgets: the runs, the tables and files, and continuing after a kill."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from multiprocessing import current_process

import numpy as np
import pandas as pd
import psutil
import pytest
from typer.testing import CliRunner

import planted
from calibray.calibration.calibrate import calibrate
from calibray.cli.app import app
from calibray.comparison import comparison as module
from calibray.comparison.comparison import FILES, FLOOR_DB, Comparison, compare, figure, parse_methods
from calibray.comparison.comparison import table as render_table
from calibray.comparison.method_runs import BudgetedMethod, MethodRun, RunFile, run_optimizer, study_problem
from calibray.errors import EngineError, InputError
from calibray.fitting import search
from calibray.optimizers import METHODS, SGWOIM, RandomSearch
from calibray.study import Study
from markdown_tables import render_markdown
from problem_families.problems import landscape_problem

STREET = partial(landscape_problem, "street")
BOUNDS = [1.5, 12.0]


@pytest.fixture(scope="module", autouse=True)
def _few_starts():
    """Fewer local searches, which suffice for `street`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "OPTIMUM_STARTS", {False: 64, True: 64})
        patch.setattr(search, "STARTS", (24, 24))
        yield


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A comparison of cheap methods, and the folder that it was run in."""
    out = tmp_path_factory.mktemp("small")
    return compare(
        STREET, parse_methods(["random", "gwo@60", "sgwo-im", "least-squares"], 45), seeds=3, out=out
    ), out


@pytest.fixture
def study(tmp_path):
    table = planted.campaign(noise_db=1.0)
    parameters = {name: {"bounds": BOUNDS} for name in planted.TRUTH}
    parameters["wood.conductivity"] = {"bounds": [1e-3, 0.3], "scale": "log"}
    plan = planted.study(tmp_path, table, parameters=parameters)
    lines = ["version = 1", '[scene]\nfile = "sionna:simple_street_canyon"\nfrequency = 3.5e9', "[links]"]
    lines += ['file = "links.csv"', f"tx = {list(planted.COLUMNS[:3])}", f"rx = {list(planted.COLUMNS[3:])}"]
    lines += ['value = "path_loss_db"', "[trace]\nmax_depth = 2\nsamples = 20000\nline_of_sight = false"]
    lines += ["[parameters]", *(f'"{name}" = {{ bounds = {BOUNDS} }}' for name in planted.TRUTH)]
    lines += ['"wood.conductivity" = { bounds = [1e-3, 0.3], scale = "log" }']
    plan.path.write_text("\n".join(lines) + "\n")
    return plan.path


def test_every_method_takes_a_budget():
    problem = STREET()
    for name in set(METHODS) - {"least-squares"}:
        assert 45 <= BudgetedMethod.parse(name, 50).optimizer(problem, 0).budget <= 50


def test_a_run_equals_the_optimizer_driven_by_hand(small):
    land, optimizer = STREET(), RandomSearch([1.5] * 3, [15.0] * 3, seed=2, budget=45)
    y = []
    while not optimizer.done:
        x = optimizer.ask()
        evaluation = land.evaluate(x, False)
        optimizer.tell(x, evaluation.value, evaluation.residuals)
        y += evaluation.value.tolist()
    best = np.minimum.accumulate(y)
    run = small[0].runs["random"][2]
    assert [run.at(call) for call in range(1, 46)] == best.tolist()
    assert run.at(0) == np.inf
    assert run.first(best[20]) == 1 + np.flatnonzero(best <= best[20])[0]
    assert run.first(0.0) == np.inf


def test_excess_is_measured_from_the_global_optimum(small):
    finished = small[0]
    assert finished.optimum == pytest.approx(2.97426794, abs=1e-7)
    assert finished.found_by == "many-start least squares"
    assert (finished.excess("random", 45) > 0.01).all()
    assert np.abs(finished.excess("least-squares", 10**6)).max() < 1e-8


def test_the_table_holds_the_statistics_of_the_runs(small):
    finished = small[0]
    table = finished.table().set_index("method")
    assert list(table.index) == ["random", "gwo@60", "sgwo-im", "least-squares"]
    assert list(table["uses"]) == ["value"] * 3 + ["value+residuals+jacobian"]
    assert list(table["rt_calls"][:3]) == [45, 60, 45]
    end = finished.excess("sgwo-im", 45)
    row = table.loc["sgwo-im"]
    assert row["median_excess_db_end"] == pytest.approx(np.median(end))
    assert row["q25_excess_db_end"] == pytest.approx(np.quantile(end, 0.25))
    assert row["worst_excess_db_end"] == end.max()
    assert row["median_excess_db_30"] == pytest.approx(np.median(finished.excess("sgwo-im", 30)))
    assert np.isnan(row["median_excess_db_60"])  # beyond its budget
    assert np.isfinite(table.loc["gwo@60", "median_excess_db_60"])
    assert row["reached_0.05_db"] == (end <= 0.05).sum()
    assert (table["failed"] == 0).all()
    assert table.loc["least-squares", "reached_0.01_db"] == 3
    calls = table.loc["least-squares", "calls_to_0.01_db"]
    assert np.median(finished.calls_to("least-squares", 0.01)) == calls


def test_an_excess_that_half_of_the_runs_never_reached_has_no_median():
    runs = tuple(
        MethodRun("random", 30, seed, 30, (1,), (value,), 0.1)
        for seed, value in enumerate([1.0, 1.0, 3.0, 3.0])
    )
    finished = Comparison("x", (BudgetedMethod.parse("random", 30),), {"random": runs}, 1.0, "random, seed 0")
    row = finished.table().iloc[0]
    assert row["reached_0.05_db"] == 2
    assert np.isnan(row["calls_to_0.05_db"])
    cells = render_table(finished)
    assert cells.rows[0][cells.headings.index("calls to 0.05 dB")] == "- (2/4)"


def test_finished_runs_are_not_repeated(small, monkeypatch):
    finished, out = small
    text = (out / "runs.jsonl").read_text()

    def refuse(*_):
        raise AssertionError("ran again")

    monkeypatch.setattr(BudgetedMethod, "run", refuse)
    monkeypatch.setattr(module, "_search_optimum", refuse)
    again = compare(STREET, parse_methods(["random", "sgwo-im"], 45), seeds=2, out=out)
    assert again.runs == {name: finished.runs[name][:2] for name in ("random", "sgwo-im")}
    # A method that stops by itself has the same run at every budget.
    other = compare(STREET, parse_methods(["least-squares"], 60), seeds=2, out=out)
    assert other.runs == {"least-squares": finished.runs["least-squares"][:2]}
    assert (out / "runs.jsonl").read_text() == text


def test_a_killed_comparison_continues_after_its_last_whole_line(small, tmp_path):
    lines = (small[1] / "runs.jsonl").read_text().splitlines(keepends=True)
    torn = "".join(lines[:5]) + lines[5][: len(lines[5]) // 2]
    (tmp_path / "runs.jsonl").write_text(torn)
    steps = []
    methods = ["random", "gwo@60", "sgwo-im", "least-squares"]
    again = compare(
        STREET, parse_methods(methods, 45), seeds=3, out=tmp_path, progress=lambda *step: steps.append(step)
    )
    assert steps == [("comparing", done, 12) for done in range(6, 13)]
    assert pd.DataFrame(again.history()).equals(small[0].history())


def _failing(kind):
    """A problem whose evaluations fail in the way named by `kind`."""
    land = landscape_problem("street")

    def evaluate(x, derivatives):
        if kind == "dies" and current_process().name != "MainProcess":
            os._exit(9)
        if kind == "raises":
            raise RuntimeError("no engine")
        return land.evaluate(x, derivatives)._replace(value=np.full(len(x), np.inf))

    return replace(land, evaluate=evaluate, minimum=np.inf)


def test_failed_runs_are_repeated(small, tmp_path, monkeypatch):
    methods = parse_methods(["random"], 45)
    with monkeypatch.context() as patch:
        patch.setattr(
            BudgetedMethod,
            "run",
            lambda method, _, seed: MethodRun(*method.key(seed), 0, (), (), 0.0, "MemoryError: full"),
        )
        patch.setattr(
            module,
            "_search_optimum",
            lambda _: MethodRun("optimum", 0, 0, 0, (), (), 0.0, "MemoryError: full"),
        )
        failed = compare(STREET, methods, seeds=2, out=tmp_path)
    assert len(failed.failures()) == 2
    again = compare(STREET, methods, seeds=2, out=tmp_path)
    assert again.failures() == []
    assert [run.best for run in again.runs["random"]] == [run.best for run in small[0].runs["random"][:2]]
    assert again.found_by == "many-start least squares"
    assert failed.found_by == "earlier searches (many-start least squares failed: MemoryError: full)"


@pytest.mark.parametrize(
    ("kind", "workers", "message"),
    [
        ("dies", 2, "a worker process died, perhaps because memory ran out; run the comparison again"),
        ("raises", 1, r"street: no evaluation of any run succeeded \(RuntimeError: no engine\)"),
        ("is infinite", 1, r"no evaluation of any run succeeded \(the objective is infinite\)"),
    ],
)
def test_a_comparison_without_any_result_ends_with_its_cause(kind, workers, message, tmp_path):
    with pytest.raises(EngineError, match=message):
        compare(
            partial(_failing, kind),
            parse_methods(["random"], 24),
            seeds=2,
            out=tmp_path,
            workers=workers,
        )


WORKER = """
import os, sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from calibray.comparison import comparison

if __name__ == "__main__":
    with ProcessPoolExecutor(1, get_context("spawn"), comparison._start, (int,)) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        sys.stdin.read()
"""


def test_workers_end_with_a_killed_comparison(tmp_path):
    (tmp_path / "program.py").write_text(WORKER)
    command = [sys.executable, str(tmp_path / "program.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        worker = psutil.Process(int(process.stdout.readline()))
        process.kill()
        worker.wait(60)
    assert not worker.is_running()


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x00", b"[1]\n", b'{"problem": "PROBLEM"}\n', b'{"runs": 1}\n']
)
def test_a_file_of_something_else_is_refused(content, tmp_path):
    (tmp_path / "runs.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=r"runs\.jsonl: contains something other than finished runs"):
        RunFile(tmp_path / "runs.jsonl", "PROBLEM")


def test_runs_of_another_problem_do_not_count(small):
    path = small[1] / "runs.jsonl"
    problem = json.loads(path.read_text().splitlines()[0])["problem"]
    assert RunFile(path, problem).find(("random", 45, 0)) is not None
    assert RunFile(path, problem + "x").find(("random", 45, 0)) is None
    assert landscape_problem("hall").fingerprint != STREET().fingerprint


def test_several_workers_give_the_same_runs(small, tmp_path):
    methods = ["random", "gwo@60"]
    spread = compare(STREET, parse_methods(methods, 45), seeds=2, out=tmp_path, workers=2)
    for name in methods:
        assert [run.best for run in spread.runs[name]] == [run.best for run in small[0].runs[name][:2]]


def test_one_method_at_one_budget_runs_once_whatever_it_is_called():
    methods = parse_methods(["gwo", "gwo@600", "random", "gwo@300"], 600)
    assert [method.name for method in methods] == ["gwo", "random", "gwo@300"]


def test_a_failed_run_is_kept_with_its_last_value(tmp_path, monkeypatch):
    class Broken:
        uses, schedule, takes_starts = RandomSearch.uses, RandomSearch.schedule, False
        within, needs_derivatives = RandomSearch.within, RandomSearch.needs_derivatives

        def __init__(self, lower, upper, *, seed, budget):
            if seed == 1:
                raise ZeroDivisionError("at once")
            self._inner = RandomSearch(lower, upper, seed=seed, budget=budget)
            self._left = 1

        done = property(lambda self: self._inner.done)

        def ask(self):
            return self._inner.ask()[:10]

        def tell(self, *evaluation, **more):
            if not self._left:
                raise RuntimeError("singular")
            self._left -= 1
            self._inner.tell(*evaluation, **more)

    monkeypatch.setitem(METHODS, "broken", Broken)
    finished = compare(STREET, parse_methods(["broken", "random"], 30), seeds=2, out=tmp_path)
    late, early = finished.runs["broken"]
    assert finished.failures() == [
        ("broken", 0, "RuntimeError: singular"),
        ("broken", 1, "ZeroDivisionError: at once"),
    ]
    assert late.evaluations == 10
    assert late.at(30) == late.at(10) == min(late.best)
    assert early.at(30) == np.inf
    row = finished.table().iloc[0]
    assert (row["failed"], row["worst_excess_db_end"]) == (2, np.inf)
    assert figure(finished).axes
    assert "none" in render_table(finished).rows[0]


def test_a_lower_minimum_known_beforehand_is_the_optimum(tmp_path, monkeypatch):
    monkeypatch.setattr(
        module, "_search_optimum", lambda problem: MethodRun("optimum", 0, 0, 1, (1,), (99.0,), 0.0)
    )
    finished = compare(STREET, parse_methods(["random"], 30), seeds=1, out=tmp_path)
    assert (finished.optimum, finished.found_by) == (2.97426794, "earlier searches")


def test_a_run_below_the_optimum_becomes_the_optimum(tmp_path, monkeypatch):
    monkeypatch.setattr(
        module, "_search_optimum", lambda problem: MethodRun("optimum", 0, 0, 1, (1,), (99.0,), 0.0)
    )
    finished = compare(
        lambda: replace(STREET(), minimum=np.inf), parse_methods(["random"], 30), seeds=2, out=tmp_path
    )
    lowest = [run.at(30) for run in finished.runs["random"]]
    assert finished.optimum == min(lowest)
    assert finished.found_by == f"random, seed {int(np.argmin(lowest))}"
    assert finished.excess("random", 30).min() == 0.0


def test_the_figure_shows_medians_and_quartiles_within_each_budget(small):
    (axes,) = figure(small[0]).axes
    by_name = {line.get_label(): line for line in axes.lines}
    assert list(by_name) == ["random", "GWO, 60 calls", "SGWO-IM", "least-squares"]
    assert axes.get_yscale() == "log"
    middle = by_name["SGWO-IM"]
    assert middle.get_xdata()[-1] == 45
    assert middle.get_ydata()[29] == pytest.approx(np.median(small[0].excess("sgwo-im", 30)))
    assert by_name["least-squares"].get_ydata().min() >= FLOOR_DB
    assert len(axes.collections) == 4


def test_markdown_has_a_row_for_each_method(small):
    lines = render_markdown(render_table(small[0])).splitlines()
    assert len(lines) == 2 + 4
    assert len({line.count("|") for line in lines}) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ["gwoo"]}, "method 'gwoo': there is no such method; did you mean 'gwo'"),
        (
            {"names": ["gwo@x"]},
            "'gwo@x': the budget x must be a whole number of RT calls from 24 to 1,000,000",
        ),
        ({"names": ["gwo@-60"]}, "the budget -60 must be"),
        ({"names": ["gwo@"]}, "'gwo@': the budget  must be a whole number"),
        ({"names": ["least-squares@60"]}, "least-squares stops by itself and has no budget; omit @60"),
        ({"names": ["gwo"], "budget": 10}, "the budget 10 must be"),
        ({"names": []}, "the list is empty"),
        ({"seeds": 0}, "seeds = 0: must be 1 to 10,000"),
        ({"workers": 0}, "workers = 0"),
    ],
)
def test_impossible_comparisons_are_refused(arguments, message, tmp_path):
    def compared(names=("gwo",), budget=225, **settings):
        return compare(STREET, parse_methods(names, budget), **settings, out=tmp_path / "new")

    with pytest.raises(InputError, match=message):
        compared(**arguments)
    assert not (tmp_path / "new").exists()


def test_a_run_on_a_study_equals_its_calibration(study):
    options = "{ population = 6, iterations = 8, full_iterations = 3 }"
    study.write_text(f'{study.read_text()}[method]\nname = "sgwo-im"\nseed = 1\noptions = {options}\n')
    result = calibrate(Study.load(study))
    problem = study_problem(study)
    run = run_optimizer(
        problem,
        ("sgwo-im", 43, 1),
        lambda: SGWOIM(problem.lower, problem.upper, seed=1, population=6, iterations=8, full_iterations=3),
    )
    assert run.failure == ""
    assert run.evaluations == len(result.history) == 43
    assert [run.at(call) for call in range(1, 44)] == result.history["best_db"].tolist()


def test_derivatives_of_a_study_equal_finite_differences_in_search_coordinates(study):
    problem = study_problem(study)
    x = 0.4 * problem.lower + 0.6 * problem.upper
    jacobian = problem.evaluate(x[None], True).jacobian
    for k in range(len(x)):
        step = 1e-5 * np.eye(len(x))[k]
        (up, down) = problem.evaluate(np.array([x + step, x - step]), False)[1]
        assert jacobian[0, :, k] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-6)


def test_the_fingerprint_depends_on_all_that_changes_an_evaluation(study):
    """Otherwise runs on other data would count as finished ones."""
    # A stated noise needs no preliminary fits.
    links = study.with_name("links.csv")
    text = study.read_text(encoding="utf-8") + "[noise]\nstd_db = 1.0\n"
    table = pd.read_csv(links).assign(spread_ns=5.0)
    table.to_csv(links, index=False)
    section = '[observables.spread]\nkind = "rms_delay_spread"\ncolumn = "spread_ns"\nunit = "ns"\nbandwidth = 1e8\n'
    observed = f"{text}{section}"
    study.write_text(observed, encoding="utf-8")
    fingerprints = [study_problem(study).fingerprint]
    study.write_text(f"{observed}[method]\nseed = 3\n", encoding="utf-8")
    assert study_problem(study).fingerprint == fingerprints[0]
    for column, change in (("path_loss_db", 0.5), ("spread_ns", 2.0)):
        table.loc[0, column] += change
        table.to_csv(links, index=False)
        fingerprints.append(study_problem(study).fingerprint)
    study.write_text(f"{text}[engine]\ncompress_db = 0.1\n", encoding="utf-8")
    fingerprints.append(study_problem(study).fingerprint)
    study.write_text(f"{text}[engine]\ncompress_db = 0.5\n", encoding="utf-8")
    fingerprints.append(study_problem(study).fingerprint)
    assert len(set(fingerprints)) == 5


def test_the_command_writes_tables_and_figure(study, tmp_path):
    out = tmp_path / "out"
    arguments = ["compare", str(study), "--out", str(out), "--seeds", "2", "--budget", "24"]
    done = CliRunner().invoke(app, [*arguments, "--methods", "random, sgwo-im,least-squares"])
    assert done.exit_code == 0, done.output
    assert "SGWO-IM" in done.stdout
    assert "found by" in done.stdout
    table, runs = (pd.read_csv(out / name) for name in FILES[:2])
    assert list(table["method"]) == ["random", "sgwo-im", "least-squares"]
    assert set(runs["seed"]) == {0, 1}
    assert runs.groupby(["method", "seed"])["best_db"].apply(lambda best: best.is_monotonic_decreasing).all()
    assert (out / FILES[2]).read_bytes()[:4] == b"\x89PNG"
    assert "6 runs with at most 96 RT calls in total, not counting least-squares" in done.stderr
    for faulty in (["--methods", "nothing"], ["--workers", "0"], ["--seeds", "0"]):
        refused = CliRunner().invoke(app, [*arguments, "--overwrite", *faulty])
        assert refused.exit_code == 2
        assert "in total" not in refused.stderr


def test_methods_are_not_compared_on_an_external_program(study):
    study.write_text(study.read_text() + '[engine]\nname = "command"\ncommand = ["true"]\n')
    with pytest.raises(InputError, match="engine 'command' is too expensive"):
        study_problem(study)
