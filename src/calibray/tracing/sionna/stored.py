"""A traced campaign as it is stored in Sionna's buffers, from which paths are compiled and gains computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibray.materials import Material
from calibray.paths import Paths, concatenate
from calibray.tracing.sionna.chunks import Chunk

if TYPE_CHECKING:
    from calibray.tracing.sionna.tracer import Tracer


@dataclass(frozen=True)
class Trace:
    """A traced campaign in Sionna's buffers.

    Attributes:
        tracer: The tracer that found it.
        materials: The constants that it was found with, by name.
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        chunks: The paths.
        told: What the search tells, for the record.
    """

    tracer: Tracer
    materials: dict[str, Material]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    chunks: tuple[Chunk, ...]
    told: Mapping[str, object] = field(default_factory=dict)

    def paths(self) -> Paths:
        """Compile the paths, ordered by link."""
        paths = concatenate(
            [self.tracer.compile(chunk, self.tx, self.rx, self.materials) for chunk in self.chunks]
        )
        return replace(paths, settings={**paths.settings, **self.told})

    def link(self) -> NDArray[np.integer]:
        """Link of every path, non-decreasing [P]."""
        return np.sort(np.concatenate([chunk.link for chunk in self.chunks]), kind="stable")

    def delay(self) -> NDArray[np.float64]:
        """Sionna's propagation delays in the order of `link` [P], [s]; known once `path_gains` has run."""
        found = [
            np.array(chunk.buffer.tau, dtype=float) if len(chunk.link) else np.zeros(0)
            for chunk in self.chunks
        ]
        return np.concatenate(found)[self._order()]

    def path_gains(self, materials: Mapping[str, Material] | None = None) -> NDArray[np.complex128]:
        """Sionna's path gains.

        Args:
            materials: Constants in place of those traced with, by name.

        Returns:
            Gains in the order of `paths()` [P, R, T].

        Raises:
            InputError: The scene has no material of a name.
        """
        self.tracer.give({**self.materials, **(materials or {})})
        return np.concatenate([self.tracer.field_stage(chunk) for chunk in self.chunks])[self._order()]

    def _order(self) -> NDArray[np.int64]:
        return np.argsort(np.concatenate([chunk.link for chunk in self.chunks]), kind="stable")
