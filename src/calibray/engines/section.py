"""The engine section of a study file, and the interface that an opened study offers to engines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, Self

from calibray.engines.protocol import Engine
from calibray.support.progress import Progress
from calibray.support.strict_models import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibray.engines.cluster.workers import Workers
    from calibray.fields import Effects
    from calibray.materials import Material
    from calibray.measurements import Measurements
    from calibray.measurements.observables import Wanted
    from calibray.parameters import Parameters
    from calibray.paths import Paths
    from calibray.scenes import Scene
    from calibray.tracing.protocol import Tracer
    from calibray.tracing.settings import Antenna, TraceSettings


@dataclass(frozen=True)
class RadioSettings:
    """Radio settings shared by all links of a study.

    Attributes:
        frequency: Carrier frequency [Hz] of links that state no carrier.
        bandwidth: Bandwidth [Hz], or None.
        combining: How a link's paths are combined: "power", "coherent" or "band".
        antennas: Transmit and receive antennas.
        observables: Observables other than path loss.
    """

    frequency: float
    bandwidth: float | None
    combining: str
    antennas: tuple[Antenna, Antenna]
    observables: tuple[Wanted, ...] = ()


class OpenedStudy(Protocol):
    """A study whose files have been read, with everything that engines require; `calibray.Setup` implements it."""

    @property
    def links(self) -> Measurements:
        """All links, including held-out links."""
        ...

    @property
    def scene(self) -> Scene:
        """The scene, with the parameters' start values."""
        ...

    @property
    def parameters(self) -> Parameters:
        """The parameters whose values a candidate contains."""
        ...

    @property
    def carriers(self) -> Mapping[float, Mapping[str, Material]]:
        """Materials before calibration, by carrier [Hz]; empty if all links have the study's carrier."""
        ...

    @property
    def radio(self) -> RadioSettings:
        """Carrier, bandwidth, combining and antennas."""
        ...

    @property
    def known_antennas(self) -> tuple[Antenna, Antenna] | None:
        """Transmit and receive antennas; None if the study does not state them."""
        ...

    @property
    def trace_settings(self) -> TraceSettings:
        """Settings of the ray tracer."""
        ...

    @property
    def engine(self) -> EngineSection:
        """The section ``[engine]``."""
        ...

    @property
    def source(self) -> Path:
        """The study file."""
        ...

    @property
    def tracer(self) -> Tracer:
        """The ray tracer with the scene at the study's carrier."""
        ...

    @property
    def tracer_versions(self) -> Mapping[str, str]:
        """Versions of the ray tracer's parts, by name."""
        ...

    def tracer_at(self, frequency: float) -> Tracer:
        """The ray tracer with the scene at another carrier [Hz]."""
        ...

    def trace(
        self, materials: Mapping[str, Material] | None = None, progress: Progress | None = None
    ) -> Paths:
        """The paths of the links, with `materials` in place of the scene's materials."""
        ...

    def with_trace(self, settings: TraceSettings) -> Self:
        """The same study with other settings of the ray tracer; the scene is not loaded again."""
        ...

    def effects(self, paths: Paths, links: NDArray[np.int64] | None = None) -> Effects:
        """Effects on the paths of the given links, other than those of materials; None stands for all links."""
        ...

    def at(self, links: Measurements) -> Self:
        """The same study with other links."""
        ...

    def replace(self, *, engine: str | None = None) -> Self:
        """The same study with another engine."""
        ...


class Openable(Protocol):
    """A study, opened or not."""

    def opened(self) -> OpenedStudy:
        """The opened study."""
        ...


class EngineSection(Section, ABC):
    """``[engine]``: the engine that computes the path loss of candidates; `name` states the kind of engine.

    To add a kind of engine, write one final subclass in a separate module in `engines.kinds`; the subclass is found
    automatically. The fields of the class are the keys of the section in the study file, and `name` is a literal. Put
    slow imports inside `open`, because reading any study file imports all kinds of engines.

    Attributes:
        name: The name of the kind in study files.
        expensive: Whether a call takes longer than reading a stored answer; if so, a ledger stores the answers.
        external: Whether an external program computes the answers, so that no ray tracer is needed.
        chunked: Whether chunks of links can be traced and replayed on workers.
    """

    name: str
    expensive: ClassVar[bool]
    external: ClassVar[bool]
    chunked: ClassVar[bool] = False

    @property
    def exports_rays(self) -> bool:
        """Whether an external program returns rays, from which a replay can be made."""
        return self.external and getattr(self, "rays", False) is True

    @abstractmethod
    def answers_by(self, study: OpenedStudy) -> list[str] | None:
        """The versions or the command line on which the answers depend; None if answers are not stored in a ledger."""

    def program_files(self, study: OpenedStudy) -> dict[str, str]:
        """SHA-256 of the program's files in the study's folder, by the names on the command line."""
        return {}

    @abstractmethod
    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Engine:
        """The engine for all links of a study; `paths` contains the paths if they have already been traced.

        Workers run the calls of a batch if `external` is True, and keep chunks of links if `chunked` is True.

        Raises:
            InputError: This kind of engine cannot be used for the study.
        """
