"""Random path programs with any sequences of interactions, without a scene or a tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.constants import speed_of_light

from calibray.materials import Material
from calibray.paths import Diffraction, Diffuse, Kind, Paths

MATERIALS = {
    "walls": Material(4.3, 0.08, 0.18, 0.35, 0.2),
    "glass": Material(6.1, 0.02, 0.009, 0.5, 0.1, "directive", alpha_r=3.4),
    "ground": Material(2.7, 0.09, 0.05, 0.6, 0.3, "backscattering", alpha_r=5.6, alpha_i=2.5, lambda_=0.6),
}
LAMBERTIAN = {
    name: replace(material, scattering_pattern="lambertian", alpha_r=1.0, alpha_i=1.0, lambda_=1.0)
    for name, material in MATERIALS.items()
}
EVERY_KIND = [
    (),
    (Kind.SPECULAR,),
    (Kind.REFRACTION, Kind.SPECULAR),
    (Kind.SPECULAR, Kind.DIFFUSE, Kind.REFRACTION),
    (Kind.DIFFUSE, Kind.DIFFUSE),
    (Kind.DIFFUSE,),
    (Kind.DIFFRACTION,),
    (Kind.SPECULAR, Kind.DIFFRACTION, Kind.SPECULAR),
]


def program(
    sequences: Sequence[Sequence[Kind]],
    seed: int = 0,
    links: int = 2,
    ports: tuple[int, int] = (1, 1),
    materials: dict[str, Material] = MATERIALS,
    frequency: float = 2.4e9,
) -> Paths:
    """A path program with random geometry.

    Args:
        sequences: Kinds of the interactions of every path.
        seed: Seed of the geometry and the materials' indices.
        links: Number of links; every one has the same number of paths, up to one.
        ports: Receive and transmit ports.
        materials: Materials; every interaction has a random one.
        frequency: Carrier frequency [Hz].

    Returns:
        The program.
    """
    random = np.random.default_rng(seed)
    paths, kinds = len(sequences), [kind for sequence in sequences for kind in sequence]
    count, diffuse, wedges = len(kinds), kinds.count(Kind.DIFFUSE), kinds.count(Kind.DIFFRACTION)
    length = random.uniform(20, 60, paths)
    exterior = random.uniform(1.2, 1.9, wedges) * np.pi
    return Paths(
        frequency=frequency,
        materials=dict(materials),
        tx_position=random.uniform(-50, 50, (links, 3)),
        rx_position=random.uniform(-50, 50, (links, 3)),
        link=np.sort(np.arange(paths) % links).astype(np.int32),
        delay=length / speed_of_light,
        spreading=1 / length,
        departure=random.uniform(0, np.pi, (paths, 2)),
        arrival=random.uniform(0, np.pi, (paths, 2)),
        tx_field=_complex(random, (paths, ports[1], 2)),
        rx_field=_complex(random, (paths, ports[0], 2)),
        first=np.concatenate([[0], np.cumsum([len(sequence) for sequence in sequences], dtype=np.int64)]),
        kind=np.array(kinds, dtype=np.uint8),
        material=random.integers(len(materials), size=count).astype(np.int32),
        cos_incidence=random.uniform(0.2, 0.95, count),
        rotation=_rotations(random, (count,)),
        diffuse=Diffuse(
            rotation=_rotations(random, (diffuse,)),
            solid_angle=random.uniform(1, 6, diffuse),
            cos_scattered=random.uniform(0.2, 1, diffuse),
            cos_specular=random.uniform(-0.9, 0.9, diffuse),
            cos_backward=random.uniform(-0.9, 0.9, diffuse),
        ),
        diffraction=Diffraction(
            cos_incidence_n=random.uniform(0.2, 0.95, wedges),
            exterior_angle=exterior,
            azimuth_in=exterior * random.uniform(0.05, 0.95, wedges),
            azimuth_out=exterior * random.uniform(0.05, 0.95, wedges),
            sin_edge=random.uniform(0.4, 1, wedges),
            distance=random.uniform(1, 20, wedges),
            rotations=_rotations(random, (wedges, 4)),
        ),
        settings={"samples": 1000, "refraction": True, "scene": "synthetic"},
        vertex=random.uniform(-50, 50, (count, 3)).astype(np.float32),
    )


def _complex(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return random.normal(size=shape) + 1j * random.normal(size=shape)


def _rotations(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    angle = random.uniform(0, 2 * np.pi, shape)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
