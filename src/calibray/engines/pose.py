"""Errors in the stated orientations and gains of transmit antennas, modelled as an effect on stored paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields import GroupedProgram
from calibray.fields.arithmetic import cosine_and_sine, materialize
from calibray.parameters import Parameter
from calibray.paths import Paths
from calibray.tracing.antennas import (
    FIELDS,
    POSE,
    AntennaPattern,
    Mounting,
    Pose,
    antenna_response,
    concerned,
    in_frame,
    of_ports,
    theta_axis,
    turns,
    wave_basis,
)
from calibray.tracing.settings import Antenna

XP: Final = SimpleNamespace(
    **vars(jnp)
    | {
        "cos": lambda angle: cosine_and_sine(angle)[0],
        "sin": lambda angle: cosine_and_sine(angle)[1],
        "power": lambda base, exponent: jnp.exp(np.log(base) * exponent),
    }
)
"""`jax.numpy` with sine, cosine and power in forms that XLA vectorizes on CPUs."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PoseError:
    """Deviations of T transmit antennas from their stated orientations and gains, for P paths and M poses.

    Attributes:
        basis: Direction of departure of every path with its basis vectors [3, 3, P]; see `wave_basis`.
        axis: Theta vector [P, 2] of every path, in the frame of its first interaction.
        pose: Stated orientations [M], each shared by several paths.
        mounted: Index of every path's pose [P].
        of_antenna: Indices of the paths of each antenna.
        transmitter: Index of every pose's transmitter [M].
        weights: Changes [3, T, e] in the yaw [rad], downtilt [rad] and gain [dB] of every transmitter, per unit of each
            of the e effect parameters.
        antennas: The distinct antennas.
        gains: Content of the antennas as text, so that a gain file that changes but keeps its name triggers a new
            compilation.
    """

    basis: Any
    axis: Any
    pose: Pose
    mounted: Any
    of_antenna: tuple[Any, ...]
    transmitter: Any
    weights: Any
    antennas: tuple[Antenna, ...] = field(metadata={"static": True})
    gains: str = field(metadata={"static": True})

    def ordered(self, order: NDArray[np.int64]) -> PoseError:
        """See `Effect.ordered`."""
        # Position of every path in the new order.
        place = np.argsort(order)
        return replace(
            self,
            basis=self.basis[..., order],
            axis=self.axis[order],
            mounted=self.mounted[order],
            of_antenna=tuple(np.sort(place[paths]) for paths in self.of_antenna),
        )

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        yaw, downtilt, gain_db = (jnp.asarray(self.weights) @ values)[:, self.transmitter]
        pose = self.pose._replace(yaw=self.pose.yaw + yaw, downtilt=self.pose.downtilt + downtilt)
        amplitude = jnp.exp(np.log(10) / 20 * gain_db)
        stored = partial(materialize, positive=program.wavelength)
        basis, mounted = jnp.asarray(self.basis), jnp.asarray(self.mounted)
        field = jnp.zeros(0)
        for antenna, paths in zip(self.antennas, self.of_antenna, strict=True):
            alone = len(self.antennas) == 1
            part = (basis, mounted) if alone else (basis[..., paths], mounted[paths])
            response = antenna_response(AntennaPattern.of(antenna), part[0], pose, XP, part[1], stored)
            jones = of_ports(antenna, *stored(response), XP)
            jones = jones * amplitude[part[1]][:, None, None]
            whole = jnp.zeros((len(self.axis), *jones.shape[1:])) if not field.size else field
            field = jones if alone else whole.at[paths].set(jones)
        field = jnp.moveaxis(in_frame(field, jnp.asarray(self.axis), False, jnp), 0, -1)[None]
        field = stored(field)
        groups, first = [], 0
        for group in program.groups:
            groups.append(replace(group, tx=field[..., first : first + group.size].astype(group.tx.dtype)))
            first += group.size
        return replace(program, groups=tuple(groups))


def pose_error(
    paths: Paths,
    mounting: Mounting,
    labels: NDArray[np.str_],
    effect_parameters: Sequence[Parameter],
    from_north: bool,
) -> PoseError | None:
    """The errors described by parameters such as "tx:CELL.azimuth"; None if there are no such parameters.

    Args:
        paths: The paths with the fields of the antennas as stated.
        mounting: The stated transmit antennas.
        labels: Name of every link's transmitter [L].
        effect_parameters: The parameters of all effects, in the order of their values.
        from_north: Whether azimuths are compass bearings.
    """
    names, transmitter = np.unique(labels, return_inverse=True)
    degree = np.pi / 180
    # Compass bearings increase clockwise, but yaw increases counter-clockwise.
    unit = {"azimuth": -degree if from_north else degree, "downtilt": degree, "gain": 1.0}
    weights = np.zeros((len(FIELDS), len(names), len(effect_parameters)))
    for number, parameter in enumerate(effect_parameters):
        if turns(parameter.name):
            own = [
                other.material.removeprefix(POSE)
                for other in effect_parameters
                if turns(other.name) and other.field == parameter.field
            ]
            chosen = concerned(names, parameter.material.removeprefix(POSE), own)
            weights[FIELDS.index(parameter.field), chosen, number] = unit[parameter.field]
    if not weights.any():
        return None
    # Links of one transmitter share its pose, so the sines of the pose's angles are computed only once.
    keys = np.column_stack([*mounting.pose, transmitter.reshape(-1)])
    shared, of_link = np.unique(keys, axis=0, return_inverse=True)
    antenna = mounting.index[paths.link]
    return PoseError(
        basis=wave_basis(paths.departure),
        axis=theta_axis(paths, mounting),
        pose=Pose(*shared[:, :-1].T),
        mounted=of_link.reshape(-1)[paths.link],
        of_antenna=tuple(np.flatnonzero(antenna == number) for number in range(len(mounting.antennas))),
        transmitter=shared[:, -1].astype(np.int64),
        weights=weights,
        antennas=mounting.antennas,
        gains=str([antenna.record() for antenna in mounting.antennas]),
    )
