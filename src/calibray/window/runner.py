"""Run one command of Calibray apart from the window, and record how it ended: `python -m calibray.window.runner`.

It has its own session, so it outlives the server. Ctrl-C is passed to the command, which keeps finished work.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from calibray.support.output_files import write_text


def main() -> None:
    """Run the command given after the file for the exit status."""
    # A handler, unlike SIG_IGN, is not inherited by the command.
    signal.signal(signal.SIGINT, lambda *_: None)
    _, status_file, *words = sys.argv
    ended = subprocess.run([sys.executable, "-m", "calibray", *words], stdin=subprocess.DEVNULL, check=False)
    write_text(Path(status_file), f"{ended.returncode}\n")


if __name__ == "__main__":
    main()
