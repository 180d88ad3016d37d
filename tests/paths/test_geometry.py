"""Geometry of paths: the chain of frames against fields carried along as vectors in space."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

import reference_fields
from calibray.materials import Material
from calibray.paths import Kind, Paths
from calibray.paths.chains import (
    Chains,
    Geometry,
    compile_chains,
    rotate,
    spherical_basis,
    transverse_electric,
    zenith_azimuth,
)

FREQUENCY = 3e9
WALL = Material(4.0, 0.1, 0.07, scattering_coefficient=0.6)
SAMPLES = 1000
S, D, T = Kind.SPECULAR, Kind.DIFFUSE, Kind.REFRACTION
SEQUENCES = [(), (S,), (T,), (D,), (S, T), (T, S, S), (S, D), (D, S, T), (T, D, D)]


def random_chains(seed: int) -> Chains:
    """Paths of every sequence that obey the law of reflection, at random positions and in random directions."""
    random = np.random.default_rng(seed)
    count, depth = len(SEQUENCES), max(map(len, SEQUENCES))
    kind = np.array([[*sequence, *[0] * (depth - len(sequence))] for sequence in SEQUENCES])
    vertex, normal = (
        np.full((count, depth, 3), 99.0),
        np.zeros((count, depth, 3)),
    )  # 99: unused entries, which Sionna does not clear
    source, direction = random.uniform(-9, 9, (count, 3)), unit(random.normal(size=(count, 3)))
    position = source.copy()
    for step in range(depth):
        row = np.flatnonzero(kind[:, step])
        position[row] += direction[row] * random.uniform(1, 9, (len(row), 1))
        vertex[row, step] = position[row]
        face = unit(random.normal(size=(len(row), 3)))
        normal[row, step] = face
        towards = face * -np.sign((face * direction[row]).sum(axis=1, keepdims=True))
        mirrored = direction[row] - 2 * (direction[row] * face).sum(axis=1, keepdims=True) * face
        scattered = unit(random.normal(size=(len(row), 3)))
        scattered *= np.sign((scattered * towards).sum(axis=1, keepdims=True))
        new = {S: mirrored, T: direction[row], D: scattered}
        direction[row] = np.choose(
            np.searchsorted([S, D, T], kind[row, step])[:, None], [new[S], new[D], new[T]]
        )
    return Chains(
        source=source,
        target=position + direction * random.uniform(1, 9, (count, 1)),
        vertex=vertex,
        normal=normal,
        kind=kind,
        material=np.zeros_like(kind),
        probability=np.where(kind > 0, random.uniform(0.2, 1, kind.shape), 1.0),
        samples=SAMPLES,
    )


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def theta_phi(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Basis vectors of the spherical coordinates, from the angles of a direction."""
    x, y, z = direction
    azimuth, rho = np.arctan2(y, x), np.hypot(x, y)
    return (
        np.array([z * np.cos(azimuth), z * np.sin(azimuth), -rho]),
        np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]),
    )


def carried_in_space(chains: Chains, path: int) -> np.ndarray:
    """Gains [R, T] of a path between antennas with fields theta and phi, the field carried as a vector in space."""
    kinds = [Kind(kind) for kind in chains.kind[path] if kind]
    stops = [chains.source[path], *chains.vertex[path][: len(kinds)], chains.target[path]]
    travel = [unit(b - a) for a, b in pairwise(stops)]
    lengths = [np.linalg.norm(b - a) for a, b in pairwise(stops)]
    wavelength = speed_of_light / FREQUENCY
    gains = np.zeros((2, 2), dtype=complex)
    for port, field in enumerate(theta_phi(travel[0])):
        field, since, tube = field.astype(complex), 0, 4 * np.pi / SAMPLES
        for step, kind in enumerate(kinds):
            k_in, k_out, n = travel[step], travel[step + 1], chains.normal[path, step]
            tube /= chains.probability[path, step]
            te = unit(np.cross(k_in, n))
            tm, tm_out = np.cross(k_in, te), np.cross(k_out, te)
            cosine = abs(k_in @ n)
            c_te, c_tm = reference_fields.slab(cosine, WALL, FREQUENCY)[kind == T]
            if kind == D:
                reflected = np.hypot(abs(c_te * (field @ te)), abs(c_tm * (field @ tm)))
                gamma = reflected / np.linalg.norm(field)
                amplitude = WALL.scattering_coefficient * gamma * np.sqrt(abs(k_out @ n) / np.pi * tube)
                (theta, phi), (theta_out, phi_out) = theta_phi(k_in), theta_phi(k_out)
                field = amplitude * ((field @ theta) * theta_out + (field @ phi) * phi_out)
                since, tube = step + 1, 2 * np.pi
            else:
                kept = np.sqrt(1 - WALL.scattering_coefficient**2) if kind == S else 1.0
                field = kept * (c_te * (field @ te) * te + c_tm * (field @ tm) * tm_out)
        scale = wavelength / (4 * np.pi) / sum(lengths[since:])
        gains[:, port] = [scale * (field @ axis) for axis in theta_phi(travel[-1])]
    return gains


def as_paths(geometry: Geometry, count: int) -> Paths:
    """The geometry between antennas with fields theta and phi at both ends."""

    def turned(rotation: np.ndarray) -> np.ndarray:
        cos, sin = rotation.T
        return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=1).astype(
            complex
        )

    shared = {entry.name for entry in fields(Geometry)} & {entry.name for entry in fields(Paths)}
    return Paths(
        frequency=FREQUENCY,
        materials={"wall": WALL},
        tx_position=np.zeros((count, 3)),
        rx_position=np.ones((count, 3)),
        link=np.arange(count, dtype=np.int32),
        departure=zenith_azimuth(geometry.departure_direction),
        arrival=zenith_azimuth(-geometry.arrival_direction),
        tx_field=turned(geometry.departure_rotation),
        rx_field=turned(geometry.arrival_rotation * [1, -1]),
        vertex=np.zeros((len(geometry.kind), 3), dtype=np.float32),
        **{name: getattr(geometry, name) for name in shared},
    )


@pytest.mark.parametrize("seed", range(5))
def test_chain_of_frames_equals_the_field_carried_in_space(seed: int) -> None:
    chains = random_chains(seed)
    gains = reference_fields.gains(as_paths(compile_chains(chains), len(SEQUENCES)))
    for path, sequence in enumerate(SEQUENCES):
        expected = carried_in_space(chains, path)
        np.testing.assert_allclose(gains[path], expected, rtol=1e-9, atol=1e-12, err_msg=str(sequence))


def assert_same(one: Geometry, other: Geometry) -> None:
    for entry in fields(Geometry):
        a, b = getattr(one, entry.name), getattr(other, entry.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_allclose(a, b, atol=1e-9, err_msg=entry.name)


def test_normals_may_point_to_either_side() -> None:
    chains = random_chains(1)
    assert_same(compile_chains(chains), compile_chains(replace(chains, normal=-chains.normal)))


def test_scene_may_be_moved_and_turned_about_the_vertical() -> None:
    chains = random_chains(2)
    turn = Rotation.from_euler("z", 1.1)

    def moved(points: np.ndarray, by: float = 30.0) -> np.ndarray:
        return turn.apply(points.reshape(-1, 3)).reshape(points.shape) + by

    other = replace(
        chains,
        source=moved(chains.source),
        target=moved(chains.target),
        vertex=moved(chains.vertex),
        normal=moved(chains.normal, by=0.0),
    )
    original, transformed = compile_chains(chains), compile_chains(other)
    for name in ("delay", "spreading", "cos_incidence", "rotation", "departure_rotation", "arrival_rotation"):
        np.testing.assert_allclose(
            getattr(original, name), getattr(transformed, name), atol=1e-9, err_msg=name
        )


def test_lengths_delays_and_solid_angles() -> None:
    chains = random_chains(3)
    geometry = compile_chains(chains)
    for path, sequence in enumerate(SEQUENCES):
        stops = np.array([chains.source[path], *chains.vertex[path][: len(sequence)], chains.target[path]])
        lengths = np.linalg.norm(np.diff(stops, axis=0), axis=1)
        assert geometry.delay[path] * speed_of_light == pytest.approx(lengths.sum())
        after = sequence[::-1].index(D) + 1 if D in sequence else len(lengths)  # the last ray tube's segments
        assert geometry.spreading[path] == pytest.approx(1 / lengths[-after:].sum())
    first = [sequence.index(D) for sequence in SEQUENCES if D in sequence]
    rows = [path for path, sequence in enumerate(SEQUENCES) if D in sequence]
    chosen = [np.prod(chains.probability[path, : step + 1]) for path, step in zip(rows, first, strict=True)]
    angles = geometry.diffuse.solid_angle[np.cumsum([0, *(SEQUENCES[path].count(D) for path in rows)])[:-1]]
    np.testing.assert_allclose(angles, 4 * np.pi / SAMPLES / np.array(chosen))
    twice = SEQUENCES.index((T, D, D))
    assert geometry.diffuse.solid_angle[-1] == pytest.approx(2 * np.pi / chains.probability[twice, 2])


# Wedges

INSIDE_OUT = st.floats(0.05, 0.95)


@given(st.floats(1.05, 1.95), INSIDE_OUT, INSIDE_OUT, st.floats(-2, 2), st.integers(0, 99))
def test_angles_of_a_wedge_equal_those_of_its_construction(
    exterior: float, share_in: float, share_out: float, along: float, seed: int
) -> None:
    """A wedge with its edge through the origin, turned at random; exterior angle in units of pi."""
    exterior, before, after = exterior * np.pi, 3.0, 5.0
    azimuth = exterior * share_in, exterior * share_out
    turn = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-2, 2, 3))

    def around(angle: float, radius: float, height: float) -> np.ndarray:
        return np.array([radius * np.cos(angle), radius * np.sin(angle), height])

    source, target = around(azimuth[0], before, -along * before), around(azimuth[1], after, along * after)
    # Faces along azimuth 0 and azimuth `exterior`, normals into the exterior.
    normal_0, normal_n = np.array([0.0, 1, 0]), np.array([np.sin(exterior), -np.cos(exterior), 0.0])
    placed = [
        turn.apply(vector)[None] for vector in (source, target, normal_0, normal_n, np.array([0.0, 0, 1]))
    ]
    sine = 1 / np.sqrt(1 + along**2)
    chains = Chains(
        source=placed[0],
        target=placed[1],
        vertex=np.zeros((1, 1, 3)),
        normal=placed[2][None],
        kind=np.array([[Kind.DIFFRACTION]]),
        material=np.zeros((1, 1), dtype=int),
        probability=np.ones((1, 1)),
        samples=SAMPLES,
        edge=placed[4][None],  # n_0 x edge points along the 0-face, away from the edge
        normal_n=placed[3][None],
        edge_lengths=np.array([[[before, after]]]) / sine,
    )
    geometry = compile_chains(chains)
    wedge = geometry.diffraction
    lit = np.sin(azimuth[0]) > 0  # the incident ray comes from the side that the 0-face's normal points to
    assert wedge.sin_edge[0] == pytest.approx(sine, abs=1e-9)
    assert wedge.distance[0] == pytest.approx(before * after / (before + after) * sine)
    assert geometry.spreading[0] == pytest.approx((before * after * (before + after) / sine**3) ** -0.5)
    assert geometry.cos_incidence[0] == pytest.approx(abs(np.sin(azimuth[0])) * sine, abs=1e-9)
    assert wedge.cos_incidence_n[0] == pytest.approx(abs(np.sin(exterior - azimuth[0])) * sine, abs=1e-9)
    if lit:
        assert wedge.exterior_angle[0] == pytest.approx(exterior, abs=1e-6)
        assert wedge.azimuth_in[0] == pytest.approx(azimuth[0], abs=1e-6)
        assert wedge.azimuth_out[0] == pytest.approx(azimuth[1], abs=1e-6)


# Frames


@given(st.integers(0, 1000))
def test_spherical_basis_follows_from_the_angles(seed: int) -> None:
    direction = unit(np.random.default_rng(seed).normal(size=3))
    zenith, azimuth = zenith_azimuth(direction)
    np.testing.assert_allclose(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)],
        direction,
        atol=1e-12,
    )
    np.testing.assert_allclose(spherical_basis(direction), theta_phi(direction)[0], atol=1e-12)


def test_reference_near_the_poles_equals_sionnas() -> None:
    for tilt in (0.0, 1e-7, 1e-4, 5e-4):
        for sign in (1, -1):
            direction = np.array([np.sin(tilt), 0.0, sign * np.cos(tilt)])
            np.testing.assert_allclose(
                spherical_basis(direction), [-np.cos(tilt), 0, sign * np.sin(tilt)], atol=1e-12
            )
    far = np.array([np.sin(0.01), 0.0, np.cos(0.01)])
    np.testing.assert_allclose(spherical_basis(far), [np.cos(0.01), 0, -np.sin(0.01)], atol=1e-12)
    np.testing.assert_allclose(spherical_basis(np.array([0.0, 0, 1.0]), pole_reference=False), [1, 0, 0])


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-3, 1.0])
def test_transverse_electric_axis_is_a_unit_vector_across_direction_and_normal(tilt: float) -> None:
    direction, normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)]), np.array([0.0, 0, 1])
    axis = transverse_electric(direction, normal)
    assert np.linalg.norm(axis) == pytest.approx(1)
    assert axis @ direction == pytest.approx(0, abs=1e-12)
    if tilt > 1e-6:
        assert axis @ normal == pytest.approx(0, abs=1e-12)


@given(st.integers(0, 1000), st.floats(-3.1, 3.1))
def test_rotation_between_two_axes_is_the_angle_between_them(seed: int, angle: float) -> None:
    direction = unit(np.random.default_rng(seed).normal(size=3))
    first = spherical_basis(direction)
    second = Rotation.from_rotvec(angle * direction).apply(first)
    np.testing.assert_allclose(rotate(direction, first, second), [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_no_paths_compile_to_an_empty_program() -> None:
    chains = random_chains(0)
    arrays = {
        entry.name: getattr(chains, entry.name)[:0]
        for entry in fields(Chains)
        if isinstance(getattr(chains, entry.name), np.ndarray)
    }
    geometry = compile_chains(replace(chains, **arrays))
    assert geometry.first.tolist() == [0]
    assert len(geometry.delay) == len(geometry.kind) == len(geometry.diffuse.solid_angle) == 0
