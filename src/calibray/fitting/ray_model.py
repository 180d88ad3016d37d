"""The powers of an engine's rays as a function of the parameters and of what the engine assumes.

An engine assumes thickness, conductivity and permittivity of the materials that the study does not calibrate, and the
antennas. The gain of an antenna cancels in ratios of powers, its polarization does not. That of an antenna with one
port is linear: along a slant angle in the frame of its axis (3GPP TR 38.901, eq. 7.3-4/5), which may be tilted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

from calibray.engines.rays.export import Export
from calibray.fields import GroupedProgram, Layout, jax_settings, layout, program_gains
from calibray.fields.combining import path_power
from calibray.fitting.cheap_replay import METAL
from calibray.materials import FIELDS
from calibray.parameters import Parameters
from calibray.paths import Paths, take
from calibray.paths.chains import spherical_basis

HALF_SPACE: Final = 1e4
"""Thickness that no wave crosses [m]: it decays there unless the conductivity is below 1e-6 S/m."""

RANGES: Final = {"thickness": (5e-4, HALF_SPACE), "conductivity": (1e-7, 1e3)}
"""Ranges of the assumed constants, in the fields' units."""

PERMITTIVITY_FACTOR: Final = 2.0
"""Largest factor between a permittivity that is not calibrated and the engine's."""

TILT: Final = 1.0
"""Largest tangent of the tilt of an antenna's axis along x or y; 1 is 45 degrees."""

BATCH: Final = 64
"""Sets of constants for which the program is compiled."""

POLARIZATIONS: Final = (0.0, np.pi / 2, np.pi / 4, -np.pi / 4)
"""Slants of one port from which its polarization is searched [rad]: vertical, horizontal, and both diagonals."""

Pair = tuple[jax.Array, jax.Array]


class Call(NamedTuple):
    """A call of the engine: its candidate [d], and its rays."""

    candidate: NDArray[np.float64]
    export: Export


@dataclass(frozen=True, eq=False)
class RayModel:
    """The powers of an export's paths as a function of the parameters and of the assumed values.

    The values are the logarithms of the assumed constants [k], and then slant and two tilts for each end with one port.

    Attributes:
        paths: The program, without correction.
        parameters: The study's parameters.
        single: Whether the antenna has one port of unknown polarization, at the transmitter and at the receiver; else
            the ports of the program count.
    """

    paths: Paths
    parameters: Parameters
    single: tuple[bool, bool] = (False, False)

    @classmethod
    def of(cls, parameters: Parameters, paths: Paths, subset: NDArray[np.int64] | None = None) -> RayModel:
        """The model of the paths of an export, or of some of them."""
        bare = replace(paths, correction=None)
        return cls(bare if subset is None else take(bare, subset), parameters)

    @cached_property
    def assumed(self) -> tuple[tuple[str, str], ...]:
        """Material and field of every assumed constant: those that are not calibrated and that a path meets."""
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
    def start(self) -> NDArray[np.float64]:
        """The study's constants, and upright vertical polarization."""
        constants = [np.log(getattr(self.paths.materials[name], field)) for name, field in self.assumed]
        return np.array(constants + [0.0] * 3 * sum(self.single))

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds of the values."""
        factor, tilt = np.log(PERMITTIVITY_FACTOR), 3 * sum(self.single)
        centre = self.start[: len(self.assumed)]
        pairs = [
            np.log(RANGES[field]) if field in RANGES else (value - factor, value + factor)
            for (_, field), value in zip(self.assumed, centre, strict=True)
        ]
        pairs += [(-np.pi, np.pi) if number % 3 == 0 else (-TILT, TILT) for number in range(tilt)]
        lower, upper = np.array(pairs).reshape(-1, 2).T
        return np.minimum(lower, self.start), np.maximum(upper, self.start)

    def with_single(self, single: tuple[bool, bool]) -> RayModel:
        """The same model with other ports; nothing is compiled again."""
        model = replace(self, single=single)
        model.__dict__["_layout"] = self._layout
        return model

    def level_and_slope(
        self, candidate: NDArray[np.float64], values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Power of every path [P], [dB], and its derivatives by the values [P, k], for values [k]."""
        with jax_settings():
            level, slope = _level_and_slope(self._layout.program, self._frame(candidate), self.single, values)
            return np.asarray(level)[self._order], np.asarray(slope)[self._order]

    def levels(self, candidate: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Power of every path with every polarization [n, H, P], [dB], for constants [n, k]."""
        frame, levels = self._frame(candidate), []
        with jax_settings():
            for start in range(0, len(values), BATCH):
                batch = values[start : start + BATCH]
                filled = np.concatenate([batch, np.repeat(batch[:1], BATCH - len(batch), axis=0)])
                level = _levels(self._layout.program, frame, self._polarized, filled)
                levels.append(np.asarray(level)[: len(batch)])
        return np.concatenate(levels)[..., self._order]

    @property
    def polarizations(self) -> tuple[tuple[float | None, float | None], ...]:
        """Slants that `levels` tries at both ends; None for the ports of the program."""
        ends: tuple[float | None, ...] = (None, *POLARIZATIONS) if self._polarized else (None,)
        return tuple((tx, rx) for tx in ends for rx in ends)

    def replay_paths(self, candidate: NDArray[np.float64], values: NDArray[np.float64]) -> Paths:
        """The program with values [k]: its materials, and its antennas as they are assumed to be."""
        constants = np.exp(values[: len(self.assumed)]).tolist()
        materials = self.parameters.materials(candidate, self.paths.materials)
        for (name, field), value in zip(self.assumed, constants, strict=True):
            materials[name] = replace(materials[name], **{field: value})
        fields = [self.paths.tx_field, self.paths.rx_field]
        angles = iter(values[len(self.assumed) :].reshape(-1, 3))
        with jax_settings():
            for end in np.flatnonzero(self.single).tolist():
                weights = np.asarray(_port_weights(self._bases[end], jnp.asarray(next(angles))))
                fields[end] = np.einsum("pt,ptc->pc", weights[self._order], fields[end])[:, None]
        return replace(self.paths, materials=materials, tx_field=fields[0], rx_field=fields[1])

    def materials(self, values: NDArray[np.float64]) -> Iterable[tuple[str, float]]:
        """Name and value of every assumed constant."""
        names = (f"{name}.{field}" for name, field in self.assumed)
        return zip(names, np.exp(values[: len(self.assumed)]).tolist(), strict=True)

    def _frame(self, candidate: NDArray[np.float64]) -> _Frame:
        names = list(self.paths.materials)
        table = self.paths.material_table(self.parameters.materials(candidate, self.paths.materials))
        rows = np.array([names.index(name) for name, _ in self.assumed], dtype=np.int64)
        columns = np.array([FIELDS.index(field) for _, field in self.assumed], dtype=np.int64)
        return _Frame(table, rows, columns, *self._bases)

    @cached_property
    def _bases(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axes theta and phi of the fields at both ends [P, 2, 3], in the order of the program."""
        order = self._layout.order
        return _basis(self.paths.departure[order]), _basis(self.paths.arrival[order])

    @property
    def _polarized(self) -> bool:
        return self.paths.tx_field.shape[1] == self.paths.rx_field.shape[1] == 2

    @cached_property
    def _layout(self) -> Layout:
        return layout(self.paths)

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        return np.argsort(self._layout.order)


class _Frame(NamedTuple):
    """Constants of the materials [M, 8], where the assumed ones belong, and axes of the fields [P, 2, 3]."""

    table: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]


def _basis(zenith_azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes theta and phi [P, 2, 3] of directions [P, 2], [rad]."""
    (zenith, azimuth) = zenith_azimuth.T
    direction = np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    theta = spherical_basis(direction)
    return np.stack([theta, np.cross(direction, theta)], axis=1)


def _port_weights(basis: ArrayLike, angles: jax.Array) -> jax.Array:
    """Weights [P, 2] of the ports V and H that make one port with a slant and a tilted axis [3]."""
    axis = jnp.stack([angles[1], angles[2], jnp.ones(())])
    # The antenna's own axis theta points away from the pole: -axis, without its part along the direction.
    theta = -jnp.asarray(basis) @ axis
    theta = theta / jnp.sqrt(jnp.maximum(jnp.sum(theta**2, axis=1, keepdims=True), 1e-12))
    cos, sin = jnp.cos(angles[0]), jnp.sin(angles[0])
    return jnp.stack([cos * theta[:, 0] - sin * theta[:, 1], cos * theta[:, 1] + sin * theta[:, 0]], axis=1)


def _decibel(gain: Pair) -> jax.Array:
    return 10 * jnp.log10(jnp.maximum(path_power(gain), 1e-30))


def _gains(program: GroupedProgram, frame: _Frame, constants: jax.Array) -> Pair:
    """Gains [R, T, P] with logarithms of the assumed constants [k]."""
    return program_gains(
        program, jnp.asarray(frame.table).at[frame.rows, frame.columns].set(jnp.exp(constants))
    )


@partial(jax.jit, static_argnums=2)
def _level_and_slope(
    program: GroupedProgram, frame: _Frame, single: tuple[bool, bool], values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Powers [P], [dB], and derivatives [P, k], in the order of the program."""
    count = len(frame.rows)

    def level(values: jax.Array) -> jax.Array:
        gain, angles = _gains(program, frame, values[:count]), values[count:].reshape(-1, 3)
        for end, basis, weighed in ((0, frame.tx, "rtp,pt->rp"), (1, frame.rx, "rtp,pr->tp")):
            if single[end]:
                weights = _port_weights(basis, angles[int(single[0]) * end])
                gain = tuple(jnp.expand_dims(jnp.einsum(weighed, part, weights), 1 - end) for part in gain)
        return _decibel((gain[0], gain[1]))

    return level(values), jax.jacfwd(level)(values)


@partial(jax.jit, static_argnums=2)
def _levels(program: GroupedProgram, frame: _Frame, polarized: bool, values: jax.Array) -> jax.Array:
    """Powers [n, H, P], [dB], with every polarization, in the order of the program."""
    ends = [jnp.eye(2), *(jnp.array([[np.cos(slant), np.sin(slant)]]) for slant in POLARIZATIONS)]

    def level(constants: jax.Array) -> jax.Array:
        gain = _gains(program, frame, constants)
        if not polarized:
            return _decibel(gain)[None]
        return jnp.stack(
            [
                _decibel(
                    (
                        jnp.einsum("ar,rtp,bt->abp", rx, gain[0], tx),
                        jnp.einsum("ar,rtp,bt->abp", rx, gain[1], tx),
                    )
                )
                for tx in ends
                for rx in ends
            ]
        )

    return jax.vmap(level)(values)
