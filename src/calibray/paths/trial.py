"""A path file from before there were seals, read by another process first.

The HDF5 library can hang or end the process on a damaged file, and without a checksum nothing tells beforehand. So
another process tries, and what it survives is read here. Usage: `python -m calibray.paths.trial FILE`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

from calibray.errors import InputError

PATIENCE: Final = 120.0
"""Longest time that reading a file may take [s]."""


def survive(path: Path) -> None:
    """Refuse a file that another process could not read.

    Args:
        path: The file.

    Raises:
        InputError: Reading it failed, took too long or ended the process; the message lacks its name.
    """
    command = [sys.executable, "-m", "calibray.paths.trial", str(path)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        raise InputError(f"is damaged (reading it took more than {PATIENCE:g} s); trace again") from None
    if done.returncode:
        raise InputError("has no checksum, and is damaged: another process failed to read it; trace again")


if __name__ == "__main__":
    import h5py

    from calibray.paths.file_format import read

    try:
        with h5py.File(sys.argv[1], "r") as file:
            read(file)
    except Exception:
        sys.exit(1)
