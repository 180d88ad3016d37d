"""Make the example town: a map in OpenStreetMap's format, and the logs of two phones carried through the town.

    python examples/bring_your_own/make_town.py

Everything is synthetic, so the truth is known: `truth.json` contains the materials of the walls and the ground, the
EIRP of the cells, the gains of the phones, the noise floor and the error of recorded positions. A calibration sees only
`town.osm`, `rsrp.csv` and `cells.csv`. All random numbers come from one seed, so the script always writes the same
files on the same machine.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd

from calibray.coordinates import Frame
from calibray.scenes.authoring import make_scene, read_openstreetmap
from synthetic import amplitudes, sample

HERE = Path(__file__).parent
SEED = 12
FRAME = Frame.local(9.99, 50.01)
FREQUENCY = 3.6e9  # [Hz]
DEPTH = 3

WALLS = {"relative_permittivity": 6.6, "conductivity": 0.12}
GROUND = {"relative_permittivity": 3.6, "conductivity": 0.05}
EIRP_DBM = {"cell-1": -22.0, "cell-2": -19.5}  # of one resource element, unknown to the user
PHONE_DB = {"phone-a": 0.0, "phone-b": -4.0}
MASTS = {"cell-1": (-35.0, 2.0, 6.0), "cell-2": (32.0, -48.0, 6.0)}  # [m], lamp posts in two streets
FLOOR_DBM = -118.0  # [dBm], below which a phone reports nothing
PHONE_HEIGHT = 1.5  # [m]
GPS_ERROR = 0.5  # [m], standard deviation in x and in y
SAMPLES = 10  # per phone and stop
PLAIN = {"building": "yes"}


def houses() -> list[tuple[list[tuple[float, float]], dict[str, str]]]:
    """Outlines [m] and tags of houses along two streets, one from west to east and one from north to south."""
    box = lambda west, south, east, north: [(west, south), (east, south), (east, north), (west, north)]  # noqa: E731
    return [
        (box(-90, 10, -62, 24), {**PLAIN, "height": "14"}),
        (box(-62, 10, -40, 24), {**PLAIN, "height": "11.5 m"}),
        (box(-32, 10, 2, 26), {**PLAIN, "building:levels": "5"}),
        (box(10, 10, 24, 40), {**PLAIN, "height": "17"}),
        ([(40, 10), (80, 10), (80, 24), (54, 24), (54, 44), (40, 44)], {**PLAIN, "height": "15"}),
        (box(-90, -26, -48, -10), {**PLAIN, "building:levels": "4"}),
        (box(-40, -24, -8, -10), {**PLAIN, "height": "12.5"}),
        (box(-8, -24, 24, -10), PLAIN),
        (box(10, -70, 24, -24), {**PLAIN, "height": "16"}),
        (box(40, -36, 86, -10), {**PLAIN, "height": "13"}),
        (box(40, -75, 56, -36), {**PLAIN, "building:levels": "6"}),
    ]


def write_map(path: Path) -> None:
    """Write the extract."""
    corners: dict[tuple[float, float], int] = {}
    ways = []
    for number, (ring, tags) in enumerate(houses(), start=1):
        nodes = [corners.setdefault(corner, len(corners) + 1) for corner in ring]
        refs = "".join(f'<nd ref="{node}"/>' for node in [*nodes, nodes[0]])
        tag_text = "".join(f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items())
        ways.append(f' <way id="{number}" version="1">{refs}{tag_text}</way>')
    degrees = FRAME.to_geographic([(*corner, 0.0) for corner in corners])
    nodes = [
        f' <node id="{number}" version="1" lat="{latitude:.7f}" lon="{longitude:.7f}"/>'
        for number, (longitude, latitude, _) in enumerate(degrees, start=1)
    ]
    lines = ['<osm version="0.6" generator="calibray example">', *nodes, *ways, "</osm>", ""]
    path.write_text("\n".join(lines))


def stops() -> np.ndarray:
    """Positions of the phones, x and y [n, 2], [m]: up and down both streets."""
    east = [(x, y) for x in range(-85, 81, 6) for y in (-6.0, 6.5)]
    north = [(x, y) for y in [*range(-70, -14, 6), *range(16, 41, 6)] for x in (27.5, 36.0)]
    return np.array(east + north, dtype=float)


def stopped(scene: Path) -> tuple[np.ndarray, list[list[np.ndarray]]]:
    """The stops [n, 3], [m], and the amplitudes of the paths from every mast to each."""
    places = np.column_stack([stops(), np.full(len(stops()), PHONE_HEIGHT)])
    planted = {"walls": WALLS, "ground": GROUND}
    masts = list(MASTS.values())
    return places, amplitudes(scene, masts, places, FREQUENCY, planted, max_depth=DEPTH, samples=500_000)


def measure(extract: Path, rng: np.random.Generator) -> pd.DataFrame:
    """Carry the phones through the town."""
    with TemporaryDirectory() as folder:
        found, frame = read_openstreetmap(extract, FRAME)
        made = make_scene(found, Path(folder), frame)
        places, gains = stopped(made.path)
    rows = []
    clock = pd.Timestamp("2026-05-04T09:00:00Z")
    for stop, place in enumerate(places):
        for phone, gain_db in PHONE_DB.items():
            recorded = place + np.append(rng.normal(0.0, GPS_ERROR, 2), 0.0)
            longitude, latitude, _ = FRAME.to_geographic(recorded)
            for _ in range(SAMPLES):
                clock += pd.Timedelta(seconds=1)
                for number, (cell, eirp) in enumerate(EIRP_DBM.items()):
                    rsrp = sample(gains[number][stop], eirp + gain_db, rng)
                    received = round(rsrp, 1) if rsrp > FLOOR_DBM else None
                    rows.append(
                        (clock.isoformat(), phone, f"{longitude:.7f}", f"{latitude:.7f}", cell, received)
                    )
    return pd.DataFrame(rows, columns=["time", "device", "longitude", "latitude", "cell", "rsrp_dbm"])


def main() -> None:
    """Write the map, the log, the cells and the truth."""
    write_map(HERE / "town.osm")
    log = measure(HERE / "town.osm", np.random.default_rng(SEED))
    log.to_csv(HERE / "rsrp.csv", index=False, lineterminator="\n")
    cells = FRAME.to_geographic(list(MASTS.values()))
    table = pd.DataFrame(cells, columns=["longitude", "latitude", "height"])
    table.insert(0, "cell", list(MASTS))
    table.to_csv(HERE / "cells.csv", index=False, float_format="%.7f", lineterminator="\n")
    truth = {
        "frequency": FREQUENCY, "walls": WALLS, "ground": GROUND, "eirp_dbm": EIRP_DBM, "phone_db": PHONE_DB,
        "floor_dbm": FLOOR_DBM, "gps_error": GPS_ERROR,
    }  # fmt: skip
    (HERE / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


if __name__ == "__main__":
    main()
