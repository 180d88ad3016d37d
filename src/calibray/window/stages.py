"""The stages of a command, read from the lines of progress in its log (`calibray.cli.progress_bars.line`)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_LINE: Final = re.compile(
    r"(?P<name>[A-Za-z][^,/]*?)(?: (?P<done>\d+)(?:/(?P<total>\d+))?)?(?:, \d+ %)?(?:, [\d.e+-]+/s)?"
    r", (?P<seconds>\d+) s(?:, about (?P<left>\d+) s left)?(?:, (?P<found>.+))?"
)


@dataclass(frozen=True)
class Stage:
    """A stage of a command.

    Attributes:
        name: Its name.
        share: How much of it is done, 0 to 1; None if unknown.
        seconds: How long it has taken [s].
        left: How long it takes yet [s]; None if unknown.
        found: What it has found so far, as "best RMSE 3.10 dB"; empty if it says nothing.
    """

    name: str
    share: float | None
    seconds: int
    left: int | None
    found: str


def stages(log: str) -> list[Stage]:
    r"""The stages that a log shows, in their order; stages of less than some seconds print no line.

    Example:
        >>> stages("tracing 3/4, 75 %, 1/s, 3 s, about 1 s left\nWritten to result")
        [Stage(name='tracing', share=0.75, seconds=3, left=1, found='')]
    """
    found: dict[str, Stage] = {}
    for text in log.splitlines():
        if (match := _LINE.fullmatch(text.strip())) is None:
            continue
        name, done, total, seconds, left, value = match.groups()
        share = min(int(done) / int(total), 1.0) if total and int(total) else None
        found.pop(name, None)
        found[name] = Stage(name, share, int(seconds), int(left) if left else None, value or "")
    return list(found.values())
