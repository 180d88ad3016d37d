"""Scenes of rooms, made from floor plans: one vertical sheet for each wall, door and window."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.scenes.authoring.extrusion import (
    Point,
    Stand,
    subtract,
    to_millimetres,
    triangulate,
    wall_triangles,
)
from calibray.scenes.authoring.floor_plan import OPENINGS, Segment
from calibray.scenes.authoring.made_scene import (
    SCENE_FILES,
    MadeScene,
    SurfaceMaterial,
    extent,
    write_made_scene,
)
from calibray.scenes.authoring.wall_alignment import align
from calibray.scenes.authoring.wall_faces import MergedPlan, merge_faces
from calibray.scenes.meshes import MILLIMETRE, MeshObject, weld
from calibray.scenes.scene import ITU_NAMES
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean
from calibray.support.output_files import check_outputs

TYPES: Final = {
    "wall": SurfaceMaterial("wall", "plasterboard", 0.12),
    "door": SurfaceMaterial("door", "wood", 0.04),
    "window": SurfaceMaterial("window", "glass", 0.01),
    "floor": SurfaceMaterial("floor", "concrete", 0.2),
    "ceiling": SurfaceMaterial("ceiling", "concrete", 0.2),
}
"""Materials of the types that are not named after an ITU-R P.2040 material."""

LIDS: Final = ("floor", "ceiling")
"""Horizontal sheets over the whole area of a plan."""

WALL_THICKNESS: Final = 0.12
"""Thickness [m] of a wall whose type is an ITU material, used if the plan states no thickness."""

STOREY: Final = 1.8
"""Minimum height of a storey [m]; lower walls, such as parapets, do not count as storeys."""

ROUNDING: Final = 2.0
"""Maximum distance [mm] by which rounding can move the common corner of two crossing walls off the line of a wall."""

_REACH: Final = 0.03  # maximum distance between a wall's face and the end of a wall that meets it [m]

Pieces = dict[tuple[Point, Point], list[tuple[int, int, str]]]
"""Bottom [mm], top [mm] and material of the sheets above each section of a line between two crossings."""


def make_plan_scene(
    segments: Sequence[Segment],
    folder: str | Path,
    types: Mapping[str, SurfaceMaterial] | None = None,
    lids: Collection[str] = LIDS,
    merge: bool = True,
    overwrite: bool = False,
) -> MadeScene:
    """Make a scene from a floor plan.

    Walls that cross or meet share corners. If a wall ends at the face of another wall, it is extended to the other
    wall's centre line. Between its own bottom and top, a door or window replaces the wall on which it is drawn; the
    wall continues above and below. Any shorter line drawn on a longer line, for example a door whose type has a
    different name, is treated in the same way.

    Args:
        segments: Lines of the plan.
        folder: Folder for `scene.xml`, `scene.json` and the meshes.
        types: Materials by type, which extend or replace the materials in `TYPES`. A type that is an ITU-R P.2040
            material, such as `brick`, becomes the material `brick_wall`. If the plan states several thicknesses for one
            type, each thickness becomes a separate material.
        lids: Which of `LIDS` to make. A floor or ceiling covers the whole area that walls enclose; the floor is at the
            height of the lowest wall bottom, and the ceiling at the height of the highest wall top.
        merge: Whether to merge two parallel lines into one wall (`merge_faces`).
        overwrite: Whether to replace files that Calibray did not write.

    Raises:
        InputError: A type has no material, there is no segment, the plan has several storeys but no floor between
            them, the folder cannot be written to, or a file in it must not be replaced.
    """
    folder = check_outputs(folder, SCENE_FILES, overwrite=overwrite)
    types = {**TYPES, **(types or {})}
    if not segments:
        raise InputError("the floor plan contains no segment; give at least one wall")
    merged = merge_faces(segments) if merge else MergedPlan(segments)
    sheets, source = merged.sheets, segments[0].source
    if lids and (level := _separation(sheets)) is not None:
        raise InputError(
            f"{source}: a storey begins at {level:g} m, but the scene would have no floor there; make a separate scene "
            "of each storey, or omit floor and ceiling (--no-floor --no-ceiling) and add the floors to the scene "
            "yourself"
        )
    materials = _materials(sheets, types, source)
    pieces = _pieces(_extend_to_walls(sheets), [material.name for material in materials])
    objects = _wall_objects(pieces)
    outline = _enclosed(pieces)
    if lids and outline.area == 0:
        raise InputError(
            f"{source}: encloses no area for a floor or ceiling; draw walls around the room, or omit both "
            "(--no-floor --no-ceiling)"
        )
    heights = {"floor": min(sheet.bottom for sheet in sheets), "ceiling": max(sheet.top for sheet in sheets)}
    for kind in lids:
        name = types[kind].name
        materials.append(types[kind])
        objects.append(MeshObject(f"all-{name}", name, weld(_lid(outline, heights[kind]))))
    counts = {
        "lines": len(segments),
        "sheets": len(sheets),
        **({"lines merged as faces of one wall": merged.lines} if merged.lines else {}),
    }
    scene = MadeScene(folder / SCENE_FILES[0], None, *extent(objects), counts, walls=merged.report)
    write_made_scene(scene, objects, materials, overwrite)
    return scene


def _materials(
    sheets: Sequence[Segment], types: Mapping[str, SurfaceMaterial], source: str
) -> list[SurfaceMaterial]:
    """The material of each sheet; a type with several thicknesses has one material for each thickness."""
    unknown = dict.fromkeys(sheet.kind for sheet in sheets if sheet.kind not in {*types, *ITU_NAMES})
    if unknown:
        listed = list(unknown)[:10]
        options = " ".join(f"--material {shlex.quote(kind)}=concrete" for kind in listed)
        raise InputError(
            f"{source}: no material for {', '.join(map(repr, listed))}; assign the closest ITU-R P.2040 material to "
            f"each, as in {options}; or correct the type, {did_you_mean(listed[0], sorted({*types, *ITU_NAMES}))}"
        )
    materials = []
    for sheet in sheets:
        if sheet.kind in types:
            base = types[sheet.kind]
        else:
            base = SurfaceMaterial(f"{sheet.kind}_wall", sheet.kind, WALL_THICKNESS)
        # The thickness is rounded to a thousandth of a millimetre, so that rounding errors do not create separate
        # materials.
        stated = base.thickness if sheet.thickness is None else round(sheet.thickness, 6)
        materials.append(replace(base, thickness=stated))
    thicknesses: dict[str, set[float]] = defaultdict(set)
    for material in materials:
        thicknesses[material.name].add(material.thickness)
    return [
        replace(material, name=f"{material.name}_{material.thickness * 1000:g}mm".replace(".", "_"))
        if len(thicknesses[material.name]) > 1
        else material
        for material in materials
    ]


def _separation(sheets: Sequence[Segment]) -> float | None:
    """Height at which one storey ends and the next begins [m]; None if there is only one storey."""
    lowest, highest = min(sheet.bottom for sheet in sheets), max(sheet.top for sheet in sheets)
    for level in sorted({sheet.bottom for sheet in sheets}):
        passed = any(sheet.bottom < level - MILLIMETRE and sheet.top > level + MILLIMETRE for sheet in sheets)
        if not passed and level - lowest >= STOREY and highest - level >= STOREY:
            return level
    return None


def _extend_to_walls(sheets: Sequence[Segment]) -> list[Segment]:
    """Move the ends of sheets along the sheets to the centre lines of the walls that they meet."""
    extended = list(sheets)
    for index, sheet in enumerate(extended):
        start, end = np.array(sheet.start), np.array(sheet.end)
        others = [other for other in extended if other is not sheet]
        start = _extend(start, start - end, others)
        end = _extend(end, end - start, others)
        extended[index] = replace(
            sheet, start=(float(start[0]), float(start[1])), end=(float(end[0]), float(end[1]))
        )
    return extended


def _extend(
    end: NDArray[np.float64], outward: NDArray[np.float64], others: Sequence[Segment]
) -> NDArray[np.float64]:
    """The end of a sheet, moved along the sheet to the centre line of the nearest wall within reach."""
    outward = outward / np.hypot(*outward)
    steps = []
    for other in others:
        along = np.subtract(other.end, other.start)
        offset = end - other.start
        sine = outward[0] * along[1] - outward[1] * along[0]  # times the length of the other wall
        reach = (other.thickness or WALL_THICKNESS) / 2 + _REACH
        # Nearly parallel walls are skipped, because their lines may cross far from the point where the walls meet.
        if abs(sine) < 0.1 * np.hypot(*along):
            continue
        step = (along[0] * offset[1] - along[1] * offset[0]) / sine
        share = (end + step * outward - other.start) @ along / (along @ along)
        margin = reach / np.hypot(*along)
        if abs(step) <= reach and -margin <= share <= 1 + margin:
            steps.append(step)
    return end + outward * min(steps, key=abs) if steps else end


def _pieces(sheets: Sequence[Segment], materials: Sequence[str]) -> Pieces:
    """Divide lines at their crossings.

    On each section, doors and windows replace walls, and shorter lines replace longer lines.
    """

    def priority(number: int) -> tuple[bool, float, int]:
        return sheets[number].kind not in OPENINGS, round(sheets[number].length, 3), number

    shapely = library("shapely", "scenes")
    lines = np.array([shapely.LineString([sheet.start, sheet.end]) for sheet in sheets], dtype=object)
    cut = shapely.get_parts(shapely.union_all(lines, grid_size=MILLIMETRE))
    middle = shapely.line_interpolate_point(cut, 0.5, normalized=True)
    piece, sheet = shapely.STRtree(lines).query(middle, predicate="dwithin", distance=2 * MILLIMETRE)
    over: dict[int, list[int]] = defaultdict(list)
    for index, owner in zip(piece.tolist(), sheet.tolist(), strict=True):
        over[index].append(owner)
    pieces: Pieces = {}
    for index, owners in over.items():
        stands: list[Stand] = []
        for owner in sorted(owners, key=priority):
            free = [(to_millimetres(sheets[owner].bottom), to_millimetres(sheets[owner].top), owner)]
            for low, high, _ in stands:
                free = [part for stand in free for part in subtract(stand, low, high)]
            stands += free
        (x0, y0), (x1, y1) = shapely.get_coordinates(cut[index])[[0, -1]]
        edge = (to_millimetres(x0), to_millimetres(y0)), (to_millimetres(x1), to_millimetres(y1))
        pieces[edge] = [(low, high, materials[owner]) for low, high, owner in stands]
    return pieces


def _wall_objects(pieces: Pieces) -> list[MeshObject]:
    """One mesh per material; where sheets of the same material meet, they share their corners."""
    levels: dict[Point, set[int]] = defaultdict(set)
    for edge, stands in pieces.items():
        for point in edge:
            levels[point] |= {height for low, high, _ in stands for height in (low, high)}
    triangles: dict[str, list[Any]] = defaultdict(list)
    for (left, right), stands in pieces.items():
        for low, high, material in stands:
            triangles[material] += wall_triangles(
                left, right, sorted(levels[left]), sorted(levels[right]), low, high
            )
    sheets = {name: np.array(corners, dtype=np.int64) for name, corners in sorted(triangles.items())}
    position = align(np.concatenate(list(sheets.values())), ROUNDING).positions
    return [MeshObject(f"all-{name}", name, weld(corners, position)) for name, corners in sheets.items()]


def _enclosed(pieces: Pieces) -> Any:
    """The area that the walls enclose or, if they enclose nothing, the convex hull of the walls [mm]."""
    shapely = library("shapely", "scenes")
    lines = shapely.linestrings(np.array(list(pieces), dtype=float))
    rooms = shapely.union_all(shapely.get_parts(shapely.polygonize(lines)))
    return shapely.convex_hull(shapely.union_all(lines)) if shapely.is_empty(rooms) else rooms


def _lid(outline: Any, height: float) -> NDArray[np.int64]:
    """Triangles [F, 3, 3], [mm], of a horizontal sheet over an area, counter-clockwise when seen from above."""
    flat, _ = triangulate(library("shapely", "scenes").get_parts(outline))
    return np.concatenate([flat, np.full((len(flat), 3, 1), to_millimetres(height))], axis=2)
