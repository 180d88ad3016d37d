"""Path files of other origin are read in a process with limits."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest

import synthetic
from calibray.errors import InputError
from calibray.paths import Paths, seal
from calibray.support import memory


@pytest.fixture
def paths() -> Paths:
    return synthetic.program(synthetic.EVERY_KIND)


def resealed(paths: Paths, file: Path) -> Path:
    """A path file that another program has changed and sealed."""
    paths.save(file)
    with h5py.File(file, "r+") as content:
        content.attrs["setting_origin"] = str(file)
    seal(file)
    return file


def count_processes(monkeypatch, program: str = "") -> list[str]:
    """The programs that are started from then on; `program` runs in place of the validation, if given."""
    started, run = [], memory.subprocess.run

    def counted(command, **options):
        started.append(command[-1])
        return run([*command[:-1], program or command[-1]], **options)

    monkeypatch.setattr(memory.subprocess, "run", counted)
    return started


def test_a_path_file_of_other_origin_is_read_in_a_process_once(paths, tmp_path, monkeypatch):
    # The user's cache may know a file with the same content from an earlier run of the tests.
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path / "cache"))
    started = count_processes(monkeypatch)
    paths.save(tmp_path / "saved.h5")
    Paths.load(tmp_path / "saved.h5")
    assert not started
    file = resealed(paths, tmp_path / "foreign.h5")
    for _ in range(2):
        assert Paths.load(file).num_paths == paths.num_paths
    assert len(started) == 1


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("import time; time.sleep(60)", "does not finish reading the file within"),
        ("import os; os.abort()", "the HDF5 library fails while reading the file"),
        ("import sys; print('is damaged (x)'); sys.exit(3)", r"is damaged \(x\)"),
    ],
)
def test_a_path_file_that_hangs_or_crashes_the_library_is_refused(
    paths, tmp_path, monkeypatch, program, message
):
    file = resealed(paths, tmp_path / "foreign.h5")
    monkeypatch.setattr(memory, "SECONDS", 2.0)
    count_processes(monkeypatch, program)
    with pytest.raises(InputError, match=message):
        Paths.load(file)
