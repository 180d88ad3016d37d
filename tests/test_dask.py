"""Calls of a batch on a real Dask cluster of worker processes, one of which is killed in mid-run."""

from __future__ import annotations

import os
import signal
import threading
import time

import distributed
import numpy as np
import pytest

import planted
import programs
from calibray import engines
from calibray.errors import InputError

pytestmark = pytest.mark.filterwarnings("default")  # Dask closes sockets late


@pytest.fixture(scope="module")
def cluster():
    """Three worker processes and their scheduler; a worker that dies is replaced."""
    options = {"n_workers": 3, "threads_per_worker": 1, "dashboard_address": None, "processes": True}
    with distributed.LocalCluster(**options) as cluster:
        yield cluster


def test_a_worker_that_is_killed_costs_no_call(tmp_path, cluster):
    def kill_one() -> None:
        while len(programs.calls(tmp_path)) < 4:
            time.sleep(0.01)
        os.kill(victim, signal.SIGKILL)

    with distributed.Client(cluster.scheduler_address) as client:
        victim = next(iter(client.run(os.getpid).values()))
    killer = threading.Thread(target=kill_one)
    candidates = np.random.default_rng(0).uniform(1.5, 12.0, (12, 3))
    with engines.open_executor(scheduler=cluster.scheduler_address) as executor:
        study = programs.study(tmp_path, "import time; time.sleep(0.2)")
        engine = engines.make(study, ledger=tmp_path / "ledger.sqlite", executor=executor)
        killer.start()
        loss = engine.path_loss(candidates)
    killer.join()
    with pytest.raises(ProcessLookupError):
        os.kill(victim, 0)
    assert loss == pytest.approx(programs.expected(candidates, planted.links()))
    assert engine.calls == len(candidates)
    asked = programs.calls(tmp_path)
    # What the dead worker was on, and had finished without it being fetched yet, is run by another.
    assert len(set(asked)) == len(candidates) <= len(asked)


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr("calibray.engines.pool.PATIENCE", 0.5)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers there"),
        engines.open_executor(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
