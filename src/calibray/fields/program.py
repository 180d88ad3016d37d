"""A path program laid out for evaluation.

Paths are grouped by the kinds of their interactions, so that each group is a dense array without padding and each
kind costs only where it occurs. What the materials act through lies flat, over all interactions of all groups.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.fields import tabulation
from calibray.fields.diffraction import affine_form
from calibray.fields.segments import Segments, make_segments
from calibray.materials import Material, constants_matrix
from calibray.paths import Kind, Paths

_LETTER: Final = {Kind.SPECULAR: "c", Kind.REFRACTION: "c", Kind.DIFFUSE: "s", Kind.DIFFRACTION: "d"}
_MODE: Final = {Kind.REFRACTION: tabulation.TRANSMITTED, Kind.DIFFUSE: tabulation.RAW}


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["tx", "rx", "rotation", "turn", "wedge"],
    meta_fields=["signature", "size"],
)
@dataclass(frozen=True)
class Group:
    """Paths with the same sequence of interactions: n paths of depth k, T transmit and R receive ports.

    Attributes:
        tx: Transmit field, real and imaginary part [2, T, 2, n]; the real part alone if all are real [1, T, 2, n].
        rx: Receive field times A lambda / 4 pi, likewise [2 or 1, R, 2, n].
        rotation: (cos, sin) into the frame of each interaction [k, 2, n].
        turn: Per position (cos, sin) from the frame of incidence into the basis (theta, phi) [2, n], or None.
        wedge: Per position the matrices C_0 .. C_4, real and imaginary part [2, 5, 2, 2, n], or None.
        signature: One letter an interaction: c coefficient (reflection or transmission), s scattering, d diffraction.
        size: Number of paths n.
    """

    tx: jax.Array
    rx: jax.Array
    rotation: jax.Array
    turn: tuple
    wedge: tuple
    signature: str
    size: int


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["material", "cosine", "transmitted", "raw"],
    meta_fields=["any_transmitted"],
)
@dataclass(frozen=True)
class Formula:
    """What the formula of the coefficients takes, for J coefficients.

    Attributes:
        material: Material [J].
        cosine: Cosine of the angle of incidence [J].
        transmitted: Whether it is a transmission [J].
        raw: Whether it is a reflection that keeps the scattered energy, as a diffuse one does [J].
        any_transmitted: Whether any coefficient is a transmission.
    """

    material: jax.Array
    cosine: jax.Array
    transmitted: jax.Array
    raw: jax.Array
    any_transmitted: bool


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "groups",
        "by_link",
        "link",
        "delay",
        "wavelength",
        "coefficients",
        "diffuse",
        "by_material",
    ],
    meta_fields=["patterns"],
)
@dataclass(frozen=True)
class GroupedProgram:
    """A path program laid out for evaluation: P paths, J coefficients, D diffuse interactions, M materials.

    Attributes:
        groups: The paths by kind of interactions.
        by_link: Which paths belong to which link.
        link: Link of every path, in the order of the groups [P]; None where only powers are added.
        delay: Delay of every path, in the order of the groups [P], [s]; None likewise.
        wavelength: [m].
        coefficients: What the coefficients are evaluated from: the formula's arguments, or places in tables.
        diffuse: Material, solid angle, and the cosines of the scattered direction to the normal, of incidence, of the
            scattered direction to the specular direction and to the way back, of every diffuse interaction (each [D];
            the last three are empty where every material scatters by Lambert's law).
        by_material: Which coefficients, and which diffuse interactions, belong to which link and material
            (segment: link x M + material).
        patterns: Scattering pattern of every material.
    """

    groups: tuple[Group, ...]
    by_link: Segments
    link: jax.Array | None
    delay: jax.Array | None
    wavelength: jax.Array
    coefficients: Formula | tabulation.Lookup
    diffuse: tuple[jax.Array, ...]
    by_material: tuple[Segments, Segments]
    patterns: tuple[str, ...]

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return self.by_link.count

    @property
    def phases(self) -> tuple[jax.Array, jax.Array]:
        """Link [P] and delay [P], [s] of every path, in the order of the groups.

        Raises:
            InputError: The program was laid out without them.
        """
        if self.link is None or self.delay is None:
            raise InputError("the program was laid out for sums of powers only; lay it out with phases=True")
        return self.link, self.delay

    @property
    def positions(self) -> list[int]:
        """How many coefficients stand at each position of each group, in order."""
        return _positions(self.groups)

    @property
    def nbytes(self) -> int:
        """Bytes that the arrays take."""
        return sum(array.nbytes for array in jax.tree.leaves(self))


@dataclass(frozen=True)
class Layout:
    """A program and the order in which it holds the paths.

    Attributes:
        program: The program.
        order: Path of the path program at each place [P].
    """

    program: GroupedProgram
    order: NDArray[np.int64]


def layout(
    paths: Paths, dtype: type = np.float64, intervals: int | None = None, phases: bool = True
) -> Layout:
    """Lay a path program out for evaluation.

    Args:
        paths: The path program.
        dtype: Precision of the constants, `numpy.float64` or `numpy.float32`.
        intervals: Tabulate the coefficients over the angle of incidence with so many intervals; None evaluates
            every coefficient by itself.
        phases: Keep the delays, which nothing but the sum of powers can do without.

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
    rows, (interaction, cosine) = flat.scattered(), flat.coefficients()
    segment = np.repeat(paths.link, depth).astype(np.int64) * len(paths.materials) + paths.material
    count = paths.num_links * len(paths.materials)
    program = GroupedProgram(
        groups=groups,
        by_link=make_segments(paths.link[order], paths.num_links),
        link=jnp.asarray(paths.link[order]) if phases else None,
        delay=jnp.asarray(paths.delay[order]) if phases else None,
        wavelength=jnp.asarray(speed_of_light / paths.frequency, dtype=dtype),
        coefficients=_coefficients(paths, interaction, cosine, _positions(groups), dtype, intervals),
        diffuse=_diffuse(paths, rows, flat.table_row[rows], dtype),
        by_material=(make_segments(segment[interaction], count), make_segments(segment[rows], count)),
        patterns=tuple(material.scattering_pattern for material in paths.materials.values()),
    )
    return Layout(program, order)


def material_table(paths: Paths, materials: Mapping[str, Material] | None = None) -> NDArray[np.float64]:
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


class _Flat:
    """Which interactions the flat arrays hold, collected position by position; a diffraction twice, face after face."""

    def __init__(self, paths: Paths) -> None:
        self._paths, self._interactions, self._cosines, self._scattered = paths, [], [], []
        self.table_row = np.maximum(_row_of(paths.kind, Kind.DIFFUSE), _row_of(paths.kind, Kind.DIFFRACTION))

    def add(self, interaction: NDArray[np.int64], kind: int) -> None:
        """Append one position's interactions."""
        self._append(interaction, self._paths.cos_incidence[interaction])
        if kind == Kind.DIFFRACTION:
            self._append(interaction, self._paths.diffraction.cos_incidence_n[self.table_row[interaction]])
        if kind == Kind.DIFFUSE:
            self._scattered.append(interaction)

    def _append(self, interaction: NDArray[np.int64], cosine: NDArray[np.float64]) -> None:
        self._interactions.append(interaction)
        self._cosines.append(cosine)

    def coefficients(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Interaction and cosine of every coefficient [J]."""
        return _joined(self._interactions, np.int64), _joined(self._cosines, float)

    def scattered(self) -> NDArray[np.int64]:
        """Interaction of every diffuse row [D]."""
        return _joined(self._scattered, np.int64)


def _joined(parts: list[NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=dtype)


def _row_of(kind: NDArray[np.integer], which: Kind) -> NDArray[np.int64]:
    chosen = kind == which
    return np.where(chosen, np.cumsum(chosen) - 1, -1)


def _positions(groups: tuple[Group, ...]) -> list[int]:
    return [
        group.size for group in groups for letter in group.signature for _ in range(2 if letter == "d" else 1)
    ]


def _coefficients(
    paths: Paths,
    interaction: NDArray[np.int64],
    cosine: NDArray[np.float64],
    sizes: list[int],
    dtype: type,
    intervals: int | None,
) -> Formula | tabulation.Lookup:
    kind, material = paths.kind[interaction], paths.material[interaction]
    if intervals is not None:
        mode = np.select([kind == one for one in _MODE], list(_MODE.values()), 0)
        return tabulation.make_lookup(material, mode, cosine, sizes, intervals, dtype)
    return Formula(
        material=jnp.asarray(material),
        cosine=jnp.asarray(cosine.astype(dtype)),
        transmitted=jnp.asarray(kind == Kind.REFRACTION),
        raw=jnp.asarray(kind == Kind.DIFFUSE),
        any_transmitted=bool((kind == Kind.REFRACTION).any()),
    )


def _diffuse(
    paths: Paths, interaction: NDArray[np.int64], row: NDArray[np.int64], dtype: type
) -> tuple[jax.Array, ...]:
    table = paths.diffuse
    lobes = slice(
        None if any(one.scattering_pattern != "lambertian" for one in paths.materials.values()) else 0
    )
    columns = (
        table.solid_angle[row],
        table.cos_scattered[row],
        paths.cos_incidence[interaction][lobes],
        table.cos_specular[row][lobes],
        table.cos_backward[row][lobes],
    )
    index = paths.material[interaction].astype(np.min_scalar_type(len(paths.materials)))
    return jnp.asarray(index), *(jnp.asarray(column.astype(dtype)) for column in columns)


def _group(paths: Paths, index: NDArray[np.int64], depth: int, flat: _Flat, dtype: type) -> Group:
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
        tx=_parts(np.moveaxis(paths.tx_field[index], 0, -1), dtype)[: _parts_needed(paths.tx_field)],
        rx=_parts(np.moveaxis(paths.rx_field[index] * scale[:, None, None], 0, -1), dtype)[
            : _parts_needed(paths.rx_field)
        ],
        rotation=jnp.asarray(np.moveaxis(paths.rotation[at], -1, 1).astype(dtype)),
        turn=tuple(turn),
        wedge=tuple(wedge),
        signature="".join(_LETTER[Kind(kind)] for kind in kinds),
        size=len(index),
    )


def _parts_needed(field: NDArray[np.complex128]) -> int:
    """1 where every field is real, as those of linearly polarized antennas mostly are, else 2."""
    return 2 if field.imag.any() else 1


def _parts(value: NDArray[np.complex128], dtype: type) -> jax.Array:
    return jnp.asarray(np.stack([value.real, value.imag]).astype(dtype))
