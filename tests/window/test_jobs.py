"""Commands of the window: they outlive the server, can be stopped, and those that died say so."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from nicegui import Client, ui
from nicegui.page import page

from calibray.errors import InputError
from calibray.window.desk import Desk, StudyFolder
from calibray.window.jobs import FOLDER, Job, Jobs, main
from calibray.window.result_steps import _row


def test_a_command_ends_with_its_status_and_output(tmp_path):
    jobs = Jobs(tmp_path)
    done = jobs.wait(jobs.start(["--version"]), 30)
    assert (done.state, done.command) == ("done", "calibray --version")
    assert done.log.startswith("calibray ")
    failed = jobs.wait(jobs.start(["run", "no such.toml", "--out", "result"]), 30)
    assert (failed.state, failed.command) == ("failed", "calibray run 'no such.toml' --out result")
    assert "no such study file" in failed.log
    assert [job.number for job in Jobs(tmp_path).list()] == [2, 1]


def test_a_command_outlives_the_server_that_started_it(tmp_path):
    program = "import sys; from pathlib import Path; from calibray.window.jobs import Jobs\n"
    program += "Jobs(Path(sys.argv[1])).start(['doctor']); print('started', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as server:
        server.stdout.readline()
        server.send_signal(signal.SIGKILL)
    jobs = Jobs(tmp_path)
    job = jobs.running()
    assert job.words == ("doctor",)
    with pytest.raises(InputError, match="is running"):
        jobs.start(["--version"])
    while not psutil.Process(job.pid).children():
        time.sleep(0.05)
    jobs.stop(job)
    assert jobs.wait(job, 60).state in {"stopped", "failed"}


def test_a_command_that_was_killed_has_died(tmp_path):
    jobs = Jobs(tmp_path)
    job = jobs.start(["doctor"])
    os.killpg(job.pid, signal.SIGKILL)
    assert jobs.wait(job, 20).state == "died"


def test_a_command_that_is_stopped_while_python_starts_is_stopped(tmp_path):
    jobs = Jobs(tmp_path)
    job = jobs.start(["doctor"])
    jobs.stop(job)
    assert jobs.wait(job, 60).state == "stopped"


def test_a_log_without_a_record_blocks_no_command(tmp_path):
    """A server that was killed while it started a command leaves one."""
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "0001.log").touch()
    jobs = Jobs(tmp_path)
    assert jobs.wait(jobs.start(["--version"]), 30).state == "done"


def test_records_of_others_are_passed_over_and_their_processes_are_not_touched(tmp_path):
    folder = tmp_path / FOLDER
    folder.mkdir()
    (folder / "0001.json").write_text('{"words": ["run"]}')
    (folder / "0002.json").write_text("[" * 100_000)
    # A record with the number of a process that is not the command's.
    (folder / "0003.json").write_text(
        json.dumps({"words": ["run"], "pid": os.getpid(), "created": time.time() - 1e6})
    )
    assert [(job.number, job.state) for job in Jobs(tmp_path).list()] == [(3, "died")]


def test_a_command_that_is_stopped_before_it_starts_does_not_run(tmp_path, monkeypatch):
    ended = tmp_path / "0001.exit"
    monkeypatch.setattr(sys, "argv", ["", str(ended), "demo"])
    monkeypatch.setattr(subprocess, "run", None)
    monkeypatch.setattr(signal, "signal", lambda number, handler: handler(number, None))
    main()
    assert ended.read_text() == "-2\n"


def test_a_command_that_ends_at_once_is_recorded(tmp_path, monkeypatch):
    """Its process leaves the system's table before the next step of the server."""

    class AtOnce:
        def __init__(self, target, daemon):
            self.start = target

    monkeypatch.setattr("calibray.window.jobs.Thread", AtOnce)
    monkeypatch.setattr(sys, "executable", "/bin/true")
    jobs = Jobs(tmp_path)
    jobs.start(["--version"])
    assert [(job.state, job.words) for job in jobs.list()] == [("died", ("--version",))]


def test_only_a_command_that_keeps_finished_work_can_be_resumed(tmp_path):
    names = []
    for words in (("init", "scene.xml", "links.csv"), ("run", "study.toml")):
        with Client(page("/")) as client:
            _row(Desk(StudyFolder(tmp_path)), Job(1, words, "failed", 1))
        names.append(
            [
                (part.text, part.props["aria-label"])
                for part in client.elements.values()
                if isinstance(part, ui.button)
            ]
        )
    assert names == [[], [("Resume", "Resume: start this command again without repeating finished work")]]
