"""Retrace: the ray tracer runs again for every candidate, as in the paper."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import Event
from typing import TYPE_CHECKING, ClassVar, Literal, final

import numpy as np
from numpy.typing import NDArray

from calibray.engines.protocol import Answer, check_candidates
from calibray.engines.section import EngineSection, OpenedStudy
from calibray.support.progress import Progress

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers
    from calibray.materials import Material
    from calibray.measurements import Measurements
    from calibray.parameters import Parameters
    from calibray.paths import Paths
    from calibray.tracing.protocol import Tracer


@final
class RetraceSection(EngineSection):
    """``[engine]`` with ``name = "retrace"``."""

    expensive: ClassVar[bool] = True
    external: ClassVar[bool] = False

    # Sections are immutable, so a narrower type is safe.
    name: Literal["retrace"] = "retrace"  # pyright: ignore[reportIncompatibleVariableOverride]

    def answers_by(self, study: OpenedStudy) -> list[str]:
        """The versions of the ray tracer."""
        return list(study.tracer_versions.values())

    def open(
        self, study: OpenedStudy, paths: Paths | None, progress: Progress | None, workers: Workers | None
    ) -> Retrace:
        """The ray tracer as the engine of a study's links; see `EngineSection.open`."""
        links = study.links
        if links.frequency is None:
            tracers = [CarrierTracer(study.tracer, links, np.arange(len(links)))]
        else:
            tracers = [
                CarrierTracer(study.tracer_at(frequency), links.select(links.frequency == frequency), index)
                for frequency, index in links.carriers
            ]
        options = study.radio.combining, study.radio.bandwidth
        return Retrace(tracers, study.scene.materials, study.parameters, *options, progress)


@dataclass(frozen=True, eq=False)
class CarrierTracer:
    """The ray tracer at one carrier.

    Attributes:
        tracer: The ray tracer with its scene, whose materials have their uncalibrated constants at this carrier.
        links: The links measured at this carrier.
        index: Indices of these links among all links [l].
    """

    tracer: Tracer
    links: Measurements
    index: NDArray[np.intp]


@final
class Retrace:
    """The ray tracer, run again for every candidate.

    Args:
        tracers: The ray tracer at each carrier; every link belongs to exactly one carrier.
        materials: The scene's materials before calibration, at the study's carrier.
        parameters: The parameters whose values a candidate contains.
        combining: How a link's paths are combined: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        progress: Called with "running" after every candidate of a batch.
    """

    def __init__(
        self,
        tracers: Sequence[CarrierTracer],
        materials: Mapping[str, Material],
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(materials), 0
        self.num_links = sum(len(carrier.index) for carrier in tracers)
        self._tracers, self._progress = tuple(tracers), progress
        self._combining, self._bandwidth = combining, bandwidth

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, which are traced one after another; see `Engine.path_loss`."""
        values = check_candidates(candidates, len(self.parameters))
        return np.stack([answer.path_loss_db for answer in self.answers(values)])

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """Yield the answers in the order of the candidates; see `Answering.answers`."""
        for index, candidate in enumerate(candidates):
            if stop is not None and stop.is_set():
                return
            started = time.perf_counter()
            loss = np.empty(self.num_links)
            for carrier in self._tracers:
                loss[carrier.index] = self._trace(carrier, candidate)
            self.calls += 1
            if self._progress is not None:
                self._progress("running", index + 1, len(candidates))
            yield Answer(index, loss, time.perf_counter() - started)

    def _trace(self, carrier: CarrierTracer, candidate: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss [l], [dB], of a carrier's links for one candidate."""
        from calibray import fields

        tracer = carrier.tracer
        materials = self.parameters.materials(candidate, tracer.scene.materials, tracer.frequency)
        solution = tracer.solve(carrier.links, materials)
        combining = fields.Combining.make(self._combining, solution.link, solution.delay, self._bandwidth)
        return fields.path_loss_of_gains(
            solution.gain, solution.link, solution.delay, len(carrier.links), tracer.frequency, combining
        )
