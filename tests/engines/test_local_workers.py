"""Worker processes on this machine: they keep objects, survive deaths, and can be reached by nobody else."""

from __future__ import annotations

import logging
import os
import sys
from contextlib import suppress
from pathlib import Path

import distributed
import numpy as np
import pandas as pd
import pytest

import two_ray
from calibray import calibrate, engines
from calibray.engines.cluster.chunks import for_each_chunk
from calibray.errors import EngineError, InputError
from calibray.study import Setup
from link_tables import links_from_frame
from worker_tasks import die, doubled, fail, kept_process, made, unchanged


def listening_sockets() -> list[str]:
    """Sockets of this process and its children that others could connect to, as lines of /proc/net."""
    processes = [str(os.getpid())]
    for process in processes:
        for children in Path(f"/proc/{process}/task").glob("*/children"):
            processes += children.read_text().split()
    inodes = set()
    for process in processes:
        for entry in Path(f"/proc/{process}/fd").iterdir():
            with suppress(OSError):
                inodes.add(str(entry.readlink()).removeprefix("socket:[").removesuffix("]"))
    lines = []
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and words[9] in inodes:
                lines.append(line)
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        words = line.split()
        if words[3] == "00010000" and words[6] in inodes:
            lines.append(line)
    return lines


def test_objects_stay_in_their_process():
    with engines.open_workers(2) as workers:
        kept = workers.keep(made, list("abcde"))
        first, again = (workers.ask(kept_process, [kept], text) for text in ("1", "2"))
    assert [name for name, _, _ in first] == ["a1", "b1", "c1", "d1", "e1"]
    assert [name for name, _, _ in again] == ["a2", "b2", "c2", "d2", "e2"]
    assert len({process for _, process, _ in first}) == 2
    for (_, maker, process), (_, same_maker, _) in zip(first, again, strict=True):
        assert maker == process == same_maker != os.getpid()
    for _, process, _ in first:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_nobody_else_can_reach_the_workers():
    before = listening_sockets()
    with engines.open_workers(2) as workers:
        kept = workers.keep(made, ["a", "b"])
        assert len(workers.ask(unchanged, [kept])) == 2
        assert listening_sockets() == before


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_check_of_sockets_sees_a_scheduler_of_dask():
    """What local workers were before: a scheduler on loopback, to which any local user can connect."""
    before = listening_sockets()
    with distributed.LocalCluster(n_workers=1, processes=False, protocol="tcp", dashboard_address=None):
        assert listening_sockets() != before


def test_an_error_reaches_the_caller_and_workers_go_on():
    with engines.open_workers(1) as workers:
        with pytest.raises(InputError, match="b cannot be used"):
            workers.ask(unchanged, [workers.keep(fail, ["b"])])
        assert workers.ask(unchanged, [workers.keep(made, ["c"])])[0][0] == "c"


def test_a_chunk_that_kills_its_workers_ends_the_run(caplog, monkeypatch):
    monkeypatch.setattr("calibray.engines.cluster.dask_workers.MOST_DEATHS", 2)
    with (
        caplog.at_level(logging.WARNING),
        engines.open_workers(1) as workers,
        pytest.raises(
            EngineError, match=r"chunk 1: 2 workers died while processing it; give workers more memory"
        ),
    ):
        workers.ask(unchanged, [workers.keep(die, ["b"])])
    assert caplog.text.count("is being replaced") == 2


def test_a_chunk_whose_worker_dies_is_done_again(tmp_path):
    table = pd.DataFrame(np.zeros((12, 6)), columns=two_ray.COLUMNS).assign(rx_x=np.arange(1.0, 13.0))
    done: list[int] = []
    with engines.open_workers(2) as workers:
        parts = for_each_chunk(
            workers,
            doubled,
            tmp_path,
            links_from_frame(table),
            2,
            lambda stage, count, total: done.append(count),
        )
    values = {int(row): value for rows, (_, values) in parts for row, value in zip(rows, values, strict=True)}
    assert values == {row: 2.0 * (row + 1) for row in range(12)}
    assert done == [2, 4, 6, 8, 10, 12]
    assert (tmp_path / "fatal").exists()


def test_chunks_on_workers_give_the_result_of_one_process(tmp_path, monkeypatch):
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path / "cache"))
    few = {"method": {"name": "least-squares", "options": {"starts": 2}}}
    chunked = {**few, "engine": {"name": "replay", "chunk_links": 15}}
    with engines.open_workers(2) as workers:
        setup = Setup.open(two_ray.study(tmp_path, noise_db=1.0, **chunked), two_ray.TwoRay)
        together = calibrate(setup, workers=workers)
    alone = calibrate(Setup.open(two_ray.study(tmp_path, noise_db=1.0, **few), two_ray.TwoRay))
    assert together.parameters == pytest.approx(alone.parameters, rel=1e-9)
    assert together.rmse_db == pytest.approx(alone.rmse_db, rel=1e-9)


def test_more_processes_than_cores_are_refused(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    with engines.open_workers(9) as workers, pytest.raises(InputError, match="must be at most 8"):
        workers.ask(unchanged, [workers.keep(made, ["a"])])
