"""Fields along stored paths, for any materials: pure JAX, batched over candidates, with derivatives.

A path's gain is (lambda / 4 pi) A E_rx^H J_K ... J_1 E_tx. Paths are grouped by the kinds of their interactions, so
that each group is a dense array without padding and each kind costs only where it occurs:

- reflection and transmission: a real rotation into the frame of incidence, then the diagonal (c_te, c_tm);
- diffuse reflection: not linear in the field, its amplitude follows the field reflected specularly;
- diffraction: affine in the reflection coefficients of the two faces, J = C_0 + sum_k R_k C_k.

Evaluation has two stages. The first turns material constants into what each interaction takes from its material
(`local_values`), flat over all interactions; the second carries the fields along the paths (`gains`). Complex
numbers are pairs of real arrays, as in `calibray.slab`.

Precision follows the program: float64 by default, as `jax_enable_x64` is switched on here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from scipy.constants import speed_of_light

from calibray import slab, tabulation
from calibray.diffraction import affine_form
from calibray.errors import InputError
from calibray.materials import FIELDS, Material
from calibray.materials import constants as constants_matrix
from calibray.paths import Kind, Paths
from calibray.scattering import pattern_value

jax.config.update("jax_enable_x64", True)

Fields = tuple[slab.Pair, slab.Pair]
Pieces = tuple[tuple[Fields, ...], tuple[tuple[jax.Array, jax.Array], ...]]

COMBINING: Final = ("power", "coherent", "band")
_LETTER: Final = {Kind.SPECULAR: "c", Kind.REFRACTION: "c", Kind.DIFFUSE: "s", Kind.DIFFRACTION: "d"}
_FIELD: Final = {name: column for column, name in enumerate(FIELDS)}


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["scale", "tx", "rx", "rotation", "turn", "wedge"],
    meta_fields=["signature", "size"],
)
@dataclass(frozen=True)
class Group:
    """Paths with the same sequence of interactions: n paths of depth k, T transmit and R receive ports.

    Attributes:
        scale: A lambda / 4 pi [n].
        tx: Transmit field, real and imaginary part [2, T, 2, n].
        rx: Receive field, real and imaginary part [2, R, 2, n].
        rotation: (cos, sin) into the frame of each interaction [k, 2, n].
        turn: Per position (cos, sin) from the frame of incidence into the basis (theta, phi) [2, n], or None.
        wedge: Per position the matrices C_0 .. C_4, real and imaginary part [2, 5, 2, 2, n], or None.
        signature: One letter an interaction: c coefficient (reflection or transmission), s scattering, d diffraction.
        size: Number of paths n.
    """

    scale: jax.Array
    tx: jax.Array
    rx: jax.Array
    rotation: jax.Array
    turn: tuple
    wedge: tuple
    signature: str
    size: int


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "groups",
        "link",
        "delay",
        "wavelength",
        "material",
        "cosine",
        "transmitted",
        "raw",
        "diffuse",
        "owner",
        "lookup",
    ],
    meta_fields=["num_links", "patterns", "any_transmitted"],
)
@dataclass(frozen=True)
class Program:
    """A path program laid out for evaluation: J coefficients, D diffuse interactions.

    Attributes:
        groups: The paths by kind of interactions.
        link: Link of every path, in the order of the groups [P].
        delay: Delay of every path, in the order of the groups [P], [s].
        wavelength: [m].
        material: Material of every coefficient [J].
        cosine: Cosine of its angle of incidence [J].
        transmitted: Whether it is a transmission [J].
        raw: Whether it is a reflection that keeps the scattered energy, as a diffuse one does [J].
        diffuse: Material, solid angle, and the cosines of incidence, of the scattered direction to the normal, to the
            specular direction and to the way back, of every diffuse interaction (each [D]).
        owner: Link of every coefficient [J] and of every diffuse interaction [D].
        num_links: Number of links.
        patterns: Scattering pattern of every material.
        any_transmitted: Whether any coefficient is a transmission.
        lookup: Where to find the coefficients in a table; None where they are evaluated one by one.
    """

    groups: tuple[Group, ...]
    link: jax.Array
    delay: jax.Array
    wavelength: jax.Array
    material: jax.Array
    cosine: jax.Array
    transmitted: jax.Array
    raw: jax.Array
    diffuse: tuple[jax.Array, ...]
    owner: tuple[jax.Array, jax.Array]
    num_links: int
    patterns: tuple[str, ...]
    any_transmitted: bool
    lookup: tabulation.Lookup | None = None


@dataclass(frozen=True)
class Layout:
    """A program and the order in which it holds the paths.

    Attributes:
        program: The program.
        order: Path of the path program at each place [P].
    """

    program: Program
    order: np.ndarray


def layout(paths: Paths, dtype: type = np.float64, intervals: int | None = None) -> Layout:
    """Lay a path program out for evaluation.

    Args:
        paths: The path program.
        dtype: Precision of the constants, `numpy.float64` or `numpy.float32`.
        intervals: Tabulate the coefficients over the cosine of incidence with so many intervals; None evaluates
            every coefficient by itself.

    Returns:
        The grouped program, on JAX's default device.
    """
    depth = np.diff(paths.first)
    letter = np.select([paths.kind == Kind.DIFFUSE, paths.kind == Kind.DIFFRACTION], [2, 3], 1).astype(
        np.int64
    )
    code = np.zeros(paths.num_paths, dtype=np.int64)
    for step in range(int(depth.max(initial=0))):
        deep = depth > step
        code[deep] = code[deep] * 4 + letter[paths.first[:-1][deep] + step]
    index = [np.flatnonzero(code == value) for value in np.unique(code)]
    order = np.concatenate(index) if index else np.zeros(0, dtype=np.int64)
    flat = _Flat(paths)
    groups = tuple(_group(paths, some, int(depth[some[0]]), flat, dtype) for some in index)
    rows = flat.scattered()
    table, at = paths.diffuse, flat.table_row[rows]
    columns = (table.solid_angle[at], paths.cos_incidence[rows], table.cos_scattered[at],
               table.cos_specular[at], table.cos_backward[at])  # fmt: skip
    interaction, cosine = flat.coefficients()
    owner = np.repeat(paths.link, depth)
    kind = paths.kind[interaction]
    lookup = None
    if intervals is not None:
        mode = np.select(
            [kind == Kind.REFRACTION, kind == Kind.DIFFUSE], [tabulation.TRANSMITTED, tabulation.RAW], 0
        )
        lookup = tabulation.make_lookup(paths.material[interaction], mode, cosine, intervals, dtype)
    program = Program(
        groups=groups,
        link=jnp.asarray(paths.link[order]),
        delay=jnp.asarray(paths.delay[order]),
        wavelength=jnp.asarray(speed_of_light / paths.frequency, dtype=dtype),
        material=jnp.asarray(paths.material[interaction]),
        cosine=jnp.asarray((cosine if lookup is None else cosine[:0]).astype(dtype)),
        transmitted=jnp.asarray(kind == Kind.REFRACTION),
        raw=jnp.asarray(kind == Kind.DIFFUSE),
        diffuse=(
            jnp.asarray(paths.material[rows]),
            *(jnp.asarray(column.astype(dtype)) for column in columns),
        ),
        owner=(jnp.asarray(owner[interaction]), jnp.asarray(owner[rows])),
        num_links=paths.num_links,
        patterns=tuple(material.scattering_pattern for material in paths.materials.values()),
        any_transmitted=bool((paths.kind == Kind.REFRACTION).any()),
        lookup=lookup,
    )
    return Layout(program, order)


class _Flat:
    """Collects, position by position, which interactions the flat arrays hold; a diffraction twice, face after face."""

    def __init__(self, paths: Paths) -> None:
        self._paths, self._interactions, self._cosines, self._scattered = paths, [], [], []
        self.table_row = np.maximum(_row_of(paths.kind, Kind.DIFFUSE), _row_of(paths.kind, Kind.DIFFRACTION))

    def add(self, interaction: np.ndarray, kind: int) -> None:
        """Append one position's interactions."""
        self._append(interaction, self._paths.cos_incidence[interaction])
        if kind == Kind.DIFFRACTION:
            self._append(interaction, self._paths.diffraction.cos_incidence_n[self.table_row[interaction]])
        if kind == Kind.DIFFUSE:
            self._scattered.append(interaction)

    def _append(self, interaction: np.ndarray, cosine: np.ndarray) -> None:
        self._interactions.append(interaction)
        self._cosines.append(cosine)

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Interaction and cosine of every coefficient [J]."""
        return _joined(self._interactions, np.int64), _joined(self._cosines, float)

    def scattered(self) -> np.ndarray:
        """Interaction of every diffuse row [D]."""
        return _joined(self._scattered, np.int64)


def _joined(parts: list[np.ndarray], dtype: type) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=dtype)


def _row_of(kind: np.ndarray, which: Kind) -> np.ndarray:
    chosen = kind == which
    return np.where(chosen, np.cumsum(chosen) - 1, -1)


def _group(paths: Paths, index: np.ndarray, depth: int, flat: _Flat, dtype: type) -> Group:
    at = paths.first[index] + np.arange(depth)[:, None]  # interactions [k, n]
    kinds = [int(kind) for kind in paths.kind[at[:, 0]]] if depth else []
    turn, wedge = [], []
    for kind, interaction in zip(kinds, at, strict=True):
        flat.add(interaction, kind)
        rows = flat.table_row[interaction]
        turn.append(
            jnp.asarray(paths.diffuse.rotation[rows].T.astype(dtype)) if kind == Kind.DIFFUSE else None
        )
        form = affine_form(paths.diffraction, rows, paths.frequency) if kind == Kind.DIFFRACTION else None
        wedge.append(None if form is None else _parts(form, dtype))
    scale = paths.spreading[index] * speed_of_light / paths.frequency / (4 * np.pi)
    return Group(
        scale=jnp.asarray(scale.astype(dtype)),
        tx=_parts(np.moveaxis(paths.tx_field[index], 0, -1), dtype),
        rx=_parts(np.moveaxis(paths.rx_field[index], 0, -1), dtype),
        rotation=jnp.asarray(np.moveaxis(paths.rotation[at], -1, 1).astype(dtype)),
        turn=tuple(turn),
        wedge=tuple(wedge),
        signature="".join(_LETTER[Kind(kind)] for kind in kinds),
        size=len(index),
    )


def _parts(value: np.ndarray, dtype: type) -> jax.Array:
    return jnp.asarray(np.stack([value.real, value.imag]).astype(dtype))


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
        raise InputError(
            f"no material {sorted(unknown)[0]!r} in the traced scene; it has {', '.join(paths.materials)}"
        )
    for name, material in materials.items():
        traced = paths.materials[name].scattering_pattern
        if material.scattering_pattern != traced:
            raise InputError(
                f"material {name!r}: scattering_pattern {material.scattering_pattern!r} differs from the traced "
                f"{traced!r}; trace again with it in [materials]"
            )
    return constants_matrix({**paths.materials, **materials})


@partial(jax.tree_util.register_dataclass, data_fields=["te", "tm", "amplitude", "xpd"], meta_fields=[])
@dataclass(frozen=True)
class Local:
    """All that the fields take from the materials.

    Attributes:
        te: Transverse electric coefficients, (real, imaginary) [J].
        tm: Transverse magnetic coefficients, (real, imaginary) [J].
        amplitude: S sqrt(f_s dOmega) of the diffuse interactions [D].
        xpd: Their XPD coefficient K_x [D].
    """

    te: slab.Pair
    tm: slab.Pair
    amplitude: jax.Array
    xpd: jax.Array


def local_values(program: Program, table: jax.Array) -> Local:
    """What the materials contribute at every interaction.

    Args:
        program: The program.
        table: Material constants [M, 8].

    Returns:
        The contributions.
    """
    if program.lookup is None:
        te, tm = tabulation.evaluate(
            program.cosine,
            table,
            program.material,
            program.wavelength,
            program.transmitted if program.any_transmitted else False,
            program.transmitted | program.raw,
        )
    else:
        te, tm = tabulation.look_up(program.lookup, table, program.wavelength)
    material, solid_angle, cosine, scattered, specular, backward = program.diffuse
    f_s = pattern_value(table[material], material, cosine, scattered, specular, backward, program.patterns)
    scattering = table[material, _FIELD["scattering_coefficient"]]
    return Local(
        te=te,
        tm=tm,
        amplitude=scattering * slab.safe_sqrt(f_s * solid_angle),
        xpd=table[material, _FIELD["xpd_coefficient"]],
    )


def _split(program: Program, local: Local) -> tuple[Pieces, ...]:
    """The contributions of the materials cut into what each position of each group takes, in the order of the program.

    Derivatives are taken by these pieces: by the flat arrays, every piece would cost a pass over all of them.
    """
    pieces, at, row = [], 0, 0
    for group in program.groups:
        coefficients, diffuse = [], []
        for letter in group.signature:
            for _ in range(2 if letter == "d" else 1):
                end = at + group.size
                coefficients.append(
                    tuple((pair[0][at:end], pair[1][at:end]) for pair in (local.te, local.tm))
                )
                at = end
            if letter == "s":
                diffuse.append((local.amplitude[row : row + group.size], local.xpd[row : row + group.size]))
                row += group.size
        pieces.append((tuple(coefficients), tuple(diffuse)))
    return tuple(pieces)


def _join(pieces: tuple[Pieces, ...], like: Local) -> Local:
    """The inverse of `_split`."""
    coefficients = [piece for group, _ in pieces for piece in group]
    diffuse = [piece for _, group in pieces for piece in group]

    def joined(parts: list[jax.Array], empty: jax.Array) -> jax.Array:
        return jnp.concatenate(parts) if parts else empty

    return Local(
        te=tuple(joined([piece[0][part] for piece in coefficients], like.te[part]) for part in range(2)),
        tm=tuple(joined([piece[1][part] for piece in coefficients], like.tm[part]) for part in range(2)),
        amplitude=joined([piece[0] for piece in diffuse], like.amplitude),
        xpd=joined([piece[1] for piece in diffuse], like.xpd),
    )


def _group_gains(group: Group, pieces: Pieces, keep: Callable[[Fields], Fields]) -> slab.Pair:
    """Gains of one group's paths, real and imaginary part [R, T, n]; `keep` is applied to the field at every step."""
    te, tm = (group.tx[0, :, 0], group.tx[1, :, 0]), (group.tx[0, :, 1], group.tx[1, :, 1])  # [T, n]
    coefficients, diffuse = (iter(part) for part in pieces)
    for step, letter in enumerate(group.signature):
        te, tm = _turn(group.rotation[step], te, tm)
        c_te, c_tm = next(coefficients)
        if letter == "c":
            te, tm = _times(c_te, te), _times(c_tm, tm)
        elif letter == "s":
            te, tm = _scatter(te, tm, c_te, c_tm, *next(diffuse), group.turn[step])
        else:
            te, tm = _diffract(te, tm, (c_te, c_tm, *next(coefficients)), group.wedge[step])
        te, tm = keep((te, tm))
    real = imaginary = 0.0
    for component, field in enumerate((te, tm)):  # E_rx^H E
        rx_real, rx_imaginary = group.rx[:, :, component][:, :, None, :]  # [R, 1, n]
        real = real + rx_real * field[0] + rx_imaginary * field[1]
        imaginary = imaginary + rx_real * field[1] - rx_imaginary * field[0]
    return real * group.scale, imaginary * group.scale


def _turn(rotation: jax.Array, a: slab.Pair, b: slab.Pair) -> tuple[slab.Pair, slab.Pair]:
    cos, sin = rotation
    return (cos * a[0] + sin * b[0], cos * a[1] + sin * b[1]), (
        cos * b[0] - sin * a[0],
        cos * b[1] - sin * a[1],
    )


def _times(a: slab.Pair, b: slab.Pair) -> slab.Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _scatter(
    te: slab.Pair,
    tm: slab.Pair,
    r_te: slab.Pair,
    r_tm: slab.Pair,
    amplitude: jax.Array,
    xpd: jax.Array,
    turn: jax.Array,
) -> tuple[slab.Pair, slab.Pair]:
    """Diffuse reflection: S Gamma sqrt(f_s dOmega) times the XPD rotation (Degli-Esposti et al. 2007)."""
    incident = _power(te) + _power(tm)
    reflected = _power(r_te) * _power(te) + _power(r_tm) * _power(tm)
    strength = amplitude * slab.safe_sqrt(
        reflected / jnp.where(incident > 0, incident, 1.0)
    )  # Gamma = |R E| / |E|
    theta, phi = _turn(turn, te, tm)  # the XPD matrix acts in the basis (theta, phi)
    straight, crossed = strength * slab.safe_sqrt(1 - xpd), strength * slab.safe_sqrt(xpd)
    return (
        (straight * theta[0] - crossed * phi[0], straight * theta[1] - crossed * phi[1]),
        (crossed * theta[0] + straight * phi[0], crossed * theta[1] + straight * phi[1]),
    )


def _diffract(
    te: slab.Pair, tm: slab.Pair, coefficients: tuple[slab.Pair, ...], form: jax.Array
) -> tuple[slab.Pair, slab.Pair]:
    """Diffraction, J = C_0 + sum_k R_k C_k."""
    real, imaginary = form[0, 0], form[1, 0]  # [2, 2, n]
    for k, (r_real, r_imaginary) in enumerate(coefficients, start=1):
        real = real + r_real * form[0, k] - r_imaginary * form[1, k]
        imaginary = imaginary + r_real * form[1, k] + r_imaginary * form[0, k]
    rows = []
    for i in range(2):
        a, b = _times((real[i, 0], imaginary[i, 0]), te), _times((real[i, 1], imaginary[i, 1]), tm)
        rows.append((a[0] + b[0], a[1] + b[1]))
    return rows[0], rows[1]


def _power(value: slab.Pair) -> jax.Array:
    return value[0] * value[0] + value[1] * value[1]


def gains(program: Program, local: Local) -> slab.Pair:
    """Path gains from what the materials contribute.

    Args:
        program: The program.
        local: The contributions of the materials.

    Returns:
        Gains in the order of the groups, real and imaginary part [R, T, P].
    """
    return _gains_of(program, _split(program, local), lambda field: field)


def _gains_of(program: Program, pieces: tuple[Pieces, ...], keep: Callable[[Fields], Fields]) -> slab.Pair:
    parts = [_group_gains(group, piece, keep) for group, piece in zip(program.groups, pieces, strict=True)]
    if not parts:
        empty = jnp.zeros((1, 1, 0), dtype=program.wavelength.dtype)
        return empty, empty
    return tuple(jnp.concatenate(side, axis=-1) for side in zip(*parts, strict=True))


def program_path_loss(
    program: Program, table: jax.Array, combining: str = "power", offsets: jax.Array | None = None
) -> jax.Array:
    """Path loss of every link of a program, as one pure function.

    Args:
        program: The program.
        table: Material constants [M, 8].
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Path loss [L], [dB]; +inf where a link has no path.
    """
    local = slab.keep(local_values(program, table), program.wavelength)
    return decibel(program_power(program, local, combining, offsets))


def local_tangents(
    program: Program, table: jax.Array, columns: tuple[int, ...]
) -> tuple[Local, tuple[Local, ...]]:
    """What the materials contribute, and its derivatives by each interaction's own material.

    Args:
        program: The program.
        table: Material constants [M, 8].
        columns: Columns of the table to derive by.

    Returns:
        The contributions, and their derivatives by each column.
    """
    local, push = jax.linearize(partial(local_values, program), table)
    return local, tuple(push(jnp.zeros_like(table).at[:, column].set(1.0)) for column in columns)


def power_and_slope(
    program: Program, local: Local, combining: str = "power", offsets: jax.Array | None = None
) -> tuple[jax.Array, Local]:
    """Power gain of every link, and its derivative by every contribution of the materials.

    Every path belongs to one link, so one reverse pass over the summed power gives the derivatives of all links.

    Args:
        program: The program.
        local: The contributions.
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Power gain [L], and the derivatives in the form of the contributions.
    """
    keep = partial(
        slab.keep, positive=program.wavelength
    )  # else fields are computed once more for each later use

    def power_of(pieces: tuple[Pieces, ...]) -> jax.Array:
        return _combined(program, _gains_of(program, pieces, keep), combining, offsets)

    power, pull = jax.vjp(power_of, _split(program, local))
    (slope,) = pull(jnp.ones_like(power))
    return power, _join(slope, local)


def decibel_slope(
    program: Program, power: jax.Array, slope: Local, tangents: tuple[Local, ...], num_materials: int
) -> jax.Array:
    """Derivatives of path loss by the constants of the materials, from the two passes.

    Every interaction belongs to one material, so one tangent per field serves all materials at once: the cost does not
    grow with their number.

    Args:
        program: The program.
        power: Power gain of every link [L].
        slope: Derivative of the power by the contributions.
        tangents: Derivatives of the contributions, one per field.
        num_materials: Number of materials M.

    Returns:
        Derivatives [L, M, fields], [dB] per unit; 0 where a link has no path.
    """
    bins = program.num_links * num_materials
    by_coefficient, by_diffuse = (
        program.owner[0] * num_materials + program.material,
        program.owner[1] * num_materials + program.diffuse[0],
    )
    parts = []
    for tangent in tangents:
        rise = sum(
            a * b
            for side in ("te", "tm")
            for a, b in zip(getattr(slope, side), getattr(tangent, side), strict=True)
        )
        total = jax.ops.segment_sum(rise, by_coefficient, bins)
        if program.owner[1].shape[0]:
            rise = slope.amplitude * tangent.amplitude + slope.xpd * tangent.xpd
            total += jax.ops.segment_sum(rise, by_diffuse, bins)
        parts.append(total.reshape(program.num_links, num_materials))
    inverse = jnp.where(power > 0, 1 / jnp.where(power > 0, power, 1.0), 0.0)
    return -10 / np.log(10) * inverse[:, None, None] * jnp.stack(parts, axis=-1)


def program_power(
    program: Program, local: Local, combining: str = "power", offsets: jax.Array | None = None
) -> jax.Array:
    """Power gain of every link of a program.

    Args:
        program: The program.
        local: The contributions of the materials.
        combining: "power", "coherent" or "band".
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Power gain [L]; 0 where a link has no path.
    """
    return _combined(program, gains(program, local), combining, offsets)


def _combined(program: Program, gain: slab.Pair, combining: str, offsets: jax.Array | None) -> jax.Array:
    frequency = speed_of_light / program.wavelength
    return link_power(gain, program.link, program.delay, program.num_links, frequency, combining, offsets)


def link_power(
    gain: slab.Pair,
    link: jax.Array,
    delay: jax.Array,
    num_links: int,
    frequency: jax.Array | float,
    combining: str = "power",
    offsets: jax.Array | None = None,
) -> jax.Array:
    """Power gain of every link from its path gains.

    With several ports the power is summed over receive ports and averaged over transmit ports.

    Args:
        gain: Path gains, real and imaginary part [R, T, P].
        link: Link of every path [P].
        delay: Delay of every path [P], [s].
        num_links: Number of links L.
        frequency: Carrier frequency [Hz].
        combining: "power": sum |a|^2; "coherent": |sum a e^{-j 2 pi f tau}|^2; "band": the average of the coherent
            power over a band.
        offsets: For "band": frequencies relative to the carrier [Hz] and weights [2, q].

    Returns:
        Power gain [L]; 0 where a link has no path.
    """
    total = partial(jax.ops.segment_sum, segment_ids=link, num_segments=num_links)
    ports = gain[0].shape[1]
    if combining == "power":
        return total(_power(gain).sum(axis=(0, 1))) / ports
    nodes = jnp.array([[0.0], [1.0]]) if offsets is None else offsets
    phase = -2 * jnp.pi * delay[:, None] * (frequency + nodes[0])  # [P, q]
    turn = jnp.cos(phase), jnp.sin(phase)
    rotated = _times((gain[0][..., None], gain[1][..., None]), turn)  # [R, T, P, q]
    field = tuple(total(jnp.moveaxis(part, 2, 0)) for part in rotated)  # [L, R, T, q]
    return (_power(field) * nodes[1]).sum(axis=(1, 2, 3)) / ports


def decibel(power: jax.Array) -> jax.Array:
    """Path loss [dB] of power gains; +inf where the power is 0."""
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
    plan = layout(paths)
    local = _local_values(plan.program, jnp.asarray(constants(paths, materials)))
    real, imaginary = _gains(plan.program, local)
    found = np.empty((paths.num_paths, paths.rx_field.shape[1], paths.tx_field.shape[1]), dtype=complex)
    found[plan.order] = np.moveaxis(np.asarray(real) + 1j * np.asarray(imaginary), -1, 0)
    return found[:, 0, 0] if found.shape[1:] == (1, 1) else found


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
    program = layout(paths).program
    local = _local_values(program, jnp.asarray(constants(paths, materials)))
    return np.asarray(decibel(_program_power(program, local, combining, offsets)))


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


# Compiled apart: XLA on CPU would otherwise fuse the first stage into each of its uses, and repeat it there.
_local_values = jax.jit(local_values)
_gains = jax.jit(gains)
_program_power = jax.jit(program_power, static_argnames="combining")
