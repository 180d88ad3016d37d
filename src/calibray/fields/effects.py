"""Effects that change the antenna fields of a program's paths and are not material properties.

An effect has its own parameters. All quantities that depend on the fields (path loss, delay spread, derivatives with
respect to the materials) are evaluated on the changed program.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import reduce
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields.program import GroupedProgram


class Effect(Protocol):
    """An effect on the paths of a program; an immutable pytree."""

    def ordered(self, order: NDArray[np.int64]) -> Effect:
        """The same effect with its paths in the order of a program [P]."""
        ...

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """The program, with its antenna fields changed according to the values [e] of all effect parameters."""
        ...


Effects = tuple[Effect, ...]


class EffectBatch(NamedTuple):
    """Effects, and the values of all their parameters for a batch of candidates [n, e]."""

    effects: Effects
    values: jax.Array | NDArray[np.floating]


def apply_effects(program: GroupedProgram, effects: Effects, values: jax.Array) -> GroupedProgram:
    """The program with all effects applied, for the values [e] of their parameters."""
    return reduce(lambda changed, effect: effect.apply(changed, values), effects, program)


AntennaFields = tuple[jax.Array, jax.Array]
"""Transmit and receive fields of a group of paths, the only arrays that effects change."""


def antenna_fields(program: GroupedProgram) -> list[AntennaFields]:
    """The antenna fields of every group of paths."""
    return [(group.tx, group.rx) for group in program.groups]


def with_antenna_fields(program: GroupedProgram, fields: list[AntennaFields]) -> GroupedProgram:
    """The program with the given antenna fields of every group of paths."""
    pairs = zip(program.groups, fields, strict=True)
    return replace(program, groups=tuple(replace(group, tx=tx, rx=rx) for group, (tx, rx) in pairs))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ExtraLoss:
    """Loss on paths through regions such as woodland; the loss saturates with the path length inside the regions.

    Attributes:
        length: Length [P], [m], of every path inside the regions, times the ratio of the specific attenuation at the
            path's carrier to that at the study's carrier.
        maximum_db: Limit that the loss approaches for long paths in the regions [dB].
        index: Index of the parameter for the specific attenuation [dB/m]; None if the attenuation is fixed.
        fixed: Specific attenuation [dB/m], if it is fixed.
    """

    length: jax.Array | NDArray[np.float64]
    maximum_db: float
    index: int | None = field(metadata={"static": True})
    fixed: float = field(default=0.0, metadata={"static": True})

    def ordered(self, order: NDArray[np.int64]) -> ExtraLoss:
        """See `Effect.ordered`."""
        return replace(self, length=np.asarray(self.length)[order])

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        specific = self.fixed if self.index is None else values[self.index]
        # A = A_m (1 - exp(-d gamma / A_m)), ITU-R P.833-10 equation 1
        # For short paths the loss is nearly d gamma, which expm1 computes without cancellation.
        loss_db = self.maximum_db * -jnp.expm1(-jnp.asarray(self.length) * specific / self.maximum_db)
        return scaled(program, jnp.exp(-np.log(10) / 20 * loss_db))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class RoughSurfaces:
    """Loss in specular reflections from M rough materials: the Rayleigh roughness factor.

    Attributes:
        exponent: 8 (pi / lambda)^2 times the sum of cos^2 theta over the specular reflections of each path on each
            material [P, M], [1/mm^2].
        fixed: Standard deviation [M], [mm], of each material's surface height, if it is fixed.
        index: For each material, the index of the parameter for the standard deviation; None if the standard deviation
            is fixed.
    """

    exponent: jax.Array | NDArray[np.float64]
    fixed: jax.Array | NDArray[np.float64]
    index: tuple[int | None, ...] = field(metadata={"static": True})

    def ordered(self, order: NDArray[np.int64]) -> RoughSurfaces:
        """See `Effect.ordered`."""
        return replace(self, exponent=np.asarray(self.exponent)[order])

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        heights = jnp.stack(
            [
                jnp.asarray(fixed) if index is None else values[index]
                for fixed, index in zip(self.fixed, self.index, strict=True)
            ]
        )
        # Mean reflected field for heights of standard deviation s: exp(-8 (pi s cos theta / lambda)^2), W. S. Ament,
        # Proc. IRE 41(1), 1953. The square of this factor is the share of the power that stays in the specular
        # direction.
        return scaled(program, jnp.exp(-jnp.asarray(self.exponent) @ heights**2))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class DisplacementLoss:
    """Change in path loss when G groups of links are displaced along K axes, interpolated by cubics between N knots.

    Attributes:
        link: Link of every path [P].
        group: Group of every link [K, L].
        weights: Displacement [m] of every group per unit of each effect parameter; one array [G, e] for each axis.
        origin: Values of the effect parameters at which the paths were traced [e].
        knots: Displacements [K, N, L], [m], at which every link was traced, in ascending order; beyond the outer knots,
            the change is constant.
        coefficients: Coefficients [K, 4, N - 1, L] of the cubics in the distance from the lower knot, highest power
            first.
    """

    link: jax.Array | NDArray[np.integer]
    group: tuple[NDArray[np.int64], ...]
    weights: tuple[NDArray[np.float64], ...]
    origin: NDArray[np.float64]
    knots: NDArray[np.float64]
    coefficients: NDArray[np.float64]

    def ordered(self, order: NDArray[np.int64]) -> DisplacementLoss:
        """See `Effect.ordered`."""
        return replace(self, link=np.asarray(self.link)[order])

    @property
    def error_db(self) -> NDArray[np.float64]:
        """Interpolation error [L], [dB], between the five middle knots, for all axes; 0 for fewer than seven knots.

        At each of the three inner knots, the change is compared with the straight line between the two neighbouring
        knots. The RMS differences for the axes are added in quadrature. For a step of J dB next to the middle knot, the
        result is J / sqrt(6), the RMS error of linear interpolation across a step at any position. For a step in an
        outer interval, the result is J / sqrt(12).
        """
        middle = self.coefficients.shape[2] // 2
        if middle < 3:
            return np.zeros(self.knots.shape[2])
        near = slice(middle - 2, middle + 3)
        position, change_db = self.knots[:, near], self.coefficients[:, 3, near]
        share = (position[:, 1:-1] - position[:, :-2]) / (position[:, 2:] - position[:, :-2])
        missed = change_db[:, 1:-1] - change_db[:, :-2] - share * (change_db[:, 2:] - change_db[:, :-2])
        return np.sqrt((missed**2).mean(axis=1).sum(axis=0))

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        loss_db = jnp.zeros(self.knots.shape[2])
        for axis, (group, weights) in enumerate(zip(self.group, self.weights, strict=True)):
            knots = jnp.asarray(self.knots[axis])
            stated = (jnp.asarray(weights) @ (values - self.origin))[group]
            displacement = jnp.clip(stated, knots[0], knots[-1])
            # Index of the lower knot: the number of inner knots not exceeding the displacement.
            below = (displacement >= knots[1:-1]).sum(axis=0)[None]
            distance = displacement - jnp.take_along_axis(knots, below, axis=0)[0]
            cubic = jnp.take_along_axis(jnp.asarray(self.coefficients[axis]), below[None], axis=1)[:, 0]
            loss_db += jnp.polyval(cubic, distance)
        return scaled(program, jnp.exp(-np.log(10) / 20 * loss_db)[self.link])


def scaled(program: GroupedProgram, amplitude: jax.Array) -> GroupedProgram:
    """Multiply the field of each path by its amplitude; the amplitudes [P] are in the program's order of paths."""
    groups, first = [], 0
    for group in program.groups:
        own = amplitude[first : first + group.size].astype(group.rx.dtype)
        groups.append(replace(group, rx=group.rx * own))
        first += group.size
    return replace(program, groups=tuple(groups))
