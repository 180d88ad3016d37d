"""Run one command of Calibray apart from the window, and note how it ended: `python -m calibray.window.runner`.

It leads a session of its own, so it outlives the server. Ctrl-C is for the command, which keeps what is finished.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from calibray.support.output_files import write_text


def main() -> None:
    """Run the words after the file that gets the exit status."""
    # A handler, unlike SIG_IGN, is not inherited by the command.
    signal.signal(signal.SIGINT, lambda *_: None)
    _, status_file, *words = sys.argv
    ended = subprocess.run([sys.executable, "-m", "calibray", *words], stdin=subprocess.DEVNULL, check=False)
    write_text(Path(status_file), f"{ended.returncode}\n")


if __name__ == "__main__":
    main()
