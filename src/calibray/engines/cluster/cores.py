"""A share of this machine's cores for every worker process, so that their threads do not stand in each other's way."""

from __future__ import annotations

import os
from typing import Final, final

from distributed import Worker
from distributed.diagnostics.plugin import WorkerPlugin

_PINS: Final = hasattr(os, "sched_setaffinity")


@final
class Cores(WorkerPlugin):
    """Pins a worker to its share of the cores before anything is loaded that counts them.

    Args:
        workers: Number of workers that share the cores; each is named by its number.
    """

    name = "calibray-cores"

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def setup(self, worker: Worker) -> None:
        """Pin a worker, when it starts or is told of this.

        Args:
            worker: The worker.
        """
        if _PINS:
            cores = sorted(os.sched_getaffinity(0))
            share = cores[int(worker.name) % self.workers :: self.workers]
            os.sched_setaffinity(0, share or cores)
