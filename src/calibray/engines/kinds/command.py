"""Command: any external program answers for every candidate."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self, cast, final

from pydantic import AfterValidator, Field, model_validator

from calibray.engines.section import EngineSection
from calibray.errors import InputError
from calibray.support.progress import Progress
from calibray.support.strict_models import Text

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.engines.external.command import Command
    from calibray.paths import Paths
    from calibray.study.setup import Setup


def _named(value: tuple[str, ...]) -> tuple[str, ...]:
    if not value:
        raise InputError("must name the program to call")
    return value


Words = Annotated[tuple[Text, ...], AfterValidator(_named)]


@final
class CommandSection(EngineSection):
    """``[engine]`` with ``name = "command"``.

    Attributes:
        name: "command".
        command: The program to call, and its arguments.
        timeout: Time that one attempt of the program may take [s].
        retries: How often the program is tried again after a failure.
        format: Format of the files exchanged with the program: "json" or "hdf5".
        give_up_after: Failed calls one after the other that end the run.
    """

    dear: ClassVar[bool] = True
    external: ClassVar[bool] = True

    # Sections are frozen, so that a narrower type is safe.
    name: Literal["command"] = "command"  # pyright: ignore[reportIncompatibleVariableOverride]
    command: Words = ()
    timeout: Annotated[float, Field(gt=0)] = 3600.0
    retries: Annotated[int, Field(ge=0)] = 2
    format: Literal["json", "hdf5"] = "json"
    give_up_after: Annotated[int, Field(ge=1)] = 10

    @model_validator(mode="after")
    def _callable(self) -> Self:
        if not self.command:
            raise InputError(
                'name = \'command\' needs command, the program and its arguments, as ["octave-cli", "model.m"]'
            )
        return self

    def answers_by(self, setup: Setup) -> list[str]:
        """The program and its arguments; its own version cannot be known."""
        return list(self.command)

    def open(
        self,
        setup: Setup,
        paths: Paths | None,
        progress: Progress | None,
        executor: Executor | Crew | None,
    ) -> Command:
        """The program over a study's links; see `EngineSection.open`."""
        from calibray.engines.external.command import Command
        from calibray.engines.external.exchange import Surroundings
        from calibray.engines.external.program import ExternalProgram

        study, links = setup.study, setup.links
        folder = study.path.resolve().parent
        program = ExternalProgram(self.command, folder, self.timeout, self.retries, self.format)
        surroundings = Surroundings(
            frequency=study.scene.frequency,
            bandwidth=study.scene.bandwidth,
            combining=study.objective.combining,
            antennas=study.antenna_pair,
            tx=links.tx,
            rx=links.rx,
            link_frequency=links.frequency,
        )
        return Command(
            program,
            surroundings,
            setup.scene.materials,
            setup.parameters,
            cast("Executor | None", executor),
            progress,
            source=str(study.path),
            carriers=setup.carriers,
            give_up_after=self.give_up_after,
        )
