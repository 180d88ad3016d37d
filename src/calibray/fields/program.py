"""A path program laid out for evaluation.

Paths are grouped by the kinds of their interactions, so that each group is a dense array and each kind costs only where
it occurs. What the materials act through lies flat, over all interactions of all groups.

A large program is laid out without padding. In a small one, whose evaluation takes less time than compiling it, paths
that differ only in how many reflections or transmissions stand in a row are one group: the shorter rows are filled up
with interactions that change nothing, and one compiled body serves the whole row.
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
from calibray.fields.steps import Step, Steps
from calibray.materials import Material, constants_matrix
from calibray.paths import Kind, Paths

_MODE: Final = {Kind.REFRACTION: tabulation.TRANSMITTED, Kind.DIFFUSE: tabulation.RAW}


PADDED: Final = 50_000
"""Interactions up to which a program with tables is filled up."""


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["tx", "rx", "rotation", "turn", "wedge"],
    meta_fields=["signature", "size"],
)
@dataclass(frozen=True)
class Group:
    """Paths with the same sequence of interactions: n paths, T transmit and R receive ports.

    Attributes:
        tx: Transmit field, real and imaginary part [2, T, 2, n]; the real part alone if all are real [1, T, 2, n].
        rx: Receive field times A lambda / 4 pi, likewise [2 or 1, R, 2, n].
        rotation: Per step (cos, sin) into the frame of the interaction [2, n], of each of a row [k, 2, n].
        turn: Per step (cos, sin) from the frame of incidence into the basis (theta, phi) [2, n], or None.
        wedge: Per step the matrices C_0 .. C_4, real and imaginary part [2, 5, 2, 2, n], or None.
        signature: One letter a step: c coefficient (reflection or transmission), r several of them in a row,
            s scattering, d diffraction.
        size: Number of paths n.
    """

    tx: jax.Array
    rx: jax.Array
    rotation: tuple[jax.Array, ...]
    turn: tuple
    wedge: tuple
    signature: str
    size: int


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["material", "cosine", "transmitted", "raw", "blank"],
    meta_fields=["shapes", "lines", "any_transmitted"],
)
@dataclass(frozen=True)
class Formula:
    """What the formula of the coefficients takes, for K places of the groups' steps, one after the other.

    Coefficients are evaluated where they stand: to gather them from elsewhere would take nearly as long as the formula.
    Places at the end of a line at which nothing stands are left out.

    Attributes:
        material: Material [K].
        cosine: Cosine of the angle of incidence [K].
        transmitted: Whether it is a transmission [K].
        raw: Whether it is a reflection that keeps the scattered energy, as a diffuse one does [K].
        blank: Whether nothing stands there, and the coefficient is 1 [K]; None where there is no such place.
        shapes: Of the places at each step of each group, (n,) or (k, n).
        lines: How many are evaluated in each line of each step, of the one or the k lines; the last line comes first.
        any_transmitted: Whether any coefficient is a transmission.
    """

    material: jax.Array
    cosine: jax.Array
    transmitted: jax.Array
    raw: jax.Array
    blank: jax.Array | None
    shapes: tuple[tuple[int, ...], ...]
    lines: tuple[tuple[int, ...], ...]
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
    paths: Paths,
    dtype: type = np.float64,
    intervals: tabulation.Intervals | None = None,
    phases: bool = True,
) -> Layout:
    """Lay a path program out for evaluation.

    Args:
        paths: The path program.
        dtype: Precision of the constants, `numpy.float64` or `numpy.float32`.
        intervals: Tabulate the coefficients over the angle of incidence with so many intervals, in all or by material
            and mode [M, 3]; None evaluates every coefficient by itself.
        phases: Keep the delays, which nothing but the sum of powers can do without.

    Returns:
        The grouped program, on JAX's default device.
    """
    small = intervals is None or paths.num_interactions <= PADDED
    steps = Steps.padded(paths) if small else Steps.exact(paths)
    index = steps.index
    order = np.concatenate(index) if index else np.zeros(0, dtype=np.int64)
    flat = _Flat(paths)
    groups = tuple(_group(paths, some, each, flat, dtype) for some, each in zip(index, steps.of, strict=True))
    places, rows = flat.places, _joined(flat.scattered, np.int64)
    depth, materials = np.diff(paths.first), len(paths.materials)
    segment = np.repeat(paths.link, depth).astype(np.int64) * materials + paths.material
    # What fills a row up changes nothing, and adds nothing to the segment that it is counted with.
    of_coefficient = np.concatenate([segment, segment[flat.faces], [0]])
    count = paths.num_links * materials
    program = GroupedProgram(
        groups=groups,
        by_link=make_segments(paths.link[order], paths.num_links),
        link=jnp.asarray(paths.link[order]) if phases else None,
        delay=jnp.asarray(paths.delay[order]) if phases else None,
        wavelength=jnp.asarray(speed_of_light / paths.frequency, dtype=dtype),
        coefficients=_coefficients(paths, flat, dtype, intervals),
        diffuse=_diffuse(paths, rows, flat.table_row[rows], dtype),
        by_material=(
            make_segments(of_coefficient[_joined([place.ravel() for place in places], np.int64)], count),
            make_segments(segment[rows], count),
        ),
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
    """Which coefficients and diffuse rows stand where, collected step by step.

    Coefficients are numbered by interaction; those of the other faces of diffracting wedges follow.
    """

    def __init__(self, paths: Paths) -> None:
        self.faces = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
        self.count = paths.num_interactions + len(self.faces)
        self.places: list[NDArray[np.int64]] = []
        self.scattered: list[NDArray[np.int64]] = []
        self._interactions = paths.num_interactions
        self.table_row = np.maximum(_row_of(paths.kind, Kind.DIFFUSE), _row_of(paths.kind, Kind.DIFFRACTION))

    def add(self, interaction: NDArray[np.int64], letter: str) -> None:
        """Append one step's interactions, -1 where there is none."""
        self.places.append(np.where(interaction < 0, self.count, interaction))
        if letter == "d":
            self.places.append(self._interactions + self.table_row[interaction])
        if letter == "s":
            self.scattered.append(interaction)


def _joined(parts: list[NDArray[Any]], dtype: type) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=dtype)


def _row_of(kind: NDArray[np.integer], which: Kind) -> NDArray[np.int64]:
    chosen = kind == which
    return np.where(chosen, np.cumsum(chosen) - 1, -1)


def coefficients_of(
    paths: Paths,
) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.float64]]:
    """Material, mode and cosine of incidence of every coefficient.

    Args:
        paths: The path program.

    Returns:
        The three, of all interactions, then of the other faces of diffracting wedges (each [J]).
    """
    faces = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
    kind, material = (np.concatenate([column, column[faces]]) for column in (paths.kind, paths.material))
    mode = np.select([kind == one for one in _MODE], list(_MODE.values()), 0)
    return material, mode, np.concatenate([paths.cos_incidence, paths.diffraction.cos_incidence_n])


def _coefficients(
    paths: Paths, flat: _Flat, dtype: type, intervals: tabulation.Intervals | None
) -> Formula | tabulation.Lookup:
    material, mode, cosine = coefficients_of(paths)
    if intervals is not None:
        root = tabulation.roots(material_table(paths), speed_of_light / paths.frequency)
        return tabulation.make_lookup(material, mode, cosine, root, flat.places, intervals, dtype)
    lines = [[_filled(line, flat.count) for line in np.atleast_2d(place)] for place in flat.places]
    at = _joined([line for step in lines for line in reversed(step)], np.int64)
    blank = at == flat.count
    # Where nothing stands, something is evaluated and left out.
    material, mode, cosine = np.append(material, 0)[at], np.append(mode, 0)[at], np.append(cosine, 1.0)[at]
    return Formula(
        material=jnp.asarray(material.astype(np.int32)),
        cosine=jnp.asarray(cosine.astype(dtype)),
        transmitted=jnp.asarray(mode == tabulation.TRANSMITTED),
        raw=jnp.asarray(mode == tabulation.RAW),
        blank=jnp.asarray(blank) if blank.any() else None,
        shapes=tuple(place.shape for place in flat.places),
        lines=tuple(tuple(len(line) for line in step) for step in lines),
        any_transmitted=bool((mode == tabulation.TRANSMITTED).any()),
    )


def _filled(line: NDArray[np.int64], nothing: int) -> NDArray[np.int64]:
    """A line without the places at its end at which nothing stands."""
    return line[: int(np.flatnonzero(line != nothing).max(initial=-1)) + 1]


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


def _group(
    paths: Paths, index: NDArray[np.int64], steps: tuple[Step, ...], flat: _Flat, dtype: type
) -> Group:
    rotation, turn, wedge = [], [], []
    for letter, at in steps:  # interactions [n] or [k, n]
        flat.add(at, letter)
        rows = flat.table_row[at]
        straight = np.where((at < 0)[..., None], [1.0, 0.0], paths.rotation[at])
        rotation.append(jnp.asarray(np.moveaxis(straight, -1, -2).astype(dtype)))
        turn.append(jnp.asarray(paths.diffuse.rotation[rows].T.astype(dtype)) if letter == "s" else None)
        form = affine_form(paths.diffraction, rows, paths.frequency) if letter == "d" else None
        wedge.append(None if form is None else _parts(form, dtype))
    scale = paths.spreading[index] * speed_of_light / paths.frequency / (4 * np.pi)
    return Group(
        tx=_parts(np.moveaxis(paths.tx_field[index], 0, -1), dtype, _parts_needed(paths.tx_field)),
        rx=_parts(
            np.moveaxis(paths.rx_field[index] * scale[:, None, None], 0, -1),
            dtype,
            _parts_needed(paths.rx_field),
        ),
        rotation=tuple(rotation),
        turn=tuple(turn),
        wedge=tuple(wedge),
        signature="".join(letter for letter, _ in steps),
        size=len(index),
    )


def _parts_needed(field: NDArray[np.complex128]) -> int:
    """1 where every field is real, as those of linearly polarized antennas mostly are, else 2."""
    return 2 if field.imag.any() else 1


def _parts(value: NDArray[np.complex128], dtype: type, needed: int = 2) -> jax.Array:
    return jnp.asarray(np.stack([value.real, value.imag][:needed]).astype(dtype))
