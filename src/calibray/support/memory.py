"""Memory that this process may still use."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import psutil

CONTROL_GROUP = Path("/sys/fs/cgroup")
"""Control group (version 2) of a container, with its memory limit."""


def available_memory() -> int:
    """Memory that can be allocated before the system ends the process or refuses more [bytes].

    The least of what the system, the container and the limit of the address space (`ulimit -v`) leave.
    """
    free = [psutil.virtual_memory().available]
    # psutil does not know limits. The file of the container holds "max" if there is none; file caches can be freed.
    with suppress(OSError, ValueError, StopIteration):
        limit = int((CONTROL_GROUP / "memory.max").read_text())
        lines = (CONTROL_GROUP / "memory.stat").read_text().splitlines()
        free.append(limit - next(int(line.split()[1]) for line in lines if line.startswith("anon ")))
    with suppress(ImportError):  # Windows has no such limit
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            free.append(limit - psutil.Process().memory_info().vms)
    return max(min(free), 0)
