"""The powers of an engine's rays as a function of the parameters and of the engine's assumptions.

An engine makes assumptions about antennas and about uncalibrated material constants (thickness, conductivity and
permittivity). The gain of an antenna cancels in ratios of powers, but its polarization does not. An unpolarized antenna
receives both components of a wave. Any other antenna is linearly polarized at a slant angle in the frame of its axis
(3GPP TR 38.901, eq. 7.3-4/5); the axis may be tilted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.export import Export
from calibray.fields import (
    EffectBatch,
    GroupedProgram,
    Layout,
    jax_settings,
    layout,
    path_losses_and_slopes,
    path_losses_and_slopes_with_effects,
    program_gains,
)
from calibray.fields.effects import with_antenna_fields
from calibray.fields.slab import FIELD_COLUMN
from calibray.fitting.cheap_replay import METAL
from calibray.materials import Material
from calibray.parameters import Parameters
from calibray.paths import Paths
from calibray.tracing.antennas import wave_basis

HALF_SPACE: Final = 1e4
"""Thickness [m] that represents a half-space; a wave decays within it unless the conductivity is below 1e-6 S/m."""

DECAYED: Final = 4.0
"""Attenuation in a slab [Np] above which the slab acts as a half-space, because the wave returns with only e^-8 of its
amplitude."""

RANGES: Final = {"thickness": (5e-4, HALF_SPACE), "conductivity": (1e-7, 1e3)}
"""Ranges of the assumed constants, in physical units."""

PERMITTIVITY_FACTOR: Final = 2.0
"""Maximum factor between the study's value and the engine's value of a permittivity that is not calibrated."""

TILT: Final = 0.3
"""Maximum tangent of the tilt of an antenna's axis along x or y. This value corresponds to 17 degrees, which exceeds
the tilt of base stations."""

ANGLES: Final = 3
"""Number of angles of the antenna at each end: the slant and two tilts."""

BATCH: Final = 8
"""Number of candidates that are evaluated together; the program is compiled for this number."""

LEAST_DB: Final = -300.0
"""Lower limit of the power of a path [dB]."""

_COLUMNS: Final = tuple(FIELD_COLUMN[field] for field in (*RANGES, "relative_permittivity"))

Ends = tuple[bool, bool]
"""Whether the antennas are linearly polarized: first at the transmitter, then at the receiver."""


class Call(NamedTuple):
    """A call of the engine: its candidate [d], and its rays."""

    candidate: NDArray[np.float64]
    export: Export


@dataclass(frozen=True, eq=False)
class RayModel:
    """The powers of an export's paths as a function of the parameters and of the assumed values.

    The values are the logarithms of the assumed constants [q], followed by the slant and two tilts [rad] of each end if
    the antennas are unknown.

    Attributes:
        paths: The program, without correction.
        parameters: The study's parameters.
        known: Whether the program's antennas are those of the engine; otherwise the antennas have the ports V and H.
    """

    paths: Paths
    parameters: Parameters
    known: bool

    @classmethod
    def of(cls, parameters: Parameters, paths: Paths, known: bool) -> RayModel:
        """The model of the paths of an export."""
        return cls(replace(paths, correction=None), parameters, known)

    @cached_property
    def assumed(self) -> tuple[tuple[str, str], ...]:
        """Material and field of every assumed constant: nonzero, uncalibrated constants of nonmetals on any path."""
        calibrated = {(item.material, item.constant) for item in self.parameters}
        met = set(np.unique(self.paths.material).tolist())
        return tuple(
            (name, field)
            for index, (name, item) in enumerate(self.paths.materials.items())
            if index in met and item.conductivity < METAL
            for field in (*RANGES, "relative_permittivity")
            if (name, field) not in calibrated and getattr(item, field) > 0
        )

    @cached_property
    def meets_calibrated(self) -> bool:
        """Whether any path meets a calibrated material; otherwise all ratios of powers are 1."""
        met = {list(self.paths.materials)[index] for index in np.unique(self.paths.material)}
        return any(item.material in met for item in self.parameters)

    @cached_property
    def start(self) -> NDArray[np.float64]:
        """The values [k] for the study's constants and, if the antennas are unknown, for vertical polarization."""
        constants = [np.log(getattr(self.paths.materials[name], field)) for name, field in self.assumed]
        return np.array(constants + [0.0] * (0 if self.known else 2 * ANGLES))

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds of the values."""
        factor = np.log(PERMITTIVITY_FACTOR)
        pairs = [
            np.log(RANGES[field]) if field in RANGES else (max(value - factor, 0.0), value + factor)
            for (_, field), value in zip(self.assumed, self.start, strict=False)
        ]
        pairs += [] if self.known else 2 * [(-np.pi, np.pi), (-TILT, TILT), (-TILT, TILT)]
        lower, upper = np.array(pairs).reshape(-1, 2).T
        return np.minimum(lower, self.start), np.maximum(upper, self.start)

    def tables(self, candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Constants [n, M, 8] of the materials for n candidates, each [d]."""
        return np.stack([self.paths.material_table(self.materials(each)) for each in candidates])

    def levels_and_slopes(
        self, tables: NDArray[np.float64], values: NDArray[np.float64], linear: Ends
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Power [n, P], [dB], of every path, and its derivatives [n, P, k] with respect to the values.

        The n candidates are given by their constants [n, M, 8]. The assumed values [k] are the same for all candidates.
        """
        (program, polarized), names, count = self._by_path, list(self.paths.materials), len(self.assumed)
        rows = [names.index(name) for name, _ in self.assumed]
        fields = [FIELD_COLUMN[field] for _, field in self.assumed]
        columns = [_COLUMNS.index(field) for field in fields]
        tables = tables.copy()
        tables[:, rows, fields] = np.exp(values[:count])
        angles = np.tile(values[count:], (BATCH, 1))
        levels, slopes = [], []
        for start in range(0, len(tables), BATCH):
            part = tables[start : start + BATCH]
            # Pad to the number of candidates for which the program is compiled.
            batch = np.concatenate([part, np.repeat(part[:1], BATCH - len(part), axis=0)])
            if self.known:
                loss, by_material, _ = path_losses_and_slopes(program, batch, _COLUMNS, count=len(part))
                by_angle = np.zeros((*loss.shape, 0))
            else:
                effects = EffectBatch((replace(polarized, linear=np.array(linear)),), angles)
                loss, by_material, by_angle = path_losses_and_slopes_with_effects(
                    program, batch, effects, _COLUMNS, count=len(part)
                )
            # Derivatives with respect to the logarithms of the constants.
            by_constant = by_material[:, :, rows, columns] * np.exp(values[:count])
            level, slope = -loss, -np.concatenate([by_constant, by_angle], axis=-1)
            levels.append(np.maximum(level, LEAST_DB))
            slopes.append(np.where(level[..., None] > LEAST_DB, slope, 0.0))
        return np.concatenate(levels), np.concatenate(slopes)

    def gains(self, candidate: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Gain [P, R, T] of every path between the ports, at a candidate [d] with the assumed values [k]."""
        with jax_settings():
            table = self.paths.material_table(self.materials(candidate, values))
            real, imaginary = map(np.asarray, program_gains(self._layout.program, jnp.asarray(table)))
        return (real + 1j * imaginary).transpose(2, 0, 1)[self._order]

    def materials(
        self, candidate: NDArray[np.float64], values: NDArray[np.float64] | None = None
    ) -> dict[str, Material]:
        """The materials at a candidate [d], with the assumed values [k] if given."""
        materials = self.parameters.materials(candidate, self.paths.materials)
        for (name, field), value in zip(self.assumed, [] if values is None else np.exp(values), strict=False):
            materials[name] = replace(materials[name], **{field: float(value)})
        return materials

    def replay_paths(
        self, candidate: NDArray[np.float64], values: NDArray[np.float64], linear: Ends
    ) -> Paths:
        """The program with the materials and antennas of a candidate [d] and the assumed values [k]."""
        fields = [self.paths.tx_field, self.paths.rx_field]
        angles = values[len(self.assumed) :].reshape(-1, ANGLES)
        for end in np.flatnonzero(linear).tolist() if not self.known else []:
            # The antenna receives only along its polarization; the second row is the orthogonal polarization.
            weights = ports(self.bases[end], angles[end])[:, 0]
            fields[end] = np.einsum("pt,ptc->pc", weights, fields[end])[:, None]
        materials = self.materials(candidate, values)
        return replace(self.paths, materials=materials, tx_field=fields[0], rx_field=fields[1])

    def described(self, values: NDArray[np.float64], half_spaces: Sequence[str]) -> dict[str, float]:
        """Names and values [k] of the assumed constants, without the thickness of the materials in `half_spaces`."""
        return {
            f"{name}.{field}": value
            for (name, field), value in zip(self.assumed, np.exp(values).tolist(), strict=False)
            if not (field == "thickness" and name in half_spaces)
        }

    @cached_property
    def bases(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit vectors theta and phi [P, 2, 3] of the fields at both ends."""
        departure, arrival = (
            np.moveaxis(wave_basis(angles)[1:], -1, 0)
            for angles in (self.paths.departure, self.paths.arrival)
        )
        return departure, arrival

    @cached_property
    def _layout(self) -> Layout:
        return layout(self.paths)

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        return np.argsort(self._layout.order)

    @cached_property
    def _by_path(self) -> tuple[GroupedProgram, Polarized]:
        """The program with one link per path, and the polarization of its antennas."""
        count = self.paths.num_paths
        # The path loss [dB] of such a link is minus the power of its only path, whatever the phase.
        nowhere = np.zeros((count, 3))
        plan = layout(
            replace(self.paths, link=np.arange(count), tx_position=nowhere, rx_position=nowhere), phases=False
        )
        return plan.program, Polarized(*self.bases, np.zeros(2, dtype=bool)).ordered(plan.order)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Polarized:
    """Polarization of antennas with the ports V and H; its parameters are the slant and two tilts [rad] at each end.

    Attributes:
        tx: Unit vectors theta and phi [P, 2, 3] of the fields at the transmitter.
        rx: The same at the receiver.
        linear: Whether the antenna at each end is linearly polarized [2]; otherwise the antenna receives both
            components.
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    linear: NDArray[np.bool_]

    def ordered(self, order: NDArray[np.int64]) -> Polarized:
        """See `Effect.ordered`."""
        return replace(self, tx=self.tx[order], rx=self.rx[order])

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        # The second port, orthogonal to a linear polarization, receives nothing.
        weights = [
            jnp.where(linear, ports(basis, angles, jnp) * jnp.array([[1.0], [0.0]]), jnp.eye(2))
            for linear, basis, angles in zip(
                self.linear, (self.tx, self.rx), values.reshape(2, -1), strict=True
            )
        ]
        fields, first = [], 0
        for group in program.groups:
            own = slice(first, first + group.size)
            tx, rx = (
                jnp.einsum("nab,xbcn->xacn", weight[own], field)
                for weight, field in zip(weights, (group.tx, group.rx), strict=True)
            )
            fields.append((tx, rx))
            first += group.size
        return with_antenna_fields(program, fields)


def tilted_theta(basis: Any, axis: Any, xp: Any = np) -> Any:
    """Unit vector theta of antennas with axes [..., 3], as components [..., P, 2] along the field vectors [P, 2, 3].

    The vector theta points away from the pole: it is the component of -axis orthogonal to the direction, scaled to unit
    length.
    """
    theta = -xp.einsum("pac,...c->...pa", basis, axis)
    return theta / xp.sqrt(xp.maximum(xp.sum(theta**2, axis=-1, keepdims=True), 1e-12))


def ports(basis: Any, angles: Any, xp: Any = np) -> Any:
    """Weights [P, 2, 2] of the ports V and H in a linear polarization and in the orthogonal one.

    Args:
        basis: Unit vectors theta and phi of the fields [P, 2, 3].
        angles: The slant and two tilts [3], [rad].
        xp: The array namespace: NumPy, or JAX for derivatives.
    """
    theta = tilted_theta(basis, xp.stack([angles[1], angles[2], xp.ones(())]), xp)
    phi = xp.stack([-theta[:, 1], theta[:, 0]], axis=1)
    cos, sin = xp.cos(angles[0]), xp.sin(angles[0])
    return xp.stack([cos * theta + sin * phi, cos * phi - sin * theta], axis=1)
