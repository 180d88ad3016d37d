"""The command engine against programs that work, and against programs that fail in every way."""

from __future__ import annotations

import json
import shlex
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing

import h5py
import numpy as np
import pytest

import planted
import programs
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.engines import Engine, Ledger
from calibray.engines.external.exchange import Unusable, read_answer
from calibray.engines.external.program import ExternalProgram, Outcome
from calibray.engines.ledger.database import LedgerEntry, key
from calibray.errors import EngineError, InputError
from calibray.study import Study

CANDIDATES = np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5], [7.5, 1.6, 11.0]])


def test_the_program_answers_for_every_candidate_and_link(tmp_path):
    engine = engines.make(programs.study(tmp_path))
    assert isinstance(engine, Engine)
    assert engine.path_loss(CANDIDATES) == pytest.approx(programs.expected(CANDIDATES, planted.links()))
    assert engine.calls == len(programs.calls(tmp_path)) == 3


def test_a_study_says_what_it_runs_before_it_does_so(tmp_path, caplog):
    """Once, with the whole command, and escaped: the study may be somebody else's."""
    spoken = "import pathlib; pathlib.Path('started').touch()"
    study = programs.study(tmp_path, spoken)
    engine = engines.make(study.replace())
    assert "runs a program" not in caplog.text
    for _ in range(2):
        engine.path_loss(CANDIDATES[:1])
    messages = [record.getMessage() for record in caplog.records if "runs a program" in record.getMessage()]
    (message,) = messages
    assert str(study.path) in message
    assert shlex.join(study.engine.command) in message
    caplog.clear()
    hidden = programs.study(tmp_path, command=[sys.executable, "-c", "raise SystemExit\x1b[2K\n# harmless"])
    with pytest.raises(EngineError):
        engines.make(hidden).path_loss(CANDIDATES[:1])
    text = next(record.getMessage() for record in caplog.records if "runs a program" in record.getMessage())
    assert text.isprintable()
    assert r"\x1b[2K\n# harmless" in text


def test_the_request_holds_the_whole_problem(tmp_path):
    keep = "import shutil; shutil.copy(request_file, 'kept.json')"
    engine = engines.make(programs.study(tmp_path, keep))
    engine.path_loss(CANDIDATES[:1])
    request = json.loads((tmp_path / "kept.json").read_text())
    assert (request["schema"], request["version"], request["frequency"]) == ("calibray.request", 1, 3.5e9)
    assert (request["bandwidth"], request["combining"]) == (None, "power")
    assert request["antennas"]["tx"]["pattern"] == "iso"
    assert np.shape(request["links"]["tx"]) == np.shape(request["links"]["rx"]) == (planted.LINKS, 3)
    materials = {entry["name"]: entry for entry in request["materials"]}
    assert set(materials) == set(engine.materials)
    assert materials["marble"]["relative_permittivity"] == 4.0
    assert materials["marble"]["conductivity"] == engine.materials["marble"].conductivity
    assert [entry["value"] for entry in request["parameters"]] == [3.0, 4.0, 5.0]
    assert [entry["name"] for entry in request["parameters"]] == list(engine.parameters.names)


def test_files_in_hdf5(tmp_path):
    folder = str(tmp_path)
    program = f"""
import sys, h5py, shutil
shutil.copy(sys.argv[2], {folder!r} + "/kept.h5")
with h5py.File(sys.argv[2]) as request, h5py.File(sys.argv[1], "w") as response:
    response["path_loss_db"] = 100 + request["links/rx"][:, 0] + request["parameters/values"][1]
"""
    (tmp_path / "model.py").write_text(program)
    programs.content(tmp_path)
    (tmp_path / "model.py").write_text(program)
    command = [sys.executable, "model.py", "{response}", "{request}"]
    study = programs.study(tmp_path, command=command, format="hdf5")
    (tmp_path / "model.py").write_text(program)
    loss = engines.make(study).path_loss(CANDIDATES[:1])[0]
    assert loss == pytest.approx(planted.links().rx_x + 104.0)
    with h5py.File(tmp_path / "kept.h5") as request:
        assert request.attrs["schema"] == "calibray.request"
        assert request["materials/marble"].attrs["relative_permittivity"] == 4.0
        assert request["links/tx"].shape == (planted.LINKS, 3)


@pytest.mark.parametrize(
    ("content", "num_links", "loss"),
    [
        ('{"path_loss_db": [70, 80.5]}', 2, [70, 80.5]),
        ('{"path_loss_db": [70, null, "inf", Infinity]}', 4, [70, np.inf, np.inf, np.inf]),
        ('{"path_loss_db": 70}', 1, [70]),
    ],
)
def test_answers_that_can_be_read(tmp_path, content, num_links, loss):
    (tmp_path / "response.json").write_text(content)
    assert read_answer(tmp_path / "response.json", "json", num_links)[0].tolist() == loss


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        ('{"path_loss_db": [70, 8', "not JSON"),
        ("[70, 80]", "no key 'path_loss_db'"),
        ('{"path_loss": [70, 80]}', "no key 'path_loss_db'$"),
        (
            '{"path": [0, 0], "point": [0, 1]}',
            r"no key 'path_loss_db'; the response is a ray table: set rays = true",
        ),
        ('[{"path": 0, "point": 0}]', r"no key 'path_loss_db'; the response is a ray table: set rays = true"),
        ('{"path_loss_db": [70]}', r"shape \(1,\); it must be \(2,\)"),
        ('{"path_loss_db": [[70, 80]]}', r"contains \[70, 80\] in path_loss_db, which is not a number"),
        ('{"path_loss_db": [70, NaN]}', r"path_loss_db\[1\] = nan; it must be a number"),
        ('{"path_loss_db": [-Infinity, 70]}', r"path_loss_db\[0\] = -inf"),
        ('{"path_loss_db": [70, true]}', "contains true in"),
        ('{"path_loss_db": [70, "80"]}', 'contains "80" in'),
        (f'{{"path_loss_db": [70, 1{"0" * 400}]}}', "too large"),
    ],
)
def test_answers_that_are_refused(tmp_path, content, message):
    (tmp_path / "response.json").write_text(content)
    with pytest.raises(Unusable, match=message):
        read_answer(tmp_path / "response.json", "json", 2)


def test_hdf5_answers_that_are_refused(tmp_path):
    path = tmp_path / "response.h5"
    with pytest.raises(Unusable, match="wrote no response file"):
        read_answer(path, "hdf5", 2)
    path.write_text("no HDF5")
    with pytest.raises(Unusable, match="is not an HDF5 file"):
        read_answer(path, "hdf5", 2)
    with h5py.File(path, "w") as file:
        file["other"] = 1.0
    with pytest.raises(Unusable, match="no dataset"):
        read_answer(path, "hdf5", 2)
    with h5py.File(path, "w") as file:
        file["path_loss_db"] = [[70.0], [np.inf]]
    assert read_answer(path, "hdf5", 2)[0].tolist() == [70.0, np.inf]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("sys.exit('license server is down')", "", r"ended with exit status 1; its output:\nlicense server"),
        ("os.abort()", "", "ended with signal SIGABRT; the program printed no output"),
        ("print('I forgot')", "", r"wrote no response file; its output:\nI forgot"),
        ("losses[3] = math.nan", programs.ANSWER, r"path_loss_db\[3\] = nan"),
        ("losses.pop()", programs.ANSWER, r"shape \(11,\); it must be \(12,\)"),
        ("import time; time.sleep(60)", "", "gave no answer within timeout = 0.5 s and was killed"),
    ],
)
def test_a_program_that_always_fails_ends_the_run_with_its_own_words(tmp_path, before, after, message):
    timeout = 0.5 if "sleep" in before else 20.0
    engine = engines.make(programs.study(tmp_path, before, after, timeout=timeout))
    with pytest.raises(EngineError, match=message) as error:
        engine.path_loss(CANDIDATES[:1])
    assert "study.toml: engine.command" in str(error.value)
    assert "marble.relative_permittivity = 4" in str(error.value)


def test_a_program_that_is_not_there_is_told_and_not_tried_again(tmp_path):
    engine = engines.make(programs.study(tmp_path, command=["no-such-program"], retries=5))
    with pytest.raises(EngineError, match="cannot be started") as error:
        engine.path_loss(CANDIDATES[:1])
    assert "attempt" not in str(error.value)


def test_a_killed_program_takes_its_children_along(tmp_path):
    child = "import time\nwhile True: open('ticks', 'a').write('.'); time.sleep(0.02)"
    before = f"""
import subprocess, time
subprocess.Popen([sys.executable, "-I", "-S", "-c", {child!r}])
time.sleep(60)
"""
    engine = engines.make(programs.study(tmp_path, before, timeout=1.5))
    with pytest.raises(EngineError, match="timeout"):
        engine.path_loss(CANDIDATES[:1])
    ticks = (tmp_path / "ticks").read_text()
    time.sleep(0.4)
    assert (tmp_path / "ticks").read_text() == ticks != ""


def test_a_failure_is_tried_again(tmp_path):
    engine = engines.make(programs.study(tmp_path, "if earlier < 3: sys.exit('not yet')", retries=2))
    assert engine.path_loss(CANDIDATES[:1]) == pytest.approx(
        programs.expected(CANDIDATES[:1], planted.links())
    )
    assert (engine.calls, len(programs.calls(tmp_path))) == (1, 3)


FAULTS = """
if hash(tuple(values)) % 5 == 0 and earlier > 1: sys.exit("out of luck")
if earlier == 7:
    import time; time.sleep(60)
if earlier == 13: losses[0] = math.nan
"""
SMALL = {"name": "sgwo-im", "options": {"population": 6, "iterations": 6, "full_iterations": 3, "elites": 3}}


def test_a_run_completes_in_spite_of_failures(tmp_path):
    """One candidate in five fails at random, one call hangs, one answers NaN, and none is tried again."""
    content = programs.content(tmp_path, FAULTS, timeout=2.0) | {"method": SMALL}
    out = tmp_path / "out"
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"), out=out)
    with closing(Ledger(out / engines.LEDGER_FILE)) as ledger:
        table = ledger.table()
    failed, asked = table[table.status == "failed"], programs.calls(tmp_path)
    unlucky = sum(hash(candidate) % 5 == 0 for candidate in asked[1:])
    assert 3 <= unlucky < len(asked) / 2
    assert sum("exit status 1; its output:\nout of luck" in text for text in failed.message) == unlucky
    others = [text for text in failed.message if "out of luck" not in text]
    assert [text for text in others if "within timeout = 2 s" in text]
    assert [text for text in others if "path_loss_db[0] = nan" in text]
    assert len(others) == 2
    # The start is the loop's own call; a failed candidate is one that the method has asked for all the same.
    assert result.rt_calls == len(result.history) == len(asked) - 1 == len(table) - 1
    assert np.isinf(result.history.rmse_db).sum() == len(failed)
    assert result.rmse_db < result.initial_rmse_db


def test_predictions_at_new_links_are_answers_of_the_program(tmp_path):
    """The program has other physics than the ray tracer, whose replay misses it by more than 10 dB."""
    content = programs.content(tmp_path) | {"method": {"name": "random", "options": {"budget": 6}}}
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"), out=tmp_path / "out")
    new = planted.links().iloc[:4]
    new = new.assign(rx_x=new.rx_x + 0.25)
    before = len(programs.calls(tmp_path))
    told = programs.expected(np.array(list(result.parameters.values())), new)[0]
    np.testing.assert_allclose(result.predict(new), told, atol=1e-6)
    assert len(programs.calls(tmp_path)) == before + 1
    np.testing.assert_allclose(result.predict_interval(new).path_loss_db, told, atol=1e-6)
    assert len(programs.calls(tmp_path)) == before + 2
    programs.content(tmp_path, "sys.exit('no licence')")
    with pytest.raises(EngineError, match=r"no licence.*The prediction requires this call"):
        result.predict(new)


@pytest.mark.parametrize(("away", "worse"), [(0.1, True), (3.5, False)])
def test_a_result_that_is_worse_than_the_initial_values_says_so(tmp_path, away, worse):
    """Two random candidates come nearer to the planted values than initial values far away, and not than near ones."""
    content = programs.content(tmp_path) | {"method": {"name": "random", "options": {"budget": 2}}}
    for name, value in zip(planted.TRUTH, programs.TRUTH + away, strict=True):
        content["parameters"][name] = {"bounds": planted.BOUNDS, "start": float(value)}
    result = calibrate(Study.from_content(content, tmp_path / "study.toml"))
    assert (result.history.rmse_db.min() > result.initial_rmse_db) == worse
    assert (result.rmse_db == result.initial_rmse_db) == worse
    remarks = [text for text in result.remarks if "did not improve on the initial values" in text]
    assert len(remarks) == worse
    assert all(f"an RMSE of {result.initial_rmse_db:.2f} dB" in text for text in remarks)
    assert all("The result keeps the initial values." in text for text in remarks)
    assert all(
        text.endswith("Use a larger budget (method.options), or the method 'auto'.") for text in remarks
    )


def test_a_program_that_breaks_down_ends_the_run_and_loses_nothing(tmp_path):
    """It answers 8 calls and then never again; mended, it goes on from there."""
    content = programs.content(tmp_path, "if earlier > 8: sys.exit('the licence ran out')", give_up_after=4)
    method = SMALL | {"options": {"population": 5, "iterations": 4, "full_iterations": 2, "elites": 2}}
    study = Study.from_content(content | {"method": method}, tmp_path / "study.toml")
    out = tmp_path / "out"
    with pytest.raises(
        EngineError,
        match=r"the licence ran out.*the run ends after 4 successive failed calls.*--forget-failed",
    ):
        calibrate(study, out=out)
    assert len(programs.calls(tmp_path)) == 12
    with closing(Ledger(out / engines.LEDGER_FILE)) as ledger:
        assert (ledger.table().status == "failed").sum() == 4
        assert ledger.forget_failures() == 4
    programs.content(tmp_path)  # mended
    result = calibrate(study, out=out)
    assert result.cost.ledger_hits == 8 - 1  # the first was the loop's own
    undisturbed = calibrate(study, out=tmp_path / "other")
    assert result.parameters == undisturbed.parameters


def test_auto_without_a_cheap_model_is_the_vector_surrogate(tmp_path):
    """Eighteen calls bring it near the planted materials; the ledger shows that the named method asks for the same."""
    content = programs.content(tmp_path)
    results = []
    for name in ("auto", "vector-surrogate"):
        method = {"name": name, "model": "none", "options": {"budget": 18}}
        study = Study.from_content(content | {"method": method}, tmp_path / "study.toml")
        results.append(calibrate(study, out=tmp_path / "out"))
    assert [(result.rt_calls, result.cost.ledger_hits) for result in results] == [(18, 0), (18, 18)]
    assert results[0].parameters == results[1].parameters
    assert results[0].rmse_db < 0.1 * results[0].initial_rmse_db


def test_candidates_of_a_batch_run_at_once_and_keep_their_order(tmp_path):
    """Each program waits until all four have started, which they do only side by side."""
    wait = """
import time
for _ in range(400):
    if sum(1 for line in open("calls.log")) >= 4: break
    time.sleep(0.05)
else: sys.exit("alone")
"""
    candidates = np.vstack([CANDIDATES, [[5.0, 5.0, 5.0]]])
    with engines.open_workers(4) as workers:
        engine = engines.make(programs.study(tmp_path, wait, timeout=60.0), workers=workers)
        assert engine.path_loss(candidates) == pytest.approx(programs.expected(candidates, planted.links()))


def test_no_call_starts_before_an_answer_is_taken(tmp_path, monkeypatch):
    """Who takes it has stored the one before, so that a run that is killed repeats one call per worker at most."""
    started = []

    def run(program, request, stop=None):
        started.append(request)
        return Outcome(np.zeros(planted.LINKS), 0.0)

    monkeypatch.setattr(ExternalProgram, "run", run)
    with engines.open_workers(2) as workers:
        engine = engines.make(programs.study(tmp_path), workers=workers)
        answers = engine.answers(np.vstack([CANDIDATES, CANDIDATES + 0.1]))
        for taken in range(6):
            next(answers)
            time.sleep(0.05)
            assert len(started) == min(2 + taken, 6)


def test_parallel_calls_wait_for_the_answer_that_another_run_pays_for(tmp_path):
    study, file = programs.study(tmp_path), tmp_path / "ledger.sqlite"
    problem, wanted = engines.fingerprint(study.opened()), programs.expected(CANDIDATES, planted.links())
    with closing(Ledger(file)) as other:
        other.describe(problem, "command", planted.TRUTH)
        assert other.claim(problem, [key(CANDIDATES[2])], planted.LINKS)

        def progress(stage, done, total):
            if stage == "waiting":
                other.commit(problem, key(CANDIDATES[2]), LedgerEntry(wanted[2], 1.0))

        with engines.open_workers(2) as workers:
            engine = engines.make(study, ledger=file, workers=workers, progress=progress)
            assert engine.path_loss(CANDIDATES) == pytest.approx(wanted)
    assert (engine.calls, engine.hits) == (2, 1)


def test_a_failure_does_not_lose_the_others(tmp_path):
    before = "if values[0] == 2.0: sys.exit('no')"
    with engines.open_workers(2) as workers:
        engine = engines.make(programs.study(tmp_path, before), workers=workers)
        loss = engine.path_loss(CANDIDATES)
        answers = {answer.index: answer.failure for answer in engine.answers(CANDIDATES[:2])}
    assert np.isinf(loss).all(axis=1).tolist() == [False, True, False]
    assert answers[0] == ""
    assert answers[1].endswith("ended with exit status 1; its output:\nno")


class DyingWorkers(ThreadPoolExecutor):
    """Workers of which the one on the second call dies; they keep no chunks."""

    submitted = 0
    keep = ask = ThreadPoolExecutor.submit

    def executor(self):
        return self

    def submit(self, function, /, *arguments):
        self.submitted += 1
        if self.submitted != 2:
            return super().submit(function, *arguments)
        future: Future = Future()
        future.set_exception(RuntimeError("worker was killed"))
        return future


def test_a_worker_that_dies_costs_its_candidate_alone(tmp_path):
    with DyingWorkers(1) as workers:
        engine = engines.make(programs.study(tmp_path), workers=workers)
        answers = {answer.index: answer for answer in engine.answers(CANDIDATES)}
    assert [bool(answers[k].failure) for k in range(3)] == [False, True, False]
    assert "lost with its worker (RuntimeError: worker was killed)" in answers[1].failure
    assert [answers[k].lost for k in range(3)] == [False, True, False]


@pytest.mark.parametrize(
    ("workers", "scheduler", "message"),
    [
        (0, None, "must be at least 1"),
        (2, "tcp://here:1", "give only one of the two"),
        *(
            (None, address, "--scheduler .*: is not an address; give a host and a port, for example tcp://")
            for address in (
                *("", "x", "127.0.0.1", "tcp://", "tcp://127.0.0.1:0", "tcp://127.0.0.1:99999", "tcp://[::1"),
                *("tcp://127.0.0.1:abc", "http://127.0.0.1:80", "inproc://1", "ucx://a:1", "a:b:c:d"),
                *("a" * 9999, "a b:1"),
            )
        ),
        (None, "tls://127.0.0.1:9", "no Dask scheduler answers at this address"),
        (None, "tcp://nowhere.invalid:8786", "no Dask scheduler answers at this address"),
    ],
)
def test_executors_that_are_refused(workers, scheduler, message, monkeypatch):
    monkeypatch.setattr("calibray.engines.cluster.dask_workers.SCHEDULER_WAIT", 0.1)
    with pytest.raises(InputError, match=message), engines.open_workers(workers, scheduler):
        pass


def test_retrace_takes_no_workers(tmp_path):
    with (
        engines.open_workers(1) as workers,
        pytest.raises(InputError, match="require the engine 'command' or 'replay'"),
    ):
        engines.make(programs.study(tmp_path), "retrace", workers=workers)


def test_a_study_without_a_program_is_refused(tmp_path):
    content = programs.content(tmp_path)
    with pytest.raises(InputError, match="'command' requires command, the program"):
        Study.from_content(content | {"engine": {"name": "command"}})
    with pytest.raises(InputError, match="must not be empty"):
        Study.from_content(content | {"engine": {"command": []}})
    replay = Study.from_content(content | {"engine": {"name": "replay"}}, tmp_path / "study.toml")
    with pytest.raises(InputError, match="requires command, the program"):
        engines.make(replay, "command")


def test_answers_in_another_order_have_a_remark(tmp_path):
    method = {"name": "random", "model": "none", "options": {"budget": 6}}
    study = Study.from_content(
        programs.content(tmp_path, "losses = losses[1:] + losses[:1]") | {"method": method},
        tmp_path / "study.toml",
    )
    texts = [text for text in calibrate(study).remarks if "worse than a constant" in text]
    assert len(texts) == 1
    assert "Check the order of the program's answers, the units, and the coordinate frame" in texts[0]
    study = Study.from_content(programs.content(tmp_path) | {"method": method}, tmp_path / "study.toml")
    assert "worse than a constant" not in " ".join(calibrate(study).remarks)
