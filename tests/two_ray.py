"""A ray tracer of a few lines: the direct path and the reflection from a flat ground at z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calibray.fields import path_gains
from calibray.materials import Material
from calibray.paths import Kind, Paths
from calibray.paths.chains import Chains
from calibray.progress import Progress
from calibray.scenes import Scene
from calibray.tracing.antennas import Radiator
from calibray.tracing.compilation import compile_paths
from calibray.tracing.launches import Plan, plan
from calibray.tracing.protocol import Links, Solution, positions
from calibray.tracing.settings import Antenna, TraceSettings

MIRROR = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class TwoRay:
    """The tracer; its scene has the material "ground"."""

    scene: Scene
    frequency: float
    settings: TraceSettings
    tx_antenna: Antenna
    rx_antenna: Antenna

    versions: ClassVar[Mapping[str, str]] = {"two-ray": "1"}

    def with_settings(self, settings: TraceSettings) -> TwoRay:
        return replace(self, settings=settings)

    def plan(self, links: Links) -> Plan:
        return plan(positions(links)[0], replace(self.settings, samples=1), lanes=1000, buffer=0)

    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        tx, rx = positions(links)
        image, count = rx * MIRROR, len(rx)
        ground = tx + (image - tx) * (tx[:, 2:] / (tx - image)[:, 2:])
        chains = Chains(
            source=np.tile(tx, (2, 1)),
            target=np.tile(rx, (2, 1)),
            vertex=np.tile(ground, (2, 1))[:, None],
            normal=np.tile([0.0, 0.0, 1.0], (2 * count, 1, 1)),
            kind=np.repeat([0, Kind.SPECULAR], count)[:, None],
            material=np.full((2 * count, 1), list(self.scene.materials).index("ground")),
            probability=np.ones((2 * count, 1)),
        )
        if progress is not None:
            progress("tracing", count, count)
        return compile_paths(
            chains, np.tile(np.arange(count), 2), tx, rx, frequency=self.frequency,
            materials={**self.scene.materials, **(materials or {})},
            antennas=(Radiator.of(self.tx_antenna), Radiator.of(self.rx_antenna)),
        )  # fmt: skip

    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        paths = self.trace(links, materials=materials)
        ports = self.rx_antenna.ports, self.tx_antenna.ports
        return Solution(path_gains(paths).reshape(-1, *ports), paths.link, paths.delay)

    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(points)[:, 2] < 0
