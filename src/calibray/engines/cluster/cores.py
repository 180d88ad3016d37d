"""A Dask plugin that gives every worker process its share of this machine's cores.

Without it, the thread pools of Dr.Jit and XLA in every process take all cores and slow each other down.
"""

from __future__ import annotations

import os
from typing import Final, final

from distributed import Worker
from distributed.diagnostics.plugin import WorkerPlugin

_CAN_PIN: Final = hasattr(os, "sched_setaffinity")


@final
class Cores(WorkerPlugin):
    """Pins a worker to its share of the cores, before any library that counts cores is loaded.

    Args:
        workers: Number of workers that share the cores; Dask names each by its number.
    """

    name = "calibray-cores"

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def setup(self, worker: Worker) -> None:
        """Pin a worker when it starts or receives this plugin.

        Args:
            worker: The worker.
        """
        if _CAN_PIN:
            cores = sorted(os.sched_getaffinity(0))
            share = cores[int(worker.name) % self.workers :: self.workers]
            os.sched_setaffinity(0, share or cores)
