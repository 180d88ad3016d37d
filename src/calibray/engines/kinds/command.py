"""Command: an external program computes path loss for every candidate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self, final

from pydantic import Field, model_validator

from calibray.engines.section import EngineSection, OpenedStudy
from calibray.errors import InputError
from calibray.support.progress import Progress
from calibray.support.strict_models import Text

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers
    from calibray.engines.external.command import Command
    from calibray.paths import Paths


@final
class CommandSection(EngineSection):
    """``[engine]`` with ``name = "command"``.

    Attributes:
        name: "command".
        command: The program to call, and its arguments.
        timeout: Time limit of one attempt of the program [s].
        retries: Number of further attempts after a failure.
        format: Format of the files exchanged with the program: "json" or "hdf5".
        give_up_after: Number of successive failed calls after which the run ends.
        rays: Whether the program answers with a ray table instead of path loss.
    """

    expensive: ClassVar[bool] = True
    external: ClassVar[bool] = True

    # Sections are frozen, so a narrower type is safe.
    name: Literal["command"] = "command"  # pyright: ignore[reportIncompatibleVariableOverride]
    command: Annotated[tuple[Text, ...], Field(min_length=1)] = ()
    timeout: Annotated[float, Field(gt=0)] = 3600.0
    retries: Annotated[int, Field(ge=0)] = 2
    format: Literal["json", "hdf5"] = "json"
    give_up_after: Annotated[int, Field(ge=1)] = 10
    rays: bool = False

    @model_validator(mode="after")
    def _has_command(self) -> Self:
        if not self.command:
            raise InputError(
                'name = \'command\' needs command, the program and its arguments, as ["octave-cli", "model.m"]'
            )
        return self

    def answers_by(self, study: OpenedStudy) -> list[str]:
        """The program, its arguments, and whether it answers with rays; its version is unknown."""
        return [*self.command, *(["rays"] if self.rays else [])]

    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Command:
        """The program over a study's links; see `EngineSection.open`."""
        from calibray.engines.external.command import Command
        from calibray.engines.external.program import ExternalProgram

        folder = study.source.resolve().parent
        program = ExternalProgram(self.command, folder, self.timeout, self.retries, self.format, self.rays)
        executor = None if workers is None else workers.executor()
        return Command(program, study, self.give_up_after, executor, progress)
