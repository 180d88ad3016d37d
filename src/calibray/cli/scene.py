"""`calibray scene`: make scenes of maps, footprints and floor plans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calibray.cli.console import log
from calibray.errors import InputError

if TYPE_CHECKING:
    from calibray.coordinates import Frame
    from calibray.scenes.authoring import Footprints, MadeScene, SurfaceMaterial
    from calibray.support.progress import Progress

SUMMARY: Final = "Make a scene of an OpenStreetMap extract, of footprints with heights, or of a floor plan."

scene = typer.Typer(
    name="scene", help=SUMMARY, short_help=SUMMARY, no_args_is_help=True, add_completion=False
)
"""The commands; `app.add_typer(scene)` adds them."""

Out = Annotated[
    Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to write scene.xml and meshes into.")
]
Terrain = Annotated[
    Path | None, typer.Option(metavar="FILE", help="GeoTIFF height model for the ground; level without one.")
]
Spacing = Annotated[
    float | None, typer.Option(metavar="M", help="Width of the ground's cells [m]; the model's without it.")
]
Origin = Annotated[
    str | None,
    typer.Option(metavar="LON,LAT", help="The scene's origin [deg]; the middle of the buildings without it."),
]
Utm = Annotated[
    bool, typer.Option("--utm", help="Use the UTM zone of the origin instead of a projection centred there.")
]
Wall = Annotated[
    str,
    typer.Option(metavar="ITU[:M]", help="P.2040 material of the walls, and thickness [m] after a colon."),
]
Roof = Annotated[
    str,
    typer.Option(
        metavar="ITU[:M]", help="Material of the roofs; 'wall' joins them to the walls: eaves diffract."
    ),
]
Ground = Annotated[str, typer.Option(metavar="ITU[:M]", help="Material of the ground.")]
Windows = Annotated[float, typer.Option(metavar="SHARE", help="Share of window in every wall, 0 to below 1.")]
Storey = Annotated[
    float, typer.Option(metavar="M", help="Height of a storey where only their number is given [m].")
]
DefaultHeight = Annotated[
    float, typer.Option(metavar="M", help="Height of a building of which nothing tells it [m].")
]
Margin = Annotated[
    float, typer.Option(metavar="M", help="How far the ground reaches beyond the buildings [m].")
]
PerBuilding = Annotated[
    bool, typer.Option("--per-building", help="One mesh a building, so that [objects] can tell them apart.")
]


@scene.command()
def osm(
    extract: Annotated[Path, typer.Argument(metavar="EXTRACT", help="An .osm or .osm.pbf file.")],
    out: Out,
    terrain: Terrain = None,
    spacing: Spacing = None,
    origin: Origin = None,
    utm: Utm = False,
    wall: Wall = "concrete:0.3",
    roof: Roof = "concrete:0.3",
    ground: Ground = "concrete:1.0",
    window_share: Windows = 0.0,
    storey: Storey = 3.0,
    default_height: DefaultHeight = 9.0,
    margin: Margin = 50.0,
    per_building: PerBuilding = False,
) -> None:
    """Make a scene of the buildings of an OpenStreetMap extract."""
    from calibray.cli.progress_bars import progress_bars
    from calibray.scenes.authoring import HeightRule, read_openstreetmap
    from calibray.support.output_files import check_folder

    check_folder(out)
    with progress_bars(log()) as progress:
        progress("reading", 0, None)
        found, frame = read_openstreetmap(extract, _frame(origin, utm), HeightRule(storey, default_height))
        made = _made(
            found, frame, out, terrain, spacing, wall, roof, ground, window_share, margin, per_building, progress,
        )  # fmt: skip
    _tell(made)


@scene.command()
def footprints(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON, Shapefile or GeoPackage.")],
    out: Out,
    height: Annotated[
        str, typer.Option(metavar="COLUMN", help="Column of heights above the ground, or a number [m].")
    ],
    bottom: Annotated[
        str, typer.Option(metavar="COLUMN", help="Column of where they begin, or a number [m].")
    ] = "0",
    levels: Annotated[
        str | None, typer.Option(metavar="COLUMN", help="Column of the numbers of storeys.")
    ] = None,
    name: Annotated[str | None, typer.Option(metavar="COLUMN", help="Column of names.")] = None,
    layer: Annotated[str | None, typer.Option(metavar="NAME", help="Layer of the file.")] = None,
    terrain: Terrain = None,
    spacing: Spacing = None,
    origin: Origin = None,
    utm: Utm = False,
    wall: Wall = "concrete:0.3",
    roof: Roof = "concrete:0.3",
    ground: Ground = "concrete:1.0",
    window_share: Windows = 0.0,
    storey: Storey = 3.0,
    default_height: DefaultHeight = 9.0,
    margin: Margin = 50.0,
    per_building: PerBuilding = False,
) -> None:
    """Make a scene of building footprints with heights."""
    from calibray.cli.progress_bars import progress_bars
    from calibray.scenes.authoring import HeightRule, read_footprints
    from calibray.support.output_files import check_folder

    check_folder(out)
    with progress_bars(log()) as progress:
        progress("reading", 0, None)
        found, frame = read_footprints(
            file, _number_or_column(height), _number_or_column(bottom), name, levels, layer,
            _frame(origin, utm), HeightRule(storey, default_height),
        )  # fmt: skip
        made = _made(
            found, frame, out, terrain, spacing, wall, roof, ground, window_share, margin, per_building, progress,
        )  # fmt: skip
    _tell(made)


@scene.command()
def plan(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="PLAN", help="CSV: x0, y0, x1, y1, type, and thickness, bottom, height if known."
        ),
    ],
    out: Out,
    height: Annotated[float, typer.Option(metavar="M", help="Height of walls that have none [m].")] = 3.0,
    unit: Annotated[
        float, typer.Option(metavar="M", help="The plan's unit of length [m]: 0.001 for mm.")
    ] = 1.0,
    floor: Annotated[bool, typer.Option(help="Make a floor.")] = True,
    ceiling: Annotated[bool, typer.Option(help="Make a ceiling.")] = True,
    merge: Annotated[bool, typer.Option(help="Make one wall of two parallel lines.")] = True,
    material: Annotated[
        list[str] | None,
        typer.Option(metavar="TYPE=ITU[:M]", help="Material of a type of wall; may be repeated."),
    ] = None,
) -> None:
    """Make a scene of a floor plan: one sheet for every wall, door and window."""
    from calibray.cli.progress_bars import progress_bars
    from calibray.scenes.authoring import make_plan_scene, read_plan

    types = _types(material or [])
    with progress_bars(log()) as progress:
        progress("making", 0, None)
        made = make_plan_scene(read_plan(file, height, unit), out, types, floor, ceiling, merge)
    _tell(made)


def _tell(made: MadeScene) -> None:
    """Print what was made."""
    from calibray.reporting import scene_tables as report
    from calibray.tables.text import render

    typer.echo(render(report.made(made)))


def _made(
    found: Footprints,
    frame: Frame,
    out: Path,
    terrain: Path | None,
    spacing: float | None,
    wall: str,
    roof: str,
    ground: str,
    window_share: float,
    margin: float,
    per_building: bool,
    progress: Progress,
) -> MadeScene:
    """A scene of footprints."""
    import numpy as np

    from calibray.scenes.authoring import Palette, lower_origin, make_scene, read_terrain
    from calibray.scenes.authoring import Windows as Division

    palette = Palette(
        wall=_material("walls", wall, 0.3),
        roof=None if roof == "wall" else _material("roofs", roof, 0.3),
        ground=_material("ground", ground, 1.0),
    )
    windows = Division(window_share) if window_share else None
    surface = None
    if terrain is not None:
        bounds = found.bounds + margin * np.array([-1, -1, 1, 1])
        surface, frame = lower_origin(read_terrain(terrain, frame, bounds, spacing), frame)
    typer.echo(f"Making a scene of {len(found)} buildings", err=True)
    progress("making", 0, None)
    return make_scene(found, out, frame, surface, palette, windows, margin, per_building=per_building)


def _frame(origin: str | None, utm: bool) -> Frame | None:
    """The frame about an origin that was given."""
    from calibray.coordinates import Frame

    if origin is None:
        if utm:
            raise InputError("--utm: needs --origin LON,LAT")
        return None
    try:
        longitude, latitude = (float(part) for part in origin.split(","))
    except ValueError:
        raise InputError(f"--origin {origin}: must be longitude and latitude, 11.5755,48.1374") from None
    return Frame.utm(longitude, latitude) if utm else Frame.local(longitude, latitude)


def _types(given: list[str]) -> dict[str, SurfaceMaterial]:
    """Materials by type of wall, from words such as `drywall=plasterboard:0.1`."""
    from calibray.scenes.authoring import WALL_THICKNESS

    types = {}
    for words in given:
        kind, parted, constants = words.partition("=")
        if not parted:
            raise InputError(f"--material {words}: must be TYPE=ITU, for instance drywall=plasterboard:0.1")
        types[kind] = _material(kind, constants, WALL_THICKNESS)
    return types


def _number_or_column(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _material(name: str, text: str, thickness: float) -> SurfaceMaterial:
    """A material from a P.2040 name and, after a colon, a thickness [m]."""
    from calibray.scenes.authoring import SurfaceMaterial

    itu, parted, given = text.partition(":")
    try:
        return SurfaceMaterial(name, itu, float(given) if parted else thickness)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"material {text!r}: {given!r} is no thickness in metres") from None
