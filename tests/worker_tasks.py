"""What the tests of workers run on them; worker processes import this file, so it imports little."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.measurements import Measurements


def made(name: str) -> tuple[str, int]:
    """An object with its name and the process that made it."""
    return name, os.getpid()


def unchanged(kept: Any) -> Any:
    """The object itself."""
    return kept


def kept_process(kept: tuple[str, int], text: str) -> tuple[str, int, int]:
    """The object with a text added, the process that made it, and this process."""
    name, process = kept
    return name + text, process, os.getpid()


def fail(name: str) -> None:
    """Refuse a name."""
    raise InputError(f"{name} cannot be used")


def die(name: str) -> None:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)


def doubled(folder: Path, links: Measurements) -> tuple[int, list[float]]:
    """Work on a chunk, which the first process that comes to the chunk with row 6 does not survive."""
    with (folder / "begun.txt").open("a") as file:
        file.write(f"{os.getpid()} {links.row[0]}\n")
    if 6 in links.row:
        with suppress(FileExistsError):
            (folder / "fatal").open("x").close()
            os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid(), (2 * links.rx[:, 0]).tolist()
