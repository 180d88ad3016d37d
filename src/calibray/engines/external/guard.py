"""Guard: runs one program to its end, keeps what it says within bounds, and leaves nothing of it behind.

A script of its own, `python -I -S guard.py TIMEOUT FOLDER WORD...`, that needs the standard library alone. It stands
between Calibray and the program for two reasons. On Linux it takes in orphans (PR_SET_CHILD_SUBREAPER), so that it
finds those that left the program's group and session; elsewhere the program's group alone is killed. And it lives on
when Calibray is killed: the end of its standard input tells it so, and it kills the program and removes the folder.

It prints one JSON object: `ended` ("status", "timeout", "stopped" or "unstarted"), `status` and `said`.
"""

from __future__ import annotations

import ctypes
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time

HEAD, TAIL = 500, 1500  # bytes of the program's first and last words that are kept
PATIENCE = 5.0  # how long to go on killing [s]
GLANCE = 0.5  # how often to look whether Calibray is still there [s]
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36


class Words:
    """The first and the last words of a stream of any length."""

    def __init__(self) -> None:
        self.head, self.tail, self.length = b"", b"", 0

    def add(self, part: bytes) -> None:
        """Take in what was said next."""
        self.length += len(part)
        room = HEAD - len(self.head)
        self.head, part = self.head + part[:room], part[room:]
        self.tail = (self.tail + part[-TAIL:])[-TAIL:]

    def text(self) -> str:
        """What was said, with the middle left out where it is long; control characters would garble a terminal."""
        left_out = self.length - len(self.head) - len(self.tail)
        middle = f" ... ({left_out} bytes left out) ... ".encode() if left_out else b""
        text = (self.head + middle + self.tail).decode("utf-8", "replace").replace("\r\n", "\n").strip()
        return "".join(letter if letter.isprintable() or letter in "\n\t" else "\ufffd" for letter in text)


def main(timeout: float, words: list[str]) -> dict[str, object]:
    """Run a program until it ends, its time is up, or Calibray is gone or wants no more.

    Args:
        timeout: Time that it may take [s].
        words: The program and its arguments.

    Returns:
        What is told to Calibray.
    """
    prctl = _prctl()
    prctl(PR_SET_CHILD_SUBREAPER, 1)
    streams = [os.pipe(), os.pipe()]
    ended, said = _watch_signals(), {reader: Words() for reader, _ in streams}
    deadline = time.monotonic() + timeout
    try:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=streams[0][1],
            stderr=streams[1][1],
            start_new_session=True,
            preexec_fn=lambda: prctl(PR_SET_PDEATHSIG, signal.SIGKILL),
        )
    except (OSError, ValueError) as error:  # it is not there, or cannot be executed
        return {"ended": "unstarted", "status": None, "said": getattr(error, "strerror", None) or str(error)}
    for _, writer in streams:
        os.close(writer)
    end = _pump(process, deadline, ended, said)
    _kill_all(process)
    for reader, heard in said.items():
        _drain(reader, heard)
    output, errors = (heard.text() for heard in said.values())
    return {"ended": end, "status": process.returncode, "said": errors or output}


def _prctl():
    """The system call that sets who takes in orphans and who dies with whom; nothing but on Linux."""
    if sys.platform != "linux":
        return lambda option, value: None
    library = ctypes.CDLL(None)
    return lambda option, value: library.prctl(option, value, 0, 0, 0)


def _watch_signals() -> int:
    """A pipe that has something to read after a child's end; a signal that asks to end writes its number there."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    return reader


def _pump(process: subprocess.Popen, deadline: float, ended: int, said: dict[int, Words]) -> str:
    """Listen to the program until there is a reason to end."""
    parent, calibray = os.getppid(), sys.stdin.fileno()
    with selectors.DefaultSelector() as selector:
        for source in (ended, calibray, *said):
            selector.register(source, selectors.EVENT_READ)
        while process.poll() is None:
            left = deadline - time.monotonic()
            if left <= 0:
                return "timeout"
            for ready, _ in selector.select(min(left, GLANCE)):
                part = os.read(ready.fd, 1 << 16)
                if ready.fd in said:
                    said[ready.fd].add(part)
                    if not part:
                        selector.unregister(ready.fd)
                elif ready.fd == calibray or set(part) - {signal.SIGCHLD}:
                    return "stopped"
            if os.getppid() != parent:
                return "stopped"
    return "status"


def _kill_all(process: subprocess.Popen) -> None:
    """Kill the program's group, and then whoever has become a child of this process, until there is none."""
    deadline = time.monotonic() + PATIENCE
    try:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE)
    except (ProcessLookupError, PermissionError, subprocess.TimeoutExpired):
        pass
    while time.monotonic() < deadline:
        try:
            pid, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if not pid:
            for child in _children():
                try:
                    os.kill(child, signal.SIGKILL)
                except (ProcessLookupError, PermissionError):
                    continue
            time.sleep(0.002)


def _children() -> list[int]:
    """The processes whose parent is this one."""
    found = []
    for name in os.listdir("/proc") if sys.platform == "linux" else []:  # noqa: PTH208
        try:
            with open(f"/proc/{name}/stat", encoding="utf-8", errors="replace") as file:  # noqa: PTH123
                state = file.read().rpartition(")")[2].split()
        except OSError:
            continue
        if name.isdigit() and int(state[1]) == os.getpid():
            found.append(int(name))
    return found


def _drain(reader: int, heard: Words) -> None:
    """Read what is left in a pipe, whether or not somebody still holds its other end."""
    os.set_blocking(reader, False)
    try:
        while part := os.read(reader, 1 << 16):
            heard.add(part)
    except BlockingIOError:
        return


if __name__ == "__main__":
    outcome = main(float(sys.argv[1]), sys.argv[3:])
    if outcome["ended"] == "stopped":
        shutil.rmtree(sys.argv[2], ignore_errors=True)
    try:
        sys.stdout.write(json.dumps(outcome))
        sys.stdout.flush()
    except OSError:  # Calibray is gone
        os._exit(0)
