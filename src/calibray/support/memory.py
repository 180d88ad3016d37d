"""How much memory this process may still take."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

GROUP = Path("/sys/fs/cgroup")
"""Where a container's limit is."""
SYSTEM = Path("/proc/meminfo")
"""Where Linux tells what is left."""
UNKNOWN = 2**34
"""What is taken to be built in where nothing tells [bytes]."""


def available_memory() -> int:
    """Memory that can be taken before the system, or the container, ends processes.

    Returns:
        The least of what the system and the container have left, [bytes]; where the system does not tell (it does on
        Linux), half of what is built in.
    """
    left = [_physical() // 2]
    with suppress(OSError, ValueError, KeyError):
        left = [_entries(SYSTEM)["MemAvailable:"] * 1024]
    # There is no number where there is no limit; caches give way.
    with suppress(OSError, ValueError, KeyError):
        left.append(int((GROUP / "memory.max").read_text()) - _entries(GROUP / "memory.stat")["anon"])
    return max(min(left), 0)


def _entries(file: Path) -> dict[str, int]:
    lines = (line.split() for line in file.read_text().splitlines())
    return {words[0]: int(words[1]) for words in lines}


def _physical() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Not every system tells.
    except (AttributeError, ValueError, OSError):
        return UNKNOWN
