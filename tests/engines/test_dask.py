"""Calls of a batch on a real Dask cluster of worker processes, one of which is killed in mid-run."""

from __future__ import annotations

import os
import signal
import threading
import time

import distributed
import numpy as np
import pandas as pd
import pytest

import planted
import programs
import two_ray
from calibray import calibrate, coverage_map, engines
from calibray.engines.cluster.chunks import for_each_chunk
from calibray.errors import InputError
from calibray.study import Setup
from link_tables import links_from_frame
from worker_tasks import doubled

pytestmark = pytest.mark.filterwarnings("default")  # Dask closes sockets late
FEW = {"method": {"name": "least-squares", "options": {"starts": 4}}}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory, _compiled_fast):
    """Two worker processes and their scheduler, with a cache of their own; a worker that dies is replaced."""
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "processes": True}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", str(tmp_path_factory.mktemp("cache")))
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
    with engines.open_workers(scheduler=cluster.scheduler_address) as workers:
        study = programs.study(tmp_path, "import time; time.sleep(0.2)")
        engine = engines.make(study, ledger=tmp_path / "ledger.sqlite", workers=workers)
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


def test_blocks_on_workers_give_what_one_process_gives_though_one_is_killed(tmp_path, cluster):
    few = {**FEW, "offset": {"bounds": [-5.0, 5.0]}}
    parted = {**few, "engine": {"name": "replay", "chunk_links": 15}}
    killed: list[int] = []

    def kill_one(stage: str, done: int, total: int | None) -> None:
        if stage.startswith("calibrating") and not killed:
            with distributed.Client(cluster.scheduler_address) as client:
                killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    setup = Setup.open(two_ray.study(tmp_path, noise_db=1.0, **parted), two_ray.TwoRay)
    with engines.open_workers(scheduler=cluster.scheduler_address) as workers:
        found = calibrate(setup, workers=workers, progress=kill_one)
    assert killed
    # No block twice: those of the dead worker came from the cache.
    assert sorted((tmp_path / two_ray.TRACED).read_text().split()) == ["15", "15"]
    whole = calibrate(Setup.open(two_ray.study(tmp_path, noise_db=1.0, **few), two_ray.TwoRay))
    assert found.parameters == pytest.approx(whole.parameters, rel=1e-9)
    assert found.rmse_db == pytest.approx(whole.rmse_db, rel=1e-9)
    assert found.nuisance.offsets_db == pytest.approx(whole.nuisance.offsets_db, rel=1e-9)
    assert found.links["after_db"].to_numpy() == pytest.approx(whole.links["after_db"].to_numpy(), rel=1e-9)


def test_maps_of_workers_are_those_of_one_process(tmp_path, cluster, monkeypatch):
    study = two_ray.study(tmp_path, **FEW, engine={"name": "replay", "chunk_links": 16})
    result = calibrate(Setup.open(study, two_ray.TwoRay))
    monkeypatch.setattr(
        "calibray.prediction.coverage_map.open_for_links",
        lambda result, links, allow_changed_inputs: Setup.open(result.study, two_ray.TwoRay, links),
    )
    where = {"tx": (0.0, 0.0, 10.0), "bounds": (20.0, -10.0, 80.0, 10.0), "cell": 5.0}
    alone = coverage_map(result, **where)
    with engines.open_workers(scheduler=cluster.scheduler_address) as workers:
        together = coverage_map(result, **where, workers=workers)
    assert alone.path_loss_db.shape == (4, 12)
    assert np.isfinite(alone.path_loss_db).all()
    for name, values in alone.layers.items():
        assert together.layers[name] == pytest.approx(values, rel=1e-9)


def test_a_block_that_is_killed_is_done_again_and_what_is_shared_is_sent(tmp_path, cluster):
    table = pd.DataFrame(np.zeros((12, 6)), columns=two_ray.COLUMNS).assign(rx_x=np.arange(1.0, 13.0))
    done: list[int] = []
    with engines.open_workers(scheduler=cluster.scheduler_address) as workers:
        found = for_each_chunk(
            workers,
            doubled,
            tmp_path,
            links_from_frame(table),
            2,
            lambda stage, count, total: done.append(count),
        )
    told = {int(row): value for rows, (_, values) in found for row, value in zip(rows, values, strict=True)}
    assert told == {row: 2.0 * (row + 1) for row in range(12)}
    assert done == [2, 4, 6, 8, 10, 12]
    begun = [line.split() for line in (tmp_path / "begun.txt").read_text().splitlines()]
    (first, again) = (process for process, row in begun if row == "5")
    assert first != again
    assert first not in {str(process) for _, (process, _) in found[2:3]}


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr("calibray.engines.cluster.dask_workers.SCHEDULER_WAIT", 0.5)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers at this address"),
        engines.open_workers(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
