"""``[facades.NAME]``: materials for parts of one mesh, selected by storey, side or position, or for windows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.materials import DEFAULT_REVISION, Material, itu_law, itu_material, law_with_stated
from calibray.parameters import Parameters
from calibray.parameters.parameter import ROUGHNESS
from calibray.paths import Kind, Paths
from calibray.scenes import Scene, check_material_name
from calibray.scenes.meshes import MILLIMETRE
from calibray.study.regions import Place, read_polygons
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean, shortened
from calibray.support.strict_models import Section, Text

if TYPE_CHECKING:
    from calibray.fields import Effects
    from calibray.scenes.checks import SceneSurfaces


NEAR: Final = 0.5
"""Maximum distance [m] of a wall from its polygon, because walls are on the outlines of buildings."""

BESIDE: Final = 0.1
"""Maximum distance [m] in plan between a wall and a point on this wall. A roof at this distance from the wall indicates
which side is the inside."""


class FacadeSection(Section):
    """``[facades.NAME]``: a separate material for those parts of walls that meet all the stated criteria.

    Attributes:
        of: Material of the scene that the new material replaces on these parts of walls. The new material has the same
            constants, unless ``[materials]`` states other constants for it.
        storeys: First and last storey, counted from 1 at the ground.
        storey_height: Height of a storey [m].
        facing: Sector of compass bearings [deg], clockwise from the first to the second, that contains the outward
            normal of the wall. The inside of a wall is the side under a roof. Without a roof, the order of the corners
            of the triangles determines the inside.
        boxes: Rectangles that contain the parts of walls: west, south, east, north [m] in the scene frame.
        file: GeoJSON, Shapefile, GeoPackage or FlatGeobuf file of polygons. The walls are on the outlines of these
            polygons.
        column: Column of the file. Only polygons with the value NAME in this column are used; without `column`, all
            polygons are used.
        position: "geographic" or "scene", as in ``[regions]``.
        share: Fraction of the wall covered by strips of this material, such as windows.
        module: Distance [m] between the centres of neighbouring strips; the distance is rounded so that a wall has a
            whole number of strips.
    """

    of: Text
    storeys: tuple[int, int] | None = None
    storey_height: Annotated[float, Field(gt=0)] = 3.0
    facing: tuple[float, float] | None = None
    boxes: tuple[tuple[float, float, float, float], ...] = ()
    file: Text | None = None
    column: Text | None = None
    position: Literal["geographic", "scene"] = "geographic"
    share: Annotated[float, Field(gt=0, lt=1)] | None = None
    module: Annotated[float, Field(gt=0)] = 3.0

    @model_validator(mode="after")
    def _some_rule(self) -> Self:
        if not any((self.storeys, self.facing, self.boxes, self.file, self.share)):
            raise InputError("a facade needs a rule: storeys, facing, boxes, file or share")
        if self.storeys is not None and not 1 <= self.storeys[0] <= self.storeys[1]:
            raise InputError(
                f"storeys = {list(self.storeys)}: must be the first and the last storey, counted from 1"
            )
        if self.column is not None and self.file is None:
            raise InputError("column selects polygons of a file; state file as well")
        return self


def with_facade_materials(
    scene: Scene,
    facades: Mapping[str, FacadeSection],
    constants: Mapping[str, Mapping[str, object]],
    frequency: float,
) -> Scene:
    """The scene with the materials of facades; `constants` are those that ``[materials]`` states for facades.

    Raises:
        InputError: A facade has the name of a material of the scene, the scene lacks the material that a facade
            replaces, or ITU-R P.2040 does not cover a material at the carrier [Hz].
    """
    materials, laws = dict(scene.materials), dict(scene.laws)
    for name, section in facades.items():
        if name in scene.materials:
            raise InputError(
                f"[facades.{name}]: the scene has a material with this name; choose another name"
            )
        check_material_name(section.of, scene.materials, f"[facades.{name}] of")
        stated = dict(constants.get(name, {}))
        itu, revision = stated.pop("itu", None), str(stated.pop("revision", DEFAULT_REVISION))
        material, law = scene.materials[section.of], scene.laws.get(section.of)
        if itu is not None:
            bulk = itu_material(str(itu), frequency, revision=revision)
            material = replace(
                material, relative_permittivity=bulk.relative_permittivity, conductivity=bulk.conductivity
            )
            law = itu_law(str(itu), frequency, revision)
        if stated:
            material = replace(material, **stated)  # type: ignore[arg-type]
        materials[name] = material
        if law is not None:
            laws[name] = law_with_stated(law, material, stated)
    return replace(scene, materials=materials, laws=laws)


def without_facade_materials(scene: Scene, facades: Mapping[str, FacadeSection]) -> Scene:
    """The scene without the materials of facades, as used for tracing."""
    if not facades:
        return scene
    materials, laws = (
        {name: value for name, value in table.items() if name not in facades}
        for table in (scene.materials, scene.laws)
    )
    return replace(scene, materials=materials, laws=laws)


def with_facades(
    paths: Paths,
    facades: Mapping[str, FacadeSection],
    files: Mapping[str, Path | None],
    place: Place,
    materials: Mapping[str, Material],
) -> Paths:
    """The paths with the materials of facades at interactions. If several facades apply, the first is used.

    `files` contains the resolved file paths of facades. `materials` includes those of the scene and of facades.

    Raises:
        InputError: A file cannot be used, or there is no ground below a wall.
    """
    surfaces, names = place.surfaces(), list(paths.materials)
    material, free = paths.material.copy(), np.ones(paths.num_interactions, dtype=bool)
    for number, (name, section) in enumerate(facades.items(), start=len(names)):
        hit = np.flatnonzero(free & (paths.material == names.index(section.of)))
        point = paths.vertex[hit].astype(np.float64)
        chosen = hit[_applies(name, section, files[name], place, surfaces, point)] if len(hit) else hit
        material[chosen], free[chosen] = number, False
    return replace(
        paths, material=material, materials=paths.materials | {name: materials[name] for name in facades}
    )


def _applies(
    name: str,
    section: FacadeSection,
    file: Path | None,
    place: Place,
    surfaces: SceneSurfaces,
    point: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether all rules of a facade apply to each point [n] of its material."""
    shapely = library("shapely", "scenes")
    applies = np.ones(len(point), dtype=bool)
    if section.storeys is not None:
        height = point[:, 2] - surfaces.ground_height(point[:, 0], point[:, 1])
        # Storeys are numbered from 1 for the ground floor.
        storey = np.floor(height / section.storey_height) + 1
        applies &= (storey >= section.storeys[0]) & (storey <= section.storeys[1])
        # The ground is not part of a storey, even if it has the material of the walls.
        applies &= height > MILLIMETRE
    if section.facing is not None or section.share is not None:
        if not len(surfaces.walls):
            return np.zeros(len(point), dtype=bool)
        bearing, along, length, beside = _walls(surfaces, point)
        # The ground and roofs have no compass direction.
        applies &= beside < BESIDE
        if section.facing is not None:
            start, end = section.facing
            # The sector runs clockwise from start to end, even across north; equal bearings mean a full turn.
            applies &= (bearing - start) % 360 <= ((end - start) % 360 or 360)
        if section.share is not None:
            strips = np.maximum(np.round(length / section.module), 1)
            # There is one strip in the middle of each module.
            applies &= np.abs((along * strips) % 1 - 0.5) < section.share / 2
    outlines = [shapely.box(*box) for box in section.boxes]
    if file is not None:
        outline, columns = read_polygons(file, section.position, place.frame)
        if section.column is not None:
            if section.column not in columns:
                remedy = did_you_mean(section.column, columns)
                raise InputError(f"{file}: no column {shortened(section.column)!r}; {remedy}")
            # A column of numbers stores 12 as 12.0.
            labels = [str(label).removesuffix(".0") for label in columns[section.column]]
            outline = outline[np.array(labels) == name.removesuffix(".0")]
            if not len(outline):
                raise InputError(f"{file}: no polygon has {name!r} in its column {section.column!r}")
        # Walls are on the outline itself, so a point on a wall may lie just outside the polygon.
        outlines += shapely.buffer(outline, NEAR).tolist()
    if outlines:
        area = shapely.union_all(outlines)
        shapely.prepare(area)
        applies &= shapely.intersects_xy(area, point[:, 0], point[:, 1])
    return applies


def _walls(surfaces: SceneSurfaces, point: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """The wall nearest to each point in plan: bearing [deg], position along the wall (0 to 1), length and distance [m].

    Each array is [n]. The bearing is that of the outward normal; position 0 is the west or south end.
    """
    shapely, walls = library("shapely", "scenes"), surfaces.walls
    # In plan, an upright triangle is the line from its first to its last corner, with corners sorted by x and y.
    plan = np.round(walls[:, :, :2], 6)
    order = np.lexsort((plan[..., 1], plan[..., 0]), axis=-1)
    ends = np.stack([plan[np.arange(len(plan)), order[:, k]] for k in (0, 2)], axis=1)
    normal = np.cross(walls[:, 1] - walls[:, 0], walls[:, 2] - walls[:, 0])
    tree = shapely.STRtree(shapely.linestrings(ends))
    (_, nearest), distance = tree.query_nearest(
        shapely.points(point[:, :2]), all_matches=False, return_distance=True
    )
    start, step = ends[nearest, 0], ends[nearest, 1] - ends[nearest, 0]
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    along = np.clip(((point[:, :2] - start) * step).sum(axis=1) / length**2, 0.0, 1.0)
    # The side under a roof is the inside; if both sides or neither are under a roof, the order of the corners decides.
    outward = normal[nearest] / np.linalg.norm(normal[nearest], axis=1, keepdims=True)
    front, back = (surfaces.under_roof(point + side * BESIDE * outward) for side in (1, -1))
    outward = np.where((front & ~back)[:, None], -outward, outward)
    # The arctangent of east over north is an angle clockwise from north.
    bearing = np.degrees(np.arctan2(outward[:, 0], outward[:, 1])) % 360
    return bearing, along, length, distance


def roughness_effects(stated: Mapping[str, float], parameters: Parameters, paths: Paths) -> Effects:
    """The loss of specular reflections at rough surfaces; empty if no material is rough.

    `stated` contains the standard deviation [mm] of the surface height, by material name.
    """
    names = [parameters.names[index] for index in parameters.of_effects]
    number = {
        name.removesuffix(f".{ROUGHNESS}"): index
        for index, name in enumerate(names)
        if name.endswith(f".{ROUGHNESS}")
    }
    rough = [name for name in paths.materials if stated.get(name) or name in number]
    if not rough:
        return ()
    # JAX is slow to import, and this module is imported whenever a study file is read.
    from calibray.fields import RoughSurfaces

    path = np.repeat(np.arange(paths.num_paths), np.diff(paths.first))
    specular = paths.kind == Kind.SPECULAR
    known = list(paths.materials)
    square = [
        np.bincount(
            path, (specular & (paths.material == known.index(name))) * paths.cos_incidence**2, paths.num_paths
        )
        for name in rough
    ]
    # Factor 8 (pi / lambda)^2 of `RoughSurfaces`, for heights in millimetres.
    per_mm = 8 * (np.pi * 1e-3 * paths.frequency / speed_of_light) ** 2
    heights = np.array([stated.get(name, 0.0) for name in rough])
    exponent = np.asarray(per_mm * np.stack(square, axis=1), dtype=np.float64)
    return (RoughSurfaces(exponent, heights, tuple(map(number.get, rough))),)
