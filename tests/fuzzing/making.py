"""Attacks on the files that scenes are made of: footprints and floor plans."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from random import Random

from calibray.scenes.authoring import make_plan_scene, make_scene, read_footprints, read_plan
from fuzzing.mutations import damage
from fuzzing.outcome import Case
from fuzzing.world import World

_VALUES = ("nan", "inf", "-1", "1e300", "1e12", "0", "9" * 400, "x", "", "12 ft", "2020")
_SQUARE = [[11.5, 48.1], [11.5002, 48.1], [11.5002, 48.1001], [11.5, 48.1001], [11.5, 48.1]]
_REFERENCES = (
    '<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/etc/passwd</SrcDataSource></OGRVRTLayer>'
    "</OGRVRTDataSource>",
    '{"type": "gdal_streamed_alg", "command_line": "gdal vector convert /etc/passwd"}',
    '{"type": "FeatureCollection", "features": 3}',
    "[" * 100_000,
    '{"type": "FeatureCollection", "features": [' + "{" * 50 + "}" * 50 + "]}",
)


def making(rng: Random, found: World, folder: Path) -> Case:
    """A scene made of a damaged or senseless map or plan, as far as its bounds."""
    return (_footprints if rng.random() < 0.6 else _plan)(rng, folder)


def _footprints(rng: Random, folder: Path) -> Case:
    file = folder / f"town.{rng.choice(('geojson', 'gpkg', 'shp', 'json'))}"
    margin = rng.choice((50.0, 50.0, 0.0, 0.0, -1000.0, float("nan"), float("inf"), 1e6))
    height: str | float = rng.choice(("h", "h", 8.0, 8.0, 8.0, "2020", float("nan"), 1e300))
    case = rng.randrange(4)
    if case == 0:
        note, content = "reference", rng.choice(_REFERENCES).encode()
    else:
        east, north = rng.choice(
            ((0, 0), (0, 0), (-11.5, -48.1), (-191.5, 0), (168.4999, 0), (0, 41.9), (400, 0))
        )
        far = [[x + east, y + north] for x, y in _SQUARE]
        value = rng.choice(_VALUES)
        features = [
            {
                "type": "Feature",
                "properties": {"h": 9.0},
                "geometry": {"type": "Polygon", "coordinates": [_SQUARE]},
            },
            {
                "type": "Feature",
                "properties": {"h": value},
                "geometry": {"type": "Polygon", "coordinates": [far]},
            },
        ]
        crs = rng.choice(
            (None, None, None, "urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:999999", "EPSG:5773", "EPSG:25832")
        )
        record: dict[str, object] = {"type": "FeatureCollection", "features": features}
        if crs is not None:
            record["crs"] = {"type": "name", "properties": {"name": crs}}
        content, note = (
            json.dumps(record).encode(),
            f"{value[:20]!r} at {east}, {north} in {crs}, margin {margin}",
        )
        if case == 1:
            content, note = damage(rng, content), "bytes"
    file.write_bytes(content)

    def act() -> list[float]:
        buildings, frame = read_footprints(file, height)
        made = make_scene(buildings, folder / "out", frame, margin=margin)
        return list(made.bounds)

    names = (
        file.name,
        "margin",
        "building",
        "height",
        "crs",
        "longitude",
        "latitude",
        "position",
        "projection",
    )
    return Case("making", f"footprints: {note}", act, damaged=case == 0, names=names, own=("out",))


def _plan(rng: Random, folder: Path) -> Case:
    file = folder / f"plan.{rng.choice(('csv', 'csv', 'csv.gz', 'zip', 'csv.xz', 'tar'))}"
    rows = [["0", "0", "4", "0"], ["4", "0", "4", "3"], ["4", "3", "0", "3"], ["0", "3", "0", "0"]]
    rows = rows[: rng.choice((1, 2, 4, 4))]
    if rng.random() < 0.6:
        rng.choice(rows)[rng.randrange(4)] = rng.choice(_VALUES)
    lines = ["x0,y0,x1,y1,type,thickness,height"]
    lines += [
        ",".join([*row, "brick", rng.choice(("", "", "", "0.2", "0.2", "1e20", "nan")), ""]) for row in rows
    ]
    content = "\n".join([*lines, ""]).encode()
    if rng.random() < 0.3:
        content = gzip.compress(content) if rng.random() < 0.5 else damage(rng, content)
    file.write_bytes(content)
    height = rng.choice((3.0, 3.0, 3.0, 3.0, 3.0, float("nan"), float("inf"), 1e300, -1.0))

    def act() -> list[float]:
        return list(make_plan_scene(read_plan(file, height), folder / "out").bounds)

    names = ("plan", "height", "thickness")
    return Case("making", f"plan: {len(rows)} walls, height {height}", act, names=names, own=("out",))
