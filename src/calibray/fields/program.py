"""A path program laid out for evaluation.

Paths are grouped by the kinds of their interactions (`calibray.fields.grouping`), so each group is a dense array. The
slab formula is evaluated for all groups at once, so its arguments are stored in flat arrays over all groups.

A large program with tables is stored without padding. In other programs, shorter runs of reflections and transmissions
are padded, so fewer groups have to be compiled. Padding saves time there, because a small program takes less time to
evaluate than to compile.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.fields.arithmetic import Segments, make_segments
from calibray.fields.coefficient_tables import (
    Intervals,
    TableLayout,
    coefficient_arguments,
    spacing_roots,
    table_layout,
)
from calibray.fields.diffraction import affine_form
from calibray.fields.grouping import DIFFRACTION, SCATTERING, PathGroup, exact_groups, padded_groups
from calibray.fields.jax_context import jax_settings
from calibray.fields.slab import Mode
from calibray.paths import Kind, Paths

LARGE: Final = 50_000
"""Number of interactions above which a program is large; with tables, large programs are not padded."""

SMALL: Final = 300
"""Largest number of coefficients in a small program, which is compiled without XLA's fusion emitters. With 120
coefficients, compiling path loss and derivatives takes 2.3 s instead of 3.4 s, and evaluating a candidate takes up to
20 us longer. With 960 coefficients, evaluating a candidate takes 135 us longer (`docs/measurements/speed.md`)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Group:
    """Paths with the same sequence of interactions: n paths, T transmit and R receive ports.

    Attributes:
        tx: Transmit field, real and imaginary parts [2, T, 2, n]; only the real part [1, T, 2, n] if all fields are
            real.
        rx: Receive field times A lambda / 4 pi, in the same form [2 or 1, R, 2, n].
        rotation: For each step, (cos, sin) of the rotation into the interaction's frame [2, n]; [k, 2, n] for a run of
            k.
        turn: For each diffuse step, (cos, sin) of the rotation from the frame of incidence into the basis (theta, phi)
            [2, n]; None for other steps.
        wedge: For each diffraction step, the matrices C_0 .. C_4, real and imaginary parts [2, 5, 2, 2, n]; None for
            other steps.
        signature: One letter for each step; see `calibray.fields.grouping`.
        size: Number of paths n.
    """

    tx: jax.Array
    rx: jax.Array
    rotation: tuple[jax.Array, ...]
    turn: tuple
    wedge: tuple
    signature: str = field(metadata={"static": True})
    size: int = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FormulaArguments:
    """Arguments of the slab formula at K positions, in the order in which the groups' steps use the coefficients.

    Reordering coefficients would take nearly as long as the formula itself. Empty positions at the end of a line are
    omitted.

    Attributes:
        material: Material [K].
        cosine: Cosine of the angle of incidence [K].
        transmitted: Whether each coefficient is a transmission coefficient [K].
        unreduced: Whether the coefficient is a reflection coefficient that scattering does not reduce, as in a diffuse
            interaction [K].
        blank: Whether each position is empty, so that its coefficient is 1 [K]; None if no position is empty.
        shapes: Shape of the positions at each step of each group, (n,) or (k, n).
        lines: Number of stored positions in each line (one line, or k for a run) of each step; the last line is stored
            first.
        any_transmitted: Whether any coefficient is a transmission coefficient.
    """

    material: jax.Array
    cosine: jax.Array
    transmitted: jax.Array
    unreduced: jax.Array
    blank: jax.Array | None
    shapes: tuple[tuple[int, ...], ...] = field(metadata={"static": True})
    lines: tuple[tuple[int, ...], ...] = field(metadata={"static": True})
    any_transmitted: bool = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DiffuseArguments:
    """Arguments of the scattering patterns of D diffuse interactions, in the order in which groups use them.

    Attributes:
        material: Material [D].
        solid_angle: Solid angle [D], [sr], of the ray tube, divided by its sampling probability.
        cos_scattered: Cosine of the angle between the scattered direction and the normal [D].
        cos_incidence: Cosine of the angle of incidence [D]; empty if every material is Lambertian.
        cos_specular: Cosine of the angle between the scattered and specular directions [D]; empty if every material is
            Lambertian.
        cos_backward: Cosine of the angle between the scattered direction and the direction to the source [D]; empty if
            every material is Lambertian.
        patterns: Scattering pattern of every material.
    """

    material: jax.Array
    solid_angle: jax.Array
    cos_scattered: jax.Array
    cos_incidence: jax.Array
    cos_specular: jax.Array
    cos_backward: jax.Array
    patterns: tuple[str, ...] = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GroupedProgram:
    """A path program laid out for evaluation: P paths, J coefficients, D diffuse interactions, M materials.

    Attributes:
        groups: The paths, grouped by sequence of interactions.
        by_link: Segments of the paths by link.
        link: Link [P] of every path, in the order of the groups; None if only powers are summed.
        delay: Delay [P], [s], of every path, in the order of the groups; None if only powers are summed.
        wavelength: Wavelength [m].
        coefficients: Arguments of the slab formula, or positions in tables.
        diffuse: Arguments of the scattering patterns.
        by_material: Segments of the coefficients and of the diffuse interactions by link and material (segment:
            link x M + material).
    """

    groups: tuple[Group, ...]
    by_link: Segments
    link: jax.Array | None
    delay: jax.Array | None
    wavelength: jax.Array
    coefficients: FormulaArguments | TableLayout
    diffuse: DiffuseArguments
    by_material: tuple[Segments, Segments]

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return self.by_link.count

    @property
    def phases(self) -> tuple[jax.Array, jax.Array]:
        """Link [P] and delay [P], [s] of every path, in the order of the groups.

        Raises:
            InputError: The program was laid out without links and delays.
        """
        if self.link is None or self.delay is None:
            raise InputError("the program was laid out for sums of powers only; lay it out with phases=True")
        return self.link, self.delay

    @property
    def is_small(self) -> bool:
        """Whether evaluating the program takes so little time that its compilation time matters more."""
        source = self.coefficients
        return isinstance(source, FormulaArguments) and len(source.material) <= SMALL

    @property
    def nbytes(self) -> int:
        """Size of the arrays [bytes]."""
        return sum(array.nbytes for array in jax.tree.leaves(self))


@dataclass(frozen=True)
class Layout:
    """A grouped program, and the index [P] of each of its paths in the path program."""

    program: GroupedProgram
    order: NDArray[np.int64]


@jax_settings()
def layout(
    paths: Paths, dtype: type = np.float64, intervals: Intervals | None = None, phases: bool = True
) -> Layout:
    """Lay out a path program for evaluation in a given precision on JAX's default device.

    If `intervals` is given (one number, or one for each material and mode [M, 3]), the coefficients are tabulated by
    angle of incidence. Without `intervals`, the slab formula is evaluated at every interaction. With `phases`, the
    links and delays of the paths are stored. Without `phases`, only sums of powers can be computed.
    """
    # Use jax.device_put: jnp.asarray compiles a program for every shape, which takes 15 ms.
    padded = intervals is None or paths.num_interactions <= LARGE
    path_groups = padded_groups(paths) if padded else exact_groups(paths)
    order = _joined([group.paths for group in path_groups])
    numbering = _Numbering(paths, path_groups)
    num_materials = len(paths.materials)
    link = np.repeat(paths.link, np.diff(paths.first)).astype(np.int64)
    segment = link * num_materials + paths.material
    # Padding belongs to segment 0. Padding adds nothing there, because its derivatives are 0.
    segment_of_coefficient = np.concatenate([segment, segment[numbering.wedges], [0]])
    num_segments = paths.num_links * num_materials
    program = GroupedProgram(
        groups=tuple(_group(paths, group, numbering.table_row, dtype) for group in path_groups),
        by_link=make_segments(paths.link[order], paths.num_links),
        link=jax.device_put(paths.link[order]) if phases else None,
        delay=jax.device_put(paths.delay[order]) if phases else None,
        wavelength=jax.device_put(np.asarray(speed_of_light / paths.frequency, dtype=dtype)),
        coefficients=_coefficients(paths, numbering, dtype, intervals),
        diffuse=_diffuse(paths, numbering.scattered, numbering.table_row[numbering.scattered], dtype),
        by_material=(
            make_segments(
                segment_of_coefficient[_joined([step.ravel() for step in numbering.steps])], num_segments
            ),
            make_segments(segment[numbering.scattered], num_segments),
        ),
    )
    return Layout(program, order)


class _Numbering:
    """Indices of the coefficients in the order in which the steps of all groups use them.

    The coefficients of all interactions come first, then those of the n-faces of diffracting wedges.

    Attributes:
        wedges: Interaction indices of the diffractions [W].
        count: Number of coefficients, which also serves as the index that marks an empty position.
        table_row: Row [I] of each interaction in the table of its kind; -1 for reflections and transmissions.
        steps: Indices of the coefficients at each step of each group, [n] or [k, n]; a diffraction has two steps.
        scattered: Indices [D] of the diffuse interactions in the order of use.
    """

    def __init__(self, paths: Paths, groups: list[PathGroup]) -> None:
        self.wedges = np.flatnonzero(paths.kind == Kind.DIFFRACTION)
        self.count = paths.num_interactions + len(self.wedges)
        self.table_row = np.full(paths.num_interactions, -1)
        for kind in (Kind.DIFFUSE, Kind.DIFFRACTION):
            of_kind = np.flatnonzero(paths.kind == kind)
            self.table_row[of_kind] = np.arange(len(of_kind))
        self.steps: list[NDArray[np.int64]] = []
        scattered = []
        for letter, interaction in [step for group in groups for step in group.steps]:
            self.steps.append(np.where(interaction < 0, self.count, interaction))
            if letter == DIFFRACTION:
                self.steps.append(paths.num_interactions + self.table_row[interaction])
            elif letter == SCATTERING:
                scattered.append(interaction)
        self.scattered = _joined(scattered)


def _joined(parts: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _coefficients(
    paths: Paths, numbering: _Numbering, dtype: type, intervals: Intervals | None
) -> FormulaArguments | TableLayout:
    arguments = coefficient_arguments(paths)
    if intervals is not None:
        root = spacing_roots(paths.material_table(), speed_of_light / paths.frequency)
        return table_layout(arguments, root, numbering.steps, intervals, dtype)
    lines = [
        [_without_empty_end(line, numbering.count) for line in np.atleast_2d(step)]
        for step in numbering.steps
    ]
    position = _joined([line for step in lines for line in reversed(step)])
    blank = position == numbering.count
    # At empty positions, the formula is evaluated for arbitrary arguments, and the result is replaced by 1.
    material, mode, cosine = (
        np.append(column, filler)[position] for column, filler in zip(arguments, (0, 0, 1.0), strict=True)
    )
    return FormulaArguments(
        material=jax.device_put(material.astype(np.int32)),
        cosine=jax.device_put(cosine.astype(dtype)),
        transmitted=jax.device_put(mode == Mode.TRANSMISSION),
        unreduced=jax.device_put(mode == Mode.FULL_REFLECTION),
        blank=jax.device_put(blank) if blank.any() else None,
        shapes=tuple(step.shape for step in numbering.steps),
        lines=tuple(tuple(len(line) for line in step) for step in lines),
        any_transmitted=bool((mode == Mode.TRANSMISSION).any()),
    )


def _without_empty_end(line: NDArray[np.int64], empty: int) -> NDArray[np.int64]:
    return line[: int(np.flatnonzero(line != empty).max(initial=-1)) + 1]


def _diffuse(
    paths: Paths, interaction: NDArray[np.int64], row: NDArray[np.int64], dtype: type
) -> DiffuseArguments:
    table = paths.diffuse
    patterns = tuple(material.scattering_pattern for material in paths.materials.values())
    # A Lambertian pattern does not depend on the angles that `lobes` selects.
    lobes = slice(0 if all(pattern == "lambertian" for pattern in patterns) else None)

    def column(values: NDArray[np.float64]) -> jax.Array:
        return jax.device_put(values.astype(dtype))

    return DiffuseArguments(
        material=jax.device_put(paths.material[interaction].astype(np.min_scalar_type(len(paths.materials)))),
        solid_angle=column(table.solid_angle[row]),
        cos_scattered=column(table.cos_scattered[row]),
        cos_incidence=column(paths.cos_incidence[interaction][lobes]),
        # A cosine rounded below -1 would make the base of a power negative and give NaN.
        cos_specular=column(np.maximum(table.cos_specular[row][lobes], -1.0)),
        cos_backward=column(np.maximum(table.cos_backward[row][lobes], -1.0)),
        patterns=patterns,
    )


def _group(paths: Paths, group: PathGroup, table_row: NDArray[np.int64], dtype: type) -> Group:
    rotation, turn, wedge = [], [], []
    for letter, interaction in group.steps:  # [n] or [k, n]
        row = table_row[interaction]
        cos_sin = np.where((interaction < 0)[..., None], [1.0, 0.0], paths.rotation[interaction])
        rotation.append(jax.device_put(np.moveaxis(cos_sin, -1, -2).astype(dtype)))
        scatters, diffracts = letter == SCATTERING, letter == DIFFRACTION
        turn.append(jax.device_put(paths.diffuse.rotation[row].T.astype(dtype)) if scatters else None)
        wedge.append(
            _parts(affine_form(paths.diffraction, row, paths.frequency), dtype) if diffracts else None
        )
    # Factor (lambda / 4 pi) A in the gain of a path.
    scale = paths.spreading[group.paths] * speed_of_light / paths.frequency / (4 * np.pi)
    if paths.correction is not None:
        # The correction is a ratio of powers, but `scale` multiplies fields.
        scale = scale * np.sqrt(paths.correction[group.paths])
    tx, rx = paths.tx_field[group.paths], paths.rx_field[group.paths] * scale[:, None, None]
    return Group(
        tx=_parts(np.moveaxis(tx, 0, -1), dtype, _num_parts(paths.tx_field)),
        rx=_parts(np.moveaxis(rx, 0, -1), dtype, _num_parts(paths.rx_field)),
        rotation=tuple(rotation),
        turn=tuple(turn),
        wedge=tuple(wedge),
        signature="".join(letter for letter, _ in group.steps),
        size=len(group.paths),
    )


def _num_parts(field: NDArray[np.complex128]) -> int:
    """Number of parts to store: 1 if all fields are real, as for most linearly polarized antennas, otherwise 2."""
    return 2 if field.imag.any() else 1


def _parts(value: NDArray[np.complex128], dtype: type, count: int = 2) -> jax.Array:
    """Real and imaginary parts, or only the real part."""
    return jax.device_put(np.stack([value.real, value.imag][:count]).astype(dtype))
