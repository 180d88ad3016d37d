"""What a ray tracer is to this package: something that finds the paths of links in a scene.

A tracer needs no more than geometry. It hands over its paths as `calibray.paths.chains.Chains`, with the material of
every interaction, and `calibray.tracing.compilation.compile_paths` turns them, with the antennas, into the path program
that everything else works on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import Material
from calibray.paths import Paths
from calibray.scenes import Scene
from calibray.support.progress import Progress
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.trace_plan import TracePlan


class Links(Protocol):
    """Anything with transmitter and receiver positions [L, 3], [m]; `Measurements` above all."""

    @property
    def tx(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def rx(self) -> NDArray[np.float64]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class Solution:
    """Path gains of links as a tracer's own field stage gives them.

    Attributes:
        gain: Complex gain of every path, without the phase of its delay [P, R, T].
        link: Link of every path, non-decreasing [P].
        delay: Propagation delay [P], [s].
    """

    gain: NDArray[np.complex128]
    link: NDArray[np.integer]
    delay: NDArray[np.float64]


class Tracer(Protocol):
    """A scene opened in a ray tracer, with antennas and settings.

    Nothing that is called changes what a later call answers.
    """

    @property
    def scene(self) -> Scene:
        """The scene."""
        ...

    @property
    def frequency(self) -> float:
        """Carrier frequency [Hz]."""
        ...

    @property
    def settings(self) -> TraceSettings:
        """The switches."""
        ...

    def with_settings(self, settings: TraceSettings) -> Tracer:
        """The tracer with other switches; the scene stays as it is loaded.

        Args:
            settings: The switches.

        Returns:
            Another tracer.
        """
        ...

    def plan(self, links: Links) -> TracePlan:
        """How the links will be traced.

        Args:
            links: The links.

        Returns:
            The launches, with an estimate of the memory that they take.

        Raises:
            InputError: There is no link, a position is not finite, or a link's ends coincide.
        """
        ...

    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        """Find the paths of every link.

        Args:
            links: The links.
            progress: Called with ("tracing", receivers traced, receivers in all).
            materials: Constants in place of the scene's, by name.

        Returns:
            The path program, its materials those traced with.

        Raises:
            InputError: There is no link, a position is not finite, a link's ends coincide, or the scene lacks a
                material.
            EngineError: There are more paths than fit into memory.
        """
        ...

    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        """Find the paths of every link and compute their gains with the tracer's own field stage.

        A tracer without one replays the paths: `calibray.path_gains`.

        Args:
            links: The links.
            materials: Constants in place of the scene's, by name.

        Returns:
            The gains.

        Raises:
            InputError: As for `trace`.
            EngineError: There are more paths than fit into memory.
        """
        ...

    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points lie inside closed bodies of the scene, such as buildings.

        Args:
            points: Positions [n, 3], [m].

        Returns:
            True where enclosed [n].
        """
        ...


class TracerFactory(Protocol):
    """What opens a scene in a ray tracer: a class that is a `Tracer`, or anything that is called like one."""

    @property
    def versions(self) -> Mapping[str, str]:
        """What the paths found depend on beside the arguments: the tracer's programs and their versions."""
        ...

    def __call__(
        self,
        scene: Scene,
        frequency: float,
        settings: TraceSettings,
        tx_antenna: Antenna,
        rx_antenna: Antenna,
        /,
    ) -> Tracer:
        """Open a scene.

        Args:
            scene: The scene, with the materials to trace with.
            frequency: Carrier frequency [Hz].
            settings: The switches.
            tx_antenna: Transmit antenna.
            rx_antenna: Receive antenna.

        Returns:
            The tracer.

        Raises:
            InputError: The tracer cannot load the scene, or does not know a switch or an antenna.
        """
        ...


def positions(links: Links) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the ends of links stand, checked.

    Args:
        links: The links.

    Returns:
        Transmitter and receiver of every link [L, 3] each, [m].

    Raises:
        InputError: There is no link, a position is not finite, or a link's ends coincide.
    """
    tx, rx = np.asarray(links.tx, dtype=float), np.asarray(links.rx, dtype=float)
    if tx.shape != rx.shape or tx.ndim != 2 or tx.shape[1:] != (3,) or not len(tx):
        raise InputError(
            f"links: tx has the shape {tx.shape}, rx {rx.shape}; both must be [links, 3], with at least one link"
        )
    for name, position in (("tx", tx), ("rx", rx)):
        bad = np.flatnonzero(~np.isfinite(position).all(axis=1))
        if len(bad):
            raise InputError(f"link {bad[0]}: {name} position {position[bad[0]]} is not finite; give metres")
    same = np.flatnonzero(np.linalg.norm(tx - rx, axis=1) < 1e-3)
    if len(same):
        raise InputError(
            f"link {same[0]}: transmitter and receiver coincide at {tx[same[0]]}; check the columns"
        )
    return tx, rx
