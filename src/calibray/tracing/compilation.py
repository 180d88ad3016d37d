"""Compilation: what any tracer found, and the antennas at both ends, as a path program."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibray.materials import Material
from calibray.paths import Paths, concatenate
from calibray.paths.chains import Chains, compile_chains, zenith_azimuth
from calibray.tracing.antennas import Radiator, turned


def compile_paths(
    chains: Chains,
    link: NDArray[np.integer],
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    frequency: float,
    materials: Mapping[str, Material],
    antennas: tuple[Radiator, Radiator],
    settings: Mapping[str, object] | None = None,
) -> Paths:
    """Compile the paths that a tracer found into a path program.

    Args:
        chains: The paths.
        link: Link of every path, in any order [P].
        tx: Transmitter of every link [L, 3], [m].
        rx: Receiver of every link [L, 3], [m].
        frequency: Carrier frequency [Hz].
        materials: The materials by name; the chains' numbers of materials count in this order.
        antennas: Transmit and receive antenna (`Radiator.of`).
        settings: How the paths were found, for the record.

    Returns:
        The program, its paths ordered by link, and within a link as given.
    """
    program = compile_chains(chains)
    departure, arrival = program.departure_direction, program.arrival_direction
    paths = Paths(
        frequency=frequency,
        materials=dict(materials),
        tx_position=tx,
        rx_position=rx,
        link=np.asarray(link).astype(np.int32),
        delay=program.delay,
        spreading=program.spreading,
        departure=zenith_azimuth(departure),
        arrival=zenith_azimuth(-arrival),
        tx_field=turned(antennas[0].jones_vectors(departure), program.departure_rotation),
        rx_field=turned(
            antennas[1].jones_vectors(-arrival, arriving=True), program.arrival_rotation * [1, -1]
        ),
        first=program.first,
        kind=program.kind,
        material=program.material,
        cos_incidence=program.cos_incidence,
        rotation=program.rotation,
        diffuse=program.diffuse,
        diffraction=program.diffraction,
        settings=dict(settings or {}),
        vertex=chains.vertex[chains.kind != 0].astype(np.float32),
    )
    return paths if (np.diff(paths.link) >= 0).all() else concatenate([paths])
