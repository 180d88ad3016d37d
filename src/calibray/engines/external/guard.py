"""The guard runs an external program, limits its output, and at the end kills all processes that the program started.

The guard is a separate script, `python -I -S guard.py LIBRARIES TIMEOUT FOLDER WORD...`, that imports no part of
Calibray. There are two reasons to run the guard as a process between Calibray and the program. First, on Linux the
guard adopts orphaned processes (PR_SET_CHILD_SUBREAPER), so it finds processes that left the program's process group
and session. Second, the guard outlives Calibray: when its standard input ends because Calibray ended or stopped the
call, the guard kills the program and removes the folder.

The guard prints one JSON object with the keys `ended` ("status", "timeout", "stopped" or "unstarted"), `status` and
`output`.
"""

from __future__ import annotations

import ctypes
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from contextlib import suppress

# Without `site`, the guard starts in half the time; LIBRARIES is the folder from which Calibray imports psutil.
if __name__ == "__main__":
    sys.path.append(sys.argv[1])

HEAD, TAIL = 500, 1500  # bytes that are kept from the start and the end of an output
KILL_TIME = 5.0  # maximum time to keep killing processes [s]
POLL = 0.5  # interval at which the guard checks whether Calibray is alive and Calibray checks whether to stop [s]
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36


class Output:
    """Keeps the beginning and the end of a stream of any length."""

    def __init__(self) -> None:
        self.head, self.tail, self.length = b"", b"", 0

    def add(self, part: bytes) -> None:
        """Append bytes."""
        self.length += len(part)
        room = HEAD - len(self.head)
        self.head, part = self.head + part[:room], part[room:]
        self.tail = (self.tail + part[-TAIL:])[-TAIL:]

    def text(self) -> str:
        """The output as text, shortened in the middle; control characters, which can harm terminals, are replaced."""
        left_out = self.length - len(self.head) - len(self.tail)
        middle = f" ... ({left_out} bytes omitted) ... ".encode() if left_out else b""
        text = (self.head + middle + self.tail).decode("utf-8", "replace").replace("\r\n", "\n").strip()
        return "".join(letter if letter.isprintable() or letter in "\n\t" else "\ufffd" for letter in text)


def main(timeout: float, words: list[str]) -> dict[str, object]:
    """Run a program until it ends, its time limit [s] expires, or Calibray ends or stops it; return a report."""
    prctl = _prctl()
    prctl(PR_SET_CHILD_SUBREAPER, 1)
    streams = [os.pipe(), os.pipe()]
    signals, outputs = _signal_pipe(), {reader: Output() for reader, _ in streams}
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
    except (OSError, ValueError) as error:  # the program does not exist, or cannot be executed
        return {
            "ended": "unstarted",
            "status": None,
            "output": getattr(error, "strerror", None) or str(error),
        }
    for _, writer in streams:
        os.close(writer)
    ended = _listen(process, deadline, signals, outputs)
    _kill_tree(process)
    for reader, output in outputs.items():
        _drain(reader, output)
    standard, errors = (output.text() for output in outputs.values())
    return {"ended": ended, "status": process.returncode, "output": errors or standard}


def _prctl():
    """The system call that makes a process adopt orphans or die with its parent; outside Linux, a dummy function."""
    if sys.platform != "linux":
        return lambda option, value: None
    library = ctypes.CDLL(None)
    return lambda option, value: library.prctl(option, value, 0, 0, 0)


def _signal_pipe() -> int:
    """A pipe that receives the number of every signal that reports the end of a child or asks this process to end."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    return reader


def _listen(process: subprocess.Popen, deadline: float, signals: int, outputs: dict[int, Output]) -> str:
    """Read the program's output until there is a reason to stop, and return the reason."""
    parent, calibray = os.getppid(), sys.stdin.fileno()
    with selectors.DefaultSelector() as selector:
        for source in (signals, calibray, *outputs):
            selector.register(source, selectors.EVENT_READ)
        while process.poll() is None:
            left = deadline - time.monotonic()
            if left <= 0:
                return "timeout"
            for ready, _ in selector.select(min(left, POLL)):
                part = os.read(ready.fd, 1 << 16)
                if ready.fd in outputs:
                    outputs[ready.fd].add(part)
                    if not part:
                        selector.unregister(ready.fd)
                elif ready.fd == calibray or set(part) - {signal.SIGCHLD}:
                    return "stopped"
            # A process that Calibray forked may keep the other end of standard input open after Calibray has ended.
            if os.getppid() != parent:
                return "stopped"
    return "status"


def _kill_tree(process: subprocess.Popen) -> None:
    """Kill the program's process group, and then all descendants of the guard until none is left."""
    # On Linux, the guard adopts orphans; elsewhere, an orphan is found only if it was listed before its parent ended.
    adopts = sys.platform == "linux"
    if adopts:
        _kill_group(process)
        if process.returncode is not None and not _has_child():
            return
    import psutil  # the import takes half of the guard's time, and few programs leave processes behind

    guard, deadline = psutil.Process(), time.monotonic() + KILL_TIME
    descendants = guard.children(recursive=True)
    if not adopts:
        _kill_group(process)
    while descendants and time.monotonic() < deadline:
        for descendant in descendants:
            with suppress(psutil.Error):
                descendant.kill()
        psutil.wait_procs(descendants, timeout=0.01)
        # In the meantime, further processes may have been started, and the guard has adopted the children of the killed
        # processes.
        descendants = guard.children(recursive=True)


def _kill_group(process: subprocess.Popen) -> None:
    with suppress(ProcessLookupError, PermissionError, subprocess.TimeoutExpired):
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(KILL_TIME)


def _has_child() -> bool:
    """Whether the guard still has a child after all ended children are reaped."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
        return True
    return False


def _drain(reader: int, output: Output) -> None:
    """Read what remains in a pipe, even if another process still has the pipe's other end open."""
    os.set_blocking(reader, False)
    with suppress(BlockingIOError):
        while part := os.read(reader, 1 << 16):
            output.add(part)


if __name__ == "__main__":
    _, _, time_limit, folder, *command = sys.argv
    report = main(float(time_limit), command)
    if report["ended"] == "stopped":
        import shutil

        shutil.rmtree(folder, ignore_errors=True)
    try:
        sys.stdout.write(json.dumps(report))
        sys.stdout.flush()
    except OSError:  # Calibray has ended
        os._exit(0)
