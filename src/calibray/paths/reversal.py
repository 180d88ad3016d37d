"""A path program in the other direction, by reciprocity: transmitters become receivers, every gain is its transpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibray.errors import InputError
from calibray.paths.interactions import Kind
from calibray.paths.program import Paths


def reversed_paths(paths: Paths) -> Paths:
    """The same paths from their receivers to their transmitters.

    A gain is E_rx^H C_K R_K ... C_2 R_2 C_1 E_tx with diagonal C and rotations R; its transpose is one of that kind
    too. Nothing is computed anew, so that gains are the same but for the order of the sums.

    Args:
        paths: A path program of reflections and transmissions.

    Returns:
        The program whose gains [P, T, R] are the transposes of those given; its paths in the order given.

    Raises:
        InputError: A path scatters or is diffracted, which has a direction.
    """
    if np.isin(paths.kind, (Kind.DIFFUSE, Kind.DIFFRACTION)).any():
        raise InputError(
            "paths with diffuse reflection or diffraction have a direction; leave them out, or trace the links with "
            "their ends exchanged"
        )
    depth = np.diff(paths.first)
    begin, end = (np.repeat(edge, depth) for edge in (paths.first[:-1], paths.first[1:]))
    place = np.arange(paths.num_interactions)
    mirrored = begin + end - 1 - place
    first = place == begin
    # The rotation into an interaction's frame was the one out of it, the other way round; into the first there is none.
    rotation = paths.rotation[np.where(first, place, mirrored + 1)] * [1.0, -1.0]
    return replace(
        paths,
        tx_position=paths.rx_position,
        rx_position=paths.tx_position,
        departure=paths.arrival,
        arrival=paths.departure,
        tx_field=paths.rx_field.conj(),
        rx_field=paths.tx_field.conj(),
        kind=paths.kind[mirrored],
        material=paths.material[mirrored],
        cos_incidence=paths.cos_incidence[mirrored],
        rotation=np.where(first[:, None], [1.0, 0.0], rotation),
        vertex=None if paths.vertex is None else paths.vertex[mirrored],
    )
