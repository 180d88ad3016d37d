"""Path gains by complex numbers, one path after the other: an independent and slow implementation to compare with.

Nothing is compiled, so that tests of anything but the compiled fields need not wait for a compiler.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.constants import epsilon_0, speed_of_light

from calibray.materials import Material
from calibray.paths import Kind, Paths

Pair = tuple[complex, complex]


def slab(cosine: float, material: Material, frequency: float) -> tuple[Pair, Pair]:
    """Reflection and transmission coefficients of a slab, each transverse electric and magnetic (ITU-R P.2040-3)."""
    eta = material.relative_permittivity - 1j * material.conductivity / (2 * np.pi * frequency * epsilon_0)
    root = np.sqrt(eta - (1 - cosine**2))
    phase = np.exp(-2j * np.pi * frequency / speed_of_light * material.thickness * root)  # e^{-jq}, eq. 44
    # eq. 37
    half_spaces = (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)
    # eq. 43
    reflected = [r * (1 - phase**2) / (1 - r**2 * phase**2) for r in half_spaces]
    transmitted = [(1 - r**2) * phase / (1 - r**2 * phase**2) for r in half_spaces]
    return (reflected[0], reflected[1]), (transmitted[0], transmitted[1])


def gains(paths: Paths, materials: Mapping[str, Material] | None = None) -> np.ndarray:
    """Path gains (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx [P, R, T], for all kinds but diffraction.

    Args:
        paths: The path program; diffuse interactions follow Lambert's law.
        materials: Constants by name; materials not named keep those of the trace.

    Returns:
        Complex gains [P, R, T].
    """
    assert not (paths.kind == Kind.DIFFRACTION).any()
    constants = list({**paths.materials, **(materials or {})}.values())
    result = np.zeros((paths.num_paths, paths.rx_field.shape[1], paths.tx_field.shape[1]), dtype=complex)
    diffuse_row = np.cumsum(paths.kind == Kind.DIFFUSE) - 1
    scale = paths.spreading * speed_of_light / paths.frequency / (4 * np.pi)
    for path in range(paths.num_paths):
        for port in range(paths.tx_field.shape[1]):
            field = paths.tx_field[path, port]
            for index in range(paths.first[path], paths.first[path + 1]):
                material = constants[paths.material[index]]
                field = _rotation(paths.rotation[index]) @ field
                reflected, transmitted = slab(paths.cos_incidence[index], material, paths.frequency)
                if paths.kind[index] == Kind.REFRACTION:
                    field = np.array(transmitted) * field
                elif paths.kind[index] == Kind.SPECULAR:
                    field = np.sqrt(1 - material.scattering_coefficient**2) * np.array(reflected) * field
                else:
                    field = _scattered(paths, diffuse_row[index], material, field, np.array(reflected))
            result[path, :, port] = scale[path] * np.conj(paths.rx_field[path]) @ field
    return result


def _scattered(
    paths: Paths, row: int, material: Material, field: np.ndarray, reflected: np.ndarray
) -> np.ndarray:
    assert material.scattering_pattern == "lambertian"
    table = paths.diffuse
    gamma = np.linalg.norm(reflected * field) / np.linalg.norm(field)
    density = table.cos_scattered[row] / np.pi
    amplitude = material.scattering_coefficient * gamma * np.sqrt(density * table.solid_angle[row])
    co, cross = np.sqrt(1 - material.xpd_coefficient), np.sqrt(material.xpd_coefficient)
    return amplitude * np.array([[co, -cross], [cross, co]]) @ _rotation(table.rotation[row]) @ field


def _rotation(cos_sin: np.ndarray) -> np.ndarray:
    cos, sin = cos_sin
    return np.array([[cos, sin], [-sin, cos]])
