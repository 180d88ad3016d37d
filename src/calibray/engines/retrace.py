"""Re-trace: the ray tracer, run anew for every candidate."""

from __future__ import annotations

import time
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from calibray import fields
from calibray.engines.protocol import Answer, Progress, check_candidates
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.parameters import Parameters
from calibray.tracing import Tracer


class Retrace:
    """The ray tracer, run anew for every candidate.

    Args:
        tracer: The scene in the ray tracer.
        links: The links.
        parameters: What the candidates' components stand for.
        combining: How a link's paths combine: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".
        progress: Called with (candidates run, candidates asked for) after every one.
    """

    def __init__(
        self,
        tracer: Tracer,
        links: Measurements,
        parameters: Parameters,
        combining: str = "power",
        bandwidth: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.parameters, self.materials, self.calls = parameters, dict(tracer.scene.materials), 0
        self.num_links = len(links)
        self._tracer, self._links, self._progress = tracer, links, progress
        self._combining, self._bandwidth = combining, bandwidth

    def path_loss(self, candidates: np.ndarray) -> np.ndarray:
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

    def answers(self, candidates: np.ndarray) -> Iterator[Answer]:
        """The answers to candidates, each as soon as it is there.

        Args:
            candidates: Parameter values [n, d], in the fields' units.

        Yields:
            The answers, in the order of the candidates.

        Raises:
            InputError: A value is outside physics.
        """
        for index, candidate in enumerate(candidates):
            started = time.perf_counter()
            loss = self._one(self.parameters.materials(candidate, self.materials))
            self.calls += 1
            if self._progress is not None:
                self._progress(index + 1, len(candidates))
            yield Answer(index, loss, time.perf_counter() - started)

    def _one(self, materials: dict[str, Material]) -> np.ndarray:
        self._tracer.set_materials(materials)
        trace = self._tracer.trace(self._links)
        gain, link, delay = trace.path_gains(), trace.link(), trace.delay()
        offsets = fields.band_quadrature(link, delay, self._bandwidth) if self._combining == "band" else None
        parts = tuple(jnp.asarray(np.moveaxis(part, 0, -1)) for part in (gain.real, gain.imag))
        power = fields.link_power(
            parts, link, delay, len(self._links), self._tracer.frequency, self._combining, offsets
        )
        return np.asarray(fields.decibel(power))
