"""The process that owns a claim or a temporary folder, and the check whether this process is still alive."""

from __future__ import annotations

import os
import socket
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Final

import psutil

CLOCK_TOLERANCE: Final = 2.0
"""Maximum accepted difference [s] between two readings of a process's start time.

A start time relative to 1970 changes if the system clock is corrected between the readings. The start times of two
processes with the same number differ by more than this, because the system uses all other numbers before it reuses one.
"""


@dataclass(frozen=True)
class ProcessOwner:
    """A process, identified across machines, containers and restarts.

    Attributes:
        host: The machine.
        namespace: The process namespace; needed because each container numbers its processes separately; empty if
            unknown.
        pid: The process number.
        started: Start time of the process [s since boot, or since 1970 if `boot` is unknown]; needed because process
            numbers are reused.
        boot: Boot identifier; needed because process numbers refer to other processes after a reboot; empty if unknown.
    """

    host: str
    namespace: str
    pid: int
    started: float
    boot: str

    @classmethod
    def current(cls) -> ProcessOwner:
        """This process."""
        return cls(*_machine(), os.getpid(), _start_time(os.getpid()), _boot())

    def record(self) -> dict[str, str | int | float]:
        """The owner as a dictionary of plain values."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: object) -> ProcessOwner | None:
        """The owner from a dictionary that `record` returned; None if the value is malformed."""
        try:
            owner = cls(**record)  # type: ignore[arg-type]
        except TypeError:
            return None
        types = (
            (owner.host, str),
            (owner.namespace, str),
            (owner.pid, int),
            (owner.started, float),
            (owner.boot, str),
        )
        return owner if all(isinstance(value, kind) for value, kind in types) else None

    @property
    def is_current(self) -> bool:
        """Whether this is the current process."""
        return self.pid == os.getpid() and (self.host, self.namespace) == _machine() and not self.is_gone

    @property
    def is_gone(self) -> bool:
        """Whether the process is known to have ended; False if it runs on another machine or in another container."""
        if (self.host, self.namespace) != _machine():
            return False
        if self.boot != _boot():
            return True
        try:
            process = psutil.Process(self.pid)
            if process.status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
                return True
            return abs(_start_time(self.pid) - self.started) > CLOCK_TOLERANCE
        except (psutil.NoSuchProcess, FileNotFoundError, ProcessLookupError, ValueError, OverflowError):
            return True
        except psutil.AccessDenied:
            return False


def _start_time(pid: int) -> float:
    """Start time of a process [s]. On Linux, the time is measured from boot, so it does not depend on the system clock.

    Raises:
        FileNotFoundError: The process does not exist. The error can also be a `ProcessLookupError` or a
            `psutil.NoSuchProcess`.
    """
    if not _boot():
        return psutil.Process(pid).create_time()
    # The name of the program, in parentheses, may contain spaces; the start time is field 22 (proc(5)).
    fields = (
        Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    )
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


@cache
def _boot() -> str:
    """Boot identifier; empty if the system has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


@cache
def _machine() -> tuple[str, str]:
    """Host and process namespace of this process."""
    try:
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115
        machine = Path("/etc/machine-id").read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        namespace = machine = ""
    return f"{socket.gethostname()} {machine}".strip(), namespace
