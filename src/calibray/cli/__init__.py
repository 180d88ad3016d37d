"""The command line: each command parses its arguments, calls the package and prints the results."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from typing import NoReturn

from calibray.support.interruption import INTERRUPTED, TERMINATED, exit_status

__all__ = ["main"]


def main() -> None:
    """Run the command line of this process and exit."""
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # library warnings are for programmers; the tests raise them
    try:
        from calibray.cli.app import app

        app()
    except KeyboardInterrupt:
        _leave()
    except SystemExit as end:
        if end.code in (INTERRUPTED, TERMINATED):
            _leave()
        raise


def _leave() -> NoReturn:
    """Exit without shutting Python down, because interrupted compiled libraries can crash during shutdown."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(exit_status())
