"""Benchmarks that continue where they stopped."""

import misfit
from finished_runs import append_run, read_runs


def test_runs_with_other_settings_do_not_count_and_a_torn_line_is_removed(tmp_path):
    file = tmp_path / "runs.jsonl"
    assert read_runs(None, {}) == read_runs(file, {}) == []
    for seed, spread in ((0, None), (1, None), (1, 0.3)):
        append_run(file, {"seed": seed, "constants_spread": spread, "repetition": 0})
    append_run(None, {"seed": 2})
    with file.open("a") as stream:
        stream.write('{"seed": 1, "constants_spread": nu')
    runs = read_runs(file, {"seed": 1, "constants_spread": None})
    assert runs == [{"seed": 1, "constants_spread": None, "repetition": 0}]
    append_run(file, {"seed": 3})
    assert len(read_runs(file, {})) == 4


def test_a_misfit_benchmark_counts_only_runs_of_its_seed_settings_districts_and_worlds(
    tmp_path, monkeypatch, capsys
):
    def repetition(world, seed, spread, *, draws, choice):
        nothing = dict.fromkeys(("verdicts", "inside", "held", "remarks"), ())
        return {"seconds": float(seed), "links": 40, **nothing}

    monkeypatch.setattr(misfit, "repetition", repetition)
    monkeypatch.setattr(misfit, "make", lambda name, folder, worlds: dict.fromkeys(worlds))

    def seconds(*words: str) -> dict[str, str]:
        """Number of runs and their mean time by world."""
        monkeypatch.setattr("sys.argv", ["misfit.py", "--out", str(tmp_path / "runs.jsonl"), *words])
        misfit.main()
        rows = [line.split() for line in capsys.readouterr().out.splitlines()]
        return {row[0]: (row[-20], row[-1]) for row in rows if row[:1] in (["all"], ["thickness"])}

    words = ("--districts", "district-1", "--repetitions", "2", "--worlds", "thickness")
    assert seconds(*words, "--seed", "1")["all"] == ("2", "1000.5")
    assert seconds(*words, "--seed", "2")["all"] == ("2", "2000.5")
    assert seconds(*words, "--seed", "2", "--no-choice")["all"] == ("2", "2000.5")
    assert len(read_runs(tmp_path / "runs.jsonl", {})) == 6
    other = ("--districts", "district-2", "--repetitions", "1", "--worlds", "nothing")
    assert seconds(*other, "--seed", "2")["all"] == ("1", "2000.0")
    assert seconds(*words, "--seed", "2")["all"] == ("2", "2000.5")
    assert len(read_runs(tmp_path / "runs.jsonl", {})) == 7
