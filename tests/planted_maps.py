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
) -> Path:
    """Write an OpenStreetMap extract.

    Args:
        path: The .osm file.
        ways: Closed ways, numbered from 1: corners [m] without the first repeated, and tags.
        relations: Multipolygons, numbered from 1: roles and numbers of their ways, and tags.
        frame: Where the corners lie.

    Returns:
        The file.
    """
    nodes: dict[tuple[float, float], int] = {}
    lines = []
    for number, (ring, tags) in enumerate(ways, start=1):
        references = [nodes.setdefault(tuple(corner), len(nodes) + 1) for corner in ring]
        refs = "".join(f'<nd ref="{node}"/>' for node in [*references, references[0]])
        lines.append(f'<way id="{number}" version="1">{refs}{_tags(tags)}</way>')
    for number, (members, tags) in enumerate(relations, start=1):
        refs = "".join(f'<member type="way" ref="{way}" role="{role}"/>' for role, way in members)
        tagged = _tags({"type": "multipolygon", **tags})
        lines.append(f'<relation id="{number}" version="1">{refs}{tagged}</relation>')
    degrees = frame.to_geographic([(*corner, 0.0) for corner in nodes])
    places = [
        f'<node id="{node}" version="1" lat="{latitude:.9f}" lon="{longitude:.9f}"/>'
        for node, (longitude, latitude, _) in zip(nodes.values(), degrees, strict=True)
    ]
    path.write_text(f'<osm version="0.6" generator="test">{"".join(places)}{"".join(lines)}</osm>')
    return path


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items())
