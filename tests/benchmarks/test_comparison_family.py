"""Methods on a family of planted problems: data profiles, continuing after a kill, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from calibray.comparison.method_runs import BudgetedMethod, MethodRun
from calibray.errors import EngineError, InputError
from problem_families import family_comparison as module
from problem_families.family_comparison import (
    FamilyComparison,
    compare_family,
    method_fingerprint,
    seed_range,
    tables,
)
from problem_families.problems import landscape_problem


@pytest.fixture
def streets(monkeypatch):
    """Landscapes in closed form instead of planted problems."""

    def landscape(kind, seed):
        street = landscape_problem("street")
        return replace(street, name=f"{kind}-{seed}", fingerprint=f"{street.fingerprint}-{seed}")

    module._opened.cache_clear()
    monkeypatch.setattr(module, "planted_problem", landscape)
    yield
    module._opened.cache_clear()


def finished(*curves: tuple[float, ...]) -> FamilyComparison:
    """Runs that improve at every call, one for each problem; the optimum of each is 1 dB."""
    runs = tuple(
        (MethodRun("random", 10, 0, len(best), tuple(range(1, len(best) + 1)), best, 0.1),) for best in curves
    )
    method = BudgetedMethod("random", "random", 10)
    return FamilyComparison("district", (0, 1, 2), (method,), {"random": runs}, np.ones(3), np.arange(3) == 1)


def test_a_data_profile_is_the_share_of_problems_within_the_tolerance():
    comparison = finished((2.0, 1.04), (1.5, 1.3, 1.005), (1.01,))
    assert [comparison.solved("random", calls, 0.05) for calls in (1, 2, 3, 8)] == pytest.approx(
        [1 / 3, 2 / 3, 1.0, 1.0]
    )
    assert comparison.solved("random", 8, 0.001) == 0.0
    row = comparison.table().iloc[0]
    assert row["calls"] == 8
    assert row["median_excess_db"] == pytest.approx(0.01)
    assert row["p90_excess_db"] == pytest.approx(0.01 + 0.8 * 0.03)
    assert row["worst_excess_db"] == pytest.approx(0.04)


def test_parts_and_joins_keep_problems_and_runs_together():
    comparison = finished((2.0, 1.04), (1.5, 1.3, 1.005), (1.01,))
    wrong, right = (
        comparison.part(mask) for mask in (comparison.wrong_constants, ~comparison.wrong_constants)
    )
    assert (wrong.seeds, right.seeds) == ((1,), (0, 2))
    assert [wrong.solved("random", 3, 0.02), right.solved("random", 3, 0.02)] == [1.0, 0.5]
    both = FamilyComparison.joined([right, wrong])
    assert both.seeds == (0, 2, 1)
    assert both.excess("random", 3).ravel() == pytest.approx(
        comparison.excess("random", 3)[[0, 2, 1]].ravel()
    )
    assert both.wrong_constants.tolist() == [False, False, True]


def test_only_problems_whose_cheap_model_has_such_constants_are_run(streets, tmp_path, monkeypatch):
    landscape = module.planted_problem
    monkeypatch.setattr(
        module,
        "planted_problem",
        lambda kind, seed: replace(landscape(kind, seed), wrong_constants=seed == 3),
    )
    for wanted, seeds in ((True, (3,)), (False, (2, 4)), (None, (2, 3, 4))):
        chosen = compare_family(
            "district", (2, 3, 4), ["random"], budget=8, out=tmp_path, wrong_constants=wanted
        )
        assert chosen.seeds == seeds
    with pytest.raises(InputError, match="no problem of these seeds"):
        compare_family("district", (2, 4), ["random"], budget=8, out=tmp_path, wrong_constants=True)


def test_a_problem_that_cannot_be_made_is_reported_and_the_others_are_run(streets, tmp_path, monkeypatch):
    landscape = module.planted_problem

    def failing(kind, seed):
        if seed == 3:
            raise EngineError("the tracer failed")
        return landscape(kind, seed)

    monkeypatch.setattr(module, "planted_problem", failing)
    finished = compare_family("district", (2, 3, 4), ["random"], budget=8, out=tmp_path)
    assert finished.seeds == (2, 4)
    assert finished.failed_problems == ((3, "the tracer failed"),)
    with pytest.raises(InputError, match="the tracer failed"):
        compare_family("district", (3,), ["random"], budget=8, out=tmp_path)


def test_finished_runs_are_not_repeated(streets, tmp_path):
    first = compare_family("district", (0, 1), ["random", "sgwo-im"], budget=30, repeats=2, out=tmp_path)
    lines = (tmp_path / "runs.jsonl").read_text().splitlines()
    assert len(lines) == 8
    again = compare_family("district", (0, 1), ["random", "sgwo-im"], budget=30, repeats=2, out=tmp_path)
    assert (tmp_path / "runs.jsonl").read_text().splitlines() == lines
    assert again.runs == first.runs
    compare_family("district", (0, 2), ["random"], budget=30, out=tmp_path)
    assert len((tmp_path / "runs.jsonl").read_text().splitlines()) == 9
    assert (first.excess("random", 30) >= 0.0).all()
    assert [len(table.rows) for table in tables(first)] == [2, 2, 2, 2]


def test_the_fingerprint_of_a_methods_code_covers_what_it_imports():
    assert len({method_fingerprint(name) for name in ("random", "gwo", "dfo-ls", "space-mapping")}) == 4
    assert method_fingerprint("gwo") == method_fingerprint("sgwo-im")  # one module has both


@pytest.mark.parametrize(
    ("text", "expected"), [("3", range(3)), ("5:7", range(5, 7)), (" 1000:1020 ", range(1000, 1020))]
)
def test_seeds_are_a_number_or_a_range(text, expected):
    assert seed_range(text) == expected


@pytest.mark.parametrize("text", ["", "0", "7:5", "-1", "1:2:3", "a", "²", "0:99999999"])
def test_malformed_seeds_are_refused(text):
    with pytest.raises(InputError, match="seeds"):
        seed_range(text)
