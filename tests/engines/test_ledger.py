"""The ledger: nothing that was paid for is lost or paid for twice, whatever happens to the run."""

from __future__ import annotations

import random
import sqlite3
import subprocess
import sys
from contextlib import closing

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import planted
import programs
import restarts
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.cli.app import app
from calibray.engines import Answer, Ledger, Recorded, fingerprint
from calibray.engines.ledger.database import LedgerEntry, key
from calibray.errors import EngineError, InputError
from calibray.parameters import Parameter, Parameters
from calibray.study import Study
from commands import numbers_of_draws

CANDIDATES = np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5], [3.0, 4.0, 5.0]])
PARAMETERS = Parameters(tuple(Parameter(name, 1.0, 12.0, 5.0) for name in planted.TRUTH))
SGWOIM = "{ population = 5, iterations = 6, full_iterations = 2, elites = 2 }"


@pytest.fixture
def ledger(tmp_path):
    """An empty ledger."""
    with closing(Ledger(tmp_path / "ledger.sqlite")) as ledger:
        ledger.describe("p", "command", ("a", "b"))
        yield ledger


class Counting:
    """An engine that counts, answers a sum, and fails where it is told to, by its own fault unless `lost`."""

    def __init__(self, fails: tuple[float, ...] = (), lost: bool = False) -> None:
        self.parameters, self.materials = PARAMETERS, {}
        self.calls, self.num_links, self.fails, self.lost = 0, 2, fails, lost

    def answers(self, candidates, stop=None):
        for index in reversed(range(len(candidates))):  # out of order, as a pool's are
            self.calls += 1
            total = candidates[index].sum()
            if total in self.fails:
                yield Answer(index, np.full(2, np.inf), 0.5, "it failed", lost=self.lost)
            else:
                yield Answer(index, np.array([total, np.inf]), 0.5)

    def path_loss(self, candidates):
        raise NotImplementedError


def test_an_entry_comes_back_bit_for_bit(ledger):
    loss = np.array([0.1 + 0.2, np.inf, -1e-310])
    assert ledger.find("p", key(np.array([0.3, 1.0])), 3) is None
    ledger.commit("p", key(np.array([0.3, 1.0])), LedgerEntry(loss, 1.5))
    with closing(Ledger(ledger.path)) as other:
        found = other.find("p", key(np.array([0.3, 1.0])), 3)
    assert (found.path_loss_db.tolist(), found.seconds, found.failure) == (loss.tolist(), 1.5, "")
    assert ledger.find("p", key(np.array([0.1 + 0.2, 1.0])), 3) is None  # another double
    assert ledger.find("q", key(np.array([0.3, 1.0])), 3) is None


def test_zero_has_no_sign_in_a_key():
    assert key(np.array([-0.0])) == key(np.array([0.0])) != key(np.array([5e-324]))


def test_the_first_of_two_answers_stays(ledger):
    here = key(np.array([1.0, 2.0]))
    assert ledger.commit("p", here, LedgerEntry(np.array([70.0]), 1.0)).path_loss_db.tolist() == [70.0]
    with closing(Ledger(ledger.path)) as other:
        assert other.commit("p", here, LedgerEntry(np.array([71.0]), 1.0)).path_loss_db.tolist() == [70.0]
    assert len(ledger.table()) == 1


def test_what_was_run_is_not_run_again(ledger):
    engine = Recorded(Counting(), ledger, "r", "command")
    assert isinstance(engine, engines.Engine)
    loss = engine.path_loss(CANDIDATES)
    assert loss.tolist() == [[12.0, np.inf], [12.5, np.inf], [12.0, np.inf]]
    assert (engine.calls, engine.hits) == (2, 1)
    again = Recorded(Counting(), ledger, "r", "command")
    assert again.path_loss(CANDIDATES[1:]).tolist() == loss[1:].tolist()
    assert (again.calls, again.hits) == (0, 2)
    other = Recorded(Counting(), ledger, "s", "command")  # another problem
    other.path_loss(CANDIDATES)
    assert (other.calls, other.hits) == (2, 1)


def test_a_failure_is_kept_until_it_is_taken_out(ledger):
    engine = Recorded(Counting(fails=(12.5,)), ledger, "r", "command")
    assert np.isinf(engine.path_loss(CANDIDATES)[:, 0]).tolist() == [False, True, False]
    mended = Recorded(Counting(), ledger, "r", "command")
    assert np.isinf(mended.path_loss(CANDIDATES)[:, 0]).tolist() == [False, True, False]
    assert sorted(ledger.table().status) == ["failed", "ok"]
    assert ledger.forget_failures() == 1
    assert mended.path_loss(CANDIDATES)[:, 0].tolist() == [12.0, 12.5, 12.0]
    assert mended.calls == 1


def test_a_call_that_was_lost_with_its_worker_is_repeated_by_the_next_run(ledger):
    engine = Recorded(Counting(fails=(12.5,), lost=True), ledger, "r", "command")
    assert np.isinf(engine.path_loss(CANDIDATES)[:, 0]).tolist() == [False, True, False]
    assert ledger.table().status.tolist() == ["ok"]
    again = Recorded(Counting(), ledger, "r", "command")
    assert again.path_loss(CANDIDATES)[:, 0].tolist() == [12.0, 12.5, 12.0]
    assert (again.calls, again.hits) == (1, 2)


def test_the_first_failed_call_is_reported_with_its_reason_and_where_to_list_them(ledger, caplog):
    engine = Recorded(Counting(fails=(12.5,)), ledger, "r", "command")
    for _ in range(2):
        engine.path_loss(CANDIDATES)
    (message,) = [record.getMessage() for record in caplog.records]
    assert message.startswith(
        "an RT call failed, so all links count as links without a path for its candidate; list failed "
    )
    assert f"calibray ledger {ledger.path.parent}, or add --forget-failed" in message
    assert message.endswith("The failed call: it failed")


def test_an_engine_that_never_worked_leaves_nothing_behind(ledger):
    with pytest.raises(EngineError, match="it failed; all 3 candidates of the first batch failed"):
        Recorded(Counting(fails=(12.0, 12.5)), ledger, "r", "command").path_loss(CANDIDATES)
    assert len(ledger.table()) == 0
    mended = Recorded(Counting(), ledger, "r", "command")
    assert mended.path_loss(CANDIDATES)[0, 0] == 12.0


def test_a_batch_that_is_interrupted_keeps_what_had_arrived(ledger):
    class Interrupted(Counting):
        def answers(self, candidates, stop=None):
            yield next(super().answers(candidates))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Recorded(Interrupted(), ledger, "r", "command").path_loss(CANDIDATES[:2])
    assert len(ledger.table()) == 1
    resumed = Recorded(Counting(), ledger, "r", "command")
    resumed.path_loss(CANDIDATES[:2])
    assert (resumed.calls, resumed.hits) == (1, 1)


WRITER = """
import sys, numpy as np
from calibray.engines import Ledger, LedgerEntry, key
name, first = sys.argv[2], int(sys.argv[3])
ledger = Ledger(sys.argv[1])
ledger.describe("shared", "command", ["a"])
for k in range(first, first + 150):
    ledger.commit("shared", key(np.array([float(k)])), LedgerEntry(np.array([float(k), len(name)]), 0.0))
"""


def test_two_runs_write_to_one_ledger_at_once(tmp_path):
    path = tmp_path / "ledger.sqlite"
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(path), name, first])
        for name, first in (("one", "0"), ("three", "100"))
    ]
    assert [writer.wait(120) for writer in writers] == [0, 0]
    with closing(Ledger(path)) as ledger:
        table = ledger.table(path_loss=True)
    assert sorted(table.a) == list(range(250))
    assert (table.a == table.link_1).all()
    assert set(table.link_2[table.a < 100]) == {3.0}
    assert set(table.link_2[table.a >= 150]) == {5.0}


@pytest.fixture(scope="module")
def runner():
    """A process that runs studies, with as few draws as this one."""
    with restarts.open_runner(numbers_of_draws()) as runner:
        yield runner


@pytest.mark.parametrize(
    ("method", "options", "workers"),
    [
        ("sgwo-im", SGWOIM, 0),
        ("random", "{ budget = 16 }", 3),
        ("vector-surrogate", "{ budget = 14, batch = 3 }", 3),
    ],
)
def test_a_run_that_is_killed_and_started_again_ends_as_an_undisturbed_one(
    runner, tmp_path, method, options, workers
):
    """Killed five times at random moments, mostly within a call.

    A call under way when its run is killed was never answered, so it must be made again: at most one for each kill
    and worker. No call that was committed is made again, none is lost, and none is committed twice.
    """
    folders = [tmp_path / "undisturbed", tmp_path / "killed"]
    for folder in folders:
        folder.mkdir()
        programs.study_file(folder, "import time; time.sleep(0.02)", method, options)
    undisturbed = restarts.finish(runner, folders[0], [], workers=workers)
    moments = sorted(random.Random(1).sample(range(1, len(undisturbed.asked) - workers), 5))
    killed = restarts.finish(runner, folders[1], moments, workers=workers)
    assert killed.kills == 5
    assert killed.result == undisturbed.result
    assert killed.repeated == undisturbed.repeated == 0
    assert len(undisturbed.asked) == len(set(undisturbed.asked)) == len(undisturbed.committed)
    assert set(killed.asked) == set(undisturbed.asked) == set(killed.committed)
    assert len(killed.committed) == len(undisturbed.committed)
    assert len(undisturbed.asked) <= len(killed.asked) <= len(undisturbed.asked) + 5 * max(workers, 1)


def test_calls_are_shared_by_methods_seeds_bounds_and_measured_values(tmp_path):
    first = programs.study_file(tmp_path, method="random", options="{ budget = 6 }")
    result = calibrate(first, out=tmp_path / "out")
    assert (result.rt_calls, result.cost.ledger_hits) == (6, 0)
    again = calibrate(first, out=tmp_path / "out")
    assert (again.rt_calls, again.cost.ledger_hits, again.parameters) == (6, 6, result.parameters)
    links = pd.read_csv(tmp_path / "links.csv")
    links.assign(path_loss_db=links.path_loss_db + 1).to_csv(tmp_path / "links.csv", index=False)
    measured_anew = calibrate(first, out=tmp_path / "out")
    assert measured_anew.cost.ledger_hits == 6
    assert measured_anew.rmse_db != result.rmse_db
    assert calibrate(first, seed=9, out=tmp_path / "out").cost.ledger_hits == 0
    assert len(programs.calls(tmp_path)) == 1 + 6 + 6
    links.assign(rx_z=links.rx_z + 1).to_csv(tmp_path / "links.csv", index=False)
    assert calibrate(first, out=tmp_path / "out").cost.ledger_hits == 0


def problem(study: Study) -> str:
    """The fingerprint of a study's problem."""
    return fingerprint(study.opened())


@pytest.mark.parametrize(
    ("old", "new", "shared"),
    [
        ("bounds = [1.5, 12.0] }", "bounds = [1.2, 12.0], start = 3.0 }", True),
        ('name = "random"', 'name = "sobol"', True),
        ("retries = 0", "retries = 1", True),
        ("[parameters]", "[materials]\nwood = { relative_permittivity = 3 }\n[parameters]", True),
        ("[parameters]", "[materials]\nwood = { thickness = 0.5 }\n[parameters]", False),
        ("[parameters]", '[objective]\ncombining = "coherent"\n[parameters]', False),
        ("[parameters]", '[antennas]\ntx = { pattern = "dipole" }\n[parameters]', False),
        ("max_depth = 1", "max_depth = 2", False),
        ("frequency = 3.5e9", "frequency = 3.6e9", False),
        ("simple_street_canyon", "simple_street_canyon_with_cars", False),
        ("'model.py'", "'other.py'", False),
        ('name = "command"', 'name = "retrace"', False),
        ("wood.relative_permittivity", "wood.conductivity", False),
    ],
)
def test_what_makes_another_problem(tmp_path, old, new, shared):
    study = programs.study_file(tmp_path, method="random", options="{ budget = 6 }")
    text = (tmp_path / "study.toml").read_text()
    assert old in text
    text = text.replace(old, new).replace(
        'conductivity" = { bounds = [1.5', 'conductivity" = { bounds = [0.0'
    )
    (tmp_path / "study.toml").write_text(text)
    assert (problem(Study.load(tmp_path / "study.toml")) == problem(study)) == shared


def test_the_command_lists_exports_and_takes_out(tmp_path):
    before = "if earlier == 3: sys.exit('no luck')"
    calibrate(programs.study_file(tmp_path, before, "random", "{ budget = 4 }"), out=tmp_path / "out")
    run = CliRunner().invoke(app, ["ledger", str(tmp_path / "out")])
    assert run.exit_code == 0
    lines = run.stdout.splitlines()
    assert lines[0].split()[:5] == ["problem", "engine", "time", "seconds", "status"]
    assert [("failed" in line) for line in lines[2:]] == [False, False, True, False, False]
    for name, read in (("calls.csv", pd.read_csv), ("calls.parquet", pd.read_parquet)):
        run = CliRunner().invoke(app, ["ledger", str(tmp_path / "out"), "-o", str(tmp_path / name)])
        assert run.exit_code == 0
        table = read(tmp_path / name)
        candidates = table[list(planted.TRUTH)].to_numpy()
        assert [tuple(row) for row in candidates] == programs.calls(tmp_path)
        loss = table[[f"link_{k}" for k in range(1, planted.LINKS + 1)]].to_numpy()
        works = table.status == "ok"
        assert loss[works] == pytest.approx(programs.expected(candidates, planted.links())[works])
        assert np.isinf(loss[~works]).all()
        assert table.message[~works].str.endswith("no luck").all()
    CliRunner().invoke(app, ["ledger", str(tmp_path / "out"), "--forget-failed"])
    with closing(engines.open_ledger(tmp_path / "out")) as ledger:
        assert ledger.table().status.tolist() == ["ok"] * 4


def test_a_file_that_is_no_ledger_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such ledger; give a folder"):
        engines.open_ledger(tmp_path)
    (tmp_path / "text").write_text("not a database, but long enough to be taken for one" * 50)
    with pytest.raises(InputError, match="cannot be used as a ledger"):
        Ledger(tmp_path / "text")
    with closing(sqlite3.connect(tmp_path / "later")) as later:
        later.execute("PRAGMA user_version = 7")
    with pytest.raises(InputError, match="a ledger of version 7"):
        Ledger(tmp_path / "later")


def test_calls_of_a_changed_program_are_used_again_with_a_warning(tmp_path, caplog):
    study, file, program = programs.study(tmp_path), tmp_path / "ledger.sqlite", tmp_path / "model.py"
    text = program.read_text()
    program.write_text("a fault, without stored calls")
    with pytest.raises(EngineError):
        engines.make(study, ledger=file).path_loss(CANDIDATES)
    program.write_text(text)
    loss = engines.make(study, ledger=file).path_loss(CANDIDATES)
    engines.make(study, ledger=file).path_loss(CANDIDATES)
    assert "changed after" not in caplog.text
    program.write_text(text.replace("return 60 +", "return 65 +"))
    assert engines.make(study, ledger=file).path_loss(CANDIDATES).tolist() == loss.tolist()
    (message,) = [text for text in caplog.messages if "changed after" in text]
    assert f"{file}: model.py changed after the RT calls of this study were stored" in message
    assert "use another folder, or delete the ledger" in message
