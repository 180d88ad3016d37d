"""Python code in a process with limits of memory and time, for libraries that hang, crash or grow on hostile files."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Final

from calibray.errors import InputError

SECONDS: Final = 20.0
"""Time that a small file may take to be read [s]; most of it is the start of the process on a busy machine."""

BYTES_PER_SECOND: Final = 20e6
"""Slowest rate at which a large file is read [bytes/s]."""

REFUSED: Final = 3
"""Exit status of code that refuses its file; the reason is on stdout."""

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
    """Run code in another process, which loads what this one can import.

    Args:
        code: The code. It may call `refuse(reason)`.
        memory: Limit of the address space [bytes].
        size: Size of the file that is read [bytes], from which follows how long that may take.

    Returns:
        Whether the code came to its end; False if the process failed.

    Raises:
        InputError: The code refused the file, for the reason given.
        TimeoutError: It did not end; the message says within which time.
    """
    if not sys.executable:
        return True  # an embedded interpreter cannot start another one
    limit = SECONDS + size / BYTES_PER_SECOND
    program = _LIMITS.format(path=sys.path, memory=memory, refused=REFUSED) + code
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=limit, check=False,
            # Threads would count against the limit of the address space.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"within {limit:.0f} s") from None
    if done.returncode == REFUSED:
        raise InputError(done.stdout.strip())
    return done.returncode == 0
