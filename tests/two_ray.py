"""A ray tracer of a few lines: the direct path and the reflection from a flat ground at z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.fields import path_gains, path_loss
from calibray.materials import Material
from calibray.paths import Kind, Paths
from calibray.paths.chains import Chains
from calibray.scenes import Scene, read_scene
from calibray.study import Study
from calibray.support.progress import Progress
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.protocol import LinkPositions, Links, Solution, compile_paths, link_positions
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.trace_plan import TracePlan, plan_trace
from link_tables import links_from_frame
from small_scenes import write_scene

MIRROR = np.array([1.0, 1.0, -1.0])
FREQUENCY = 3.5e9
TRUTH = 6.3
BOUNDS = {"ground.relative_permittivity": [1.5, 15.0], "ground.conductivity": [0.01, 2.0]}
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
GROUND = (
    '<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="3.0"/>'
    '<float name="conductivity" value="0.5"/><float name="thickness" value="1.0"/></bsdf>'
)
TRACED = "traced.txt"
"""File beside the scene with a line for every trace."""


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

    def plan(self, links: Links) -> TracePlan:
        return plan_trace(link_positions(links)[0], replace(self.settings, samples=1), lanes=1000, buffer=0)

    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        tx, rx = link_positions(links)
        with (self.scene.path.parent / TRACED).open("a") as file:
            file.write(f"{len(rx)}\n")
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
            chains, np.tile(np.arange(count), 2), LinkPositions(tx, rx), frequency=self.frequency,
            materials={**self.scene.materials, **(materials or {})},
            antennas=(AntennaPattern.of(self.tx_antenna), AntennaPattern.of(self.rx_antenna)),
        )  # fmt: skip

    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        paths = self.trace(links, materials=materials)
        ports = self.rx_antenna.ports, self.tx_antenna.ports
        return Solution(path_gains(paths).reshape(-1, *ports), paths.link, paths.delay)

    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(points)[:, 2] < 0


def study(folder: Path, links: int = 30, noise_db: float = 0.0, free: int = 1, **sections: Any) -> Study:
    """A study of links over a flat ground, their path loss computed by the tracer with the planted permittivity.

    With one noise model and exact constants, intervals are quick.
    """
    corners = [(-300.0, -300.0, 0.0), (300.0, -300.0, 0.0), (300.0, 300.0, 0.0), (-300.0, 300.0, 0.0)]
    file = write_scene(folder, {"floor": [corners]}, GROUND, "mat-ground")
    rx = np.stack([np.geomspace(3, 150, links), np.zeros(links), np.full(links, 1.5)], axis=1)
    table = pd.DataFrame(np.hstack([np.tile([0.0, 0.0, 10.0], (links, 1)), rx]), columns=COLUMNS)
    antenna = Antenna("dipole")
    truth = {"ground": {"relative_permittivity": TRUTH, "conductivity": 0.5, "thickness": 1.0}}
    tracer = TwoRay(read_scene(file, FREQUENCY, truth), FREQUENCY, TraceSettings(), antenna, antenna)
    loss = path_loss(tracer.trace(links_from_frame(table)), combining="coherent")
    loss = loss + noise_db * np.random.default_rng(5).standard_normal(links)
    half = np.where(np.arange(links) % 2, "odd", "even")
    table.assign(path_loss_db=loss, half=half).to_csv(folder / "links.csv", index=False, float_format="%.17g")
    (folder / TRACED).unlink()
    dipole = {"pattern": "dipole", "polarization": "V"}
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": FREQUENCY},
        "links": {"file": "links.csv", "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db"},
        "antennas": {"tx": dipole, "rx": dipole},
        "objective": {"combining": "coherent"},
        "trace": {"max_depth": 1, "samples": 20_000},  # for Sionna RT
        "parameters": {name: {"bounds": bounds} for name, bounds in list(BOUNDS.items())[:free]},
        "noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0},
        **sections,
    }
    return Study.from_content(content, folder / "study.toml")
