"""Commands that do not trace work without a usable libLLVM."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

import programs
from calibray.calibration.result import Result
from calibray.engines import Ledger
from calibray.engines.ledger.database import LedgerEntry, key
from calibray.tracing.llvm import PATH_VARIABLE
from commands import few_draws, write_study


@pytest.fixture
def calibray(tmp_path):
    """Run a command in a subprocess with a text file as libLLVM."""
    (tmp_path / "libLLVM.so.19.1").write_text("no library\n")
    environment = {
        **os.environ,
        PATH_VARIABLE: str(tmp_path / "libLLVM.so.19.1"),
        "CUDA_VISIBLE_DEVICES": "",
        "CALIBRAY_CACHE": "",
    }

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        # Only a calibration draws, and the code for it takes long to import.
        code = "from calibray.cli import main; main()"
        code = f"{few_draws()}\n{code}" if arguments[0] == "run" else code
        command = [sys.executable, "-c", code, *map(str, arguments)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    return run


def test_the_ledger_is_listed(calibray, tmp_path):
    with closing(Ledger(tmp_path / "ledger.sqlite")) as ledger:
        ledger.describe("p", "command", ("walls.thickness",))
        ledger.commit("p", key(np.array([0.25])), LedgerEntry(np.array([80.0, np.inf]), 1.5))
    listed = calibray("ledger", tmp_path)
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "0.25" in listed.stdout


def test_an_external_program_is_calibrated(calibray, tmp_path):
    """Without a cheap model, which would be traced."""
    method = {"name": "auto", "options": {"budget": 18}}
    write_study(tmp_path, programs.content(tmp_path) | {"method": method})
    ran = calibray("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--workers", 2)
    assert ran.returncode == 0, ran.stderr
    result = Result.load(tmp_path / "out")
    assert list(result.parameters.values()) == pytest.approx(programs.TRUTH, abs=0.5)
    assert result.remarks[0].startswith("No cheap model is used: the scene cannot be traced here")


def test_a_command_that_traces_reports_the_library(calibray, tmp_path):
    """The negative control: the library is unusable, and a command that needs it ends with one message."""
    content = programs.content(tmp_path)
    del content["engine"]
    write_study(tmp_path, content)
    refused = calibray("trace", tmp_path / "study.toml", "-o", tmp_path / "paths.h5")
    assert (refused.returncode, refused.stdout) == (2, "")
    # On a busy machine, a line of progress precedes the message.
    message = refused.stderr.splitlines()[-1]
    assert message.startswith("Error: ")
    assert PATH_VARIABLE in message
