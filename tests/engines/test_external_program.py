"""External programs that misbehave: what they say, leave behind, answer and are killed with."""

from __future__ import annotations

import concurrent.futures
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event

import h5py
import numpy as np
import pytest

import programs
from calibray import engines
from calibray.engines.external import program as external_program
from calibray.engines.external.exchange import RESPONSE_BYTES, Request, Unusable, read_answer
from calibray.engines.external.program import OWNER_FILE, PREFIX, ExternalProgram, Stopped
from calibray.engines.kinds import command
from calibray.engines.process_owner import ProcessOwner
from calibray.engines.section import RadioSettings
from calibray.errors import EngineError, InputError
from calibray.materials import Material
from calibray.support.interruption import INTERVAL, ensure_interruption
from calibray.tracing.settings import Antenna

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="orphans are taken in on Linux alone")
ANSWER = """echo '{"path_loss_db": [70, 80]}' > "$2";"""


def request() -> Request:
    """What a program is asked about two links."""
    places = np.zeros((2, 3))
    radio = RadioSettings(3.5e9, None, "power", (Antenna(), Antenna()))
    return Request(radio, places, places + 5, parameters={"a": 1.0})


def test_materials_of_any_name_are_in_an_hdf5_request(tmp_path: Path) -> None:
    """Groups of HDF5 cannot have all of them as names, so each group states the name of its material."""
    names = ["a/b", "a_b", ".", "", "/"]
    materials = {name: Material(float(number + 1), 0.1, 0.2) for number, name in enumerate(names)}
    replace(request(), materials=materials).write(tmp_path / "request.h5", "hdf5")
    with h5py.File(tmp_path / "request.h5") as file:
        written = {
            each.attrs["name"]: each.attrs["relative_permittivity"] for each in file["materials"].values()
        }
    assert written == {name: float(number + 1) for number, name in enumerate(names)}


def shell(folder: Path, script: str, timeout: float = 20.0, retries: int = 0) -> ExternalProgram:
    """A shell script as a program; its `$1` is the request, its `$2` the response."""
    return ExternalProgram(("sh", "-c", script, "sh"), folder, timeout, retries, "json")


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    """A temporary folder of the test's own."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    external_program._remove_abandoned.cache_clear()
    return folder


def soon(condition: Callable[[], bool]) -> bool:
    """Whether something becomes true within some seconds."""
    deadline = time.monotonic() + 60
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def a_time() -> str:
    """Seconds to sleep for, of which no other test thinks."""
    return f"4101.{time.time_ns() % 10**9:09d}"


def sleeping(seconds: str) -> bool:
    """Whether any process sleeps for so many seconds."""
    lines = subprocess.run(
        ["ps", "-eo", "args"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return f"sleep {seconds}" in [line.strip() for line in lines]


def test_a_program_answers_and_leaves_nothing(tmp_path, temporary):
    outcome = shell(tmp_path, ANSWER).run(request())
    assert (outcome.path_loss_db.tolist(), outcome.failure) == ([70, 80], "")
    assert list(temporary.iterdir()) == []


@LINUX
def test_what_is_said_without_end_is_kept_within_bounds(tmp_path, temporary):
    """300 MB on standard error; the guard's peak memory is looked up by the program itself, the disk afterwards."""
    script = """
echo first >&2; head -c 300000000 /dev/zero | tr '\\0' x >&2; echo last >&2
grep VmHWM /proc/$PPID/status > peak; du -sk "$(dirname $1)" | cut -f1 > disk; exit 3
"""
    failure = shell(tmp_path, script).run(request()).failure
    assert failure.startswith("ended with exit status 3; its output:\nfirst\nxxx")
    assert failure.endswith("xxxlast")
    assert "bytes omitted" in failure
    assert len(failure) < 2500
    assert int((tmp_path / "peak").read_text().split()[1]) < 60_000  # kB
    assert int((tmp_path / "disk").read_text()) < 100  # kB
    assert list(temporary.iterdir()) == []


def test_control_characters_do_not_reach_the_terminal(tmp_path):
    failure = shell(tmp_path, r"printf 'a\033[2Jb\000c\377' >&2; exit 1").run(request()).failure
    assert failure.isprintable() or set(filter(lambda letter: not letter.isprintable(), failure)) == {"\n"}
    assert "its output:\na\ufffd[2Jb\ufffdc\ufffd" in failure


@LINUX
@pytest.mark.parametrize(
    ("script", "timeout"),
    [
        ("setsid sleep SECONDS & sleep SECONDS", 1.0),
        ("(setsid sh -c 'sleep SECONDS & sleep SECONDS' &) ; sleep 0.3; exit 1", 20.0),
        (f"{ANSWER} (setsid nohup sleep SECONDS >/dev/null 2>&1 &); sleep 0.3", 20.0),
        # It holds the pipes open.
        (f"{ANSWER} (setsid sleep SECONDS &); sleep 0.3", 20.0),
    ],
)
def test_every_child_is_gone_after_timeout_and_end(tmp_path, script, timeout):
    seconds = a_time()
    outcome = shell(tmp_path, script.replace("SECONDS", seconds), timeout).run(request())
    assert ("timeout" in outcome.failure) == (timeout == 1.0)
    assert bool(outcome.failure) == (ANSWER not in script)
    assert not sleeping(seconds)


CALIBRAY = """
import os, sys
sys.path[:0] = [sys.argv[1], os.path.dirname(sys.argv[1])]
from pathlib import Path
from test_external_program import request, shell
for line in sys.stdin:
    run = os.fork()  # imports once
    if not run:
        script = f"touch begun{line.strip()}; (setsid sleep {sys.argv[3]} &); sleep {sys.argv[3]}"
        shell(Path(sys.argv[2]), script).run(request())
    print(run, flush=True)
    os.waitpid(run, 0)
"""


@LINUX
def test_when_calibray_is_killed_its_programs_and_folders_go_too(tmp_path, temporary):
    seconds = a_time()
    command = [sys.executable, "-c", CALIBRAY, str(Path(__file__).parent), str(tmp_path), seconds]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, text=True, **pipes) as runner:
        for number in (signal.SIGTERM, signal.SIGKILL, signal.SIGINT):
            runner.stdin.write(f"{int(number)}\n")
            runner.stdin.flush()
            run = int(runner.stdout.readline())
            assert soon((tmp_path / f"begun{int(number)}").exists)
            assert soon(lambda: sleeping(seconds))
            assert len(list(temporary.iterdir())) == 1
            os.kill(run, number)
            assert soon(lambda: not sleeping(seconds))
            assert soon(lambda: not list(temporary.iterdir()))
        runner.kill()


def test_a_call_that_is_stopped_is_no_failure_of_the_program(tmp_path):
    stop = Event()
    stop.set()
    with pytest.raises(Stopped):
        shell(tmp_path, ANSWER).run(request(), stop)


@LINUX
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_call_whose_guard_is_ended_from_outside_is_lost(tmp_path, number):
    """The program's parent is the guard."""
    outcome = shell(tmp_path, f"kill -{int(number)} $PPID; sleep 30").run(request())
    assert "was lost with its guard" in outcome.failure
    assert outcome.lost
    assert not shell(tmp_path, "exit 3").run(request()).lost


@LINUX
def test_real_time_signals_have_names(tmp_path):
    number = signal.SIGRTMIN + 1
    failure = shell(tmp_path, f"kill -{int(number)} $$").run(request()).failure
    assert failure == "ended with signal SIGRTMIN+1; the program printed no output"
    assert "signal SIGKILL" in shell(tmp_path, "kill -9 $$").run(request()).failure


def test_a_program_is_told_apart_from_its_absence(tmp_path):
    program = ExternalProgram(("no-such-program",), tmp_path, 5.0, 3, "json")
    assert program.run(request()).failure == "cannot be started (No such file or directory)"
    away = ExternalProgram(("true",), tmp_path / "no-such-folder", 5.0, 3, "json")
    assert away.run(request()).failure == "cannot be started (No such file or directory)"
    with pytest.raises(
        InputError, match=r"engine.command\[1\] = 'a\\x00b': contains a NUL character.*remove it"
    ):
        ExternalProgram(("true", "a\0b"), tmp_path, 5.0, 0, "json")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ('mkfifo "$2"', "is a folder, a FIFO or a device; it must be"),
        ('mkdir "$2"', "is a folder, a FIFO or a device; it must be"),
        ('ln -s /dev/zero "$2"', "must be a regular file, not a link"),
        (
            'echo \'{"path_loss_db": [70, 80]}\' > elsewhere; ln -s "$PWD/elsewhere" "$2"',
            "must be a regular file, not a link",
        ),
        ('truncate -s 20G "$2"', "has 21,474,836,480 bytes; it must have 16,785,408 or fewer"),
        (f'{sys.executable} -c \'print("[" * 1000000)\' > "$2"', "nests lists or objects too deeply"),
    ],
)
def test_responses_that_are_no_files_of_a_sensible_size(tmp_path, script, message):
    assert RESPONSE_BYTES[0] + 2 * RESPONSE_BYTES[1] == 16_785_408
    assert message in shell(tmp_path, script).run(request()).failure


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "-85.2",
            r"path_loss_db\[1\] = -85.2; it must be a number between 20 and 300 dB.*return gains\?",
        ),
        ("19.9", r"= 19.9; it must be a number between 20 and 300 dB, or infinite if the link has no path$"),
        ("300.1", "= 300.1; it must be a number between 20 and 300 dB"),
        ("1e308", r"= 1e\+308; it must"),
        ("-1e4", "= -10000; it must be a number between 20 and 300 dB, or infinite if the link has no path$"),
    ],
)
def test_path_loss_out_of_range_is_refused_with_a_hint_at_the_sign(tmp_path, value, message):
    (tmp_path / "response.json").write_text(f'{{"path_loss_db": [70, {value}]}}')
    with pytest.raises(Unusable, match=message):
        read_answer(tmp_path / "response.json", "json", 2)
    (tmp_path / "response.json").write_text('{"path_loss_db": [20, 300, null]}')
    assert read_answer(tmp_path / "response.json", "json", 3)[0].tolist() == [20, 300, np.inf]


def test_a_byte_order_mark_and_line_ends_of_windows_are_read(tmp_path):
    (tmp_path / "response.json").write_bytes(b'\xef\xbb\xbf{"path_loss_db":\r\n[20, 300]}\r\n')
    assert read_answer(tmp_path / "response.json", "json", 2)[0].tolist() == [20, 300]


def test_hdf5_responses_that_lie_elsewhere_or_unfold_to_any_size(tmp_path):
    path = tmp_path / "response.h5"
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["path_loss_db"] = [70.0, 80.0]
    layout = h5py.VirtualLayout((2,), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "path_loss_db", (2,))
    cases: list[tuple[str, Callable[[h5py.File], object]]] = [
        (
            "to another object",
            lambda file: file.__setitem__("path_loss_db", h5py.ExternalLink("other.h5", "path_loss_db")),
        ),
        ("to another object", lambda file: file.__setitem__("path_loss_db", h5py.SoftLink("/away"))),
        ("in other files", lambda file: file.create_virtual_dataset("path_loss_db", layout)),
        ("shape", lambda file: file.create_dataset("path_loss_db", (1 << 40,), "f8", chunks=(1024,))),
        ("not a dataset of numbers", lambda file: file.create_group("path_loss_db")),
        ("not a dataset of numbers", lambda file: file.create_dataset("path_loss_db", data=["70", "80"])),
        ("not a dataset of numbers", lambda file: file.create_dataset("path_loss_db", data=[70 + 1j, 80])),
    ]
    for message, make in cases:
        with h5py.File(path, "w") as file:
            make(file)
        with pytest.raises(Unusable, match=message):
            read_answer(path, "hdf5", 2)


def test_folders_of_calls_that_were_killed_are_removed_at_the_next_start(tmp_path, temporary):
    gone = subprocess.Popen(["sleep", "0"])
    current = ProcessOwner.current()
    dead = replace(current, pid=gone.pid)
    gone.wait()
    reused = replace(current, started=current.started - 60.0)  # another process had this number before
    elsewhere = replace(dead, host="another host")
    owners = {"dead": dead, "reused": reused, "current": current, "elsewhere": elsewhere}
    for name, owner in owners.items():
        (temporary / f"{PREFIX}{name}").mkdir()
        (temporary / f"{PREFIX}{name}" / OWNER_FILE).write_text(json.dumps(owner.record()))
    (temporary / f"{PREFIX}nobody").mkdir()
    (temporary / "calibray-other").mkdir()
    shell(tmp_path, ANSWER).run(request())
    left = sorted(folder.name.removeprefix(PREFIX) for folder in temporary.iterdir())
    assert left == ["calibray-other", "current", "elsewhere", "nobody"]


@pytest.mark.parametrize("workers", [None, 2])
def test_a_full_temporary_folder_is_not_the_programs_fault(tmp_path, monkeypatch, workers):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "no-such-folder"))
    with engines.open_workers(workers) as opened:
        engine = engines.make(programs.study(tmp_path), ledger=tmp_path / "ledger.sqlite", workers=opened)
        with pytest.raises(EngineError, match=r"no-such-folder.*free disk space, or set.*TMPDIR"):
            engine.path_loss(np.array([[3.0, 4.0, 5.0]]))
    assert engine.calls == 0


def test_what_was_answered_before_an_interruption_is_given(tmp_path):
    """The third of three programs at once is stopped; the two that have answered are not lost."""
    before = "import time; time.sleep(60 * (values[0] == 7.5))"
    candidates = np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5], [7.5, 1.6, 11.0], [7.5, 2.0, 2.0]])
    with engines.open_workers(3) as opened:
        engine = engines.make(programs.study(tmp_path, before), workers=opened)
        stop, found = Event(), []
        for answer in engine.answers(candidates, stop):
            found.append(answer.index)
            if len(found) == 1:
                assert soon(lambda: len(programs.calls(tmp_path)) >= 3)
                time.sleep(0.5)
                stop.set()
    assert sorted(found) == [0, 1]
    assert len(programs.calls(tmp_path)) <= 4


def test_ctrl_c_is_not_raised_again_while_answers_are_saved(tmp_path, monkeypatch):
    """Two programs have answered when Ctrl-C is pressed; saving the second answer takes longer than the repetition."""
    waits = []

    def wait(*arguments):
        waits.append(1)
        if len(waits) == 2:
            signal.raise_signal(signal.SIGINT)
        return concurrent.futures.wait(*arguments)

    saved = []

    def work():
        with ensure_interruption():
            for answer in engine.answers(np.array([[3.0, 4.0, 5.0], [2.0, 9.0, 1.5]]), Event()):
                if not saved:
                    assert soon(lambda: len(programs.calls(tmp_path)) >= 2)
                time.sleep(1.0 if not saved else 3 * INTERVAL)
                saved.append(answer.index)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(command, "wait", wait)
    try:
        with engines.open_workers(2) as opened:
            engine = engines.make(programs.study(tmp_path), workers=opened)
            with pytest.raises(KeyboardInterrupt):
                work()
    finally:
        signal.signal(signal.SIGINT, handler)
    assert sorted(saved) == [0, 1]
