"""OpenStreetMap extracts: the buildings of an .osm or .pbf file.

Read with pyosmium, OpenStreetMap's own library: it assembles multipolygon relations with their holes as the map's
rules say, takes both formats, and gives every tag; GDAL's driver hides `building:levels` in a text of other tags.
Nothing is fetched: an extract comes from any of the usual download services.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from calibray.coordinates import WGS84, Frame
from calibray.errors import InputError
from calibray.scenes.authoring.footprints import Footprints, HeightRule, cleaned, in_frame
from calibray.support.extras import library

_KEYS: Final = ("building", "building:part")


def read_openstreetmap(
    path: str | Path, frame: Frame | None = None, rule: HeightRule | None = None
) -> tuple[Footprints, Frame]:
    """Read the buildings of an extract: closed ways and multipolygon relations tagged `building` or `building:part`.

    Args:
        path: The extract, .osm or .osm.pbf.
        frame: The scene's frame; without one, the local frame centred on the buildings.
        rule: How high a building is whose height is not given.

    Returns:
        The footprints, and the frame that they are in.

    Raises:
        InputError: The file does not exist, is no extract, holds no building, or pyosmium is not installed.
    """
    path, rule = Path(path), rule or HeightRule()
    osmium, shapely = library("osmium", "scenes"), library("shapely", "scenes")
    if not path.is_file():
        raise InputError(f"extract {path}: does not exist; check the path")
    wanted = osmium.filter.KeyFilter(*_KEYS)
    geometry = osmium.geom.WKBFactory()
    outlines, names, tags = [], [], []
    announced = 0
    try:
        for item in osmium.FileProcessor(path).with_areas(wanted).with_filter(wanted):
            if item.tags.get("building") == "no" or item.tags.get("location") == "underground":
                continue
            if item.is_area():
                outlines.append(shapely.from_wkb(geometry.create_multipolygon(item)))
                names.append(f"{'way' if item.from_way() else 'relation'}-{item.orig_id()}")
                tags.append({tag.k: tag.v for tag in item.tags})
            elif item.is_way() or item.is_relation():
                announced += item.is_relation() or item.is_closed()
    except (RuntimeError, ValueError, osmium.InvalidLocationError) as error:
        raise InputError(f"extract {path}: cannot be read ({error}); give an .osm or .osm.pbf file") from None
    if not outlines:
        raise InputError(f"extract {path}: holds no complete building; choose an extract that covers some")
    degrees = np.array(outlines, dtype=object)
    if frame is None:
        west, south, east, north = shapely.total_bounds(degrees)
        frame = Frame.local((west + east) / 2, (south + north) / 2)
    heights = [rule.heights(each) for each in tags]
    incomplete = announced - len(outlines)
    return cleaned(
        Footprints(
            polygon=in_frame(degrees, frame, WGS84),
            bottom=np.array([bottom for bottom, _, _ in heights]),
            top=np.array([top for _, top, _ in heights]),
            name=tuple(names),
            height_from=tuple(source for _, _, source in heights),
            part=np.array(["building:part" in each for each in tags]),
            repairs={"incomplete in the extract, left out": incomplete} if incomplete > 0 else {},
        )
    ), frame
