"""Positions that are parameters, heights of transmitters and shifts of devices, and errors of receivers' positions.

Path loss is traced at the stated positions and at displaced ones. Between them its change is a polynomial of second
order in the displacement [dB], for every link and direction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths, take_links
from calibray.paths.selection import concatenate
from calibray.support.messages import did_you_mean
from calibray.tracing.mounting import EVERY, NEW, POSE, Mounting, concerned

if TYPE_CHECKING:
    from calibray.fields import DisplacementLoss, Effects


RECEIVER: Final = "rx:"
"""Beginning of the names of the parameters of receivers."""

AXES: Final = {"dx": 0, "dy": 1, "height": 2}
"""Axis of the scene along which each field displaces an antenna."""


def displaces(name: str) -> bool:
    """Whether a parameter displaces antennas.

    Example:
        >>> displaces("tx:CELL.height"), displaces("rx:*.dx"), displaces("tx:CELL.azimuth")
        (True, True, False)
    """
    return name.startswith((POSE, RECEIVER)) and name.rpartition(".")[2] in AXES


@dataclass(frozen=True, eq=False)
class Displacement:
    """What parameters displace links along one axis.

    Attributes:
        field: "height" of the transmitters, or "dx" or "dy" of the receivers.
        weights: 1 where a parameter displaces a group of links [G, parameters].
        group: Group of every link [L].
        reach: Largest displacement of every group within the bounds [G], [m].
    """

    field: str
    weights: NDArray[np.float64]
    group: NDArray[np.int64]
    reach: NDArray[np.float64]

    def moved(self, links: Measurements, displacement: NDArray[np.float64]) -> Measurements:
        """The links with displaced ends [L], [m]."""
        end = "tx" if self.field == "height" else "rx"
        position = np.array(getattr(links, end))
        position[:, AXES[self.field]] += displacement
        return replace(links, **{end: position})


def displacements(
    items: tuple[Parameter, ...], links: Measurements, columns: Mapping[str, str | None]
) -> tuple[Displacement, ...]:
    """The displacements of links, one for each axis that parameters displace them along.

    Args:
        items: The parameters.
        links: The links. Receivers of links without measured values are exact, and not displaced.
        columns: Columns of the names of transmitters ("tx:") and of devices ("rx:").

    Raises:
        InputError: A column is missing.
    """
    displacements = []
    for field in AXES:
        named = [(k, item) for k, item in enumerate(items) if displaces(item.name) and item.field == field]
        kind = POSE if field == "height" else RECEIVER
        if not named or (kind == RECEIVER and not links.measured):
            continue
        labels = np.full(len(links), EVERY)
        if any(item.material != kind + EVERY for _, item in named):
            labels = links.table.labels(columns[kind] or "")
        names, group = np.unique(labels, return_inverse=True)
        weights, own = (
            np.zeros((len(names), len(items))),
            [item.material.removeprefix(kind) for _, item in named],
        )
        for number, item in named:
            weights[concerned(names, item.material.removeprefix(kind), own), number] = 1.0
        largest = np.array([max(abs(item.lower), abs(item.upper)) for item in items])
        displacements.append(Displacement(field, weights, group.reshape(-1), (weights * largest).max(axis=1)))
    return tuple(displacements)


def check_labels(
    source: str, names: Mapping[str, object], links: Measurements, kind: str, column: str | None
) -> None:
    """Refuse parameters of transmitters ("tx:") or devices ("rx:") that no link has.

    Raises:
        InputError: One is unknown, or the column of their names is missing.
    """
    stated = {name.removeprefix(kind).rpartition(".")[0]: name for name in names if name.startswith(kind)}
    for label in (EVERY, NEW):
        stated.pop(label, None)
    if not stated:
        return
    known = set(links.table.labels(column or "").tolist())
    for label, name in stated.items():
        if label not in known:
            what = "transmitter" if kind == POSE else "device"
            raise InputError(
                f"{source}: parameters: {name!r}: no link has the {what} {label!r} in column {column!r}; "
                f"{did_you_mean(label, known)}"
            )


def displacement_loss(
    displacements: Sequence[Displacement],
    parameters: Parameters,
    values: NDArray[np.float64],
    share: float,
    links: Measurements,
    here: tuple[Paths, Effects],
    traced: Callable[[Measurements], tuple[Paths, Effects]],
) -> DisplacementLoss:
    """The change of path loss by displacements, from traces at neighbouring positions.

    Args:
        displacements: The displacements.
        parameters: The study's parameters.
        values: Their values at which the paths are traced [d].
        share: Distance of the neighbours, as a share of the largest displacement.
        links: The links at these values.
        here: Their paths, and other effects on them.
        traced: Gives the same at other positions.
    """
    # JAX is slow to import, and every study file that is read imports this module.
    from calibray.engines.replay import Replay
    from calibray.fields import DisplacementLoss

    materials = parameters.materials(values, here[0].materials)

    def path_loss_db(paths: Paths, effects: Effects) -> NDArray[np.float64]:
        replay = Replay(replace(paths, materials=materials), parameters, batch=1, effects=effects)
        return replay.path_loss(values[None])[0]

    stated_db, slopes, curvatures, distances = path_loss_db(*here), [], [], []
    for displacement in displacements:
        distance = (share * displacement.reach)[displacement.group]
        sides = [path_loss_db(*traced(displacement.moved(links, side * distance))) for side in (1.0, -1.0)]
        with np.errstate(invalid="ignore"):  # inf - inf where no path reaches
            slope, curvature = polynomial(np.array(sides) - stated_db, distance)
        slopes.append(slope)
        curvatures.append(curvature)
        distances.append(distance)
    return DisplacementLoss(
        here[0].link,
        tuple(displacement.group for displacement in displacements),
        tuple(displacement.weights[:, parameters.of_effects] for displacement in displacements),
        values[parameters.of_effects],
        np.array(slopes),
        np.array(curvatures),
        np.array(distances),
    )


def polynomial(
    change_db: NDArray[np.float64], distance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coefficients [L], [dB/m] and [dB/m^2], of a polynomial through 0 and the changes of path loss on both sides.

    Args:
        change_db: Path loss of links displaced by +distance and by -distance, minus that of the links [2, L].
        distance: The distance [L], [m]; links with 0 are not displaced.

    Returns:
        Slope and curvature: where no path reaches one side, those of a line; 0 where none reaches any.
    """
    reached = np.isfinite(change_db)
    above, below = np.where(reached, change_db, 0.0)
    above, below = np.where(reached[0], above, -below), np.where(reached[1], below, -above)
    distance = np.where(distance > 0, distance, 1.0)
    return (above - below) / (2 * distance), (above + below) / (2 * distance**2)


DIRECTIONS: Final = np.sqrt(2.0) * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Displacements in units of the error: means over them equal those of a Gaussian error up to cubic terms (Stroud, the
spherical rule of degree three in the plane)."""


def displaced(links: Measurements, error_m: NDArray[np.float64]) -> Measurements:
    """Links to displaced receivers, all those in one direction after the other; errors are standard deviations [L]."""
    rx = np.tile(links.rx, (len(DIRECTIONS), 1))
    rx[:, :2] += (DIRECTIONS[:, None] * error_m[:, None]).reshape(-1, 2)
    tx = np.tile(links.tx, (len(DIRECTIONS), 1))
    return Measurements(tx=tx, rx=rx, path_loss_db=np.full(len(rx), np.nan))


def averaged(paths: Paths, links: Measurements) -> Paths:
    """Paths to displaced receivers as paths of their links, whose power sum is the mean over the displaced receivers.

    Displaced receivers that no path reaches do not count.
    """
    count, directions = len(links), len(DIRECTIONS)
    reached = np.bincount(paths.link, minlength=paths.num_links).reshape(directions, count) > 0
    parts = []
    for direction in range(directions):
        part = take_links(paths, np.arange(count) + direction * count)
        # Amplitudes, so that powers are divided by the number of displaced receivers.
        spreading = part.spreading / np.sqrt(reached.sum(axis=0)[part.link])
        parts.append(replace(part, spreading=spreading, tx_position=links.tx, rx_position=links.rx))
    return concatenate(parts)


def mounted_at_displaced(mountings: Mapping[str, Mounting], count: int) -> dict[str, Mounting]:
    """The antennas of displaced links, from those of the links."""
    link = np.tile(np.arange(count), len(DIRECTIONS))
    return {end: mounting.of_paths(link) for end, mounting in mountings.items()}


def spread_db(path_loss_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of the path loss of displaced links between the displacements of each link [L], [dB].

    It is 0 if a path reaches only one of them.
    """
    loss = path_loss_db.reshape(len(DIRECTIONS), -1)
    reached = np.isfinite(loss)
    number = np.maximum(reached.sum(axis=0), 1)
    mean = np.where(reached, loss, 0.0).sum(axis=0) / number
    return np.sqrt((np.where(reached, loss - mean, 0.0) ** 2).sum(axis=0) / number)
