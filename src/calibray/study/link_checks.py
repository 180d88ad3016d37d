"""Checks links for common mistakes in positions, units and angles before tracing.

Each finding is a suspicion supported by evidence, not a proof. An error is raised only if all receivers or all
transmitters are far from the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import FEW, Measurements
from calibray.measurements.column_names import LENGTH_UNITS, WATTS, find_length_unit, words
from calibray.measurements.observables import KINDS
from calibray.measurements.placement import NOT_ON_TRACK
from calibray.scenes.checks import Finding, SceneSurfaces, scale_findings
from calibray.scenes.obstruction import CLUSTER, cluster_labels
from calibray.study.calibration_sections import NuisanceSection
from calibray.study.model import StudyModel
from calibray.study.mounting import largest_gain_dbi, link_antennas, link_mountings
from calibray.support.messages import shortened
from calibray.tracing.gain_table import read_gain_table
from calibray.tracing.settings import Antenna

BELOW_FREE_SPACE_DB: Final = 6.0
"""Largest plausible amount [dB] by which path loss can be below free-space loss; a ground reflection adds up to 6
dB."""

GUIDED_DB: Final = 12.0
"""Largest such amount [dB] under a roof. In a corridor of 40 m by 2.4 m, four reflections can add 11 dB at 60 GHz."""

FAR: Final = 10.0
"""Distance from the scene, in multiples of the scene size, beyond which links cannot belong to the scene."""

CELL_SHARE: Final = 0.05
"""Maximum width of averaging areas, as a fraction of the shorter side of the scene."""

HIGH: Final = 300.0
"""Height limit [m] above the top of the scene. Greater heights are probably altitudes above sea level that were read as
heights above ground. Drones fly up to 120 m above ground (Regulation (EU) 2019/947), and few masts are higher than 300
m."""

DOMINATED: Final = 0.5
"""If the effective fraction of the positions is lower, a few positions with many rows dominate the fit. In district
383, three of about 47 positions had 60 rows each (an effective fraction of 10 %). Prediction errors were 3.5 dB instead
of 3.0 dB, and 90 % intervals covered 86 % of the links instead of 93 %. With ten rows at every position (an effective
fraction of 100 %), neither the errors nor the coverage changed."""

SPREAD: Final = 5.0
"""Width [m] of the cells in which GPS positions, such as those of a parked car, count as one position. GPS positions of
phones are accurate to 4.9 m under an open sky (GPS.gov, GPS accuracy)."""

LOSSY: Final = 0.5
"""Mean gain [1] below which a gain table with a maximum of exactly 0 dBi probably contains gains relative to the
maximum."""

LINKS_PER_UNKNOWN: Final = 5
"""Minimum number of links per unknown needed to constrain the unknowns of a fit."""

_Turn = Callable[[NDArray[np.float64]], NDArray[np.float64]]
_TURNS: Final[dict[str, _Turn]] = {
    "x and y are swapped": lambda p: p[:, [1, 0, 2]],
    "they are turned by 90 degrees": lambda p: p[:, [1, 0, 2]] * [1, -1, 1],
    "they are turned by -90 degrees": lambda p: p[:, [1, 0, 2]] * [-1, 1, 1],
    "they are turned by 180 degrees": lambda p: p * [-1, -1, 1],
    "x has the wrong sign": lambda p: p * [-1, 1, 1],
    "y has the wrong sign": lambda p: p * [1, -1, 1],
}


def suspicions(study: StudyModel, links: Measurements) -> tuple[Finding, ...]:
    """The findings of `examine`, or a warning that shapely is missing.

    The result is empty if only an external program can read the scene.

    Raises:
        InputError: All receivers or all transmitters are far from the scene, or the scene cannot be read. If the engine
            is an external program, no error is raised.
    """
    if find_spec("shapely") is None:
        problem = "positions were not checked against the scene: shapely is not installed"
        return (Finding("warning", links.source, problem, "run pip install 'calibray[scenes]'"),)
    try:
        return examine(study, links)
    except InputError:
        # An external program may be able to read scene files that Calibray cannot read.
        if study.engine.external:
            return ()
        raise


def examine(study: StudyModel, links: Measurements) -> tuple[Finding, ...]:
    """Check links for common mistakes, and return the findings with their remedies.

    Raises:
        InputError: All receivers or all transmitters are far from the scene, the scene cannot be read, or shapely is
            not installed.
    """
    overhead = SceneSurfaces.read(study.scene_source)
    scale = scale_findings(overhead.bounds[:3], overhead.bounds[3:])
    checks = (
        *((finding.problem, finding.remedy) for finding in scale if finding.severity == "error"),
        *_positions(study, overhead, links),
        *_far_transmitters(study, links, overhead.bounds),
        *_units(study),
        *_levels(study, links, overhead),
        *_delays(study, links, overhead),
        *_angles(study, links),
        *_antennas(study, links),
        *_averages(study, overhead),
        *_dominant_positions(links, study.links.position == "geographic"),
        *_clock(links),
    )
    return tuple(Finding("warning", links.source, problem, remedy) for problem, remedy in checks)


def count_unknowns(study: StudyModel, links: Measurements) -> tuple[Finding, ...]:
    """Return a finding with a remedy if there are fewer than `LINKS_PER_UNKNOWN` links per unknown."""
    grouped = len(links.group_names) if links.group is not None else 1
    offsets = 0 if study.offset is None else grouped
    coefficients = sum(_count_coefficients(study, section, links) for section in study.nuisance.values())
    unknowns = len(study.parameters) + offsets + coefficients
    if len(links) >= LINKS_PER_UNKNOWN * unknowns:
        return ()
    counted = f"{len(study.parameters)} parameters, {offsets} offsets" + (
        f", {coefficients} coefficients of [nuisance]" if coefficients else ""
    )
    problem = (
        f"{len(links)} links for {unknowns} unknowns ({counted}), fewer than {LINKS_PER_UNKNOWN} per unknown"
    )
    remedy = "calibrate fewer parameters or measure at more positions"
    if study.links.average is not None and study.links.average.by != "place":
        remedy = f"average over smaller areas (links.average.size), {remedy}"
    return (Finding("warning", links.source, problem, remedy),)


def _count_coefficients(study: StudyModel, section: NuisanceSection, links: Measurements) -> int:
    """Number of coefficients of a nuisance term: one per group.

    A random effect counts as one coefficient, because only its mean is free.
    """
    if section.per is None or section.prior == "auto":
        return 1
    if section.per == CLUSTER and CLUSTER not in links.frame and study.cluster_m is not None:
        return len(np.unique(cluster_labels(links.rx, study.cluster_m)))
    return len(np.unique(links.table.labels(section.per)))


def _averages(study: StudyModel, overhead: SceneSurfaces) -> Iterator[tuple[str, str]]:
    average = study.links.average
    if average is None or average.size is None or average.by == "time":
        return
    largest = CELL_SHARE * float(np.min(overhead.bounds[3:5] - overhead.bounds[:2]))
    if average.size > 2 * largest:
        yield (
            f"averages span {average.size:g} m, {100 * average.size / largest * CELL_SHARE:.0f} % of the scene's "
            "shorter side",
            f"set links.average.size to {largest:.2g} m or less",
        )


def _clock(links: Measurements) -> Iterator[tuple[str, str]]:
    for change, number in links.prepared.items():
        if change.startswith(NOT_ON_TRACK) and change != NOT_ON_TRACK:
            yield (
                f"{number:,} {change}: the positions of the remaining rows may also be wrong",
                "check the time zone of the table",
            )


def _dominant_positions(links: Measurements, is_geographic: bool) -> Iterator[tuple[str, str]]:
    """Check whether rows at a few positions, such as those of a parked car, outweigh all other rows (Kish, 1965)."""
    cell = SPREAD if is_geographic else 0.01
    ends = np.round(np.hstack([links.tx, links.rx]) / cell)
    count = np.unique(ends, axis=0, return_counts=True)[1]
    # `effective` is the number of positions if all have equally many rows; it is nearly 1 if one position has nearly
    # all rows.
    effective = len(links) ** 2 / float(np.sum(count.astype(float) ** 2))
    if effective < DOMINATED * len(count):
        within = f" within {cell:g} m" if is_geographic else ""
        average = f"{{ by = 'cell', size = {cell:g} }}" if is_geographic else "'place'"
        yield (
            f"{count.max():,} of {len(links):,} links have the same position{within}; they dominate fits, accuracy and "
            f"prediction intervals: {len(count):,} positions are equivalent to about {effective:.0f} positions",
            f"average the rows at each position: links.average = {average}",
        )


def _transmitters(
    study: StudyModel, links: Measurements
) -> tuple[NDArray[np.float64], Callable[[NDArray[np.bool_]], str]]:
    """Positions [n, 3], [m], of the transmitters, and a function that counts and names the transmitters in a mask [n].

    Transmitters with different names, such as the sectors of a mast, count separately even at the same position.
    """
    column, frame = study.links.transmitter, pd.DataFrame(links.tx)
    named = column in links.frame
    frame = frame.assign(name=links.frame[column].astype(str).to_numpy() if named else "").drop_duplicates()
    names, table = frame.pop("name").to_numpy(), study.transmitters_path

    def counted(mask: NDArray[np.bool_]) -> str:
        source = "" if table is None else f" of {table}"
        listed = f" ({shortened(', '.join(dict.fromkeys(names[mask])))}{source})" if named else ""
        return f"{int(mask.sum())} of {len(mask)} transmitters{listed}"

    return frame.to_numpy(), counted


def _positions(study: StudyModel, overhead: SceneSurfaces, links: Measurements) -> Iterator[tuple[str, str]]:
    rx, (tx, counted_tx) = np.unique(links.rx, axis=0), _transmitters(study, links)
    refuse_far_receivers(overhead.bounds, rx, links.source, study.links.position == "geographic")

    def counted_rx(mask: NDArray[np.bool_]) -> str:
        return f"{int(mask.sum())} of {len(mask)} receivers"

    for counted, points in ((counted_rx, rx), (counted_tx, tx)):
        below = overhead.underground(points) | (points[:, 2] < overhead.bounds[2])
        if below.any():
            yield f"{counted(below)} are below the ground", "check heights and their datum"
        high = points[:, 2] > overhead.bounds[5] + HIGH
        if high.any():
            yield (
                f"{counted(high)} are more than {HIGH:g} m above the whole scene",
                "check heights and their datum: with links.heights = 'ground', heights are above the ground",
            )
        touching = overhead.touching(points)
        if touching.any():
            yield (
                f"{counted(touching)} touch the ground, a floor or a roof, so reflections from this surface are "
                "missed",
                "give the height of the antenna, at least 1 cm above the surface",
            )
    through_walls = study.trace.refraction
    roofed = overhead.under_roof(rx)
    if roofed.mean() > 0.8 and (through_walls or overhead.under_roof(tx).any()):
        return  # an indoor scene, or indoor receivers with outdoor transmitters
    wrong = _misplaced(overhead, rx)
    turn = _better_turn(overhead, rx, wrong)
    if turn is not None:
        name, fewer = turn
        yield (
            f"{wrong} of {len(rx)} receivers are inside buildings or outside the scene; {fewer or 'none'} of {len(rx)} "
            f"if {name}",
            "check the order and the directions of the axes: x to the east, y to the north",
        )
        return
    beyond = overhead.outside(rx)
    if beyond.mean() > 0.25:
        shift = rx[:, :2].mean(axis=0) - (overhead.bounds[:2] + overhead.bounds[3:5]) / 2
        yield (
            f"{int(beyond.sum())} of {len(rx)} receivers are outside the scene; their centre is {shift[0]:.0f} m east "
            f"and {shift[1]:.0f} m north of the scene's centre",
            "check the origin of the positions",
        )
    elif beyond.any():
        rows = links.row[overhead.outside(links.rx)]
        yield (
            f"{int(beyond.sum())} of {len(rx)} receivers are outside the scene, where there is no ground and no "
            f"building (links there: {len(rows):,}, the first in row {rows[0]})",
            "use links.where to leave out wrong positions, or create a larger scene",
        )
    if through_walls:
        return  # antennas may be indoors
    inside = roofed & ~overhead.underground(rx)
    if inside.any():
        problem = f"{counted_rx(inside)} are inside buildings"
        yield problem, "correct or remove these receivers or set links.inside = 'move'"
    inside = overhead.under_roof(tx) & ~overhead.underground(tx)
    if inside.any():
        problem = f"{counted_tx(inside)} are inside buildings"
        yield problem, "check the position and the height: an antenna on a roof must be above the roof"


def _far_transmitters(
    study: StudyModel, links: Measurements, bounds: NDArray[np.float64]
) -> Iterator[tuple[str, str]]:
    """Report the transmitters that are far from the scene.

    Raises:
        InputError: All transmitters are far from the scene.
    """
    furthest, far = _far(bounds, links.tx)
    if not far.any():
        return
    first = int(np.argmax(far))
    name = study.links.transmitter
    names = sorted(set(links.frame[name][far].astype(str))) if name in links.frame else ["the transmitter"]
    problem = (
        f"{shortened(', '.join(names))} {'is' if len(names) == 1 else 'are'} more than {furthest:.0f} m from the "
        f"scene, near ({links.tx[first, 0]:.0f}, {links.tx[first, 1]:.0f}) m"
    )
    remedy = "check the position" + (
        " and the order of longitude and latitude" if study.links.position == "geographic" else ""
    )
    if far.all():
        raise InputError(f"{study.transmitters_path or links.source}: {problem}; {remedy}")
    yield problem, remedy


def _far(bounds: NDArray[np.float64], positions: NDArray[np.float64]) -> tuple[float, NDArray[np.bool_]]:
    """The distance [m] beyond which positions are far from the scene, and the mask [n] of far positions."""
    low, high = bounds[:2], bounds[3:5]
    # The limit is at least one kilometre, because the scene may be a room.
    furthest = FAR * max(float(np.max(high - low)), 100.0)
    outside = (positions[:, :2] < low - furthest) | (positions[:, :2] > high + furthest)
    return furthest, np.asarray(outside.any(axis=1))


def refuse_far_receivers(
    bounds: NDArray[np.float64], rx: NDArray[np.float64], source: str, is_geographic: bool
) -> None:
    """Raise an error if all receivers are farther from the scene than `FAR` times its size.

    Args:
        bounds: Bounds [6], [m], of the scene: west, south, bottom, east, north and top.
        rx: Positions of the receivers [n, 3], [m].
        source: The table that contains the receivers.
        is_geographic: Whether the positions in the table are in degrees.

    Raises:
        InputError: All receivers are too far from the scene.
    """
    furthest, far = _far(bounds, rx)
    if far.all():
        centre = rx.mean(axis=0)
        raise InputError(
            f"{source}: all receivers are more than {furthest:.0f} m from the scene, near ({centre[0]:.0f}, "
            f"{centre[1]:.0f}) m; "
            + (
                "check links.crs, the order of longitude and latitude, and the location of the scene"
                if is_geographic
                else "give positions relative to the scene's origin, or state the map projection as links.crs"
            )
        )


def _misplaced(overhead: SceneSurfaces, rx: NDArray[np.float64]) -> int:
    """Number of receivers outside the scene or below a roof."""
    return int((overhead.outside(rx) | overhead.under_roof(rx)).sum())


def _better_turn(overhead: SceneSurfaces, rx: NDArray[np.float64], wrong: int) -> tuple[str, int] | None:
    """Axis changes that misplace the fewest receivers, and this number; None if it exceeds a quarter of `wrong`."""
    if len(rx) < FEW or wrong < 0.15 * len(rx):
        return None
    misplaced = {name: _misplaced(overhead, turn(rx)) for name, turn in _TURNS.items()}
    fewest = min(misplaced.values())
    names = " or ".join(name for name, count in misplaced.items() if count == fewest)
    return (names, fewest) if fewest <= wrong / 4 else None


def _units(study: StudyModel) -> Iterator[tuple[str, str]]:
    """Check whether column names state units that differ from those of the study."""
    links = study.links
    unit = 1.0 if links.position == "geographic" else links.position_unit
    for name in dict.fromkeys(name for name in (*links.tx, *links.rx) if isinstance(name, str)):
        if words(name) & {*LENGTH_UNITS, "m"} and (stated := find_length_unit([name])) != unit:
            yield (
                f"the name of column {name!r} implies a unit of {stated:g} m, but the column is read in units of "
                f"{unit:g} m",
                # `links.position_unit` does not apply to degrees.
                "convert it"
                if links.position == "geographic"
                else "convert the column, or set links.position_unit if all positions have this unit",
            )
    for key in ("tx_power_dbm", "eirp_dbm"):
        name = getattr(links, key)
        if isinstance(name, str) and words(name) & WATTS:
            yield f"the name of column {name!r} of links.{key} implies watts or dBW", "convert it to dBm"


def _levels(study: StudyModel, links: Measurements, overhead: SceneSurfaces) -> Iterator[tuple[str, str]]:
    name, quantity = study.links.value, study.links.quantity
    column_words = words(name)
    if quantity in ("path_loss", "path_gain") and column_words & {"dbm", "rsrp", "rssi", "rss"}:
        yield (
            f"column {name!r} has the name of a received power [dBm], but quantity = {quantity!r} [dB]",
            "set quantity = 'received_power' with tx_power_dbm, or 'rsrp' with [offset]",
        )
    if quantity in ("received_power", "rsrp") and column_words & {
        "loss", "pl", "pathloss", "gain", "pathgain",
    }:  # fmt: skip
        yield (
            f"column {name!r} has the name of a loss or gain [dB], but quantity = {quantity!r} [dBm]",
            "set quantity = 'path_loss' or 'path_gain'",
        )
    if quantity == "rsrp" or not links.measured:
        return
    frequency = study.scene.frequency if links.frequency is None else links.frequency
    free_space = 20 * np.log10(4 * np.pi * links.distance * frequency / speed_of_light)
    gain = sum(
        max(largest_gain_dbi(antenna) for antenna in link_antennas(study, end, links.table)[0])
        for end in ("tx", "rx")
    )
    # The smallest possible loss in free space is that between the main directions of the highest-gain antennas.
    excess = free_space - gain - links.path_loss_db
    roofed = overhead.under_roof(links.tx) & overhead.under_roof(links.rx)
    below = excess > np.where(roofed, GUIDED_DB, BELOW_FREE_SPACE_DB)
    if below.mean() > 0.1:
        median = float(np.median(excess[below]))
        yield (
            f"{int(below.sum())} of {len(links)} path losses are below free-space loss, with a median difference of "
            f"{median:.0f} dB",
            "check tx_power_dbm (30 dB indicates watts instead of milliwatts), gains included in the values, "
            "scene.frequency and the sign",
        )


def _delays(study: StudyModel, links: Measurements, overhead: SceneSurfaces) -> Iterator[tuple[str, str]]:
    """Check whether most measured delays belong to paths that are much longer than the scene."""
    longest = FAR * max(float(np.max(overhead.bounds[3:5] - overhead.bounds[:2])), 100.0)
    for name, section in study.observables.items():
        # Devices add unknown delays to times of flight; a bias accounts for these delays.
        if KINDS[section.kind] != "s" or section.column is None or section.bias is not None:
            continue
        measured = links.table.numbers(section.column, gaps=True) * section.scale
        length = float(np.nanmedian(measured)) * speed_of_light if np.isfinite(measured).any() else 0.0
        if length > longest:
            yield (
                f"the median of column {section.column!r} [{section.unit}] corresponds to a path length of "
                f"{length:.0f} m, more than {FAR:g} times the size of the scene",
                f"check observables.{name}.unit",
            )


def _angles(study: StudyModel, links: Measurements) -> Iterator[tuple[str, str]]:
    ends = (links.tx, links.rx), (links.rx, links.tx)
    for name, antenna, (own, other) in zip(("tx", "rx"), study.antenna_pair, ends, strict=True):
        yaw = antenna.orientation[0]
        if any(abs(angle) > 2 * np.pi + 1e-6 for angle in antenna.orientation):
            problem = f"antennas.{name}.orientation = {list(antenna.orientation)} is more than a full turn"
            yield problem, "give radians, not degrees"
        gain = _horizontal_gain(antenna)
        if gain is None or len(links) < FEW or not links.measured:
            continue
        # A compass bearing is measured clockwise from north; yaw is measured counter-clockwise from east.
        compass = np.pi / 2 - yaw
        spread, spread_compass = (_spread(links, gain, own, other, angle) for angle in (yaw, compass))
        if spread_compass < 0.7 * spread:
            yield (
                f"the values fit antennas.{name} better with a yaw of {compass:.2f} rad: the standard deviation "
                f"around a log-distance line is {spread_compass:.1f} dB instead of {spread:.1f} dB",
                "yaw is measured from x (east) towards y (north); a compass bearing b is a yaw of pi/2 - b",
            )


def _antennas(study: StudyModel, links: Measurements) -> Iterator[tuple[str, str]]:
    antennas = [*study.stated_antennas.values(), *study.antenna_types.values()]
    for file in dict.fromkeys(antenna.gain_file for antenna in antennas if antenna.gain_file is not None):
        table = read_gain_table(file)
        # A lossless antenna has a mean gain of 1, so its maximum gain exceeds 0 dBi.
        if table.gain_dbi.max() == 0 and table.efficiency < LOSSY:
            yield (
                f"the maximum gain in {file} is 0 dBi and the mean gain is {100 * table.efficiency:.0f} %, which "
                "suggests gains relative to the main direction",
                "give absolute gains [dBi]",
            )
    if study.links.tx_antenna is not None and study.links.tx_antenna.aim is None:
        pose = link_mountings(study, links)["tx"].pose
        tilt = np.degrees(pose.downtilt + pose.electrical_downtilt)
        if tilt.max() < 0:
            yield (
                f"all downtilts of links.tx_antenna are negative, {tilt.min():g} to {tilt.max():g} degrees: the "
                "antennas point upwards",
                "give angles below the horizon as positive numbers",
            )


def _horizontal_gain(antenna: Antenna) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """Gain [dB] in the horizontal plane, by azimuth relative to the main direction; None if the gain is constant."""
    if antenna.pattern == "tr38901":
        # 3GPP TR 38.901, Table 7.3-1.
        return lambda azimuth: -np.minimum(12 * (np.degrees(azimuth) / 65) ** 2, 30.0)
    if antenna.gain_file is None:
        return None
    table = read_gain_table(antenna.gain_file)
    return lambda azimuth: table.gain(np.degrees(azimuth), np.zeros(len(azimuth)))


def _spread(
    links: Measurements,
    gain: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    own: NDArray[np.float64],
    other: NDArray[np.float64],
    yaw: float,
) -> float:
    """Standard deviation [dB] of path loss around a log-distance line, after removal of the antenna gain."""
    away = other - own
    azimuth = (np.arctan2(away[:, 1], away[:, 0]) - yaw + np.pi) % (2 * np.pi) - np.pi
    # Measured path loss includes the antenna gain; adding this gain removes the dependence on azimuth.
    level = links.path_loss_db + gain(azimuth)
    design = np.column_stack([np.ones(len(links)), np.log10(links.distance)])
    residual = level - design @ np.linalg.lstsq(design, level)[0]
    return float(residual.std())
