"""Limits on the resources that the process may use: memory and BLAS threads."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calibray.errors import InputError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


LEAST_ADDRESS_SPACE: Final = 2_900_000_000
"""Lowest permitted limit on the address space [bytes]; below it, libraries fail to load or terminate the process."""

CONTROL_GROUP = Path("/sys/fs/cgroup")
"""Folder of the container's control group (version 2), whose files state the memory limit."""


def check_address_space() -> None:
    """Refuse to start if the address space (`ulimit -v`) is too small for the libraries.

    Raises:
        InputError: The limit is below `LEAST_ADDRESS_SPACE`.
    """
    with suppress(ImportError):  # Windows has no such limit
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
            raise InputError(
                f"too little memory: the address space of this process is limited to {limit / 2**30:.1f} GiB (ulimit "
                f"-v), and the libraries need {LEAST_ADDRESS_SPACE / 2**30:.1f} GiB; raise the limit"
            )


def available_memory() -> int:
    """Memory [bytes] that can still be allocated before the system kills the process or refuses further allocations.

    This is the smallest of three amounts: what is still available in the system, in the container, and under the limit
    on the address space (`ulimit -v`).
    """
    import psutil  # imported here because `check_address_space` runs without it

    free = [psutil.virtual_memory().available]
    # psutil ignores limits. If there is no limit, memory.max contains "max". Only anonymous memory counts as used,
    # because file caches can be freed.
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


def single_blas_thread(wanted: bool = True) -> AbstractContextManager[object]:
    """Make a context in which linear algebra uses a single thread, or a context without effect if `wanted` is False."""
    return _libraries().limit(limits=1, user_api="blas") if wanted else nullcontext()


@cache
def _libraries() -> ThreadpoolController:
    """The loaded BLAS libraries, cached because finding them requires reading the process's complete memory map."""
    # SciPy is imported first, so that its BLAS library is among the loaded libraries.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


SECONDS: Final = 20.0
"""Time limit for reading a small file [s]; on a busy machine, starting the process takes most of this time."""

REFUSED: Final = 3
"""Exit status by which code refuses its input file; the code prints the reason to stdout."""

_LIMITS: Final = """
import sys
sys.path[:] = {path!r}
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}))
except (ImportError, ValueError, OSError):
    pass
def refuse(reason):
    print(reason)
    sys.exit({refused})
"""


def run_limited(code: str, memory: int, size: int) -> bool:
    """Run code in a separate process, which can import the same modules as this process.

    Args:
        code: Python code, which may call `refuse(reason)`.
        memory: Limit on the address space [bytes].
        size: Size of the file that the code reads [bytes], which determines the time limit.

    Returns:
        True if the code finished; False if the process failed.

    Raises:
        InputError: The code refused the file; the message states the reason.
        TimeoutError: The code did not finish in time; the message states the time limit.
    """
    if not sys.executable:
        return True  # an embedded interpreter cannot start another interpreter
    # The time limit is long enough to read large files at 20 MB/s.
    limit = SECONDS + size / 20e6  # [s]
    program = _LIMITS.format(path=sys.path, memory=memory, refused=REFUSED) + code
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=limit, check=False,
            # Each thread would take up part of the limited address space.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"within {limit:.0f} s") from None
    if done.returncode == REFUSED:
        raise InputError(done.stdout.strip())
    return done.returncode == 0
