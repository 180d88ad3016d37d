"""Rooms: scenes made of floor plans, one upright sheet for every wall, door and window."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.materials import ITU_MATERIALS
from calibray.scenes.authoring.building_parts import outside
from calibray.scenes.authoring.extrusion import MILLIMETRE, Point, Stand, flat_triangles, upright
from calibray.scenes.authoring.floor_plan_file import OPENINGS, Segment, merge_faces
from calibray.scenes.authoring.scene_folder import Made, SurfaceMaterial, finish
from calibray.scenes.authoring.wall_alignment import align
from calibray.scenes.meshes import MeshObject, welded
from calibray.support.extras import library
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_folder

TYPES: Final = {
    "wall": SurfaceMaterial("wall", "plasterboard", 0.12),
    "door": SurfaceMaterial("door", "wood", 0.04),
    "window": SurfaceMaterial("window", "glass", 0.01),
    "floor": SurfaceMaterial("floor", "concrete", 0.2),
    "ceiling": SurfaceMaterial("ceiling", "concrete", 0.2),
}
"""Types that are no materials of ITU-R P.2040's by themselves."""

WALL_THICKNESS: Final = 0.12  # [m], of a wall of a P.2040 material whose thickness nothing tells
ROUNDING: Final = 2.0
"""Distance from its line at which a corner may lie by rounding [mm]: where walls of a plan cross, they are cut."""
_REACH: Final = 0.03  # [m], how far beyond the middle of a wall another's end may miss it


def make_plan_scene(
    segments: Sequence[Segment],
    folder: str | Path,
    types: Mapping[str, SurfaceMaterial] | None = None,
    floor: bool = True,
    ceiling: bool = True,
    merge: bool = True,
    frame: Frame | None = None,
) -> Made:
    """Make a scene of a floor plan.

    Walls that cross or meet share their corners, and ends that stop at another wall's face are led to its middle. A
    door or window takes the place of the wall that it is drawn on, at the heights that it has; the wall goes on
    above and below.

    Args:
        segments: Lines of the plan.
        folder: Where to write `scene.xml`, `scene.json` and the meshes.
        types: Materials by type, beside or in place of `TYPES`; a type that is a material of ITU-R P.2040's, such as
            `brick`, becomes the material `brick_wall`. Several thicknesses of one type become several materials.
        floor: Whether to make one: a sheet over all that walls enclose, at the lowest bottom.
        ceiling: Whether to make one, at the highest top.
        merge: Whether two parallel lines are made one wall (`merge_faces`).
        frame: Where the scene lies on the globe, if that is known.

    Returns:
        What was made.

    Raises:
        InputError: A type has no material, there is no segment, or the folder cannot be written.
    """
    folder = check_folder(folder)
    if not segments:
        raise InputError("the floor plan holds no segment; give at least one wall")
    sheets, merged = merge_faces(segments) if merge else (list(segments), 0)
    materials = _materials(sheets, {**TYPES, **(types or {})})
    pieces = _pieces(_joined(sheets), [material.name for material in materials])
    objects = _walls(pieces)
    outline = _enclosed(pieces)
    lids = [
        (wanted, kind, height)
        for wanted, kind, height in (
            (floor, "floor", min(sheet.bottom for sheet in sheets)),
            (ceiling, "ceiling", max(sheet.top for sheet in sheets)),
        )
        if wanted
    ]
    for _, kind, height in lids:
        material = {**TYPES, **(types or {})}[kind]
        materials.append(material)
        objects.append(
            MeshObject(f"all-{material.name}", material.name, welded(_lid(outline, height), MILLIMETRE))
        )
    counts = {
        "lines": len(segments),
        "sheets": len(sheets),
        **({"lines merged as faces of one wall": merged} if merged else {}),
    }
    return finish(folder, objects, materials, frame, counts, {})


def _materials(sheets: Sequence[Segment], types: Mapping[str, SurfaceMaterial]) -> list[SurfaceMaterial]:
    """The material of every sheet; a type with several thicknesses has as many."""
    known = {name for table in ITU_MATERIALS.values() for name in table}
    found = []
    for sheet in sheets:
        if sheet.kind in types:
            base = types[sheet.kind]
        elif sheet.kind in known:
            base = SurfaceMaterial(f"{sheet.kind}_wall", sheet.kind, WALL_THICKNESS)
        else:
            names = sorted({*types, *known})
            raise InputError(
                f"type {sheet.kind!r}: has no material, {did_you_mean(sheet.kind, names)} Or name its own"
            )
        found.append(base if sheet.thickness is None else replace(base, thickness=sheet.thickness))
    thicknesses: dict[str, set[float]] = defaultdict(set)
    for material in found:
        thicknesses[material.name].add(material.thickness)
    return [
        replace(material, name=f"{material.name}_{round(material.thickness * 1000)}mm")
        if len(thicknesses[material.name]) > 1
        else material
        for material in found
    ]


def _joined(sheets: Sequence[Segment]) -> list[Segment]:
    """Sheets whose ends are led to the middle of a wall that they stop at."""
    joined = list(sheets)
    for index, sheet in enumerate(joined):
        start, end = np.array(sheet.start), np.array(sheet.end)
        others = [other for other in joined if other is not sheet]
        start, end = _led(start, start - end, others), _led(end, end - start, others)
        joined[index] = replace(
            sheet, start=(float(start[0]), float(start[1])), end=(float(end[0]), float(end[1]))
        )
    return joined


def _led(
    end: NDArray[np.float64], outward: NDArray[np.float64], others: Sequence[Segment]
) -> NDArray[np.float64]:
    """An end of a sheet, moved along the sheet to the nearest wall within reach."""
    outward = outward / np.hypot(*outward)
    steps = []
    for other in others:
        along = np.subtract(other.end, other.start)
        to_end = end - other.start
        turn = outward[0] * along[1] - outward[1] * along[0]
        reach = (other.thickness or WALL_THICKNESS) / 2 + _REACH
        if abs(turn) < 0.1 * np.hypot(*along):
            continue
        step = (along[0] * to_end[1] - along[1] * to_end[0]) / turn
        at = (end + step * outward - other.start) @ along / (along @ along)
        beyond = reach / np.hypot(*along)
        if abs(step) <= reach and -beyond <= at <= 1 + beyond:
            steps.append(step)
    return end + outward * min(steps, key=abs) if steps else end


Pieces = dict[tuple[Point, Point], list[tuple[int, int, str]]]
"""What stands over every piece of a line between two crossings: bottom [mm], top [mm] and material."""


def _pieces(sheets: Sequence[Segment], materials: Sequence[str]) -> Pieces:
    """The lines cut where they cross, and on each piece what stands, doors and windows before walls."""
    shapely = library("shapely", "scenes")
    lines = np.array([shapely.LineString([sheet.start, sheet.end]) for sheet in sheets], dtype=object)
    noded = shapely.get_parts(shapely.union_all(lines, grid_size=MILLIMETRE))
    middle = shapely.line_interpolate_point(noded, 0.5, normalized=True)
    piece, sheet = shapely.STRtree(lines).query(middle, predicate="dwithin", distance=2 * MILLIMETRE)
    over: dict[int, list[int]] = defaultdict(list)
    for index, owner in zip(piece.tolist(), sheet.tolist(), strict=True):
        over[index].append(owner)
    pieces: Pieces = {}
    for index, owners in over.items():
        stands: list[Stand] = []
        for owner in sorted(owners, key=lambda one: (sheets[one].kind not in OPENINGS, one)):
            rest = [(_whole(sheets[owner].bottom), _whole(sheets[owner].top), owner)]
            for low, high, _ in stands:
                rest = [part for one in rest for part in outside(one, low, high)]
            stands += rest
        (x0, y0), (x1, y1) = shapely.get_coordinates(noded[index])[[0, -1]]
        edge = (_whole(x0), _whole(y0)), (_whole(x1), _whole(y1))
        pieces[edge] = [(low, high, materials[owner]) for low, high, owner in stands]
    return pieces


def _whole(length: float) -> int:
    return round(length / MILLIMETRE)


def _walls(pieces: Pieces) -> list[MeshObject]:
    """One mesh a material; sheets that meet share their corners."""
    levels: dict[Point, set[int]] = defaultdict(set)
    for edge, stands in pieces.items():
        for point in edge:
            levels[point] |= {height for low, high, _ in stands for height in (low, high)}
    triangles: dict[str, list[Any]] = defaultdict(list)
    for (left, right), stands in pieces.items():
        for low, high, material in stands:
            triangles[material] += upright(
                left, right, sorted(levels[left]), sorted(levels[right]), low, high
            )
    sheets = {name: np.array(corners, dtype=np.int64) for name, corners in sorted(triangles.items())}
    place = align(np.concatenate(list(sheets.values())), ROUNDING).placed
    return [
        MeshObject(f"all-{name}", name, welded(corners, MILLIMETRE, place))
        for name, corners in sheets.items()
    ]


def _enclosed(pieces: Pieces) -> Any:
    """What the walls enclose, or, if they enclose nothing, the ground between them [mm]."""
    shapely = library("shapely", "scenes")
    lines = shapely.linestrings(np.array(list(pieces), dtype=float))
    rooms = shapely.union_all(shapely.get_parts(shapely.polygonize(lines)))
    return shapely.convex_hull(shapely.union_all(lines)) if shapely.is_empty(rooms) else rooms


def _lid(outline: Any, height: float) -> NDArray[np.int64]:
    """A level sheet over an outline, seen from above counter-clockwise [F, 3, 3], [mm]."""
    flat, _ = flat_triangles(library("shapely", "scenes").get_parts(outline))
    return np.concatenate([flat, np.full((len(flat), 3, 1), _whole(height))], axis=2)
