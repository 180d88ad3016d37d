"""Owner: the process that something on disk belongs to, so that another can tell whether it is still at work."""

from __future__ import annotations

import os
import socket
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True)
class Owner:
    """A process, told apart from all others of all machines and times as well as the system allows.

    Attributes:
        host: The machine.
        boot: When it was started, as the system names that; empty where it does not.
        namespace: The space that the process number counts in, as a container has its own; empty where unknown.
        pid: The process.
        started: When the process was started, as the system counts that; empty where it does not.
    """

    host: str
    boot: str
    namespace: str
    pid: int
    started: str

    @classmethod
    def here(cls) -> Owner:
        """This process."""
        return cls(*_machine(), os.getpid(), _started(os.getpid()) or "")

    def record(self) -> dict[str, str | int]:
        """The owner as plain values."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: object) -> Owner | None:
        """The owner that `record` gave, or None if that is none."""
        try:
            owner = cls(**record)  # type: ignore[arg-type]
        except TypeError:
            return None
        texts = (owner.host, owner.boot, owner.namespace, owner.started)
        return owner if isinstance(owner.pid, int) and all(isinstance(text, str) for text in texts) else None

    @property
    def gone(self) -> bool:
        """Whether the process is certainly at work no more; of another machine nothing is certain."""
        host, boot, namespace = _machine()
        if self.host != host:
            return False
        if self.boot != boot:
            return True
        return self.namespace == namespace and _started(self.pid) != self.started


@cache
def _machine() -> tuple[str, str, str]:
    try:
        namespace = os.readlink("/proc/self/ns/pid")  # noqa: PTH115
    except OSError:
        namespace = ""
    host = f"{socket.gethostname()} {_text('/etc/machine-id')}".strip()
    return host, _text("/proc/sys/kernel/random/boot_id"), namespace


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _started(pid: int) -> str | None:
    """When a process was started, empty where the system does not tell; None if there is none, or it is only buried."""
    if Path("/proc/self/stat").exists():
        # After the name, which may hold anything: state, parent, ..., the 22nd entry is the start.
        entries = _text(f"/proc/{pid}/stat").rpartition(")")[2].split()
        return entries[19] if len(entries) > 19 and entries[0] not in "ZX" else None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except (OSError, OverflowError):
        pass
    return ""
