"""What came of one case, and whether that is allowed."""

from __future__ import annotations

import hashlib
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibray.errors import EngineError, InputError

ALLOWED = ("fine", "refused", "failed", "announced")
FORBIDDEN = ("traceback", "hang", "crash", "silent", "memory", "harm", "message")
LONGEST = 6_000
"""Characters that a message may have."""
MEMORY = 4 * 2**30
"""Memory that a process may take [bytes]."""


@dataclass(frozen=True)
class Case:
    """One attack.

    Attributes:
        kind: The kind of input.
        note: What was done to it.
        act: Does what a user would; gives the numbers that came out.
        damaged: Whether the input was damaged so that no number may come out.
        expected: The numbers that come out if any do; any if None.
        names: Words of which a refusal names at least one; none if empty.
        own: Files by name that may be changed.
    """

    kind: str
    note: str
    act: Callable[[], Any]
    damaged: bool = False
    expected: Any = None
    names: tuple[str, ...] = ()
    own: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """What came of a case.

    Attributes:
        verdict: One of `ALLOWED` and `FORBIDDEN`.
        detail: The message, or what is wrong.
    """

    verdict: str
    detail: str = ""


class Exited(Exception):
    """A command that ended with a status other than 0."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass
class Watch:
    """What the process did beside the case, told by an audit hook.

    Attributes:
        place: The folder in which files may be written.
        on: Whether somebody looks.
        programs: Whether programs may be started.
        seen: What was done elsewhere.
    """

    place: str
    on: bool = False
    programs: bool = False
    seen: list[str] = field(default_factory=list)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(path, str | bytes) and isinstance(flags, int) and flags & 3:
                name = path.decode(errors="replace") if isinstance(path, bytes) else path
                if name.startswith("/") and not name.startswith((self.place, "/dev/null", "/proc/self")):
                    self.seen.append(f"opened {name} for writing")
        elif (
            event in ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork")
            and not self.programs
        ):
            self.seen.append(f"{event} {str(arguments)[:200]}")


def judge(case: Case, folder: Path, watch: Watch) -> Verdict:
    """Let a case happen, and say what came of it."""
    before = snapshot(folder, case.own)
    watch.seen.clear()
    watch.on = True
    try:
        verdict = _happened(case)
    finally:
        watch.on = False
    if watch.seen:
        return Verdict("harm", "; ".join(watch.seen[:5]))
    after = snapshot(folder, case.own)
    if changed := sorted(name for name in before if before[name] != after.get(name)):
        return Verdict("harm", f"changed {', '.join(changed)}; {verdict.verdict}: {verdict.detail[:300]}")
    return verdict


def _happened(case: Case) -> Verdict:
    try:
        found = case.act()
    except InputError as error:
        return _message(case, "refused", str(error))
    except EngineError as error:
        return _message(case, "failed", str(error))
    except Exited as error:
        return _message(case, "refused" if error.status == 2 else "failed", str(error))
    except MemoryError:
        return Verdict("memory", traceback.format_exc())
    except BaseException:
        return Verdict("traceback", traceback.format_exc())
    if case.damaged:
        return Verdict("silent", f"damaged, and yet {str(found)[:300]}")
    numbers = _numbers(found)
    if np.isnan(numbers).any() or np.isneginf(numbers).any():
        return Verdict("silent", f"not a number: {str(found)[:300]}")
    if case.expected is not None:
        expected = _numbers(case.expected)
        if expected.shape != numbers.shape or not np.allclose(numbers, expected, rtol=1e-9, atol=1e-9):
            return Verdict("silent", f"{str(found)[:300]}, expected {str(case.expected)[:300]}")
    return Verdict("fine", str(found)[:100])


def _message(case: Case, verdict: str, message: str) -> Verdict:
    if not message.strip():
        return Verdict("message", f"{verdict} without a word")
    if len(message) > LONGEST:
        return Verdict("message", f"{verdict} with {len(message)} characters: {message[:300]}")
    if "Traceback (most" in message:
        return Verdict("traceback", message)
    if case.names and not any(name in message for name in case.names):
        return Verdict("message", f"{verdict}, and names none of {', '.join(case.names)}: {message}")
    return Verdict(verdict, message)


def _numbers(found: Any) -> np.ndarray:
    """All numbers of a value, in order."""
    match found:
        case None | str():
            return np.array([])
        case bool() | int() | float() | np.generic():
            return np.array([float(found)])
        case np.ndarray():
            return found.astype(float).ravel()
        case Mapping():
            return _numbers([found[key] for key in sorted(found)])
        case _:
            return np.concatenate([np.array([]), *(_numbers(each) for each in found)])


def snapshot(folder: Path, own: tuple[str, ...]) -> dict[str, str]:
    """The user's files in a folder, each with what it holds."""
    found = {}
    for file in folder.rglob("*"):
        name = str(file.relative_to(folder))
        if any(file.match(pattern) or name.startswith(pattern) for pattern in own):
            continue
        if file.is_symlink():
            found[name] = str(file.readlink())
        elif file.is_file():
            found[name] = (
                hashlib.sha256(file.read_bytes()).hexdigest() if file.stat().st_size < 2**26 else "large"
            )
        elif not file.is_dir():
            found[name] = "special"
    return found


def peak(process: int | str = "self") -> int:
    """The most memory that a process ever took [bytes], since `restart_peak` where the system can."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        return 0


def restart_peak() -> None:
    """Begin to look anew for the most memory that is taken."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return
