"""Methods on a family: data profiles, going on after a kill, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from calibray.cli.app import app
from calibray.comparison.contestant import Contender, code
from calibray.comparison.run_log import MethodRun
from calibray.errors import EngineError, InputError
from problem_families import comparison as module
from problem_families.arenas import landscape_arena
from problem_families.comparison import FamilyComparison, compare_family, seed_range
from problem_families.tables import tables


@pytest.fixture
def streets(monkeypatch):
    """Landscapes in closed form in place of planted problems; the list of problems opened."""
    opened = []

    def arena(kind, seed):
        opened.append(seed)
        street = landscape_arena("street")
        return replace(street, name=f"{kind}-{seed}", fingerprint=f"{street.fingerprint}-{seed}")

    module._opened.cache_clear()
    monkeypatch.setattr(module, "family_arena", arena)
    yield opened
    module._opened.cache_clear()


def finished(*curves: tuple[float, ...]) -> FamilyComparison:
    """Runs that improve at every call, one a problem whose optimum is 1 dB."""
    runs = tuple(
        (MethodRun("random", 10, 0, len(best), tuple(range(1, len(best) + 1)), best, 0.1),) for best in curves
    )
    contender = Contender("random", "random", 10)
    return FamilyComparison(
        "district", (0, 1, 2), (contender,), {"random": runs}, np.ones(3), np.arange(3) == 1
    )


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


def test_problems_are_taken_apart_and_joined():
    comparison = finished((2.0, 1.04), (1.5, 1.3, 1.005), (1.01,))
    wrong, right = (comparison.part(chosen) for chosen in (comparison.misinformed, ~comparison.misinformed))
    assert (wrong.seeds, right.seeds) == ((1,), (0, 2))
    assert [wrong.solved("random", 3, 0.02), right.solved("random", 3, 0.02)] == [1.0, 0.5]
    both = FamilyComparison.joined([right, wrong])
    assert both.seeds == (0, 2, 1)
    assert both.excess("random", 3).ravel() == pytest.approx(
        comparison.excess("random", 3)[[0, 2, 1]].ravel()
    )
    assert both.misinformed.tolist() == [False, False, True]


def test_a_problem_that_cannot_be_made_is_named_and_the_others_are_run(streets, tmp_path, monkeypatch):
    made = module.family_arena

    def arena(kind, seed):
        if seed == 3:
            raise EngineError("the tracer fell over")
        return made(kind, seed)

    monkeypatch.setattr(module, "family_arena", arena)
    finished = compare_family("district", (2, 3, 4), ["random"], budget=8, out=tmp_path)
    assert finished.seeds == (2, 4)
    assert finished.unmade == ((3, "the tracer fell over"),)
    with pytest.raises(InputError, match="fell over"):
        compare_family("district", (3,), ["random"], budget=8, out=tmp_path)


def test_finished_runs_are_not_run_again(streets, tmp_path):
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


def test_the_code_of_a_method_is_what_it_imports():
    assert code("random") != code("gwo") != code("sgwo-im")
    assert code() not in {code(name) for name in ("random", "gwo")}


@pytest.mark.parametrize(
    ("text", "expected"), [("3", range(3)), ("5:7", range(5, 7)), (" 1000:1020 ", range(1000, 1020))]
)
def test_seeds_are_a_number_or_a_range(text, expected):
    assert seed_range(text) == expected


@pytest.mark.parametrize("text", ["", "0", "7:5", "-1", "1:2:3", "a", "²", "0:99999999"])
def test_what_are_no_seeds_is_refused(text):
    with pytest.raises(InputError, match="seeds"):
        seed_range(text)


def test_the_command_takes_a_family_or_a_study(streets, tmp_path):
    out = ["--out", str(tmp_path), "--methods", "random,latin-hypercube", "--budget", "30"]
    done = CliRunner().invoke(app, ["compare", "--family", "district", "--seeds", "4:6", *out])
    assert done.exit_code == 0, done.output
    assert "latin-hypercube" in done.stdout
    assert set(streets) == {4, 5}
    assert (tmp_path / "family.csv").read_text().count("\n") == 1 + 2 * 3
    for wrong in ([], ["--family", "district", "study.toml"], ["study.toml", "--seeds", "2:4"]):
        refused = CliRunner().invoke(app, ["compare", *wrong, *out])
        assert refused.exit_code == 2, refused.output
    dear = CliRunner().invoke(
        app, ["compare", "--family", "district", "--methods", "dfo-ls,nothing", *out[:2]]
    )
    assert dear.exit_code == 2
