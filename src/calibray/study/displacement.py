"""Positions as parameters (heights of transmitters, displacements of devices), and errors of receiver positions.

Paths are traced at the stated positions and at displaced positions. For every link and axis, the change in path loss
[dB] between these positions is a monotone cubic function of the displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from calibray.errors import InputError
from calibray.measurements import Ground, Measurements
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths, concatenate, take_links
from calibray.support.messages import did_you_mean
from calibray.tracing.antennas import EVERY, NEW, POSE, Mounting, concerned

if TYPE_CHECKING:
    from calibray.fields import DisplacementLoss, Effects


RECEIVER: Final = "rx:"
"""Prefix of the names of receiver parameters."""

AXES: Final = {"dx": 0, "dy": 1, "height": 2}
"""Index of the coordinate (x, y, z) that each field changes."""

LEAST: Final = 0.01
"""Minimum displacement of the outermost knot [m]; it keeps knots distinct if a parameter is at its bound."""

ACROSS: Final = (0.25, 0.5, 0.75, 1.0)
"""Displacements at which paths are traced on each side before the calibration, as fractions of the largest
displacement. For antenna panels of eight rows, traced at heights 2 m apart, the error of the interpolated path loss has
a median of 0.1 dB and an RMS value of 2 dB. If a parabola is fitted to the path loss at the stated height and at the
bounds 8 m above and below, the RMS error is 5 dB."""


def displaces(name: str) -> bool:
    """Whether a parameter displaces antennas.

    Example:
        >>> displaces("tx:CELL.height"), displaces("rx:*.dx"), displaces("tx:CELL.azimuth")
        (True, True, False)
    """
    return name.startswith((POSE, RECEIVER)) and name.rpartition(".")[2] in AXES


@dataclass(frozen=True, eq=False)
class Displacement:
    """The displacement of links along one axis, as a function of parameters.

    Attributes:
        field: "height" of the transmitters, or "dx" or "dy" of the receivers.
        weights: Matrix [G, parameters]: 1 if a parameter displaces a group of links, otherwise 0.
        group: Group of every link [L].
        reach: Largest displacement [G], [m], that a single parameter can cause in each group. The sum over parameters
            has the same limit.
        ground: The ground above which receivers keep their height; None if heights are not measured from the ground.
    """

    field: str
    weights: NDArray[np.float64]
    group: NDArray[np.int64]
    reach: NDArray[np.float64]
    ground: Ground | None = None

    def moved(self, links: Measurements, displacement: NDArray[np.float64]) -> Measurements:
        """The links with one end displaced by `displacement` [L], [m]."""
        end = "tx" if self.field == "height" else "rx"
        stated = getattr(links, end)
        position = np.array(stated)
        position[:, AXES[self.field]] += displacement
        if end == "rx":
            follow(self.ground, stated, position)
        return replace(links, **{end: position})

    def knots(self, values: NDArray[np.float64], neighbours: Sequence[float]) -> NDArray[np.float64]:
        """Displacements [2n + 1, L], [m], at which the links are traced, in ascending order.

        Args:
            values: Parameter values [d] at which the displacement is 0.
            neighbours: Displacements on each side, as fractions of the largest displacement. Near a bound, these
                displacements are limited to equidistant positions up to the bound.
        """
        shares = np.array(neighbours)
        equidistant = np.arange(1, len(shares) + 1) / max(len(shares), 1)
        # The displacement of a link is a sum of parameters; `room` is the distance from the present sum to a bound.
        present, knots = self.weights @ values, [np.zeros((1, len(self.reach)))]
        for side in (1, -1):
            room = np.maximum(self.reach - side * present, LEAST)
            outwards = np.minimum(shares[:, None] * self.reach, equidistant[:, None] * room)
            outwards = np.maximum(outwards, equidistant[:, None] * LEAST)
            knots = [*knots, side * outwards] if side > 0 else [side * outwards[::-1], *knots]
        return np.concatenate(knots)[:, self.group]


def follow(ground: Ground | None, before: NDArray[np.float64], after: NDArray[np.float64]) -> None:
    """Keep displaced positions [n, 3], [m], at the same height above ground. Without `ground`, z is unchanged."""
    if ground is None:
        return
    with np.errstate(invalid="ignore"):  # inf - inf where there is no ground
        rise = ground(*after[:, :2].T) - ground(*before[:, :2].T)
    after[:, 2] += np.where(np.isfinite(rise), rise, 0.0)


def displacements(
    items: tuple[Parameter, ...],
    links: Measurements,
    columns: Mapping[str, str | None],
    ground: Ground | None = None,
) -> tuple[Displacement, ...]:
    """One `Displacement` for each axis along which parameters displace links.

    Receivers of links without measured values have exact positions and are not displaced. `columns` states the columns
    with the names of the transmitters ("tx:") and of the devices ("rx:").

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
        reach = (weights * largest).max(axis=1)
        displacements.append(Displacement(field, weights, group.reshape(-1), reach, ground))
    return tuple(displacements)


def check_labels(
    source: str, names: Mapping[str, object], links: Measurements, kind: str, column: str | None
) -> None:
    """Check that the transmitters ("tx:") or devices ("rx:") to which parameters refer occur in the links.

    Raises:
        InputError: A transmitter or device is unknown, or the column of names is missing.
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
    placed: tuple[Parameters, NDArray[np.float64]],
    neighbours: Sequence[float],
    links: Measurements,
    here: tuple[Paths, Effects],
    traced: Callable[[Measurements], tuple[Paths, Effects]],
) -> DisplacementLoss:
    """The change in path loss due to displacements, from a single trace of all links at all neighbouring positions.

    Args:
        displacements: The K displacements.
        placed: The parameters of the study, and their values [d] at which the paths are traced.
        neighbours: Distances to the n neighbouring positions on each side, as fractions of the largest displacement, in
            ascending order.
        links: The L links at the positions that these values determine.
        here: The paths of these links, and the effects on these paths other than displacements.
        traced: Function that returns the paths of displaced links and the effects on these paths. The number of
            displaced links can differ from L.
    """
    # JAX is slow to import, and this module is imported whenever a study file is read.
    from calibray.engines.replay import Computation, Replay
    from calibray.fields import DisplacementLoss

    (parameters, values), single = placed, Computation(batch=1)
    materials = parameters.materials(values, here[0].materials)

    def path_loss_db(paths: Paths, effects: Effects) -> NDArray[np.float64]:
        replay = Replay(replace(paths, materials=materials), parameters, effects=effects, computation=single)
        return replay.path_loss(values[None])[0]

    knots = np.array([each.knots(values, neighbours) for each in displacements])  # [K, 2n + 1, L]
    change_db = np.zeros(knots.shape)
    # A link is not traced again at its undisplaced position, where the change in path loss is zero.
    moved = (knots != 0) & np.array([each.reach[each.group] > 0 for each in displacements])[:, None]
    if moved.any():
        axis, _, link = np.nonzero(moved)
        there, offset = at_index(links, link), knots[moved]
        # Each copy of a link is displaced along a single axis.
        for number, each in enumerate(displacements):
            there = each.moved(there, np.where(axis == number, offset, 0.0))
        with np.errstate(invalid="ignore"):  # inf - inf where no path arrives
            change_db[moved] = path_loss_db(*traced(there)) - path_loss_db(*here)[link]
    return DisplacementLoss(
        here[0].link,
        tuple(each.group for each in displacements),
        tuple(each.weights[:, parameters.of_effects] for each in displacements),
        values[parameters.of_effects],
        knots,
        np.array([cubics(*pair) for pair in zip(knots, reached(change_db), strict=True)]),
    )


def at_index(links: Measurements, index: NDArray[np.int64]) -> Measurements:
    """Select links by index; indices can be repeated."""
    table = links.table
    return Measurements(
        tx=links.tx[index],
        rx=links.rx[index],
        path_loss_db=links.path_loss_db[index],
        table=replace(table, frame=table.frame.iloc[index].reset_index(drop=True), row=table.row[index]),
    )


def reached(change_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Changes in path loss [K, 2n + 1, L], [dB]. Where no path arrives, use the change at the next position inwards."""
    change_db, middle = change_db.copy(), change_db.shape[1] // 2
    for step in range(1, middle + 1):
        for side in (1, -1):
            here, inwards = change_db[:, middle + side * step], change_db[:, middle + side * (step - 1)]
            here[:] = np.where(np.isfinite(here), here, inwards)
    return change_db


def cubics(knots: NDArray[np.float64], change_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients [4, N - 1, L] of monotone cubics through changes in path loss [N, L], [dB], at knots [N, L], [m].

    The cubics do not overshoot where paths appear or vanish between two positions (Fritsch and Carlson 1980).
    """
    coefficients = np.empty((4, len(knots) - 1, knots.shape[1]))
    # SciPy requires the same knots for all columns, so links with the same knots are interpolated together.
    distinct, group = np.unique(knots, axis=1, return_inverse=True)
    for number, column in enumerate(distinct.T):
        links = group.reshape(-1) == number
        coefficients[:, :, links] = PchipInterpolator(column, change_db[:, links]).c
    return coefficients


DIRECTIONS: Final = np.sqrt(2.0) * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Displacements in units of the standard deviation of the error. For polynomials up to degree three, the mean over
these displacements equals the mean over a Gaussian error (Stroud's spherical rule in the plane)."""


def displaced(
    links: Measurements, error_m: NDArray[np.float64], ground: Ground | None = None
) -> Measurements:
    """Links to displaced receivers, ordered by direction; `error_m` [L], [m], is the standard deviation of positions.

    With a `ground`, receivers keep their height above the ground.
    """
    stated = np.tile(links.rx, (len(DIRECTIONS), 1))
    rx = stated.copy()
    rx[:, :2] += (DIRECTIONS[:, None] * error_m[:, None]).reshape(-1, 2)
    follow(ground, stated, rx)
    tx = np.tile(links.tx, (len(DIRECTIONS), 1))
    return Measurements(tx=tx, rx=rx, path_loss_db=np.full(len(rx), np.nan))


def averaged(paths: Paths, links: Measurements) -> Paths:
    """Assign the paths of displaced receivers to the original links; a link has the mean power of its receivers.

    Displaced receivers without a path are excluded from the mean.
    """
    count, directions = len(links), len(DIRECTIONS)
    reached = np.bincount(paths.link, minlength=paths.num_links).reshape(directions, count) > 0
    parts = []
    for direction in range(directions):
        part = take_links(paths, np.arange(count) + direction * count)
        # `spreading` is an amplitude, so dividing it by a square root divides powers by the number of receivers.
        spreading = part.spreading / np.sqrt(reached.sum(axis=0)[part.link])
        parts.append(replace(part, spreading=spreading, tx_position=links.tx, rx_position=links.rx))
    return concatenate(parts)


def mounted_at_displaced(mountings: Mapping[str, Mounting], count: int) -> dict[str, Mounting]:
    """The antennas of displaced links, from the antennas of the original links."""
    link = np.tile(np.arange(count), len(DIRECTIONS))
    return {end: mounting.of_paths(link) for end, mounting in mountings.items()}


def spread_db(path_loss_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation [L], [dB], of the path loss of each link over its displaced receivers.

    The result is 0 if only one displaced receiver has a path.
    """
    loss = path_loss_db.reshape(len(DIRECTIONS), -1)
    reached = np.isfinite(loss)
    number = np.maximum(reached.sum(axis=0), 1)
    mean = np.where(reached, loss, 0.0).sum(axis=0) / number
    # The directions represent the whole distribution of the error, not a sample, so the divisor is n, not n - 1.
    return np.sqrt((np.where(reached, loss - mean, 0.0) ** 2).sum(axis=0) / number)
