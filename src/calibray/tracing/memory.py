"""How much memory this process may still take."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

GROUP = Path("/sys/fs/cgroup")  # where a container's limit is
SYSTEM = Path("/proc/meminfo")
UNKNOWN = 2**34  # [bytes] what is taken to be built in where nothing tells


def available() -> int:
    """Memory that can be taken before the system, or the container, ends processes.

    Returns:
        The least of what the system and the container have left, [bytes]; where the system does not tell (it does on
        Linux), half of what is built in.
    """
    left = [_physical() // 2]
    with suppress(OSError, ValueError, KeyError):
        left = [_entries(SYSTEM)["MemAvailable:"] * 1024]
    with suppress(OSError, ValueError, KeyError):  # no number where there is no limit; caches give way
        left.append(int((GROUP / "memory.max").read_text()) - _entries(GROUP / "memory.stat")["anon"])
    return max(min(left), 0)


def _entries(file: Path) -> dict[str, int]:
    lines = (line.split() for line in file.read_text().splitlines())
    return {words[0]: int(words[1]) for words in lines}


def _physical() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not every system tells
        return UNKNOWN
