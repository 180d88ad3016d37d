"""What every kind of engine states: its section of the study file, and how it is opened."""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Executor
from typing import TYPE_CHECKING, ClassVar

from calibray.engines.protocol import Engine
from calibray.support.progress import Progress
from calibray.support.strict_models import Section

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Crew
    from calibray.paths import Paths
    from calibray.study.setup import Setup


class EngineSection(Section, ABC):
    """``[engine]``: what turns candidates into path loss, chosen by its name.

    A kind of engine is a final class in a module of its own under `engines.kinds`, where it is found. It states its
    keys as fields, its name as a literal, and imports what is heavy when it is opened.

    Attributes:
        name: The kind's name in study files.
        dear: Whether a call costs more than looking it up, so that calls are kept in a ledger.
        external: Whether a program outside answers, which needs no ray tracer here.
        parted: Whether its links can be parted into blocks that live elsewhere.
    """

    name: str
    dear: ClassVar[bool]
    external: ClassVar[bool]
    parted: ClassVar[bool] = False

    @abstractmethod
    def answers_by(self, setup: Setup) -> list[str] | None:
        """What answers besides the study itself, as words or versions, so that a ledger can tell; None for nothing.

        Args:
            setup: The opened study.
        """

    @abstractmethod
    def open(
        self,
        setup: Setup,
        paths: Paths | None,
        progress: Progress | None,
        executor: Executor | Crew | None,
    ) -> Engine:
        """The engine over all links of a study.

        Args:
            setup: The opened study.
            paths: Paths of its links that were traced already; traced, if the kind needs any, if None.
            progress: Called as the work goes on.
            executor: What runs the calls of a batch, for kinds that are `external`; where blocks live, for kinds
                that are `parted`.

        Returns:
            The engine.

        Raises:
            InputError: The study does not suit the kind.
        """
