"""A ledger that is damaged, full, locked, taken away, or shared: no answer is lost, made up, or paid for twice."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import sqlite3
import threading
import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

import planted
import programs
from calibray import engines
from calibray.calibration.calibrate import calibrate
from calibray.engines import Answer, Ledger, Recorded
from calibray.engines.ledger import database
from calibray.engines.ledger.database import LedgerEntry, key
from calibray.engines.process_owner import ProcessOwner
from calibray.errors import EngineError, InputError
from calibray.parameters import Parameter, Parameters
from calibray.study import Study

CANDIDATES = np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5], [7.0, 7.0, 7.0]])
LOSSES = [[72.0, np.inf], [72.5, np.inf], [81.0, np.inf]]
PARAMETERS = Parameters(tuple(Parameter(name, 1.0, 12.0, 5.0) for name in planted.TRUTH))


class Summing:
    """An engine that answers 60 dB and the sum of a candidate on one link, none on the other."""

    def __init__(self, between=lambda index: None) -> None:
        self.parameters, self.materials, self.num_links = PARAMETERS, {}, 2
        self.asked, self.between = [], between

    @property
    def calls(self) -> int:
        return len(self.asked)

    def answers(self, candidates, stop=None):
        for index, candidate in enumerate(candidates):
            if stop is not None and stop.is_set():
                return
            self.asked.append(tuple(candidate))
            self.between(index)
            yield Answer(index, np.array([60 + candidate.sum(), np.inf]), 0.5)

    def path_loss(self, candidates):
        raise NotImplementedError


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    """The user's folder for state."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "calibray"


@pytest.fixture
def path(tmp_path):
    """Where a ledger lies that holds two answers."""
    file = tmp_path / "out" / "ledger.sqlite"
    with closing(Ledger(file)) as ledger:
        Recorded(Summing(), ledger, "p", "command").path_loss(CANDIDATES[:2])
    return file


def resumed(path, candidates=CANDIDATES) -> int:
    """The calls that a new run needs for all candidates, having found that it answers rightly."""
    with closing(Ledger(path)) as ledger:
        engine = Recorded(Summing(), ledger, "p", "command")
        assert engine.path_loss(candidates).tolist() == LOSSES[: len(candidates)]
        return engine.calls


def doubles(*values: float) -> bytes:
    return np.array(values, "<f8").tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("path_loss_db", doubles(70)), "8 bytes of path loss for 2 links"),
        (("path_loss_db", b"1234567"), "7 bytes of path loss"),
        (("path_loss_db", b""), "0 bytes of path loss"),
        (("path_loss_db", doubles(72, 71)), "a wrong checksum"),
        (("path_loss_db", "72"), "a value of the wrong type"),
        (("failure", "it failed"), "a wrong checksum"),
        (("failure", 7.0), "a wrong checksum"),
        (("seconds", 0.25), "a wrong checksum"),
        (("digest", b"0" * 32), "a wrong checksum"),
        (("digest", "text"), "a wrong checksum"),
        (("digest", None), "a wrong checksum"),
    ],
)
def test_a_damaged_entry_is_dropped_with_a_line_and_asked_again(path, caplog, change, message):
    with closing(sqlite3.connect(path)) as file, file:
        file.execute(f"UPDATE answers SET {change[0]} = ? WHERE id = 2", (change[1],))
    assert resumed(path) == 2  # the damaged one, and one that was never run
    (record,) = caplog.records
    assert record.message.startswith(f"{path}: call 2 is damaged ({message}")
    assert record.message.endswith("; the call is deleted and run again")
    assert resumed(path) == 0


def test_damaged_entries_are_left_out_of_the_table(path, caplog):
    with closing(sqlite3.connect(path)) as file, file:
        file.execute("UPDATE answers SET candidate = ? WHERE id = 1", (b"short",))
    with closing(Ledger(path)) as ledger:
        assert len(ledger.table(path_loss=True)) == 1
    assert "call 1 is damaged" in caplog.text
    assert resumed(path) == 2


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("CREATE TABLE bookmarks (url TEXT)", "is a database with a table 'bookmarks', not a ledger"),
        (
            "CREATE TABLE answers (id, text)",
            "its table 'answers' has the columns id, text; it must have",
        ),
        ("CREATE TABLE claims (who)", "its table 'claims' has the columns who; it must have"),
        ("PRAGMA user_version = 3", "ledger of version 3, but Calibray uses version 2"),
    ],
)
def test_another_database_is_refused_and_left_as_it_is(tmp_path, script, message):
    file = tmp_path / "file"
    with closing(sqlite3.connect(file)) as database:
        database.executescript(script)
    before = file.read_bytes()
    with pytest.raises(InputError, match=message):
        Ledger(file)
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA journal_mode = DELETE")
    assert len(file.read_bytes()) == len(before)


FOREIGN = {
    "link": lambda file, mine: file.symlink_to(mine),
    "link to nothing": lambda file, mine: file.symlink_to(mine.with_name("new")),
    "second name": lambda file, mine: file.hardlink_to(mine),
    "FIFO": lambda file, _: os.mkfifo(file),
    "folder": lambda file, _: file.mkdir(),
}


@pytest.mark.parametrize("ending", database.ENDINGS[:2])
@pytest.mark.parametrize("foreign", FOREIGN)
def test_a_ledger_that_leads_to_another_file_is_refused(tmp_path, foreign, ending):
    mine = tmp_path / "mine.sqlite"
    with closing(Ledger(mine)):
        pass
    before = mine.read_bytes()
    FOREIGN[foreign](tmp_path / f"ledger.sqlite{ending}", mine)
    with pytest.raises(InputError, match=rf"ledger.sqlite{ending}: must be .* or choose another folder"):
        Ledger(tmp_path / "ledger.sqlite")
    assert mine.read_bytes() == before
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("seed", range(4))
def test_malformed_pages_are_refused_with_place_and_remedy(path, seed):
    with closing(Ledger(path)) as ledger:
        for number in range(60):
            ledger.commit("p", key(np.full(3, float(number))), LedgerEntry(np.full(200, 70.0), 0.0))
        ledger._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    for page in rng.integers(1, len(content) // 4096, 3):
        content[page * 4096 : page * 4096 + 64] = rng.bytes(64)
    path.write_bytes(content)
    with pytest.raises(
        InputError, match=r"ledger.sqlite: cannot be used.*(malformed|disk image).*move the ledger away"
    ):
        Ledger(path)


def test_a_lock_that_is_held_for_long_costs_nothing(path, monkeypatch):
    monkeypatch.setattr(database, "LOCK_WAIT", 0.2)
    with closing(Ledger(path)) as ledger, closing(sqlite3.connect(path, isolation_level=None)) as other:
        engine = Recorded(Summing(), ledger, "p", "command")
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(
            EngineError, match=r"ledger.sqlite: the ledger cannot be used \(database is locked; another"
        ):
            engine.path_loss(CANDIDATES)
        assert engine.calls == 0
        with pytest.raises(InputError, match=r"has locked the ledger for 0.2 s: end that"):
            Ledger(path)
        other.execute("ROLLBACK")
        assert engine.path_loss(CANDIDATES).tolist() == LOSSES
        assert engine.calls == 1


def fill(ledger: Ledger) -> None:
    """Let a ledger's disk be full."""
    run = ledger._connection.execute
    run("PRAGMA max_page_count = 1")  # as few as there are
    for size in (1000, 100, 10, 1):
        with contextlib.suppress(sqlite3.OperationalError):
            for number in range(200):
                run(
                    "INSERT INTO answers VALUES (NULL, 'r', ?, ?, 0.0, 'x', '', NULL)",
                    (f"{size} {number}", b"x" * size),
                )


@pytest.mark.parametrize("fault", ["lock", "full"])
def test_an_answer_that_was_paid_for_is_kept_beside_the_ledger_and_taken_up(path, monkeypatch, caplog, fault):
    """The ledger fails after the first of three calls; what is not in it is in a file, and not run again."""
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(database, "LOCK_WAIT", 0.1)
    with closing(sqlite3.connect(path, isolation_level=None)) as other, closing(Ledger(path)) as ledger:
        faults = {"lock": lambda: other.execute("BEGIN IMMEDIATE"), "full": lambda: fill(ledger)}
        engine = Recorded(
            Summing(lambda index: faults[fault]() if index == 1 else None), ledger, "r", "command"
        )
        with pytest.raises(
            EngineError, match=r"\. 1 answer is kept in .*ledger-rescue-\w+.sqlite, and used when"
        ):
            engine.path_loss(CANDIDATES)
        assert engine.calls == 2
        if fault == "lock":
            other.execute("ROLLBACK")
    assert len(list(path.parent.glob("ledger-rescue-*.sqlite"))) == 1
    with closing(Ledger(path)) as ledger:
        again = Recorded(Summing(), ledger, "r", "command")
        assert again.path_loss(CANDIDATES).tolist() == LOSSES
    assert again.calls == 1
    assert "1 answer read from the rescue file" in caplog.text
    assert list(path.parent.glob("ledger-rescue-*")) == []


def test_answers_that_arrive_while_the_ledger_fails_are_kept_too(tmp_path, monkeypatch):
    """Three programs at once; the ledger is locked when the first answers, and the others have answered by then."""
    monkeypatch.setattr(database, "LOCK_WAIT", 1.5)
    out = tmp_path / "out"
    with engines.open_workers(3) as workers:
        study = programs.study(tmp_path, "import time; time.sleep(0.5)")
        engine = engines.make(study, ledger=out / "ledger.sqlite", workers=workers)
        with closing(sqlite3.connect(out / "ledger.sqlite", isolation_level=None)) as other:
            original = Ledger.commit

            def commit(ledger, *arguments):
                if not other.in_transaction:
                    other.execute("BEGIN IMMEDIATE")
                return original(ledger, *arguments)

            monkeypatch.setattr(Ledger, "commit", commit)
            with pytest.raises(EngineError, match=r"locked.* 3 answers are kept in"):
                engine.path_loss(CANDIDATES)
    monkeypatch.undo()
    engine = engines.make(study, ledger=out / "ledger.sqlite")
    assert engine.path_loss(CANDIDATES) == pytest.approx(programs.expected(CANDIDATES, planted.links()))
    assert (engine.calls, len(programs.calls(tmp_path))) == (0, 3)


def test_answers_that_arrive_before_the_engine_fails_as_well_are_kept(path, monkeypatch):
    """A full disk stops the ledger and the files of further calls; two of three calls have ended by then."""

    def fail(*_):
        raise EngineError("the disk is full")

    class Failing(Summing):
        def answers(self, candidates, stop=None):
            yield from super().answers(candidates[:2])
            fail()

    monkeypatch.setattr(Ledger, "commit", fail)
    with closing(Ledger(path)) as ledger:
        engine = Recorded(Failing(), ledger, "r", "command")
        with pytest.raises(EngineError, match=r"2 answers are kept in"):
            engine.path_loss(CANDIDATES)


@pytest.mark.parametrize("again", [False, True])
def test_a_folder_that_is_removed_in_mid_run_is_noticed_and_nothing_is_lost(path, state, again):
    """Removed after the third of three calls, and made again by somebody else or not."""
    before = path.parent / "ledger.sqlite"

    def remove(index: int) -> None:
        shutil.rmtree(before.parent)
        if again:
            before.parent.mkdir()

    with closing(Ledger(path)) as ledger:
        engine = Recorded(Summing(remove), ledger, "p", "command")
        with pytest.raises(
            EngineError, match=r"was removed or replaced during the run; 3 answers are kept in"
        ):
            engine.path_loss(CANDIDATES)
        calls = engine.calls
        with pytest.raises(EngineError, match="was removed or replaced"):
            engine.path_loss(CANDIDATES + 1)
        assert engine.calls == calls == 1  # nothing is paid for after that
    assert bool(list(state.glob("*"))) == (not again)
    assert resumed(path) == 0
    assert list(path.parent.glob("*rescue*")) == []
    assert not state.exists() or list(state.iterdir()) == []


def test_a_damaged_rescue_file_is_renamed_with_a_warning(path, caplog):
    file = path.parent / "ledger-rescue-1.sqlite"
    file.write_text("not a database, but long enough to be taken for one" * 50)
    assert resumed(path) == 1
    assert f"{file}: is damaged (file is not a database)" in caplog.text
    assert [entry.name for entry in path.parent.glob("*rescue*")] == ["ledger-rescue-1.sqlite.damaged"]


def test_a_damaged_answer_of_a_rescue_file_is_run_again(path, caplog):
    with closing(Ledger(path)) as ledger:
        entries = [(key(CANDIDATES[2]), LedgerEntry(np.array([81.0, np.inf]), 0.5))]
        ledger.rescue("p", "command", PARAMETERS.names, entries)
    (file,) = path.parent.glob("ledger-rescue-*")
    with closing(sqlite3.connect(file)) as connection, connection:
        connection.execute("UPDATE answers SET path_loss_db = ?", (doubles(82.0, np.inf),))
    assert resumed(path) == 1
    assert "is damaged (a wrong checksum); the call is deleted and run again" in caplog.text


def test_a_ledger_that_cannot_be_written_is_read(path, monkeypatch):
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    monkeypatch.setattr("calibray.engines.ledger.ledger.os.access", lambda *_: False)
    assert resumed(path, CANDIDATES[:2]) == 0
    with closing(Ledger(path)) as ledger:
        assert len(ledger.table()) == 2
        engine = Recorded(Summing(), ledger, "p", "command")
        with pytest.raises(
            InputError, match="cannot be written, and has no answer for 1 candidate; make the ledger and its"
        ):
            engine.path_loss(CANDIDATES)
        assert engine.calls == 0
        with pytest.raises(InputError, match="cannot be written"):
            ledger.forget_failures()
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_two_runs_at_once_pay_for_each_candidate_once(path):
    """Two threads with an engine each ask for forty candidates in different orders, some of them both at once."""
    rng = np.random.default_rng(0)
    candidates = rng.uniform(1.0, 12.0, (40, 3))
    asked, losses = [], {}

    def run(name: str, order: np.ndarray) -> None:
        with closing(Ledger(path)) as ledger:
            engine = Recorded(Summing(lambda _: time.sleep(0.002)), ledger, "p", "command")
            found = [engine.path_loss(candidates[order[k : k + 8]]) for k in range(0, 40, 8)]
            asked.extend(engine._engine.asked)
            losses[name] = np.concatenate(found)[np.argsort(order)]
            assert engine.calls + engine.hits == 40

    threads = [threading.Thread(target=run, args=(str(k), rng.permutation(40))) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sorted(asked) == sorted(map(tuple, candidates))
    assert np.array_equal(losses["0"], losses["1"])
    assert np.array_equal(losses["0"], losses["2"])


CURRENT = ProcessOwner.current()


@pytest.mark.parametrize(
    ("owner", "expires", "waits"),
    [
        (CURRENT, 100.0, True),
        (CURRENT, -3600.0, True),  # the clock was set since
        (CURRENT, 1e9, False),  # no clock of ours wrote that
        (
            replace(CURRENT, started=CURRENT.started - 60.0),
            100.0,
            False,
        ),  # its number belongs to another process now
        (replace(CURRENT, pid=2**22 + 1), 100.0, False),
        (replace(CURRENT, boot="before a restart"), 100.0, False),
        (replace(CURRENT, namespace="a container"), 100.0, True),
        (replace(CURRENT, host="elsewhere"), -3600.0, True),  # its clock is an hour late
        (replace(CURRENT, host="elsewhere"), 3600.0, True),
        (replace(CURRENT, host="elsewhere"), -1e6, False),
        (replace(CURRENT, host="elsewhere", pid=2**22 + 1), 100.0, True),
        (None, 100.0, False),
    ],
)
def test_a_claim_holds_for_as_long_as_its_run_may_be_alive(path, monkeypatch, owner, expires, waits):
    monkeypatch.setattr(database, "_active_runs", {"another run"})
    text = "no owner" if owner is None else json.dumps(owner.record())
    with closing(Ledger(path)) as ledger:
        with closing(sqlite3.connect(path)) as file, file:
            row = ("p", key(CANDIDATES[2]), "another run", text, time.time() + expires)
            file.execute("INSERT INTO claims VALUES (?, ?, ?, ?, ?)", row)
        claimed = ledger.claim("p", [key(each) for each in CANDIDATES], 2)
    assert claimed == ([] if waits else [key(CANDIDATES[2])])


def test_a_claim_of_another_machine_ends_once_nobody_renews_it(path, monkeypatch):
    """By the observer's clock: neither clock of the two machines is asked for the time of day."""
    monkeypatch.setattr(database, "_observed", {})
    clock = [1000.0]
    monkeypatch.setattr(database.time, "monotonic", lambda: clock[0])
    owner = json.dumps(replace(CURRENT, host="elsewhere").record())
    with closing(Ledger(path)) as ledger, closing(sqlite3.connect(path)) as file:
        row = ("p", key(CANDIDATES[2]), "another run", owner, time.time() - 3600.0)
        with file:
            file.execute("INSERT INTO claims VALUES (?, ?, ?, ?, ?)", row)
        wanted = [key(CANDIDATES[2])]
        assert ledger.claim("p", wanted, 2) == []
        clock[0] += 0.9 * database.EXPIRY
        with file:
            file.execute("UPDATE claims SET expires = expires + 60")
        assert ledger.claim("p", wanted, 2) == []
        clock[0] += 0.9 * database.EXPIRY
        assert ledger.claim("p", wanted, 2) == []
        clock[0] += 0.2 * database.EXPIRY
        assert ledger.claim("p", wanted, 2) == wanted


def test_the_owner_of_a_claim_is_known_again_after_the_clock_was_set(monkeypatch):
    """psutil counts from the machine's start by the clock of the day."""
    monkeypatch.setattr("psutil.boot_time", lambda: 0.0)
    monkeypatch.setattr("psutil.Process.create_time", lambda _: 0.0)
    assert not CURRENT.is_gone


def test_a_sign_of_life_renews_a_claim_and_the_end_of_work_gives_it_up(path, monkeypatch):
    monkeypatch.setattr(database, "RENEWAL", 0.01)
    with closing(Ledger(path)) as ledger, closing(sqlite3.connect(path)) as file:
        ledger.claim("p", [key(CANDIDATES[2])], 2)
        (before,) = file.execute("SELECT expires FROM claims").fetchone()
        with ledger.working():
            time.sleep(0.3)
            (after,) = file.execute("SELECT expires FROM claims").fetchone()
            assert after > before
        assert file.execute("SELECT * FROM claims").fetchall() == []


def test_an_interrupted_run_gives_up_its_claims(path):
    def interrupt(index: int) -> None:
        raise KeyboardInterrupt

    with closing(Ledger(path)) as ledger:
        engine = Recorded(Summing(interrupt), ledger, "p", "command")
        with pytest.raises(KeyboardInterrupt):
            engine.path_loss(CANDIDATES)
        assert resumed(path) == 1


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("random", {"budgett": 6}, "budgett"),
        ("random", {"budget": -1}, "budget"),
        ("sgwo-im", {"population": "many"}, "population"),
        ("least-squares", {}, "needs derivatives"),
        ("no-such", {}, "no such method"),
    ],
)
def test_nothing_is_paid_or_written_before_the_method_was_checked(tmp_path, method, options, message):
    content = programs.content(tmp_path) | {"method": {"name": method, "options": options}}
    out = tmp_path / "out"
    with pytest.raises(InputError, match=message):
        calibrate(Study.from_content(content, tmp_path / "study.toml"), out=out)
    assert programs.calls(tmp_path) == []
    assert not out.exists()
