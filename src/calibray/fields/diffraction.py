"""First-order diffraction at wedges: the part of the uniform theory (UTD) that is independent of the materials.

The Jones matrix of a diffracted ray is affine in the reflection coefficients of the wedge's two faces,
J = C_0 + R_te(0) C_1 + R_tm(0) C_2 + R_te(n) C_3 + R_tm(n) C_4, with constant matrices C_k. A diffraction therefore has
the form of a reflection with four coefficients instead of two.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.special import modfresnelm

from calibray.paths import Diffraction


def affine_form(table: Diffraction, row: NDArray[np.int64], frequency: float) -> NDArray[np.complex128]:
    """The matrices C_0 .. C_4 of diffractions in the edge-fixed frames [5, 2, 2, n], for rows [n] of a table."""
    exterior, phi_in, phi_out = table.exterior_angle[row], table.azimuth_in[row], table.azimuth_out[row]
    wavenumber = 2 * np.pi * frequency / speed_of_light
    n = exterior / np.pi
    # Common factor of the four terms: -e^{-j pi/4} / (2 n sqrt(2 pi k) sin beta_0)
    scale = -np.exp(-0.25j * np.pi) / (2 * n * np.sqrt(2 * np.pi * wavenumber) * table.sin_edge[row])
    size = wavenumber * table.distance[row]  # k L
    difference, total = phi_out - phi_in, phi_out + phi_in

    def term(sign: int, beta: NDArray[np.float64]) -> NDArray[np.complex128]:
        """One of the four terms D_i (Kouyoumjian and Pathak 1974, eq. 25; ITU-R P.526-15 eqs. 66-69)."""
        # a(beta) = 2 cos^2((2 n pi N - beta) / 2), where N is the integer that best satisfies 2 pi n N - beta = +-pi
        turns = np.round((beta + sign * np.pi) / (2 * exterior))
        a = 2 * np.cos(exterior * turns - beta / 2) ** 2
        return scale * _cotangent_times_transition((np.pi + sign * beta) / (2 * n), size * a, n, size)

    # D_1 - D_4 and D_2 - D_3 as in Sionna RT, where the terms of the 0-face have the wrong sign
    # (docs/explanation/fidelity.md).
    zero_face = term(1, difference) - term(-1, total)
    n_face = term(-1, difference) - term(1, total)
    in_0, out_0, in_n, out_n = (_matrix(table.rotations[row, k]) for k in range(4))
    unlit = exterior > np.pi + phi_in  # the n-face is not lit: R_n = -1
    lit_n_face = np.where(unlit, 0.0, n_face)
    form = np.zeros((5, 2, 2, len(row)), dtype=complex)
    form[0] = np.where(unlit, -n_face, 0.0) * np.eye(2)[:, :, None]
    for component in range(2):
        # One term of W_out diag(R_te, R_tm) W_in: a column of W_out times a row of W_in.
        form[1 + component] = zero_face * out_0[:, None, component] * in_0[None, component, :]
        form[3 + component] = lit_n_face * out_n[:, None, component] * in_n[None, component, :]
    return form


def transition(x: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Transition function F(x) = 2 j sqrt(x) e^{jx} int_{sqrt x}^inf e^{-j u^2} du (Kouyoumjian and Pathak, eq. 27).

    The argument x is at least 0 [...].
    """
    root = np.sqrt(x)
    return 2j * root * np.exp(1j * x) * modfresnelm(root)[0]


def _cotangent_times_transition(
    psi: NDArray[np.float64], x: NDArray[np.float64], n: NDArray[np.float64], size: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """cot(psi) F(x), or its finite limit on shadow and reflection boundaries, where F is 0 at the pole of cot."""
    sine = np.sin(psi)
    pole = np.abs(sine) < 1e-9
    limit = np.where(sine >= 0, 1.0, -1.0) * n * np.sqrt(2 * np.pi * size) * np.exp(0.25j * np.pi)
    return np.where(pole, limit, np.cos(psi) / np.where(pole, 1.0, sine) * transition(np.maximum(x, 0.0)))


def _matrix(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix [2, 2, n] that rotates a Jones vector's frame, from (cos, sin)."""
    cos, sin = rotation.T
    return np.array([[cos, sin], [-sin, cos]])
