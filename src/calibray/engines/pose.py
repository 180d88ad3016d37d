"""Errors of the stated directions and gains of transmit antennas, as an effect on stored paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from calibray.fields import GroupedProgram
from calibray.parameters import Parameter
from calibray.paths import Paths
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.mounting import EVERY, FIELDS, POSE, Mounting, Pose, in_frame, jones_vectors, theta_axis
from calibray.tracing.settings import Antenna


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["angles", "axis", "pose", "antenna", "transmitter", "weights"],
    meta_fields=["antennas"],
)
@dataclass(frozen=True, eq=False)
class PoseError:
    """Transmit antennas that point, and radiate, otherwise than stated; P paths, T transmitters, e parameters.

    Attributes:
        angles: Zenith and azimuth of departure [P, 2], [rad].
        axis: Theta vector of every path in the frame of its first interaction [P, 2].
        pose: Stated directions of the antennas [P].
        antenna: Antenna of every path [P].
        transmitter: Transmitter of every path [P].
        weights: What is added to yaw [rad], downtilt [rad] and gain [dB] of a transmitter, per unit of each effect
            parameter [3, T, e].
        antennas: The different antennas.
    """

    angles: Any
    axis: Any
    pose: Pose
    antenna: Any
    transmitter: Any
    weights: Any
    antennas: tuple[Antenna, ...]

    def ordered(self, order: NDArray[np.int64]) -> PoseError:
        """See `Effect.ordered`."""
        arrays = {name: getattr(self, name)[order] for name in ("angles", "axis", "antenna", "transmitter")}
        return replace(self, **arrays, pose=Pose(*(angle[order] for angle in self.pose)))

    def apply(self, program: GroupedProgram, values: jax.Array) -> GroupedProgram:
        """See `Effect.apply`."""
        yaw, downtilt, gain_db = (jnp.asarray(self.weights) @ values)[:, self.transmitter]
        pose = Pose(self.pose.yaw + yaw, self.pose.downtilt + downtilt, self.pose.electrical_downtilt)
        jones = sum(
            jnp.where(
                (jnp.asarray(self.antenna) == number)[:, None, None],
                jones_vectors(AntennaPattern.of(antenna), jnp.asarray(self.angles), pose, jnp),
                0.0,
            )
            for number, antenna in enumerate(self.antennas)
        )
        jones = jones * jnp.exp(np.log(10) / 20 * gain_db)[:, None, None]
        field = jnp.moveaxis(in_frame(jones, jnp.asarray(self.axis), False, jnp), 0, -1)[None]
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
    """The errors that parameters such as "tx:CELL.azimuth" state; None if no parameter does.

    Args:
        paths: The paths, with the fields of the stated antennas.
        mounting: The stated transmit antennas.
        labels: Transmitter of every link [L].
        effect_parameters: The parameters of all effects, in the order of their values.
        from_north: Whether azimuths are compass bearings.
    """
    names, transmitter = np.unique(labels, return_inverse=True)
    degree = np.pi / 180
    unit = {"azimuth": -degree if from_north else degree, "downtilt": degree, "gain": 1.0}
    weights = np.zeros((len(FIELDS), len(names), len(effect_parameters)))
    for number, parameter in enumerate(effect_parameters):
        if parameter.name.startswith(POSE):
            label = parameter.material.removeprefix(POSE)
            chosen = (names == label) | (label == EVERY)
            weights[FIELDS.index(parameter.field), chosen, number] = unit[parameter.field]
    if not weights.any():
        return None
    on_paths = mounting.of_paths(paths.link)
    return PoseError(
        angles=paths.departure,
        axis=theta_axis(paths, mounting),
        pose=on_paths.pose,
        antenna=on_paths.index,
        transmitter=transmitter.reshape(-1)[paths.link],
        weights=weights,
        antennas=mounting.antennas,
    )
