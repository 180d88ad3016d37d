"""Geometry of traced paths: computes the constants of the path program from vertices and normals.

The field of a path is a Jones vector. Each interaction defines a frame for the Jones vector. At a surface with normal
n, the first axis of the frame is s = k x n / |k x n| (transverse electric), and the second axis is k x s. At an edge
that diffracts, the frame is fixed to the edge. Between interactions, Sionna RT
expresses the field in the basis (theta, phi) of the direction of travel. This module combines two rotations: from the
frame of one interaction into the basis (theta, phi), and from this basis into the frame of the next interaction. All
conventions are those of Sionna RT, so path gains agree with those of Sionna RT, including the phase. These conventions
concern the reference near the poles, the orientation of normals and wedges, and the direction after a reflection, for
which the mirrored direction is used instead of the traced direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.paths.interactions import Diffraction, Diffuse, Kind


@dataclass(frozen=True)
class Chains:
    """Paths found by a ray tracer, padded to the largest depth D.

    Attributes:
        source: Start of every path [P, 3], [m].
        target: End of every path [P, 3], [m].
        vertex: Interaction points [P, D, 3], [m].
        normal: Normals [P, D, 3] of the surfaces at the interactions; each can point to either side of the surface.
        kind: Kinds [P, D] of the interactions; 0 after the last interaction.
        material: Material index [P, D] of every interaction.
        probability: Probability [P, D] with which the tracer chose the kind of interaction.
        samples: Number of rays launched per source.
        edge: Directions of the diffracting edges [P, D, 3], read only at diffractions; empty without diffraction.
        normal_n: Normals of the n-faces of the wedges [P, D, 3], read only at diffractions.
        edge_lengths: Path lengths [P, D, 2], [m], read only at diffractions: s' from the source to an edge, and s from
            this edge to the next edge or to the target.
    """

    source: NDArray[np.float64]
    target: NDArray[np.float64]
    vertex: NDArray[np.float64]
    normal: NDArray[np.float64]
    kind: NDArray[np.integer]
    material: NDArray[np.integer]
    probability: NDArray[np.float64]
    samples: int = 1
    edge: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    normal_n: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    edge_lengths: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 2)))


@dataclass(frozen=True)
class Geometry:
    """The geometric part of a path program; names and shapes are those of `calibray.paths.Paths`.

    Attributes:
        delay: Propagation delay [P], [s].
        spreading: Amplitude spreading [P], [1/m].
        departure_direction: Unit vector of departure [P, 3].
        arrival_direction: Unit vector [P, 3] of the direction of travel at the target.
        departure_rotation: (cos, sin) [P, 2] of the rotation from the basis (theta, phi) of departure into the first
            frame.
        arrival_rotation: (cos, sin) [P, 2] of the rotation from the last frame into the basis (theta, phi) of arrival.
        first: Index [P + 1] of the first interaction of each path.
        kind: Kind of every interaction [I].
        material: Index of its material [I].
        cos_incidence: Cosine [I] of the angle of incidence.
        rotation: (cos, sin) [I, 2] of the rotation from the previous frame into the frame of the interaction.
        diffuse: Table of diffuse interactions.
        diffraction: Table of diffractions.
    """

    delay: NDArray[np.float64]
    spreading: NDArray[np.float64]
    departure_direction: NDArray[np.float64]
    arrival_direction: NDArray[np.float64]
    departure_rotation: NDArray[np.float64]
    arrival_rotation: NDArray[np.float64]
    first: NDArray[np.int64]
    kind: NDArray[np.integer]
    material: NDArray[np.integer]
    cos_incidence: NDArray[np.float64]
    rotation: NDArray[np.float64]
    diffuse: Diffuse
    diffraction: Diffraction


def compile_chains(chains: Chains) -> Geometry:
    """Compute the geometry that determines the fields of traced paths, with interactions in path order."""
    count, depth = chains.kind.shape
    present = chains.kind != 0
    length = present.sum(axis=1)
    stop = np.concatenate([chains.vertex, np.zeros((count, 1, 3))], axis=1)
    # the target follows the last interaction
    stop[np.arange(count), length] = chains.target
    ahead = np.concatenate([stop[:, :1] - chains.source[:, None], np.diff(stop, axis=1)], axis=1)
    # After the target, `stop` is padding.
    segment = np.linalg.norm(ahead, axis=2) * (np.arange(depth + 1) <= length[:, None])
    total = segment.sum(axis=1)
    direction = ahead / np.where(segment > 0, segment, 1.0)[..., None]

    # (cos, sin) from the frame of the latest interaction into the basis (theta, phi)
    out_of = np.tile([1.0, 0.0], (count, 1))
    departure_rotation = np.tile([1.0, 0.0], (count, 1))
    rotation, cosine = np.zeros((count, depth, 2)), np.zeros((count, depth))
    tables: dict[int, list[tuple[NDArray[Any], ...]]] = {Kind.DIFFUSE: [], Kind.DIFFRACTION: []}
    # Solid angle of the ray tube, as in Sionna RT: rays share the sphere equally, and every interaction divides the
    # solid angle by the probability with which its kind was chosen.
    solid_angle = np.full(count, 4 * np.pi / chains.samples)
    # Path length up to the start of the ray tube; a diffuse reflection starts a new ray tube.
    tube_start = np.zeros(count)
    # spreading of diffracted paths, 1/sqrt(s s' (s + s')) for a single edge; 0 for all other paths
    spread = np.zeros(count)
    travelled = segment[:, 0].copy()
    for step in range(depth):
        row = np.flatnonzero(present[:, step])
        incident, leaving = direction[row, step], direction[row, step + 1]
        normal = chains.normal[row, step]
        # Orient the normal towards the incident wave.
        normal = normal * _sign(_dot(normal, -incident))[:, None]
        cosine[row, step] = np.abs(_dot(incident, normal))
        solid_angle[row] *= _inverse(chains.probability[row, step])
        kind = chains.kind[row, step]
        entering = transverse_electric(incident, normal)
        mirrored = incident - 2 * _dot(incident, normal)[:, None] * normal
        # Direction in whose basis Sionna RT expresses the field after the interaction.
        onward = np.where((kind == Kind.SPECULAR)[:, None], mirrored, incident)
        exiting = entering.copy()

        diffuse = kind == Kind.DIFFUSE
        if diffuse.any():
            rows, k_in, k_out = row[diffuse], incident[diffuse], leaving[diffuse]
            tables[Kind.DIFFUSE].append(
                (
                    rows,
                    np.full(len(rows), step),
                    *_diffuse(k_in, k_out, normal[diffuse], entering[diffuse]),
                    solid_angle[rows],
                )
            )
            exiting[diffuse], onward[diffuse] = spherical_basis(k_out, pole_reference=False), k_out
            # The ray tube of a diffuse reflection fills the half space.
            solid_angle[rows] = 2 * np.pi
            tube_start[rows] = travelled[rows]

        wedge = kind == Kind.DIFFRACTION
        if wedge.any():
            rows, k_in, k_out = row[wedge], incident[wedge], leaving[wedge]
            edge, normal_n = chains.edge[rows, step], chains.normal_n[rows, step]
            before, after = chains.edge_lengths[rows, step].T
            # An edge multiplies the amplitude by sqrt(s' / (s (s' + s))); the amplitude at the first edge is 1/s'.
            arriving = np.where(spread[rows] > 0, spread[rows], 1 / before)
            spread[rows] = arriving * np.sqrt(before / (after * (before + after)))
            constants = _wedge(k_in, k_out, normal[wedge], normal_n, edge, before * after / (before + after))
            tables[Kind.DIFFRACTION].append((rows, np.full(len(rows), step), *constants))
            # Edge-fixed frames: the first axes are k_in x e and -(k_out x e).
            entering[wedge] = _unit(_cross(k_in, edge))
            exiting[wedge], onward[wedge] = -_unit(_cross(k_out, edge)), k_out

        into = rotate(incident, spherical_basis(incident), entering)
        if step == 0:
            # The first rotation is applied to the transmit field.
            departure_rotation[row], rotation[row, 0] = into, [1.0, 0.0]
        else:
            rotation[row, step] = _compose(out_of[row], into)
        out_of[row] = rotate(onward, exiting, spherical_basis(onward))
        travelled[row] += segment[row, step + 1]

    last = direction[np.arange(count), length]
    # the spreading of the diffraction if there is one, otherwise 1 / r from the start of the ray tube
    spread = np.where(spread > 0, spread, 1 / (total - tube_start))
    flat = present.reshape(-1)
    return Geometry(
        delay=total / speed_of_light,
        spreading=spread,
        departure_direction=direction[:, 0],
        arrival_direction=last,
        departure_rotation=departure_rotation,
        arrival_rotation=out_of,
        first=np.concatenate([[0], np.cumsum(length)]).astype(np.int64),
        kind=chains.kind.reshape(-1)[flat].astype(np.uint8),
        material=chains.material.reshape(-1)[flat].astype(np.int32),
        cos_incidence=cosine.reshape(-1)[flat],
        rotation=rotation.reshape(-1, 2)[flat],
        diffuse=Diffuse(*_in_path_order(tables[Kind.DIFFUSE], Diffuse.empty())),
        diffraction=Diffraction(*_in_path_order(tables[Kind.DIFFRACTION], Diffraction.empty())),
    )


def spherical_basis(direction: NDArray[np.float64], pole_reference: bool = True) -> NDArray[np.float64]:
    """Basis vector theta [..., 3], the first axis of the basis (theta, phi), for directions of travel [..., 3].

    Near the poles, `pole_reference` selects the fixed reference -x of Sionna RT instead of the limit of theta.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    rho = np.hypot(x, y)
    pole = rho < 1e-6
    cos_phi, sin_phi = (
        np.where(pole, 1.0, x / np.where(pole, 1.0, rho)),
        np.where(pole, 0.0, y / np.where(pole, 1.0, rho)),
    )
    theta = np.stack([z * cos_phi, z * sin_phi, -rho], axis=-1)
    if not pole_reference:
        return theta
    reference = np.array([-1.0, 0.0, 0.0])
    fallback = reference - _dot(direction, reference)[..., None] * direction
    # Sionna compares in single precision.
    near = np.abs(np.float32(z)) > np.float32(1 - 5e-7)
    return np.where(near[..., None], _unit(np.where(near[..., None], fallback, reference)), theta)


def transverse_electric(direction: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """First axis [..., 3] of the frame of incidence: the normalized k x n (ITU-R P.2040 section 2.2.2).

    At normal incidence, any transverse vector can be used, because the transverse electric and magnetic coefficients
    describe the same reflection.
    """
    cross = _cross(direction, normal)
    degenerate = _dot(cross, cross) < 1e-12
    reference = np.where((np.abs(direction[..., 0]) < 0.9)[..., None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    fallback = reference - _dot(reference, direction)[..., None] * direction
    return _unit(np.where(degenerate[..., None], fallback, cross))


def rotate(
    direction: NDArray[np.float64], current: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(cos, sin) [..., 2] of the angle by which the frame of a Jones vector is rotated about the direction of travel.

    The vector (a, b) becomes (cos a + sin b, -sin a + cos b). `current` and `target` [..., 3] are the first axes of the
    two frames.
    """
    return np.stack([_dot(current, target), _dot(direction, _cross(current, target))], axis=-1)


def zenith_azimuth(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zenith and azimuth [..., 2], [rad], of unit vectors, in [0, pi] and (-pi, pi]; near the poles, azimuth is 0."""
    x, y, z = np.moveaxis(direction, -1, 0)
    rho = np.hypot(x, y)
    # The threshold is that of `spherical_basis`; without it, rounding errors would give a vertical path an arbitrary
    # azimuth.
    return np.stack([np.arctan2(rho, z), np.where(rho < 1e-6, 0.0, np.arctan2(y, x))], axis=-1)


def _diffuse(
    incident: NDArray[np.float64],
    leaving: NDArray[np.float64],
    normal: NDArray[np.float64],
    frame: NDArray[np.float64],
) -> tuple[NDArray[np.float64], ...]:
    mirrored = incident - 2 * _dot(incident, normal)[:, None] * normal
    return (
        rotate(incident, frame, spherical_basis(incident, pole_reference=False)),
        np.abs(_dot(leaving, normal)),
        _dot(mirrored, leaving),
        -_dot(incident, leaving),
    )


def _wedge(
    incident: NDArray[np.float64],
    leaving: NDArray[np.float64],
    normal_0: NDArray[np.float64],
    normal_n: NDArray[np.float64],
    edge: NDArray[np.float64],
    distance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], ...]:
    """Constants of a wedge diffraction, in the conventions of Sionna RT.

    `distance` is s s' / (s + s'), where s and s' are the distances to the edge. The function returns the columns of
    `Diffraction` (Kouyoumjian and Pathak 1974; ITU-R P.526-15 section 4.5).
    """
    # Both normals point out of the wedge, so its interior angle is arccos(-n_0 . n_n).
    exterior = 2 * np.pi - np.arccos(np.clip(-_dot(normal_0, normal_n), -1, 1))
    cos_edge = np.abs(_dot(incident, edge))
    tangent = _unit(_cross(normal_0, edge))
    azimuth_in = _azimuth(-_unit(_reject(incident, edge)), tangent, normal_0)
    azimuth_out = _azimuth(_unit(_reject(leaving, edge)), tangent, normal_0)
    sin_edge = np.sqrt(np.maximum(1 - cos_edge**2, 0))
    phi_in = _unit(_cross(incident, edge))
    turns = []
    for normal in (normal_0, normal_n):
        # Direction of the reflection boundary.
        mirrored = incident - 2 * _dot(incident, normal)[:, None] * normal
        face = transverse_electric(incident, normal)
        boundary = -_unit(_cross(mirrored, edge))
        turns += [rotate(incident, phi_in, face), rotate(mirrored, face, boundary)]
    return (
        np.abs(_dot(incident, normal_n)),
        exterior,
        azimuth_in,
        azimuth_out,
        sin_edge,
        distance * sin_edge**2,
        np.stack(turns, axis=1),
    )


def _azimuth(
    away: NDArray[np.float64], tangent: NDArray[np.float64], normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Azimuth in [0, 2 pi), measured from the 0-face, of a direction that points away from the edge."""
    # The angle from arccos is the azimuth in front of the plane of the 0-face; behind this plane, the azimuth is 2 pi
    # minus the angle.
    angle = np.pi - np.arccos(np.clip(_dot(away, tangent), -1, 1))
    return np.pi - angle * _sign(_dot(away, normal))


def _compose(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """(cos, sin) of the composition of two rotations."""
    (cos_1, sin_1), (cos_2, sin_2) = first.T, second.T
    return np.stack([cos_1 * cos_2 - sin_1 * sin_2, sin_1 * cos_2 + cos_1 * sin_2], axis=-1)


def _in_path_order(
    parts: list[tuple[NDArray[Any], ...]], empty: Diffuse | Diffraction
) -> list[NDArray[np.float64]]:
    """Sort the rows of a table into the order of the interactions; the rows were collected step by step."""
    if not parts:
        return list(vars(empty).values())
    path, step, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((step, path))
    columns = [column[order] for column in columns]
    # The solid angle was collected last, but is the second column of the table.
    if isinstance(empty, Diffuse):
        rotation, scattered, specular, backward, solid_angle = columns
        return [rotation, solid_angle, scattered, specular, backward]
    return columns


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sum(a * b, axis=-1)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.cross(a, b), dtype=np.float64)


def _sign(value: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(value >= 0, 1.0, -1.0)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _reject(vector: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector - _dot(vector, axis)[:, None] * axis


def _inverse(probability: NDArray[np.float64]) -> NDArray[np.float64]:
    # A choice with probability 0 contributes nothing, as in Sionna RT.
    return np.where(probability > 0, 1 / np.where(probability > 0, probability, 1.0), 0.0)
