"""The powers of an engine's rays as a function of the parameters and of what the engine assumes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.engines.rays.export import Export
from calibray.fields import GroupedProgram, Layout, jax_settings, layout, path_powers
from calibray.fitting.cheap_replay import METAL
from calibray.materials import Material
from calibray.parameters import Parameter, Parameters
from calibray.parameters.laws import PARAMETER_BOUNDS
from calibray.paths import Paths

FACTOR: Final = {"thickness": 10.0, "conductivity": 30.0, "relative_permittivity": 2.0}
"""Largest factor between a constant of the study and that of the engine."""

HALF_SPACE: Final = 1e4
"""Thickness that no wave crosses [m]: it decays there unless the conductivity is below 1e-6 S/m."""

BATCH: Final = 8
"""Sets of constants evaluated at once, for which the program is compiled; the information is averaged over as many."""


class Call(NamedTuple):
    """A call of the engine: its candidate [d], and its rays."""

    candidate: NDArray[np.float64]
    export: Export


class Assumption(NamedTuple):
    """What an engine may assume besides constants.

    Attributes:
        ports: Which ports of the program's antennas count, at the transmitter and at the receiver.
        half_space: Whether surfaces are half-spaces, else slabs.
    """

    ports: tuple[tuple[float, ...], tuple[float, ...]]
    half_space: bool


@dataclass(frozen=True, eq=False)
class RayModel:
    """The powers of an export's paths as a function of the parameters and the assumed constants.

    Attributes:
        paths: The program, without correction.
        parameters: The study's parameters, and then the assumed constants.
        count: Number of the study's parameters.
        assumption: What it is computed with.
    """

    paths: Paths
    parameters: Parameters
    count: int
    assumption: Assumption

    @classmethod
    def of(cls, parameters: Parameters, export: Export, assumption: Assumption) -> RayModel:
        """The model of the paths of an export."""
        paths, (tx, rx) = export.paths, (np.array(ports)[:, None] for ports in assumption.ports)
        paths = replace(paths, correction=None, tx_field=paths.tx_field * tx, rx_field=paths.rx_field * rx)
        return cls(paths, _with_assumed(parameters, _used(paths)), len(parameters), assumption)

    def level_and_slope(
        self, candidate: NDArray[np.float64], constants: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Power of every path [n, P], [dB], and its derivatives by the constants [n, P, k], for constants [n, k]."""
        rows, columns = self.parameters.matrix_indices(list(self.paths.materials))
        base, count = self.paths.material_table(), self.count
        base[rows[:count], columns[:count]] = candidate
        assumed, levels, slopes = self._thick(constants), [], []
        order = np.argsort(self._layout.order)
        with jax_settings():
            for start in range(0, len(constants), BATCH):
                batch = assumed[start : start + BATCH]
                filled = np.concatenate([batch, np.repeat(batch[:1], BATCH - len(batch), axis=0)])
                level, slope = _levels_and_slopes(
                    self._layout.program, base, rows[count:], columns[count:], filled
                )
                levels.append(np.asarray(level)[: len(batch), order])
                slopes.append(np.asarray(slope)[: len(batch), order])
        slope = np.concatenate(slopes)
        return np.concatenate(levels), slope * ~self._is_thickness if self.assumption.half_space else slope

    def materials(
        self, candidate: NDArray[np.float64], constants: NDArray[np.float64]
    ) -> dict[str, Material]:
        """The materials with parameters [d] and constants [k]."""
        values = np.concatenate([candidate, self._thick(constants)])
        return self.parameters.materials(values, self.paths.materials)

    def _thick(self, constants: NDArray[np.float64]) -> NDArray[np.float64]:
        return (
            np.where(self._is_thickness, HALF_SPACE, constants) if self.assumption.half_space else constants
        )

    @cached_property
    def _is_thickness(self) -> NDArray[np.bool_]:
        return np.array([item.constant == "thickness" for item in self.parameters], dtype=bool)[self.count :]

    @cached_property
    def _layout(self) -> Layout:
        return layout(self.paths)


@jax.jit
def _levels_and_slopes(
    program: GroupedProgram, base: jax.Array, rows: jax.Array, columns: jax.Array, values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Powers [n, P], [dB], and derivatives [n, P, k], in the order of the program."""

    def level(constants: jax.Array) -> jax.Array:
        power = path_powers(program, base.at[rows, columns].set(constants))
        return 10 * jnp.log10(jnp.maximum(power, 1e-30))

    return jax.vmap(lambda constants: (level(constants), jax.jacfwd(level)(constants)))(values)


def _used(paths: Paths) -> dict[str, Material]:
    """The materials that a path meets, except metal."""
    met = np.unique(paths.material)
    return {
        name: item
        for index, (name, item) in enumerate(paths.materials.items())
        if index in met and item.conductivity < METAL
    }


def _with_assumed(parameters: Parameters, materials: dict[str, Material]) -> Parameters:
    """The parameters, and then the constants that the engine may assume otherwise."""
    calibrated = {f"{parameter.material}.{parameter.constant}" for parameter in parameters}
    assumed = []
    for name, field in product(materials, FACTOR):
        value, bound = getattr(materials[name], field), PARAMETER_BOUNDS[field]
        if f"{name}.{field}" not in calibrated and value > 0:
            lower, upper = max(value / FACTOR[field], bound.lower), min(value * FACTOR[field], bound.upper)
            assumed.append(Parameter(f"{name}.{field}", lower, upper, value, "log"))
    return replace(parameters, items=(*parameters.items, *assumed))
