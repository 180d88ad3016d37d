"""Fields along stored paths, for any materials: pure JAX, batched over candidates, with derivatives.

A path's gain is (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx. Paths are grouped by the kinds of their interactions, so
that each group is a dense array without padding and each kind costs only where it occurs:

- reflection and transmission: a real rotation into the frame of incidence, then the diagonal (c_te, c_tm);
- diffuse reflection: not linear in the field, its amplitude follows the field reflected specularly;
- diffraction: affine in the reflection coefficients of the two faces, J = C_0 + sum_k R_k C_k.

Precision follows the constants: float64 by default, as `jax_enable_x64` is switched on here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from scipy.constants import epsilon_0, speed_of_light

from calibray.diffraction import affine_form
from calibray.errors import InputError
from calibray.materials import FIELDS, Material
from calibray.materials import constants as constants_matrix
from calibray.paths import Kind, Paths
from calibray.scattering import pattern_value

jax.config.update("jax_enable_x64", True)

COMBINING: Final = ("power", "coherent", "band")
_LETTER: Final = {Kind.SPECULAR: "c", Kind.REFRACTION: "c", Kind.DIFFUSE: "s", Kind.DIFFRACTION: "d"}
_FIELD: Final = {name: column for column, name in enumerate(FIELDS)}


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["path", "scale", "tx", "rx", "rotation", "material", "transmitted", "cosine", "diffuse", "wedge"],
    meta_fields=["signature"],
)
@dataclass(frozen=True)
class Group:
    """Paths with the same sequence of interactions: n paths of depth k, T transmit and R receive ports.

    Attributes:
        signature: One letter an interaction: c coefficient (reflection or transmission), s scattering, d diffraction.
        path: Index of the paths in the program [n].
        scale: A lambda / 4 pi [n].
        tx: Transmit field [T, 2, n].
        rx: Receive field, conjugated [R, 2, n].
        rotation: (cos, sin) into the frame of each interaction [k, 2, n].
        material: Material of each interaction [k, n].
        transmitted: Whether it is a transmission [k, n].
        cosine: Cosine of the angle of incidence [k, n].
        diffuse: Per position the columns of `Diffuse`, or None [6, n].
        wedge: Per position the second face's cosine and the matrices C_0 .. C_4, or None ([n], [5, 2, 2, n]).
    """

    signature: str
    path: jax.Array
    scale: jax.Array
    tx: jax.Array
    rx: jax.Array
    rotation: jax.Array
    material: jax.Array
    transmitted: jax.Array
    cosine: jax.Array
    diffuse: tuple
    wedge: tuple


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["groups", "link", "delay", "wavelength"],
    meta_fields=["num_links", "patterns"],
)
@dataclass(frozen=True)
class Program:
    """A path program laid out for evaluation.

    Attributes:
        groups: The paths by kind of interactions.
        link: Link of every path, in the order of the groups [P].
        delay: Delay of every path, in the order of the groups [P], [s].
        wavelength: [m].
        num_links: Number of links.
        patterns: Scattering pattern of every material.
    """

    groups: tuple[Group, ...]
    link: jax.Array
    delay: jax.Array
    wavelength: jax.Array
    num_links: int
    patterns: tuple[str, ...]


def layout(paths: Paths, dtype: type = np.float64) -> Program:
    """Lay a path program out for evaluation.

    Args:
        paths: The path program.
        dtype: Precision of the constants, `numpy.float64` or `numpy.float32`.

    Returns:
        The grouped program, on JAX's default device.
    """
    depth = np.diff(paths.first)
    letters = np.select([paths.kind == Kind.DIFFUSE, paths.kind == Kind.DIFFRACTION], [1, 2], 0)
    code = np.zeros(paths.num_paths, dtype=np.int64)  # the signature in base 3, led by the depth
    for step in range(int(depth.max(initial=0))):
        has = depth > step
        code[has] += (letters[paths.first[:-1][has] + step] + 1) * 4**step
    groups, order = [], []
    for value in np.unique(code):
        index = np.flatnonzero(code == value)
        groups.append(_group(paths, index, int(depth[index[0]]), dtype))
        order.append(index)
    path = np.concatenate(order) if order else np.zeros(0, dtype=np.int64)
    return Program(
        groups=tuple(groups),
        link=jnp.asarray(paths.link[path]),
        delay=jnp.asarray(paths.delay[path]),
        wavelength=jnp.asarray(speed_of_light / paths.frequency, dtype=dtype),
        num_links=paths.num_links,
        patterns=tuple(material.scattering_pattern for material in paths.materials.values()),
    )


def _group(paths: Paths, index: np.ndarray, depth: int, dtype: type) -> Group:
    complex_dtype = np.result_type(dtype, np.complex64)
    at = paths.first[index] + np.arange(depth)[:, None]  # interactions [k, n]
    kinds = paths.kind[at[:, 0]] if depth else []
    diffuse_row = np.cumsum(paths.kind == Kind.DIFFUSE) - 1
    wedge_row = np.cumsum(paths.kind == Kind.DIFFRACTION) - 1
    diffuse, wedge = [], []
    for step, kind in enumerate(kinds):
        table, row = paths.diffuse, diffuse_row[at[step]]
        diffuse.append(
            jnp.asarray(
                np.stack([table.rotation[row, 0], table.rotation[row, 1], table.solid_angle[row],
                          table.cos_scattered[row], table.cos_specular[row], table.cos_backward[row]]).astype(dtype)
            ) if kind == Kind.DIFFUSE else None
        )  # fmt: skip
        row = wedge_row[at[step]]
        wedge.append(
            (
                jnp.asarray(paths.diffraction.cos_incidence_n[row].astype(dtype)),
                jnp.asarray(affine_form(paths.diffraction, row, paths.frequency).astype(complex_dtype)),
            )
            if kind == Kind.DIFFRACTION
            else None
        )
    scale = paths.spreading[index] * speed_of_light / paths.frequency / (4 * np.pi)
    return Group(
        signature="".join(_LETTER[Kind(kind)] for kind in kinds),
        path=jnp.asarray(index),
        scale=jnp.asarray(scale.astype(dtype)),
        tx=jnp.asarray(np.moveaxis(paths.tx_field[index], 0, -1).astype(complex_dtype)),
        rx=jnp.asarray(np.moveaxis(paths.rx_field[index].conj(), 0, -1).astype(complex_dtype)),
        rotation=jnp.asarray(np.moveaxis(paths.rotation[at], -1, 1).astype(dtype)),
        material=jnp.asarray(paths.material[at]),
        transmitted=jnp.asarray(paths.kind[at] == Kind.REFRACTION),
        cosine=jnp.asarray(paths.cos_incidence[at].astype(dtype)),
        diffuse=tuple(diffuse),
        wedge=tuple(wedge),
    )


def constants(paths: Paths, materials: Mapping[str, Material] | None = None) -> np.ndarray:
    """The matrix of material constants that evaluation takes.

    Args:
        paths: A path program.
        materials: Constants by name; materials not named keep those of the trace.

    Returns:
        Constants in the order of `paths.materials` and `calibray.materials.FIELDS` [M, 8].

    Raises:
        InputError: A name is not a material of the paths, or a material's scattering pattern differs from the trace's.
    """
    materials = materials or {}
    unknown = set(materials) - set(paths.materials)
    if unknown:
        raise InputError(f"no material {sorted(unknown)[0]!r} in the traced scene; it has {', '.join(paths.materials)}")
    for name, material in materials.items():
        traced = paths.materials[name].scattering_pattern
        if material.scattering_pattern != traced:
            raise InputError(
                f"material {name!r}: scattering_pattern {material.scattering_pattern!r} differs from the traced "
                f"{traced!r}; trace again with it in [materials]"
            )
    return constants_matrix({**paths.materials, **materials})


def slab_coefficients(
    cosine: jax.Array, permittivity: jax.Array, thickness: jax.Array, wavelength: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Reflection and transmission coefficients of a slab in air (ITU-R P.2040-3 eqs. 37, 43, 44).

    Args:
        cosine: Cosine of the angle of incidence [...].
        permittivity: Complex relative permittivity eta, imaginary part at most 0 [...].
        thickness: Thickness d [...], [m].
        wavelength: [m].

    Returns:
        R_te, R_tm, T_te, T_tm [...], complex.
    """
    root = jnp.sqrt(permittivity - (1 - cosine**2))
    phase = jnp.exp(-1j * (2 * jnp.pi * thickness / wavelength) * root)  # e^{-jq}, q of eq. 44
    half_te = (cosine - root) / (cosine + root)  # eq. 37a
    half_tm = (permittivity * cosine - root) / (permittivity * cosine + root)  # eq. 37b
    inverse_te = 1 / (1 - (half_te * phase) ** 2)
    inverse_tm = 1 / (1 - (half_tm * phase) ** 2)
    return (
        half_te * (1 - phase**2) * inverse_te,  # eq. 43a
        half_tm * (1 - phase**2) * inverse_tm,
        (1 - half_te**2) * phase * inverse_te,  # eq. 43b
        (1 - half_tm**2) * phase * inverse_tm,
    )


def _complex_permittivity(table: jax.Array, wavelength: jax.Array) -> jax.Array:
    """eta = eps_r - j sigma / (2 pi f eps_0) (ITU-R P.2040-3 eq. 9) of every material [M]."""
    angular_frequency = 2 * jnp.pi * speed_of_light / wavelength
    return jax.lax.complex(
        table[:, _FIELD["relative_permittivity"]],
        -table[:, _FIELD["conductivity"]] / (angular_frequency * epsilon_0),
    )


def _group_gains(group: Group, table: jax.Array, wavelength: jax.Array, patterns: tuple[str, ...]) -> jax.Array:
    """Gains of one group's paths [n, R, T]."""
    te, tm = group.tx[:, 0], group.tx[:, 1]  # field in the present frame [T, n]
    eta = _complex_permittivity(table, wavelength)
    scattering = table[:, _FIELD["scattering_coefficient"]]
    for step, letter in enumerate(group.signature):
        material, cosine = group.material[step], group.cosine[step]
        cos, sin = group.rotation[step]
        te, tm = cos * te + sin * tm, cos * tm - sin * te
        slab = partial(
            slab_coefficients,
            permittivity=eta[material],
            thickness=table[material, _FIELD["thickness"]],
            wavelength=wavelength,
        )
        r_te, r_tm, t_te, t_tm = slab(cosine)
        kept = jnp.sqrt(1 - scattering[material] ** 2)  # what the scattered energy leaves to the specular field
        if letter == "c":
            transmitted = group.transmitted[step]
            te = te * jnp.where(transmitted, t_te, r_te * kept)
            tm = tm * jnp.where(transmitted, t_tm, r_tm * kept)
        elif letter == "s":
            te, tm = _scatter(te, tm, r_te, r_tm, table[material], material, cosine, group.diffuse[step], patterns)
        else:
            cosine_n, form = group.wedge[step]
            n_te, n_tm, _, _ = slab(cosine_n)
            weights = jnp.stack([jnp.ones_like(r_te), kept * r_te, kept * r_tm, kept * n_te, kept * n_tm])
            matrix = jnp.einsum("kn,kijn->ijn", weights, form)  # J = C_0 + sum_k R_k C_k
            te, tm = matrix[0, 0] * te + matrix[0, 1] * tm, matrix[1, 0] * te + matrix[1, 1] * tm
    field = jnp.stack([te, tm])  # [2, T, n]
    return jnp.einsum("rin,itn->nrt", group.rx, field) * group.scale[:, None, None]


def _scatter(
    te: jax.Array,
    tm: jax.Array,
    r_te: jax.Array,
    r_tm: jax.Array,
    row: jax.Array,
    material: jax.Array,
    cosine: jax.Array,
    geometry: jax.Array,
    patterns: tuple[str, ...],
) -> tuple[jax.Array, jax.Array]:
    """Diffuse reflection: S Gamma sqrt(f_s dOmega) times the XPD rotation (Degli-Esposti et al. 2007)."""
    cos, sin, solid_angle, scattered, specular, backward = geometry
    incident = _square(te) + _square(tm)
    reflected = _square(r_te) * _square(te) + _square(r_tm) * _square(tm)
    gamma_squared = reflected / jnp.where(incident > 0, incident, 1.0)
    f_s = pattern_value(row, material, cosine, scattered, specular, backward, patterns)
    xpd = row[:, _FIELD["xpd_coefficient"]]
    amplitude = row[:, _FIELD["scattering_coefficient"]] * _safe_sqrt(gamma_squared * f_s * solid_angle)
    theta, phi = cos * te + sin * tm, cos * tm - sin * te  # the XPD matrix acts in the spherical basis
    straight, crossed = _safe_sqrt(1 - xpd), _safe_sqrt(xpd)
    return amplitude * (straight * theta - crossed * phi), amplitude * (crossed * theta + straight * phi)


def _square(value: jax.Array) -> jax.Array:
    return value.real**2 + value.imag**2


def _safe_sqrt(value: jax.Array) -> jax.Array:
    """Square root with derivative 0 instead of infinity at 0."""
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def program_gains(program: Program, table: jax.Array) -> jax.Array:
    """Path gains of a program.

    Args:
        program: The grouped program.
        table: Material constants [M, 8].

    Returns:
        Gains in the order of the groups [P, R, T], complex.
    """
    parts = [_group_gains(group, table, program.wavelength, program.patterns) for group in program.groups]
    return jnp.concatenate(parts) if parts else jnp.zeros((0, 1, 1), dtype=complex)


def program_path_loss(
    program: Program, table: jax.Array, combining: str = "power", offsets: jax.Array | None = None
) -> jax.Array:
    """Path loss of every link of a program.

    Args:
        program: The grouped program.
        table: Material constants [M, 8].
        combining: "power", "coherent" or "band".
        offsets: For "band": quadrature over the band, frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.
    """
    gain = program_gains(program, table)
    frequency = speed_of_light / program.wavelength
    return combine(gain, program.link, program.delay, program.num_links, frequency, combining, offsets)


def combine(
    gain: jax.Array,
    link: jax.Array,
    delay: jax.Array,
    num_links: int,
    frequency: jax.Array | float,
    combining: str = "power",
    offsets: jax.Array | None = None,
) -> jax.Array:
    """Path loss of every link from its path gains.

    With several ports the power is summed over receive ports and averaged over transmit ports.

    Args:
        gain: Path gains [P, R, T].
        link: Link of every path [P].
        delay: Delay of every path [P], [s].
        num_links: Number of links L.
        frequency: Carrier frequency [Hz].
        combining: "power": -10 log10 sum |a|^2; "coherent": -10 log10 |sum a e^{-j 2 pi f tau}|^2; "band": the
            average of the coherent power over a band.
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.
    """
    total = partial(jax.ops.segment_sum, segment_ids=link, num_segments=num_links)
    if combining == "power":
        power = total(_square(gain).sum(axis=(1, 2)))
    else:
        nodes = jnp.array([[0.0], [1.0]]) if offsets is None else offsets
        phase = jnp.exp(-2j * jnp.pi * delay[:, None] * (frequency + nodes[0])).astype(gain.dtype)  # [P, q]
        field = total(gain[..., None] * phase[:, None, None, :])  # [L, R, T, q]
        power = (_square(field) * nodes[1]).sum(axis=(1, 2, 3))
    power = power / gain.shape[2]
    reached = power > 0
    return jnp.where(reached, -10 * jnp.log10(jnp.where(reached, power, 1.0)), jnp.inf)


def band_quadrature(link: np.ndarray, delay: np.ndarray, bandwidth: float | None) -> np.ndarray:
    """Gauss-Legendre nodes over a band, enough for the largest spread of delays within a link.

    The average of |H|^2 over the band holds oscillations e^{j 2 pi f (tau_i - tau_j)}; a rule with n nodes integrates
    them to machine precision once n exceeds about a quarter of their phase [rad] plus ten.

    Args:
        link: Link of every path, non-decreasing [P].
        delay: Delay of every path [P], [s].
        bandwidth: Bandwidth [Hz].

    Returns:
        Frequencies relative to the carrier [Hz] and weights that sum to 1 [2, q].

    Raises:
        InputError: The bandwidth is not positive.
    """
    if bandwidth is None or not (np.isfinite(bandwidth) and bandwidth > 0):
        raise InputError(f'combining = "band": bandwidth = {bandwidth}: must be a positive number of Hz')
    spread = 0.0
    if len(link):
        start = np.flatnonzero(np.diff(link, prepend=-1))
        spread = float(np.max(np.maximum.reduceat(delay, start) - np.minimum.reduceat(delay, start)))
    nodes, weights = np.polynomial.legendre.leggauss(int(np.pi * bandwidth * spread) + 12)
    return np.stack([nodes * bandwidth / 2, weights / 2])


def path_gains(paths: Paths, materials: Mapping[str, Material] | None = None) -> np.ndarray:
    """Path gains for any materials, equal to Sionna RT's `Paths.a` for the same materials.

    Args:
        paths: The path program.
        materials: Constants by name; materials not named keep those of the trace.

    Returns:
        Complex gains [P]; [P, R, T] if an antenna is dual-polarized.

    Raises:
        InputError: A material is unknown.
    """
    program = layout(paths)
    gains = np.zeros((paths.num_paths, *(max(n, 1) for n in (paths.rx_field.shape[1], paths.tx_field.shape[1]))), complex)
    if paths.num_paths:
        order = np.concatenate([np.asarray(group.path) for group in program.groups])
        gains[order] = np.asarray(_compiled_gains(program, jnp.asarray(constants(paths, materials))))
    return gains[:, 0, 0] if gains.shape[1:] == (1, 1) else gains


def path_loss(
    paths: Paths,
    materials: Mapping[str, Material] | None = None,
    combining: str = "power",
    bandwidth: float | None = None,
) -> np.ndarray:
    """Path loss of every link for any materials.

    Args:
        paths: The path program.
        materials: Constants by name; materials not named keep those of the trace.
        combining: "power" sums the paths' powers (a wide band, or many snapshots); "coherent" their fields at the
            carrier; "band" averages the coherent power over `bandwidth`.
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.

    Raises:
        InputError: The combining or a material is unknown, or the bandwidth missing.
    """
    offsets = check_combining(paths, combining, bandwidth)
    return np.asarray(
        _compiled_path_loss(layout(paths), jnp.asarray(constants(paths, materials)), combining, offsets)
    )


def check_combining(paths: Paths, combining: str, bandwidth: float | None) -> np.ndarray | None:
    """The quadrature that a way of combining needs.

    Args:
        paths: The path program.
        combining: "power", "coherent" or "band".
        bandwidth: Bandwidth [Hz], for "band".

    Returns:
        Nodes and weights for "band" [2, q], else None.

    Raises:
        InputError: The combining is unknown, or the bandwidth is missing.
    """
    if combining not in COMBINING:
        raise InputError(f"combining = {combining!r}: must be one of {', '.join(COMBINING)}")
    return band_quadrature(paths.link, paths.delay, bandwidth) if combining == "band" else None


_compiled_gains = jax.jit(program_gains)
_compiled_path_loss = jax.jit(program_path_loss, static_argnames="combining")
