"""``[regions.NAME]``: regions with extra loss, such as trees, and the effect of these regions on paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.constants import speed_of_light

from calibray.coordinates import WGS84
from calibray.errors import InputError
from calibray.measurements.column_names import find_length_unit
from calibray.parameters import Parameters
from calibray.paths import Paths
from calibray.scenes.obstruction import STEP, Region
from calibray.support.lazy_imports import library
from calibray.support.messages import did_you_mean, shortened
from calibray.support.strict_models import Section, Text
from calibray.tracing.antennas import wave_basis

if TYPE_CHECKING:
    from calibray.coordinates import Frame
    from calibray.fields import Effects
    from calibray.scenes.authoring import Terrain
    from calibray.scenes.checks import SceneSurfaces

PREFIX: Final = "region:"
"""Prefix of the names of a region's parameters."""

WOODLAND: Final = (1.15, 0.43)
"""Coefficients A_1 [dB] and alpha of the maximum loss A_1 f^alpha in woodland, with f in MHz (ITU-R P.833-10, section
2, Mulhouse)."""

EXPONENT: Final = 0.284
"""Frequency exponent of the specific attenuation. Weissberger (1982): 0.45 f^0.284 dB/m for up to 14 m of dense, dry,
in-leaf trees, with f from 0.23 to 95 GHz."""

MOST_CELLS: Final = 400
"""Maximum number of cells along each side of the grid of ground heights; 160,000 heights take a second to compute."""

Height = float | str


def dense_trees(frequency: float) -> float:
    """Specific attenuation of dense trees in leaf at a carrier [Hz], [dB/m] (Weissberger 1982; see `EXPONENT`)."""
    return 0.45 * (frequency / 1e9) ** EXPONENT


class RegionSection(Section):
    """``[regions.NAME]``: polygons in which paths have extra loss.

    Attributes:
        file: GeoJSON, Shapefile, GeoPackage or FlatGeobuf file with the polygons, relative to the study file's folder.
        canopy: GeoTIFF with the height of the trees above the ground, instead of polygons.
        boxes: Rectangles instead of a file: west, south, east, north [m] in the scene frame.
        position: "geographic" if the coordinates are in the reference system that the file states, "scene" if they are
            in the scene frame [m].
        heights: "ground" for heights above the ground of the scene; the heights of a canopy are always above the
            ground. If absent, heights are above z = 0 of the scene.
        bottom: Height of the bottom of the region: a number [m], or a column of the file (in metres, or in the unit
            stated in the column name).
        top: Height of the top of the region, in the same form; not allowed with a canopy.
        specific_attenuation: Loss per unit length [dB/m] of a short path inside the region, at the study's carrier; the
            start value if the specific attenuation is a parameter.
        frequency_exponent: Frequency exponent [1] that scales the specific attenuation to other carriers.
        maximum_db: Loss [dB] of a very long path inside the region. If absent, the ITU-R P.833 value for woodland is
            used.
    """

    file: Text | None = None
    canopy: Text | None = None
    boxes: tuple[tuple[float, float, float, float], ...] = ()
    position: Literal["geographic", "scene"] = "geographic"
    heights: Literal["ground"] | None = None
    bottom: Height = 0.0
    top: Height | None = None
    specific_attenuation: Annotated[float, Field(ge=0)]
    frequency_exponent: Annotated[float, Field(ge=-5, le=5)] = EXPONENT
    maximum_db: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if sum((self.file is not None, self.canopy is not None, bool(self.boxes))) != 1:
            raise InputError(
                "a region is defined by a file, a canopy or boxes; give exactly one of these keys"
            )
        for box in self.boxes:
            west, south, east, north = box
            if not (west < east and south < north):
                raise InputError(
                    f"boxes: {list(box)}: must be west, south, east, north [m], with west less than east and south "
                    "less than north"
                )
        if (self.top is None) != (self.canopy is not None):
            raise InputError(
                "a region of polygons or boxes needs top [m], but a region with a canopy must not state top"
            )
        if self.file is None and (isinstance(self.bottom, str) or isinstance(self.top, str)):
            raise InputError("bottom and top must be numbers [m], because column names apply only to a file")
        if isinstance(self.bottom, float) and isinstance(self.top, float) and not self.bottom < self.top:
            raise InputError(f"bottom = {self.bottom:g}: must be less than top = {self.top:g} [m]")
        return self

    @property
    def source(self) -> tuple[str, str] | None:
        """Key and name of the file; None for boxes."""
        stated = (("file", self.file), ("canopy", self.canopy))
        return next(((key, name) for key, name in stated if name is not None), None)

    def largest_loss_db(self, frequency: float) -> float:
        """Loss [dB] of a very long path inside the region at a carrier [Hz]."""
        scale, exponent = WOODLAND
        return scale * (frequency / 1e6) ** exponent if self.maximum_db is None else self.maximum_db

    def region(self, path: Path | None, place: Place) -> Region:
        """The region in the scene frame, from its boxes or from the file with the resolved `path`.

        Raises:
            InputError: The file cannot be read or contains no polygon, a height is not a number, or the scene is not
                georeferenced.
        """
        shapely = library("shapely", "scenes")
        columns: dict[str, NDArray] = {}
        top: Height | NDArray[np.float64] | None = self.top
        if path is None:
            outline = np.array([shapely.box(*box) for box in self.boxes])
        elif self.canopy is not None:
            from calibray.scenes.authoring.trees import read_canopy

            bounds = place.surfaces().bounds[[0, 1, 3, 4]]
            outline, top = read_canopy(path, _known(place.frame, path), bounds)
        else:
            outline, columns = read_polygons(path, self.position, place.frame)
        bottom, top = (
            _heights(path, key, height, columns, len(outline))
            for key, height in (("bottom", self.bottom), ("top", top))
        )
        if (wrong := np.flatnonzero(~(bottom < top))).size:
            raise InputError(
                f"{path}: bottom = {bottom[wrong[0]]:g} of polygon {wrong[0] + 1} must be less than top = "
                f"{top[wrong[0]]:g} [m]"
            )
        if self.heights is None and self.canopy is None:
            return Region(outline, bottom, top)
        surfaces = place.surfaces()
        # The height of the ground is unknown outside the scene.
        outline = shapely.intersection(outline, shapely.box(*surfaces.bounds[[0, 1, 3, 4]]))
        inside = np.flatnonzero(~shapely.is_empty(outline))
        outline, bottom, top = outline[inside], bottom[inside], top[inside]
        # Take a point inside each polygon, because the centroid of a non-convex polygon can be outside.
        ground = surfaces.lowest_surface(*shapely.get_coordinates(shapely.point_on_surface(outline)).T)
        if (missing := inside[np.isinf(ground)]).size:
            raise InputError(
                f"{path or 'boxes'}: the scene has no ground below polygon {missing[0] + 1}; remove the polygon, or "
                "give heights above z = 0 and remove heights = 'ground'"
            )
        terrain = _terrain(surfaces)
        if np.ptp(terrain.z) == 0:
            return Region(outline, bottom + ground, top + ground)
        return Region(outline, bottom, top, terrain.heights)


def _terrain(surfaces: SceneSurfaces) -> Terrain:
    """The ground heights of a scene on a grid; NaN where there is no ground."""
    from calibray.scenes.authoring import Terrain

    low, high = surfaces.bounds[:2], surfaces.bounds[3:5]
    count = int(np.clip(np.ceil(np.max(high - low) / STEP), 1, MOST_CELLS)) + 1
    x, y = np.linspace(low, high, count).T
    heights = surfaces.lowest_surface(*(axis.ravel() for axis in np.meshgrid(x, y))).reshape(count, count)
    return Terrain(x, y, np.where(np.isfinite(heights), heights, np.nan))


def read_polygons(path: Path, position: str, frame: Frame | None) -> tuple[NDArray[Any], dict[str, NDArray]]:
    """Polygons of a vector file [n] in the scene frame, and the columns of the attribute table.

    `position` is "geographic" for coordinates in the reference system of the file, or "scene" for the scene frame.

    Raises:
        InputError: The file cannot be read or contains no polygon, or the scene is not georeferenced.
    """
    shapely = library("shapely", "scenes")
    from calibray.scenes.authoring.footprints import project
    from calibray.scenes.authoring.geodata import read_features

    features = read_features(path, None)
    # Polygons and multipolygons.
    polygon = np.isin(shapely.get_type_id(features.outline), (3, 6))
    if not polygon.any():
        raise InputError(f"{path}: none of the {len(polygon)} features is a polygon; give a file of outlines")
    outline = shapely.make_valid(features.outline[polygon])
    if position == "geographic":
        known = _known(frame, path)
        try:
            outline = project(outline, known, features.crs or WGS84)
        except InputError as error:
            raise InputError(
                f"{path}: {error}, or set position = 'scene' if the coordinates are in the scene frame"
            ) from None
    return outline, {name: values[polygon] for name, values in features.columns.items()}


def _known(frame: Frame | None, path: Path) -> Frame:
    if frame is None:
        raise InputError(
            f"{path}: the scene is not georeferenced; give scene.origin or scene.crs, or set position = 'scene'"
        )
    return frame


@dataclass(frozen=True)
class Place:
    """The georeference of a scene, if known, and a function that reads its surfaces, for regions and facades."""

    frame: Frame | None
    surfaces: Callable[[], SceneSurfaces]


def _heights(
    path: Path | None,
    key: str,
    height: Height | NDArray[np.float64] | None,
    columns: dict[str, NDArray],
    count: int,
) -> NDArray[np.float64]:
    if not isinstance(height, str):
        return np.broadcast_to(np.asarray(height, dtype=float), count)
    if height not in columns:
        raise InputError(f"{path}: {key}: no column {shortened(height)!r}; {did_you_mean(height, columns)}")
    try:
        values = columns[height].astype(np.float64) * find_length_unit([height])
    except (TypeError, ValueError):
        values = np.full(count, np.nan)
    if (wrong := np.flatnonzero(~np.isfinite(values))).size:
        raise InputError(
            f"{path}: {key}: column {shortened(height)!r} is not a number [m] at polygon {wrong[0] + 1}"
        )
    return values


def region_effects(
    sections: dict[str, RegionSection],
    regions: dict[str, Region],
    parameters: Parameters,
    paths: Paths,
    frequency: float,
    *,
    displaced: bool = False,
) -> Effects:
    """The extra loss of paths in regions. The stated specific attenuations apply at the carrier `frequency` [Hz].

    If `displaced`, paths end at displaced receivers instead of the receivers of the links.
    """
    # JAX is slow to import, and this module is imported whenever a study file is read.
    from calibray.fields import ExtraLoss

    path, start, end = _segments(paths, displaced)
    names = [parameters.names[index] for index in parameters.of_effects]
    effects = []
    for name, section in sections.items():
        parameter = f"{PREFIX}{name}.specific_attenuation"
        length = np.zeros(paths.num_paths)
        np.add.at(length, path, regions[name].length_inside(start, end))
        effects.append(
            ExtraLoss(
                # Paths at another carrier need the attenuation at that carrier.
                length * (paths.frequency / frequency) ** section.frequency_exponent,
                section.largest_loss_db(paths.frequency),
                names.index(parameter) if parameter in names else None,
                section.specific_attenuation,
            )
        )
    return tuple(effects)


def _segments(
    paths: Paths, displaced: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The straight segments of all paths: path index [k], and both end points [k, 3], [m]."""
    number = np.arange(paths.num_paths)
    path = np.repeat(number, np.diff(paths.first) + 1)
    # A path with n interactions has n + 1 segments, so the index of the first segment of path p exceeds the index of
    # its first interaction by p.
    begins, ends = paths.first[:-1] + number, paths.first[1:] + number
    start = np.empty((len(path), 3))
    end = np.empty((len(path), 3))
    start[begins], end[ends] = paths.tx_position[paths.link], paths.rx_position[paths.link]
    inner = np.ones(len(path), dtype=bool)
    inner[begins] = False
    start[inner] = paths.vertex
    inner[begins], inner[ends] = True, False
    end[inner] = paths.vertex
    if displaced:
        # The last segment is computed from its direction and the remaining length of the path.
        before = np.bincount(path[inner], np.linalg.norm(end - start, axis=1)[inner], paths.num_paths)
        last = paths.delay * speed_of_light - before
        # The arrival direction points from the receiver back towards the last interaction.
        end[ends] = start[ends] - last[:, None] * wave_basis(paths.arrival)[0].T
    return path, start, end
