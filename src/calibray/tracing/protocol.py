"""The interface to ray tracers: the methods that Calibray calls, and the form in which a tracer returns its paths.

A tracer only has to compute the geometry. It returns its paths as `calibray.paths.chains.Chains`, with the material of
every interaction. `compile_paths` combines these paths with the antennas into the path program that all further
computations use.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements.links import MIN_DISTANCE
from calibray.paths import Paths, concatenate
from calibray.paths.chains import Chains, compile_chains, zenith_azimuth
from calibray.scenes import Scene
from calibray.scenes.meshes import LARGEST_COORDINATE
from calibray.support.messages import type_name
from calibray.support.progress import Progress
from calibray.tracing.antennas import AntennaPattern, rotate_jones
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.trace_plan import TracePlan


class Links(Protocol):
    """An object, such as `Measurements`, with the positions [L, 3], [m], of transmitters and receivers."""

    @property
    def tx(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def rx(self) -> NDArray[np.float64]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class LinkPositions:
    """Positions of the transmitters and receivers of links, each [L, 3], [m]."""

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solution:
    """Path gains of links from the tracer's own field computation.

    Attributes:
        gain: Complex gain of every path, without the phase due to its delay [P, R, T].
        link: Link of every path, non-decreasing [P].
        delay: Propagation delay [P], [s].
    """

    gain: NDArray[np.complex128]
    link: NDArray[np.integer]
    delay: NDArray[np.float64]


class Tracer(Protocol):
    """A scene opened in a ray tracer, with antennas and settings.

    No call affects the result of a later call.
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
        """The tracer's settings."""
        ...

    def with_settings(self, settings: TraceSettings) -> Tracer:
        """Copy the tracer, with different settings; the copy shares the loaded scene."""
        ...

    def plan(self, links: Links) -> TracePlan:
        """Plan the launches of a trace, and estimate the memory that they need.

        Raises:
            InputError: There is no link, a position is not finite, or the ends of a link coincide.
        """
        ...

    def trace(
        self, links: Links, progress: Progress | None = None, materials: Mapping[str, Material] | None = None
    ) -> Paths:
        """Find the paths of every link; `materials` gives, by name, constants that replace those of the scene.

        `progress` is called with ("tracing", receivers traced, number of receivers).

        Raises:
            InputError: There is no link, a position is not finite, the ends of a link coincide, or a material is not
                in the scene.
            EngineError: The paths do not fit into memory.
        """
        ...

    def solve(self, links: Links, materials: Mapping[str, Material]) -> Solution:
        """Find the paths of every link and compute their gains with the tracer's own field computation.

        A tracer without its own field computation can replay the paths with `calibray.path_gains`. `materials` gives,
        by name, constants that replace those of the scene.

        Raises:
            InputError: The links or materials are invalid, as described in `trace`.
            EngineError: The paths do not fit into memory.
        """
        ...

    def enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether each point [n, 3], [m], lies inside a closed body of the scene, for example a building; shape [n]."""
        ...


class TracerFactory(Protocol):
    """Opens a scene in a ray tracer: a class that implements `Tracer`, or a callable with the same arguments."""

    @property
    def versions(self) -> Mapping[str, str]:
        """Versions of the tracer's programs by name; a stored trace is reused only with the same versions."""
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
        """Open a scene, which contains the materials for the trace.

        Raises:
            InputError: The tracer cannot load the scene, or does not support a setting or an antenna.
        """
        ...


def compile_paths(
    chains: Chains,
    link: NDArray[np.integer],
    ends: Links,
    *,
    frequency: float,
    materials: Mapping[str, Material],
    antennas: tuple[AntennaPattern, AntennaPattern],
) -> Paths:
    """Compile the paths that a tracer found, which can be in any order, into a path program.

    Material indices in `chains` refer to the order of `materials`. `link` [P] is the link of every path, and `ends`
    contains the positions of all links. The paths of the program are ordered by link; within a link, paths keep the
    given order.
    """
    geometry = compile_chains(chains)
    departure, arrival = geometry.departure_direction, geometry.arrival_direction
    tx_pattern, rx_pattern = antennas
    paths = Paths(
        frequency=frequency,
        materials=dict(materials),
        tx_position=ends.tx,
        rx_position=ends.rx,
        link=np.asarray(link).astype(np.int32),
        delay=geometry.delay,
        spreading=geometry.spreading,
        departure=zenith_azimuth(departure),
        # The wave travels along `arrival`; seen from the receiver, it comes from the opposite direction.
        arrival=zenith_azimuth(-arrival),
        tx_field=rotate_jones(tx_pattern.jones_vectors(departure), geometry.departure_rotation),
        # The inverse rotation transforms the receive pattern from the basis of the arriving wave into the frame of the
        # last interaction.
        rx_field=rotate_jones(
            rx_pattern.jones_vectors(-arrival, arriving=True), geometry.arrival_rotation * [1, -1]
        ),
        first=geometry.first,
        kind=geometry.kind,
        material=geometry.material,
        cos_incidence=geometry.cos_incidence,
        rotation=geometry.rotation,
        diffuse=geometry.diffuse,
        diffraction=geometry.diffraction,
        vertex=chains.vertex[chains.kind != 0].astype(np.float32),
    )
    return paths if (np.diff(paths.link) >= 0).all() else concatenate([paths])


def link_positions(links: Links) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check and return the positions of transmitters and receivers, each [L, 3], [m].

    Raises:
        InputError: There is no link, a position is not finite or too far away, or the ends of a link coincide.
    """
    if not (hasattr(links, "tx") and hasattr(links, "rx")):
        raise InputError(
            f"links: is a {type_name(links)}, but must have positions tx and rx, such as Measurements(tx, rx, "
            "path_loss_db)"
        )
    tx, rx = np.asarray(links.tx, dtype=float), np.asarray(links.rx, dtype=float)
    if tx.shape != rx.shape or tx.ndim != 2 or tx.shape[1:] != (3,) or not len(tx):
        raise InputError(
            f"links: tx has the shape {tx.shape} and rx the shape {rx.shape}; both must have the shape [links, 3], "
            "with at least one link"
        )
    for name, position in (("tx", tx), ("rx", rx)):
        # NaN fails the comparison.
        wrong = np.flatnonzero(~(np.abs(position) <= LARGEST_COORDINATE).all(axis=1))
        if len(wrong):
            link = wrong[0]
            fault = "is not finite" if not np.isfinite(position[link]).all() else "is too far away"
            raise InputError(f"link {link}: {name} position {position[link]} {fault}; give metres")
    coincident = np.flatnonzero(np.linalg.norm(tx - rx, axis=1) < MIN_DISTANCE)
    if len(coincident):
        link = coincident[0]
        raise InputError(f"link {link}: transmitter and receiver coincide at {tx[link]}; check the columns")
    return tx, rx


@dataclass(frozen=True)
class EnclosedAntennas:
    """Antennas inside closed bodies of the scene or below the ground, usually because of wrong positions.

    Attributes:
        tx: Rows of the source file whose transmitter is inside a body.
        rx: Rows of the source file whose receiver is inside a body.
        indoors: Whether most links have an antenna inside a body, as in an indoor scene; in this case, these antennas
            are not suspicious.
        tx_below: Rows of the source file whose transmitter is below the ground.
        rx_below: Rows of the source file whose receiver is below the ground.
    """

    tx: tuple[int, ...] = ()
    rx: tuple[int, ...] = ()
    indoors: bool = False
    tx_below: tuple[int, ...] = ()
    rx_below: tuple[int, ...] = ()

    @property
    def ends(self) -> tuple[tuple[str, tuple[int, ...], tuple[int, ...]], ...]:
        """Name of each end of the links, rows with this antenna inside a body, and rows with it below the ground."""
        return ("transmitter", self.tx, self.tx_below), ("receiver", self.rx, self.rx_below)

    @classmethod
    def of(
        cls,
        row: NDArray[np.integer],
        tx: NDArray[np.bool_],
        rx: NDArray[np.bool_],
        tx_below: NDArray[np.bool_] | None = None,
        rx_below: NDArray[np.bool_] | None = None,
    ) -> EnclosedAntennas:
        """Collect the rows of the source file, given the row of each link and the masks of enclosed antennas [L].

        Antennas that are also in `tx_below` or `rx_below` [L] are listed only as below the ground.
        """
        under = [np.zeros(len(row), dtype=bool) if mask is None else mask for mask in (tx_below, rx_below)]
        tx, rx = tx & ~under[0], rx & ~under[1]
        rows = [tuple(row[mask].tolist()) for mask in (tx, rx, *under)]
        return cls(rows[0], rows[1], bool(np.mean(tx | rx) > 0.5), rows[2], rows[3])
