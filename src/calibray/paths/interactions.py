"""Kinds of interaction, and tables of additional constants for diffuse reflections and diffractions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Kind(IntEnum):
    """Kinds of interaction, with the codes of Sionna RT."""

    SPECULAR = 1
    DIFFUSE = 2
    REFRACTION = 4
    DIFFRACTION = 8


@dataclass(frozen=True)
class Diffuse:
    """Additional constants of the diffuse reflections: one row per reflection, in the order of the interactions.

    Attributes:
        rotation: (cos, sin) [D, 2] of the rotation from the transverse electric frame into the spherical basis (theta,
            phi) of the incident direction. The XPD matrix acts in this basis.
        solid_angle: Solid angle [D], [sr], of the ray tube, divided by the sampling probability in the trace.
        cos_scattered: Cosine [D] of the angle between the scattered direction and the normal.
        cos_specular: Cosine [D] of the angle between the scattered and specular directions.
        cos_backward: Cosine [D] of the angle between the scattered direction and the direction back to the source.
    """

    rotation: NDArray[np.float64]
    solid_angle: NDArray[np.float64]
    cos_scattered: NDArray[np.float64]
    cos_specular: NDArray[np.float64]
    cos_backward: NDArray[np.float64]

    @classmethod
    def empty(cls) -> Diffuse:
        """A table without rows."""
        return cls(np.zeros((0, 2)), *(np.zeros(0) for _ in range(4)))


@dataclass(frozen=True)
class Diffraction:
    """Additional constants of the diffractions: one row per diffraction, in the order of the interactions.

    The cosine of incidence on the 0-face is in `Paths.cos_incidence`.

    Attributes:
        cos_incidence_n: Cosine [W] of the angle of incidence on the n-face.
        exterior_angle: Exterior angle [W], [rad], of the wedge.
        azimuth_in: Azimuth phi' [W], [rad], of the incident ray around the edge, measured from the 0-face.
        azimuth_out: Azimuth phi [W], [rad], of the diffracted ray, measured from the 0-face.
        sin_edge: Sine [W] of the angle beta_0 between the ray and the edge.
        distance: L = s s' sin^2(beta_0) / (s + s') [W], [m].
        rotations: (cos, sin) [W, 4, 2] of the four rotations between the edge-fixed frames and the transverse electric
            frames of the faces: in 0, out 0, in n, out n.
    """

    cos_incidence_n: NDArray[np.float64]
    exterior_angle: NDArray[np.float64]
    azimuth_in: NDArray[np.float64]
    azimuth_out: NDArray[np.float64]
    sin_edge: NDArray[np.float64]
    distance: NDArray[np.float64]
    rotations: NDArray[np.float64]

    @classmethod
    def empty(cls) -> Diffraction:
        """A table without rows."""
        return cls(*(np.zeros(0) for _ in range(6)), rotations=np.zeros((0, 4, 2)))
