"""What the steps of the window share: the folder, its commands, and what was chosen on the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from nicegui import ui

from calibray.errors import InputError
from calibray.window.folder import StudyFolder
from calibray.window.jobs import Jobs
from calibray.window.solid import Solid


@dataclass
class Desk:
    """The state of the page; one user, so one for all its tabs.

    Attributes:
        folder: The study's folder.
        scene: The chosen scene, relative to the folder.
        point: The chosen place, x and y [m].
        area: The chosen area: west, south, east, north [m].
        transmitters: Transmitters of the measured links, x, y, z [m].
        findings: Suspicions about the links.
        solid: The scene that is shown in 3-D.
        refresh: Shows all steps again.
    """

    folder: StudyFolder
    scene: str | None = None
    point: tuple[float, float] | None = None
    area: tuple[float, float, float, float] | None = None
    transmitters: list[list[float]] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    solid: Solid | None = None
    refresh: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.jobs = Jobs(self.folder.path)

    def start(self, words: Sequence[object]) -> None:
        """Start a command and say so, or say why not."""
        with self.messages():
            job = self.jobs.start([str(word) for word in words])
            ui.notify(f"Started: {job.command}", type="info", color="primary")
            self.refresh()

    def messages(self) -> Messages:
        """A context that shows errors instead of raising them."""
        return Messages()


class Messages:
    """Shows the message of an `InputError`, as text."""

    def __enter__(self) -> None:
        """Nothing to do."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: Any) -> bool:
        """Show the error, if it is one of the input or of a file."""
        if not isinstance(error, InputError | OSError):
            return False
        ui.notify(str(error), type="negative", multi_line=True, timeout=15_000, close_button="Close")
        return True
