"""Maps whose truth is known: footprints planted in metres about a place, written as an extract or a layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely

from calibray.coordinates import Frame
from calibray.scenes.authoring import Footprints, HeightSource, clean_footprints

FRAME = Frame.local(11.5755, 48.1374)
Ring = Sequence[tuple[float, float]]

L_SHAPE = shapely.Polygon(
    [(0, 0), (30, 0), (30, 10), (12, 10), (12, 40), (0, 40)], [[(3, 3), (3, 8), (9, 8), (9, 3)]]
)
"""An L-shaped building with a courtyard: 300 + 360 - 30 = 630 m^2."""


def footprints(
    polygons: Sequence[shapely.Geometry],
    tops: Sequence[float],
    bottoms: Sequence[float] | None = None,
    part: Sequence[bool] | None = None,
    names: Sequence[str] | None = None,
) -> Footprints:
    """Footprints of known heights."""
    count = len(polygons)
    sources: tuple[HeightSource, ...] = ("height",) * count
    return clean_footprints(
        Footprints(
            polygon=np.array(polygons, dtype=object),
            bottom=np.zeros(count) if bottoms is None else np.array(bottoms, dtype=float),
            top=np.array(tops, dtype=float),
            name=tuple(names or [f"b{index}" for index in range(count)]),
            height_from=sources,
            part=np.zeros(count, dtype=bool) if part is None else np.array(part),
            repairs={},
        )
    )


def write_extract(
    path: Path,
    ways: Sequence[tuple[Ring, Mapping[str, str]]],
    relations: Sequence[tuple[Sequence[tuple[str, int]], Mapping[str, str]]] = (),
    frame: Frame = FRAME,
    points: Sequence[tuple[tuple[float, float], Mapping[str, str]]] = (),
    lines: Sequence[tuple[Ring, Mapping[str, str]]] = (),
) -> Path:
    """Write an OpenStreetMap extract.

    Args:
        path: The .osm file.
        ways: Closed ways, numbered from 1: corners [m] without the first repeated, and tags.
        relations: Multipolygons, numbered from 1: roles and numbers of their ways, and tags.
        frame: Where the corners lie.
        points: Places [m] and tags of nodes.
        lines: Open ways, numbered after the closed ones: corners [m], and tags.

    Returns:
        The file.
    """
    nodes: dict[tuple[float, float], int] = {}
    written = []
    for number, (ring, tags) in enumerate((*ways, *lines), start=1):
        references = [nodes.setdefault(tuple(corner), len(nodes) + 1) for corner in ring]
        closed = [*references, references[0]] if number <= len(ways) else references
        refs = "".join(f'<nd ref="{node}"/>' for node in closed)
        written.append(f'<way id="{number}" version="1">{refs}{_tags(tags)}</way>')
    tags_of = {nodes.setdefault(place, len(nodes) + 1): _tags(tags) for place, tags in points}
    for number, (members, tags) in enumerate(relations, start=1):
        refs = "".join(f'<member type="way" ref="{way}" role="{role}"/>' for role, way in members)
        tagged = _tags({"type": "multipolygon", **tags})
        written.append(f'<relation id="{number}" version="1">{refs}{tagged}</relation>')
    degrees = frame.to_geographic([(*corner, 0.0) for corner in nodes])
    places = [
        f'<node id="{node}" version="1" lat="{latitude:.9f}" lon="{longitude:.9f}">{tags_of.get(node, "")}</node>'
        for node, (longitude, latitude, _) in zip(nodes.values(), degrees, strict=True)
    ]
    path.write_text(f'<osm version="0.6" generator="test">{"".join(places)}{"".join(written)}</osm>')
    return path


def write_park(path: Path) -> Path:
    """Write a house with two trees, a row, a wood and a forest with a clearing next to it, and a forest far away."""

    def rectangle(west: float, south: float, east: float, north: float) -> Ring:
        return [(west, south), (east, south), (east, north), (west, north)]

    return write_extract(
        path,
        [
            (rectangle(0, 0, 20, 20), {"building": "yes"}),
            (rectangle(40, 0, 60, 20), {"natural": "wood", "height": "18"}),
            (rectangle(9000, 0, 9020, 20), {"landuse": "forest"}),
            (rectangle(0, 30, 60, 60), {}),
            (rectangle(20, 40, 40, 50), {}),
        ],
        [([("outer", 4), ("inner", 5)], {"landuse": "forest"})],
        points=[
            ((30, 5), {"natural": "tree", "height": "12 m", "diameter_crown": "8"}),
            ((30, 15), {"natural": "tree", "height": "400"}),
            ((30, 17), {"natural": "stone"}),
        ],
        lines=[([(0, -10), (50, -10)], {"natural": "tree_row", "height": "4"})],
    )


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items())
