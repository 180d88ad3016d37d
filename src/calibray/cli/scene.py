"""`calibray scene`: make scenes from maps, building footprints and floor plans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibray.cli.console import Overwrite, echo, log, option, progress_bars, read_origin, with_groups
from calibray.errors import InputError
from calibray.support.messages import counted

if TYPE_CHECKING:
    from calibray.coordinates import Frame
    from calibray.scenes.authoring import Footprints, HeightRule, MadeScene, SurfaceMaterial, Trees

SUMMARY: Final = "Make a scene from an OpenStreetMap extract, building footprints or a floor plan."

scene = typer.Typer(
    name="scene", help=SUMMARY, short_help=SUMMARY, no_args_is_help=True, add_completion=False
)
"""The commands that make scenes; `app.add_typer(scene)` adds them to the application."""

Out = Annotated[Path, option("DIR", "Folder for scene.xml and the meshes.", "--out", "-o")]


@dataclass(frozen=True)
class MapOptions:
    """Options for outdoor scenes, which consist of buildings and ground."""

    terrain: Annotated[
        Path | None,
        option("FILE", "GeoTIFF height model of the ground; without this option, the ground is level."),
    ] = None
    spacing: Annotated[
        float | None,
        option("M", "Cell width of the ground mesh [m]; by default, the cell width of the height model."),
    ] = None
    origin: Annotated[
        str | None,
        option(
            "LON,LAT",
            "Origin of the scene frame [deg]; by default, the origin is the centre of the buildings.",
        ),
    ] = None
    utm: Annotated[
        bool,
        typer.Option(
            "--utm", help="Use the UTM zone of the origin instead of a projection centred on the origin."
        ),
    ] = False
    wall: Annotated[
        str, option("ITU[:M]", "P.2040 material of the walls; a colon and the thickness [m] can follow.")
    ] = "concrete:0.3"
    roof: Annotated[
        str,
        option(
            "ITU[:M]",
            "Material of the roofs. 'wall' combines roofs and walls in one mesh, so that rays can diffract at the "
            "eaves.",
        ),
    ] = "concrete:0.3"
    ground: Annotated[str, option("ITU[:M]", "Material of the ground.")] = "concrete:1.0"
    window_share: Annotated[
        float, option("SHARE", "Share of each wall that windows cover, at least 0 and below 1.")
    ] = 0.0
    storey: Annotated[
        float,
        option(
            "M",
            "Height of a storey [m]; used for buildings for which the map states only the number of storeys.",
        ),
    ] = 3.0
    default_height: Annotated[
        float,
        option(
            "M",
            "Height [m] of buildings for which the map states neither the height nor the number of storeys.",
        ),
    ] = 9.0
    margin: Annotated[float, option("M", "Width of the strip of ground around the buildings [m].")] = 50.0
    per_building: Annotated[
        bool,
        typer.Option(
            "--per-building",
            help="Make one mesh per building, so that [objects] can assign a material to each building.",
        ),
    ] = False
    overwrite: Overwrite = False

    @property
    def inputs(self) -> list[Path]:
        """The input files that the options name."""
        return [] if self.terrain is None else [self.terrain]

    @property
    def heights(self) -> HeightRule:
        """The rule for the heights of buildings for which the map states no height."""
        from calibray.scenes.authoring import HeightRule

        return HeightRule(self.storey, self.default_height)

    def frame(self) -> Frame | None:
        """The scene frame with the given origin; None if no origin is given."""
        from calibray.coordinates import Frame

        if self.origin is None:
            if self.utm:
                raise InputError("--utm needs --origin LON,LAT")
            return None
        longitude, latitude = read_origin(self.origin)
        return Frame.utm(longitude, latitude) if self.utm else Frame.local(longitude, latitude)


@dataclass(frozen=True)
class ColumnOptions:
    """Options that name the columns of a vector file."""

    height: Annotated[
        str | None,
        option(
            "COLUMN",
            "Column that contains the building heights above the ground, or one height for all buildings [m]; not "
            "needed with --levels.",
        ),
    ] = None
    bottom: Annotated[
        str,
        option(
            "COLUMN",
            "Column that contains the heights of the buildings' undersides above the ground, or one height for all "
            "buildings [m].",
        ),
    ] = "0"
    levels: Annotated[str | None, option("COLUMN", "Column that contains the numbers of storeys.")] = None
    name: Annotated[str | None, option("COLUMN", "Column with the names.")] = None
    layer: Annotated[str | None, option("NAME", "Layer of the file.")] = None


@scene.command()
@with_groups
def osm(
    extract: Annotated[Path, typer.Argument(metavar="EXTRACT", help="An .osm or .osm.pbf file.")],
    out: Out,
    options: MapOptions,
) -> None:
    """Make a scene from the buildings in an OpenStreetMap extract, and write the trees in the extract to a file."""
    from calibray.scenes.authoring import SCENE_FILES, TREES_FILE, read_openstreetmap, read_trees
    from calibray.support.output_files import check_outputs

    check_outputs(out, (*SCENE_FILES, TREES_FILE), [extract, *options.inputs], options.overwrite)

    def read() -> tuple[Footprints, Frame, Trees]:
        buildings, frame = read_openstreetmap(extract, options.frame(), options.heights)
        return buildings, frame, read_trees(extract, frame)

    _make(read, out, options)


@scene.command()
@with_groups
def footprints(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON, Shapefile or GeoPackage.")],
    out: Out,
    columns: ColumnOptions,
    options: MapOptions,
) -> None:
    """Make a scene from building footprints with heights."""
    from calibray.scenes.authoring import SCENE_FILES, FootprintColumns, read_footprints
    from calibray.support.output_files import check_outputs

    check_outputs(out, SCENE_FILES, [file, *options.inputs], options.overwrite)
    further = FootprintColumns(columns.bottom, columns.name, columns.levels)

    def read() -> tuple[Footprints, Frame, None]:
        reading = columns.height, further, columns.layer, options.frame(), options.heights
        return *read_footprints(file, *reading), None

    _make(read, out, options)


@dataclass(frozen=True)
class PlanOptions:
    """Options for scenes from floor plans."""

    height: Annotated[float, option("M", "Height [m] of walls for which the plan states no height.")] = 3.0
    unit: Annotated[
        float | None,
        option(
            "M",
            "Unit of length of the plan [m], such as 0.001 for mm; by default, the unit that a DXF file states, or "
            "metres.",
        ),
    ] = None
    floor: Annotated[bool, typer.Option(help="Make a floor.")] = True
    ceiling: Annotated[bool, typer.Option(help="Make a ceiling.")] = True
    merge: Annotated[bool, typer.Option(help="Merge two parallel lines into one wall.")] = True
    material: Annotated[
        list[str] | None, option("TYPE=ITU[:M]", "Material of one type of wall; the option can be repeated.")
    ] = None
    overwrite: Overwrite = False


@scene.command()
@with_groups
def plan(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="PLAN",
            help="CSV file with the columns x0, y0, x1, y1 (or wkt) and type and, optionally, thickness, bottom and "
            "height. DXF, GeoJSON and other vector files are also read.",
        ),
    ],
    out: Out,
    options: PlanOptions,
) -> None:
    """Make a scene from a floor plan; each wall, door and window becomes one sheet."""
    from calibray.scenes.authoring import LIDS, SCENE_FILES, make_plan_scene, read_plan
    from calibray.support.output_files import check_outputs

    types = _types(options.material or [])
    lids = [name for name in LIDS if getattr(options, name)]
    check_outputs(out, SCENE_FILES, [file], options.overwrite)
    with progress_bars(log()) as progress:
        progress("making", 0, None)
        segments = read_plan(file, options.height, options.unit)
        made = make_plan_scene(segments, out, types, lids, options.merge, options.overwrite)
    _print(made)


def _print(made: MadeScene) -> None:
    """Print the contents of the scene that was made."""
    from calibray.reporting.scene_tables import contents
    from calibray.tables import render

    echo(render(contents(made)))


def _make(read: Callable[[], tuple[Footprints, Frame, Trees | None]], out: Path, options: MapOptions) -> None:
    """Make a scene from the buildings, frame and trees that `read` returns, and print the scene's contents."""
    import numpy as np

    from calibray.scenes.authoring import Palette, Windows, lower_origin, make_scene, read_terrain

    with progress_bars(log()) as progress:
        progress("reading", 0, None)
        buildings, frame, trees = read()
        _check_origin(options.origin, buildings)
        palette = Palette(
            wall=_material("walls", options.wall, 0.3),
            roof=None if options.roof == "wall" else _material("roofs", options.roof, 0.3),
            ground=_material("ground", options.ground, 1.0),
        )
        windows = Windows(options.window_share) if options.window_share else None
        surface = None
        if options.terrain is not None:
            bounds = buildings.bounds + options.margin * np.array([-1, -1, 1, 1])
            surface, frame = lower_origin(
                read_terrain(options.terrain, frame, bounds, options.spacing), frame
            )
        echo(f"Making a scene with {counted(len(buildings), 'building')}", err=True)
        progress("making", 0, None)
        made = make_scene(
            buildings, out, frame, surface, palette, windows, options.margin,
            per_building=options.per_building, overwrite=options.overwrite, trees=trees,
        )  # fmt: skip
    _print(made)


def _check_origin(origin: str | None, buildings: Footprints) -> None:
    """Refuse an origin far from the buildings, which usually means that latitude and longitude are swapped."""
    import numpy as np

    from calibray.scenes.meshes import WIDEST

    distance = float(np.abs(buildings.bounds).max())
    if origin is not None and distance > WIDEST:
        raise InputError(
            f"--origin {origin}: the buildings are {distance / 1000:,.0f} km from this origin; give longitude first, "
            "then latitude"
        )


def _types(entries: list[str]) -> dict[str, SurfaceMaterial]:
    """Read the material of each wall type from entries such as `drywall=plasterboard:0.1`."""
    from calibray.scenes.authoring import WALL_THICKNESS, material_name

    types: dict[str, SurfaceMaterial] = {}
    for entry in entries:
        kind, equals, material = entry.partition("=")
        kind = kind.strip().lower()
        if not equals:
            raise InputError(f"--material {entry}: must be TYPE=ITU, such as drywall=plasterboard:0.1")
        if kind in types:
            raise InputError(
                f"--material {entry}: the type {kind!r} already has a material; give one material for each type"
            )
        name, taken = material_name(kind), {other.name for other in types.values()}
        while name in taken:
            name += "_2"
        types[kind] = _material(name, material, WALL_THICKNESS)
    return types


def _material(name: str, text: str, thickness: float) -> SurfaceMaterial:
    """Read a material from its P.2040 name, which a colon and the thickness [m] can follow."""
    from calibray.scenes.authoring import SurfaceMaterial

    itu, colon, own_thickness = text.partition(":")
    try:
        return SurfaceMaterial(name, itu, float(own_thickness) if colon else thickness)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"material {text!r}: {own_thickness!r} is not a thickness in metres") from None
