"""Make the example hill: houses on a slope, and the log of a scanner carried past them along a GPX track.

    python examples/bring_your_own/make_hill.py

Everything is synthetic, so the truth is known: `hill/truth.json` contains the materials of walls and ground and the
EIRP of the mast. A calibration sees only the other files: `houses.geojson`, footprints with heights; `ground.tif`, a
height model above sea level; `walk.gpx`, a point every five seconds; `power.csv`, five values per second without
positions; `masts.csv`, the mast's position and its height above the ground.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import rasterio
from rasterio.transform import from_origin

from calibray.coordinates import Frame
from calibray.scenes.authoring import lower_origin, make_scene, read_footprints, read_terrain
from calibray.scenes.checks import SceneSurfaces
from synthetic import amplitudes, sample

FOLDER = Path(__file__).parent / "hill"
SEED = 56
FRAME = Frame.local(9.99, 50.01)
FREQUENCY = 2.1e9  # [Hz]
DEPTH = 3
PLANTED = {
    "walls": {"relative_permittivity": 4.4, "conductivity": 0.08},
    "ground": {"relative_permittivity": 6.8, "conductivity": 0.07},
}
MAST = (-6.0, 0.0, 8.0)  # [m], its height above the ground
EIRP_DBM = 31.0  # unknown to the user
FLOOR_DBM = -115.0  # [dBm], below which the scanner reports nothing
SPEED, RATE, TRACKED = 1.2, 5, 5  # [m/s], values per second, [s] between track points
GPS_ERROR = 0.4  # [m], standard deviation in x and in y
HEIGHT = 1.5  # [m]
START = pd.Timestamp("2026-05-04T09:00:00Z")
HOUSES = [
    (-70, 10, -40, 24, 8.0), (-30, 12, 5, 26, 10.5), (15, 10, 40, 25, 7.5), (48, 12, 75, 30, 12.0),
    (-60, -28, -25, -12, 9.0), (-12, -30, 20, -14, 11.0), (30, -26, 70, -11, 8.5),
]  # fmt: skip
CORNERS = [(-78, -6), (-20, -6), (22, 4), (84, 2), (84, -4), (10, -8)]
"""Corners of the track, x and y [m]: up the street, then halfway back."""


def write_houses() -> None:
    """Write the footprints."""
    features = []
    for west, south, east, north, height in HOUSES:
        ring = [(west, south), (east, south), (east, north), (west, north), (west, south)]
        degrees = FRAME.to_geographic([(*corner, 0.0) for corner in ring])[:, :2].round(7).tolist()
        geometry = {"type": "Polygon", "coordinates": [degrees]}
        features.append({"type": "Feature", "properties": {"height_m": height}, "geometry": geometry})
    collection = {"type": "FeatureCollection", "features": features}
    (FOLDER / "houses.geojson").write_text(json.dumps(collection) + "\n")


def write_ground() -> None:
    """Write the height model: 240 m above sea level, rising to the north-east, with a bump."""
    west, south = FRAME.to_geographic([(-240.0, -240.0, 0.0)])[0][:2]
    east, north = FRAME.to_geographic([(240.0, 240.0, 0.0)])[0][:2]
    count = 17
    x = y = np.linspace(-240.0, 240.0, count)
    heights = 240 + 0.05 * x[None, :] + 0.03 * y[::-1, None]
    heights = heights + 4 * np.exp(-((x[None, :] - 30) ** 2 + (y[::-1, None] - 30) ** 2) / 60**2)
    step = (east - west) / (count - 1), (north - south) / (count - 1)
    place = from_origin(west - step[0] / 2, north + step[1] / 2, *step)
    with rasterio.open(
        FOLDER / "ground.tif", "w", driver="GTiff", width=count, height=count, count=1, dtype="float32",
        crs="EPSG:4326", transform=place, compress="deflate",
    ) as file:  # fmt: skip
        file.write(heights.astype("float32"), 1)


def way(seconds: np.ndarray) -> np.ndarray:
    """Positions of the scanner, x and y [n, 2], [m]."""
    corners = np.array(CORNERS, dtype=float)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    return np.stack([np.interp(SPEED * seconds, along, corners[:, axis]) for axis in (0, 1)], axis=1)


def duration() -> int:
    """Duration of the walk [s]."""
    length = np.linalg.norm(np.diff(np.array(CORNERS), axis=0), axis=1).sum()
    return int(length / SPEED)


def received() -> list[np.ndarray]:
    """Amplitudes of the paths from the mast to the scanner's position in the middle of every second."""
    with TemporaryDirectory() as folder:
        found, frame = read_footprints(FOLDER / "houses.geojson", "height_m")
        bounds = found.bounds + 50 * np.array([-1, -1, 1, 1])
        terrain, frame = lower_origin(read_terrain(FOLDER / "ground.tif", frame, bounds), frame)
        scene = make_scene(found, Path(folder), frame, terrain).path
        overhead = SceneSurfaces.read(scene)

        def placed(points: np.ndarray, height: float) -> np.ndarray:
            """Convert positions from `FRAME` to the frame of the scene, with heights above its ground."""
            degrees = FRAME.to_geographic(np.column_stack([points, np.zeros(len(points))]))
            place = frame.to_scene(degrees[:, 0], degrees[:, 1], 0.0)
            place[:, 2] = overhead.ground_height(place[:, 0], place[:, 1]) + height
            return place

        mast = placed(np.array([MAST[:2]]), MAST[2])
        places = placed(way(np.arange(duration()) + 0.5), HEIGHT)
        return amplitudes(scene, mast, places, FREQUENCY, PLANTED, max_depth=DEPTH, samples=200_000)[0]


def measure(gains: list[np.ndarray], rng: np.random.Generator) -> pd.DataFrame:
    """The table that the scanner writes."""
    rows = []
    for value in range(duration() * RATE):
        # Within one second, amplitudes are constant and phases random.
        power = sample(gains[value // RATE], EIRP_DBM, rng)
        loud = round(power, 1) if power > FLOOR_DBM else None
        rows.append(((START + pd.Timedelta(seconds=value / RATE)).isoformat(), "mast-1", loud))
    return pd.DataFrame(rows, columns=["time", "mast", "power_dbm"])


def track(rng: np.random.Generator) -> str:
    """The GPX track that the satellite receiver writes."""
    seconds = np.arange(0, duration() + TRACKED, TRACKED)
    recorded = way(seconds) + rng.normal(0.0, GPS_ERROR, (len(seconds), 2))
    degrees = FRAME.to_geographic(np.column_stack([recorded, np.zeros(len(seconds))]))
    points = [
        f'<trkpt lat="{latitude:.7f}" lon="{longitude:.7f}"><time>{START + pd.Timedelta(seconds=int(second)):%FT%TZ}'
        "</time></trkpt>"
        for second, (longitude, latitude, _) in zip(seconds, degrees, strict=True)
    ]
    head = '<gpx version="1.1" creator="calibray example"><trk><trkseg>'
    return "\n".join([head, *points, "</trkseg></trk></gpx>", ""])


def main() -> None:
    """Write the map, the log and the truth."""
    FOLDER.mkdir(exist_ok=True)
    write_houses()
    write_ground()
    rng = np.random.default_rng(SEED)
    measure(received(), rng).to_csv(FOLDER / "power.csv", index=False, lineterminator="\n")
    (FOLDER / "walk.gpx").write_text(track(rng))
    longitude, latitude, _ = FRAME.to_geographic([(*MAST[:2], 0.0)])[0]
    (FOLDER / "masts.csv").write_text(
        f"mast,longitude,latitude,height\nmast-1,{longitude:.7f},{latitude:.7f},{MAST[2]:g}\n"
    )
    truth = {
        "frequency": FREQUENCY,
        "eirp_dbm": EIRP_DBM,
        "floor_dbm": FLOOR_DBM,
        "materials": PLANTED,
        "gps_error": GPS_ERROR,
    }
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


if __name__ == "__main__":
    main()
