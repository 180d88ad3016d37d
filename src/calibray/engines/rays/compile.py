"""Conversion of ray tables to path programs, with checks and a correction for every path, and conversion back.

A path's correction is the power that the engine states divided by the power in replay. It accounts for properties that
only the engine models, such as its antennas. At any other constants, the replayed power is multiplied by this
correction.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.spatial import KDTree

from calibray.engines.rays.surfaces import TOLERANCE, Hits, Surfaces, find_edge, match
from calibray.engines.rays.table import RayTable
from calibray.engines.section import OpenedStudy
from calibray.errors import InputError
from calibray.fields import path_gains
from calibray.measurements.reading import join_positions
from calibray.paths import Kind, Paths, take, take_links
from calibray.paths.chains import Chains
from calibray.scenes import Scene
from calibray.support.messages import did_you_mean
from calibray.tracing.antennas import AntennaPattern
from calibray.tracing.protocol import LinkPositions, Links, compile_paths
from calibray.tracing.settings import Antenna

_LOG: Final = logging.getLogger(__name__)

UNKNOWN: Final = Antenna("iso", "VH")
"""Antenna assumed at an end of a link whose antenna is unknown. Its two ports cover every polarization, and the
correction accounts for the gain of the real antenna.
"""

FREE_SPACE_DB: Final = 1.0
"""Maximum deviation [dB] of a direct path's power from free-space power if the antennas are known. The pattern tables
of different engines differ by tenths of a decibel. A wrong transmitted power, or watts instead of decibels, causes
deviations of tens of decibels.
"""

DIRECT_GAIN_DB: Final = 60.0
"""Maximum total gain [dB] of the two antennas of a direct path, for example of two dishes with 30 dBi each."""

ROUNDING: Final = 1e-12
"""Power relative to free space below which a path is assumed to lie in a null of the antennas. The value corresponds to
a few rounding errors of a field computed in single precision, as in Sionna RT.
"""

HIGH_GAIN_DB: Final = 25.0
"""A warning is issued if the median total gain of unknown antennas exceeds this value [dB] in magnitude. The value
corresponds to 18 dBi at one end and 7 dBi at the other.
"""


@dataclass(frozen=True, eq=False)
class RaySetting:
    """The inputs, other than the table itself, for compiling the paths of a ray table.

    Attributes:
        scene: The scene, with the constants that the engine used.
        frequency: Carrier frequency [Hz].
        antennas: Transmit and receive antennas; None if they are unknown.
        links: The links of the program; if None, the links of the table.
    """

    scene: Scene
    frequency: float
    antennas: tuple[Antenna, Antenna] | None = None
    links: Links | None = None

    @classmethod
    def of(cls, study: OpenedStudy) -> RaySetting:
        """The setting of a study at the start values; the antennas are unknown if the study does not state them."""
        return cls(study.scene, study.radio.frequency, study.known_antennas, study.links)


def compile_rays(table: RayTable, setting: RaySetting) -> Paths:
    """Compile the paths of a table. Paths with zero power are omitted, but their links are kept.

    Raises:
        InputError: The table contradicts the scene, the links or itself; or `links` is None and no path has a power
            above 0.
    """
    scene = setting.scene
    absent = np.zeros(len(table.path), dtype=bool) if table.power is None else table.power == 0
    if absent.all() and setting.links is None:
        raise InputError(f"{table.source}: no path has a power above 0; export the rays of at least one link")
    ends, link, chosen = _assign_links(table, setting.links)
    link = np.where(absent, -1, link)
    # Paths that belong to no link or have no power have the link index -1; these paths come first and are left out.
    order = np.argsort(link, kind="stable")[(link < 0).sum() :]
    table, link = table.take(order), link[order]
    _check_repeats(table, link)
    chains, distance = _chains(table, scene)
    antennas = setting.antennas or (UNKNOWN, UNKNOWN)
    paths = compile_paths(
        chains, link, ends, frequency=setting.frequency, materials=scene.materials,
        antennas=(AntennaPattern.of(antennas[0]), AntennaPattern.of(antennas[1])),
    )  # fmt: skip
    settings = {"rays": table.source, "scene": scene.source, "largest_distance_m": distance}
    paths = replace(paths, settings=settings)
    if scene.local_origin.any():
        # Vertices far from the origin are kept in double precision, because single precision would displace them.
        paths = replace(paths, vertex=table.vertex[table.kind != 0])
    if table.power is not None:
        # In a null of the antennas, a path may have zero power in replay while its power in the engine is only a
        # rounding error.
        replayed = _without_nulls(paths)
        kept = np.flatnonzero((replayed > 0) | (table.power > ROUNDING * _free_space(paths)))
        power, replayed, table, paths = table.power[kept], replayed[kept], table.take(kept), take(paths, kept)
        _check_direct(table, paths, power, None if setting.antennas is None else replayed)
        paths = replace(paths, correction=_correction(table, paths, power, replayed))
    elif (table.kind == Kind.DIFFUSE).any():
        raise InputError(
            f"{table.source}: diffuse reflections require the power of the path, because the solid angle of their rays "
            "is unknown; add power_db"
        )
    else:
        unknown = "isotropic antennas of both polarizations"
        _LOG.warning(
            "%s: the table states no power for its paths, so path loss is computed with the materials of the scene and "
            "%s; add power_db to use the engine's powers",
            table.source, unknown if setting.antennas is None else "the stated antennas",
        )  # fmt: skip
    return paths if chosen is None else take_links(paths, chosen)


def rays_of(paths: Paths) -> RayTable:
    """The ray table of a path program, with the power of every path at the constants of the program's materials.

    A link without a path is represented by a direct path with zero power, so that the table contains all links.
    """
    silent = np.asarray(paths.links_without_path, dtype=np.int64)
    link = np.concatenate([paths.link, silent])
    tx, rx = paths.tx_position[link], paths.rx_position[link]
    delay = np.linalg.norm(rx - tx, axis=1) / speed_of_light
    delay[: paths.num_paths] = paths.delay
    power = np.concatenate([powers(paths), np.zeros(len(silent))])
    count, depth = len(link), np.append(np.diff(paths.first), np.zeros(len(silent), dtype=np.int64))
    shape = count, int(depth.max(initial=0))
    present = np.arange(shape[1]) < depth[:, None]
    kind, vertex = np.zeros(shape, dtype=np.int64), np.zeros((*shape, 3))
    material = np.full(shape, "", dtype=object)
    kind[present], vertex[present] = paths.kind, paths.vertex
    material[present] = np.array(list(paths.materials), dtype=object)[paths.material]
    unstated = np.full(shape, "")
    return RayTable(
        "paths", np.arange(count), link, tx, rx, vertex, kind, material.astype(np.str_), unstated, unstated, power,
        delay,
    )  # fmt: skip


def powers(paths: Paths) -> NDArray[np.float64]:
    """Power gain of every path, summed over receive ports and averaged over transmit ports [P]."""
    gain = path_gains(paths).reshape(paths.num_paths, paths.rx_field.shape[1], paths.tx_field.shape[1])
    return (np.abs(gain) ** 2).sum(axis=1).mean(axis=1)


def _without_nulls(paths: Paths) -> NDArray[np.float64]:
    """Power gain of every path in replay [P], with 0 instead of the rounding error in a null of an antenna."""
    gain = [(np.abs(field) ** 2).sum(axis=2).max(axis=1) for field in (paths.tx_field, paths.rx_field)]
    return np.where(np.minimum(*gain) > ROUNDING, powers(paths), 0.0)


def _free_space(paths: Paths) -> NDArray[np.float64]:
    """Power gain of every path between isotropic antennas, without losses at interactions [P]."""
    return (paths.spreading * speed_of_light / paths.frequency / (4 * np.pi)) ** 2


def _chains(table: RayTable, scene: Scene) -> tuple[Chains, float]:
    """The paths with surface normals and materials, and the largest distance [m] of a point from its surface."""
    present = table.kind != 0
    stops = np.concatenate([table.tx[:, None], table.vertex, table.rx[:, None]], axis=1)
    stops[np.arange(len(stops)), present.sum(axis=1) + 1] = table.rx
    ahead = np.diff(stops, axis=1)
    length = np.linalg.norm(ahead, axis=2)
    used = np.hstack([np.ones((len(stops), 1), bool), present])
    segment = length * used  # 0 beyond the receiver
    if (used & (length == 0)).any():
        number = int(np.argmax((used & (length == 0)).any(axis=1)))
        raise InputError(
            f"{table.source}: path {table.path[number]} has the same point twice in succession; remove one of the two"
        )
    row, step = np.nonzero(present)
    direction = ahead / np.where(length > 0, length, 1)[..., None]
    names = list(scene.materials)
    hits = Hits(
        point=table.vertex[present],
        incident=direction[row, step],
        leaving=direction[row, step + 1],
        length=np.minimum(length[row, step], length[row, step + 1]),
        reflects=table.kind[present] == Kind.SPECULAR,
        diffracts=table.kind[present] == Kind.DIFFRACTION,
        material=_stated_materials(table, scene)[present],
        preferred=np.array(
            [names.index(name) if name in names else -1 for name in table.hit_material[present]], int
        ),
        label=np.array(
            [f"{table.source}: path {table.path[p]}, point {s + 1}" for p, s in zip(row, step, strict=True)]
        ),
    )
    _check_straight(hits, table.kind[present] == Kind.REFRACTION)
    surfaces = Surfaces.of(scene)
    face, distance = match(surfaces, hits, names)
    normal = np.zeros((*table.kind.shape, 3))
    normal[present] = surfaces.normal[face]
    edge, normal_n, lengths = (np.zeros((*table.kind.shape, width)) for width in (3, 3, 2))
    for number in np.flatnonzero(hits.diffracts).tolist():
        path, at = row[number], step[number]
        found = find_edge(surfaces, hits, number)
        face[number], normal[path, at] = found.face, found.normal_0
        edge[path, at], normal_n[path, at] = found.direction, found.normal_n
        # The second length ends at the next edge or at the receiver.
        onward = np.append(table.kind[path, at + 1 :] == Kind.DIFFRACTION, True)
        lengths[path, at] = (
            segment[path, : at + 1].sum(),
            segment[path, at + 1 :][: np.argmax(onward) + 1].sum(),
        )
    _check_delays(table, segment)
    material = np.zeros(table.kind.shape, dtype=np.int64)
    material[present] = surfaces.material[face]
    return Chains(
        table.tx, table.rx, table.vertex, normal, table.kind, material, np.ones(table.kind.shape),
        edge=edge, normal_n=normal_n, edge_lengths=lengths,
    ), distance  # fmt: skip


def _stated_materials(table: RayTable, scene: Scene) -> NDArray[np.int64]:
    """Index of every interaction's material, as stated or from the stated object [P, D]; -1 if neither is stated."""
    names = {name: index for index, name in enumerate(scene.materials)}
    by_object = {item.name: names[item.material] for item in scene.objects}
    index = np.full(table.kind.shape, -1)
    for name in np.unique(table.object[table.object != ""]).tolist():
        if name not in by_object:
            raise InputError(f"{table.source}: the scene has no object {name!r}; correct or remove the name")
        index[table.object == name] = by_object[name]
    for name in np.unique(table.material[table.material != ""]).tolist():
        if name not in names:
            raise InputError(
                f"{table.source}: the scene has no material {name!r}; without the column material, each interaction "
                f"has the material of the nearest face; {did_you_mean(name, names)}"
            )
        stated = table.material == name
        if (stated & (index >= 0) & (index != names[name])).any():
            raise InputError(
                f"{table.source}: the table states the material {name!r} for an object that has another material in "
                "the scene"
            )
        index[stated] = names[name]
    return index


def _check_straight(hits: Hits, transmits: NDArray[np.bool_]) -> None:
    # The bend angle times the length of the shorter segment is the distance by which the bend displaces this segment's
    # end.
    bend = np.linalg.norm(hits.leaving - hits.incident, axis=1) * hits.length
    if (transmits & (bend > 4 * TOLERANCE)).any():
        number = int(np.argmax(np.where(transmits, bend, 0)))
        raise InputError(
            f"{hits.label[number]}: the path bends by {bend[number]:.3g} m at a transmission; a transmitted ray is "
            "straight, so correct the type or the vertices"
        )


def _check_delays(table: RayTable, segment: NDArray[np.float64]) -> None:
    """Refuse delays that contradict the lengths [P, D + 1], [m], of the paths' segments."""
    if table.delay is None:
        return
    length = segment.sum(axis=1)
    off = np.abs(table.delay * speed_of_light - length)
    # Both ends of every segment may be displaced by the tolerance.
    if (wrong := off > 2 * TOLERANCE * (segment > 0).sum(axis=1) + 1e-4 * length).any():
        worst = int(np.argmax(np.where(wrong, off / length, 0)))
        raise InputError(
            f"{table.source}: path {table.path[worst]} has the delay {table.delay[worst]:.6g} s, but its length of "
            f"{length[worst]:.6g} m corresponds to {length[worst] / speed_of_light:.6g} s ({wrong.sum()} of {len(off)} "
            "paths); give the total delay in seconds, not relative to the first path"
        )


def _assign_links(
    table: RayTable, links: Links | None
) -> tuple[LinkPositions, NDArray[np.int64], NDArray[np.int64] | None]:
    """Ends of the distinct links, link index of every path, and indices of the program's links (None without `links`).

    Paths between positions that are not in `links` have the index -1.

    Raises:
        InputError: No path belongs to a link, or the paths of a link have different ends.
    """
    own = np.hstack([table.tx, table.rx])
    # Without labels, nearly equal positions count as one position; comparing rounded positions would separate a few of
    # them.
    label = join_positions(own) if table.link is None else _ranks(table.link)
    _, first, link = np.unique(label, return_index=True, return_inverse=True)
    link = link.reshape(-1)
    apart = np.abs(own - own[first][link]).max(axis=1)
    if (apart > TOLERANCE).any():
        raise InputError(
            f"{table.source}: path {table.path[int(np.argmax(apart))]} does not have the same ends as the other paths "
            "of its link; correct its first and last points"
        )
    if links is None:
        return LinkPositions(own[first, :3], own[first, 3:]), link, None
    ends, chosen = np.unique(np.hstack([links.tx, links.rx]), axis=0, return_inverse=True)
    off, link = KDTree(ends).query(own)
    if (lost := off > TOLERANCE).any():
        worst = int(np.argmin(np.where(lost, off, np.inf)))
        fault = (
            f"{table.source}: path {table.path[worst]} does not connect the positions of a link; the nearest link is "
            f"{off[worst]:.3g} m away ({lost.sum()} of {len(lost)} paths in all)"
        )
        if lost.all():
            raise InputError(
                f"{fault}; check the units [m] and the order and signs of x, y and z, or export the rays of the given "
                "links"
            )
        _LOG.warning("%s; such paths are omitted", fault)
    return LinkPositions(ends[:, :3], ends[:, 3:]), np.where(lost, -1, link), chosen.reshape(-1)


def _ranks(label: NDArray) -> NDArray[np.int64]:
    """Ranks of the labels in sorted order [P]; digits in labels are compared as numbers, so `rx2` precedes `rx10`."""
    names = np.unique(label).tolist()
    if label.dtype.kind not in "iu":
        names.sort(key=lambda name: re.sub(r"\d+", lambda digits: digits[0].zfill(20), name))
    rank = {name: number for number, name in enumerate(names)}
    return np.array([rank[name] for name in label.tolist()], dtype=np.int64)


def _check_repeats(table: RayTable, link: NDArray[np.int64]) -> None:
    """Refuse repeated paths of a link, as in merged exports, because their power would be added twice."""
    point = np.round(table.vertex, 3).reshape(len(link), 3 * table.kind.shape[1])
    rows = np.column_stack([link, table.kind, point])
    _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    original = first[group.reshape(-1)]
    if (repeated := original != np.arange(len(link))).any():
        number = int(np.argmax(repeated))
        raise InputError(
            f"{table.source}: paths {table.path[original[number]]} and {table.path[number]} have the same points and "
            f"types (repeated paths: {repeated.sum()} of {len(link)}); keep each path once"
        )


def _check_direct(
    table: RayTable, paths: Paths, power: NDArray[np.float64], replayed: NDArray[np.float64] | None
) -> None:
    """Refuse direct paths whose power is implausible for their antennas; `power` [P] is the power of every path.

    `replayed` is the power of every path in replay; None if the antennas are unknown.

    Raises:
        InputError: A direct path has an implausible power.
    """
    direct = np.diff(paths.first) == 0
    free_space = _free_space(paths)
    known, least = replayed is not None, ROUNDING * free_space
    expected = free_space if replayed is None else replayed
    off = 10 * np.log10(np.maximum(power, least) / np.maximum(expected, least))
    # In a null of an antenna, where the replayed power is 0, no correction can restore the power.
    implausible = (np.abs(off) > FREE_SPACE_DB) | (expected == 0) if known else off > DIRECT_GAIN_DB
    wrong = direct & implausible
    if wrong.any():
        worst = int(np.argmax(np.where(wrong, np.abs(off), 0)))
        side = "above" if off[worst] > 0 else "below"
        what = "with the stated antennas" if known else "between isotropic antennas"
        common = ""
        if np.ptp(off[direct]) < FREE_SPACE_DB and direct.sum() > 1:
            common = (
                "; all direct paths differ by about this amount, which may be the transmitted power or a cable loss; "
                "subtract this amount"
            )
        raise InputError(
            f"{table.source}: path {table.path[worst]}, a direct path, is {abs(off[worst]):.1f} dB {side} free space "
            f"{what}; power_db must be the path gain, received minus transmitted power, with antenna gains{common}"
            + ("; omit the antennas if they are not those of the engine" if known else "")
        )
    if direct.any() and abs(typical := float(np.median(off[direct]))) > HIGH_GAIN_DB:
        side, mistake = "above", "received power, an amplitude in dB or path loss"
        if typical < 0:
            side, mistake = "below", "twice the path gain in dB (20 log10 of the power)"
        _LOG.warning(
            "%s: direct paths are %.0f dB %s free space between isotropic antennas (median): check that power_db is "
            "the path gain, not %s",
            table.source, abs(typical), side, mistake,
        )  # fmt: skip


def _correction(
    table: RayTable, paths: Paths, power: NDArray[np.float64], replayed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Ratio of the stated power to the power in replay, for every path [P].

    Raises:
        InputError: A path has no power in replay.
    """
    if not (replayed > 0).all():
        material = list(paths.materials)[paths.material[paths.first[int(np.argmin(replayed))]]]
        raise InputError(
            f"{table.source}: a path of the table has no power in replay; check the constants of {material!r} (a "
            f"diffuse reflection needs a scattering_coefficient), or omit the antennas"
        )
    return power / replayed
