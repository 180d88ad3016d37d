"""Sanity: the classic mistakes of positions, units and angles, found before an hour is traced.

Each is a suspicion with what speaks for it, no proof; only links that all lie far from the scene are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import Measurements
from calibray.measurements.column_names import words
from calibray.scenes.checks import Finding, SceneSurfaces
from calibray.tracing.gain_table import read_gain_table

if TYPE_CHECKING:
    from calibray.study.study import Study
    from calibray.tracing.settings import Antenna

MOST_GAIN_DB: Final = {"iso": 0.0, "dipole": 1.8, "hw_dipole": 2.2, "tr38901": 8.0}
BELOW_FREE_SPACE_DB: Final = 6.0
"""How far below free space a link counts [dB]: a ground reflection alone adds up to 6 dB."""

_FAR: Final = 10.0  # times the scene's size: links as far as that have nothing to do with it
_FEW: Final = 8  # links fewer than which nothing is concluded from shares
_Turn = Callable[[NDArray[np.float64]], NDArray[np.float64]]
_TURNS: Final[dict[str, _Turn]] = {
    "x and y are swapped": lambda p: p[:, [1, 0, 2]],
    "they are turned by 90 degrees": lambda p: p[:, [1, 0, 2]] * [1, -1, 1],
    "they are turned by -90 degrees": lambda p: p[:, [1, 0, 2]] * [-1, 1, 1],
    "they are turned by 180 degrees": lambda p: p * [-1, -1, 1],
    "x has the wrong sign": lambda p: p * [-1, 1, 1],
    "y has the wrong sign": lambda p: p * [1, -1, 1],
}


def examine(study: Study, links: Measurements) -> tuple[Finding, ...]:
    """Look for the classic mistakes.

    Args:
        study: The study.
        links: Its links.

    Returns:
        What is suspicious, and what to do about it.

    Raises:
        InputError: All links lie far from the scene, the scene cannot be read, or shapely or trimesh is not installed.
    """
    overhead = SceneSurfaces.read(study.scene_source)
    return (*_places(overhead, links), *_levels(study, links), *_angles(study, links))


def _places(overhead: SceneSurfaces, links: Measurements) -> Iterator[Finding]:
    tx, rx = np.unique(links.tx, axis=0), np.unique(links.rx, axis=0)
    _refuse_elsewhere(overhead, rx, links.source)
    if (under := overhead.underground(rx) | (rx[:, 2] < overhead.bounds[2])).any():
        yield _finding(
            links,
            f"{int(under.sum())} of {len(rx)} receivers lie under the ground",
            "check heights and their datum",
        )
    if (under := overhead.underground(tx) | (tx[:, 2] < overhead.bounds[2])).any():
        yield _finding(
            links,
            f"{int(under.sum())} of {len(tx)} transmitters lie under the ground",
            "check heights and their datum",
        )
    roofed = overhead.under_roof(rx)
    if roofed.mean() > 0.8 and overhead.under_roof(tx).any():
        return  # indoors
    wrong = _misplaced(overhead, rx)
    turned = _turned(overhead, rx, wrong)
    if turned is not None:
        name, fewer = turned
        yield _finding(
            links,
            f"{_count(wrong, len(rx))} receivers lie inside buildings or beyond the scene; {_count(fewer, len(rx))} if "
            f"{name}",
            "check the order and the directions of the axes: x to the east, y to the north",
        )
        return
    if (beyond := overhead.outside(rx)).mean() > 0.25:
        off = rx[:, :2].mean(axis=0) - (overhead.bounds[:2] + overhead.bounds[3:5]) / 2
        yield _finding(
            links,
            f"{int(beyond.sum())} of {len(rx)} receivers lie beyond the scene; their middle is {off[0]:.0f} m east and "
            f"{off[1]:.0f} m north of the scene's",
            "check the origin that positions are relative to",
        )
    inside = roofed & ~overhead.underground(rx)
    if inside.any():
        yield _finding(
            links,
            f"{int(inside.sum())} of {len(rx)} receivers stand inside buildings",
            "correct them, leave them out, or say links.inside = 'move'",
        )
    if (inside := overhead.under_roof(tx) & ~overhead.underground(tx)).any():
        yield _finding(
            links,
            f"{int(inside.sum())} of {len(tx)} transmitters stand inside buildings",
            "check position and height: an antenna on a roof stands above it",
        )


def _refuse_elsewhere(overhead: SceneSurfaces, rx: NDArray[np.float64], source: str) -> None:
    size = max(float(np.max(overhead.bounds[3:5] - overhead.bounds[:2])), 100.0)
    if overhead.outside(rx, _FAR * size).all():
        middle = rx.mean(axis=0)
        raise InputError(
            f"{source}: all receivers lie more than {_FAR * size:.0f} m from the scene, about ({middle[0]:.0f}, "
            f"{middle[1]:.0f}); give positions relative to the scene's origin"
        )


def _misplaced(overhead: SceneSurfaces, rx: NDArray[np.float64]) -> int:
    return int((overhead.outside(rx) | overhead.under_roof(rx)).sum())


def _turned(overhead: SceneSurfaces, rx: NDArray[np.float64], wrong: int) -> tuple[str, int] | None:
    """The turn of the axes that puts receivers outside of buildings and into the scene, if they are not so."""
    if len(rx) < _FEW or wrong < 0.15 * len(rx):
        return None
    found = {name: _misplaced(overhead, turn(rx)) for name, turn in _TURNS.items()}
    least = min(found.values())
    names = " or ".join(name for name, count in found.items() if count == least)
    return (names, least) if least <= wrong / 4 else None


def _count(number: int, of: int) -> str:
    return f"{number or 'none'} of {of}"


def _levels(study: Study, links: Measurements) -> Iterator[Finding]:
    told, quantity = words(study.links.value), study.links.quantity
    if quantity in ("path_loss", "path_gain") and told & {"dbm", "rsrp", "rssi", "rss"}:
        yield _finding(
            links,
            f"column {study.links.value!r} is called like a received power [dBm], and taken for a {quantity} [dB]",
            "say quantity = 'received_power' with tx_power_dbm, or 'rsrp' with [offset]",
        )
    if quantity in ("received_power", "rsrp") and told & {"loss", "pl", "pathloss", "gain", "pathgain"}:
        yield _finding(
            links,
            f"column {study.links.value!r} is called like a loss or gain [dB], and taken for a received power [dBm]",
            "say quantity = 'path_loss' or 'path_gain'",
        )
    if quantity == "rsrp" or not links.measured:
        return
    frequency = study.scene.frequency if links.frequency is None else links.frequency
    free_space = 20 * np.log10(4 * np.pi * links.distance * frequency / speed_of_light)
    gain = sum(MOST_GAIN_DB.get(antenna.pattern, 20.0) for antenna in study.antenna_pair)
    short = free_space - gain - links.path_loss_db
    if (below := short > BELOW_FREE_SPACE_DB).mean() > 0.1:
        middle = float(np.median(short[below]))
        yield _finding(
            links,
            f"{int(below.sum())} of {len(links)} path losses lie below free space, by {middle:.0f} dB in the middle",
            "check tx_power_dbm (30 dB: watts for milliwatts), gains that are in the values, scene.frequency, the sign",
        )


def _angles(study: Study, links: Measurements) -> Iterator[Finding]:
    for end, antenna, own, other in zip(
        ("tx", "rx"), study.antenna_pair, (links.tx, links.rx), (links.rx, links.tx), strict=True
    ):
        yaw = antenna.orientation[0]
        if any(abs(angle) > 2 * np.pi + 1e-6 for angle in antenna.orientation):
            yield _finding(
                links,
                f"antennas.{end}.orientation = {list(antenna.orientation)} is more than a whole turn",
                "give radians, not degrees",
            )
        gain = _pattern(antenna)
        if gain is None or len(links) < _FEW or not links.measured:
            continue
        compass = np.pi / 2 - yaw
        as_given, as_compass = (_spread(links, gain, own, other, each) for each in (yaw, compass))
        if as_compass < 0.7 * as_given:
            yield _finding(
                links,
                f"the values fit antennas.{end} better turned to {compass:.2f} rad: {as_compass:.1f} dB about a line "
                f"over distance, {as_given:.1f} dB as it is",
                "yaw counts from x (east) towards y (north); a compass bearing b is pi/2 - b",
            )


def _pattern(antenna: Antenna) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """Gain over azimuth from where the antenna looks, at the horizon [dB]; None where it is the same all around."""
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
    """Spread of the losses about a line over the logarithm of distance, the antenna's gain taken out [dB]."""
    away = other - own
    azimuth = (np.arctan2(away[:, 1], away[:, 0]) - yaw + np.pi) % (2 * np.pi) - np.pi
    level = links.path_loss_db + gain(azimuth)
    design = np.column_stack([np.ones(len(links)), np.log10(links.distance)])
    residual = level - design @ np.linalg.lstsq(design, level)[0]
    return float(residual.std())


def _finding(links: Measurements, problem: str, remedy: str) -> Finding:
    return Finding("warning", links.source, problem, remedy)
