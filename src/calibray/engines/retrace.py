"""Re-trace: the ray tracer, run anew for every candidate."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import Event

import numpy as np
from numpy.typing import NDArray

from calibray import fields
from calibray.engines.protocol import Answer, check_candidates
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.support.progress import Progress
from calibray.tracing.protocol import Tracer


@dataclass(frozen=True, eq=False)
class CarrierTracer:
    """The ray tracer at one carrier.

    Attributes:
        tracer: The scene in the ray tracer, with the constants at that carrier before calibration.
        links: The links measured there.
        index: Where they stand among all [l].
    """

    tracer: Tracer
    links: Measurements
    index: NDArray[np.intp]


class Retrace:
    """The ray tracer, run anew for every candidate.

    Args:
        parts: The ray tracer at each carrier; together they hold every link once.
        materials: The scene's materials before calibration, at the study's carrier.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        progress: Called with the stage "running" after every candidate of a batch.
    """

    def __init__(
        self,
        parts: Sequence[CarrierTracer],
        materials: Mapping[str, Material],
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(materials), 0
        self.num_links = sum(len(part.index) for part in parts)
        self._parts, self._progress = tuple(parts), progress
        self._combining, self._bandwidth = combining, bandwidth

    def path_loss(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Path loss of every link for candidates, each with a trace of its own.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Returns:
            Path loss [n, L], [dB]; +inf where a link has no path.

        Raises:
            InputError: The candidates have another width, or a value is outside physics.
        """
        values = check_candidates(candidates, len(self.parameters))
        return np.stack([answer.path_loss_db for answer in self.answers(values)])

    def answers(self, candidates: NDArray[np.float64], stop: Event | None = None) -> Iterator[Answer]:
        """The answers to candidates, each as soon as it is there.

        Args:
            candidates: Parameter values [n, d], in the fields' units.
            stop: Set from outside to begin no further call.

        Yields:
            The answers, in the order of the candidates.

        Raises:
            InputError: A value is outside physics.
        """
        for index, candidate in enumerate(candidates):
            if stop is not None and stop.is_set():
                return
            started = time.perf_counter()
            loss = np.empty(self.num_links)
            for part in self._parts:
                loss[part.index] = self._one(part, candidate)
            self.calls += 1
            if self._progress is not None:
                self._progress("running", index + 1, len(candidates))
            yield Answer(index, loss, time.perf_counter() - started)

    def _one(self, part: CarrierTracer, candidate: NDArray[np.float64]) -> NDArray[np.float64]:
        tracer = part.tracer
        materials = self.parameters.materials(candidate, tracer.scene.materials, tracer.frequency)
        solution = tracer.solve(part.links, materials)
        combining = fields.Combining.make(self._combining, solution.link, solution.delay, self._bandwidth)
        return fields.path_loss_of_gains(
            solution.gain, solution.link, solution.delay, len(part.links), tracer.frequency, combining
        )
