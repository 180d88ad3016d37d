"""Make the example flat: a hand-drawn floor plan, and the power that a laptop receives from three access points.

    python examples/bring_your_own/make_flat.py

Everything is synthetic, so the truth is known: `flat/truth.json` contains the materials of the walls and the EIRP of
the access points. A calibration sees only `flat/plan.csv`, `flat/access_points.csv` and `flat/rss.csv`.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from calibray.scenes.authoring import make_plan_scene, merge_faces, read_plan
from synthetic import amplitudes, sample

FOLDER = Path(__file__).parent / "flat"
SEED = 34
FREQUENCY = 2.44e9  # [Hz]
DEPTH = 4
HEIGHT = 1.5  # [m]
SAMPLES = 30  # per value; the laptop averages them while it is turned

PLANTED = {
    "brick_wall": {"relative_permittivity": 5.1, "conductivity": 0.06},
    "plasterboard_wall": {"relative_permittivity": 2.2, "conductivity": 0.03},
}
EIRP_DBM = {"ap1": 17.0, "ap2": 14.5, "ap3": 20.0}  # unknown to the user
ACCESS_POINTS = {"ap1": (0.6, 0.7, 2.2), "ap2": (9.4, 6.1, 2.3), "ap3": (4.6, 6.4, 1.1)}  # [m]
WALLS = [
    (0, 0, 10, 0, "brick", 0.24), (10, 0, 10, 7, "brick", 0.24), (10, 7, 0, 7, "brick", 0.24),
    (0, 7, 0, 0, "brick", 0.24), (5.5, 0, 5.5, 2.8, "brick", 0.24), (5.5, 3.8, 5.5, 7, "brick", 0.24),
    (0, 3.6, 1.8, 3.6, "plasterboard", 0.1), (2.8, 3.6, 5.5, 3.6, "plasterboard", 0.1),
    (5.5, 4.3, 8.2, 4.3, "plasterboard", 0.1), (9.2, 4.3, 10, 4.3, "plasterboard", 0.1),
]  # fmt: skip


def spots() -> np.ndarray:
    """Positions of the laptop, x and y [n, 2], [m]."""
    return np.array([(x, y) for x in (0.9, 2.3, 3.7, 4.8, 6.4, 7.7, 9.0) for y in (0.9, 2.4, 4.9, 6.2)])


def received() -> list[list[np.ndarray]]:
    """Amplitudes of the paths from every access point to every spot, in the scene of the plan."""
    places = np.column_stack([spots(), np.full(len(spots()), HEIGHT)])
    with TemporaryDirectory() as folder:
        sheets = merge_faces(read_plan(FOLDER / "plan.csv", 2.6)).sheets
        scene = make_plan_scene(sheets, folder).path
        return amplitudes(
            scene, list(ACCESS_POINTS.values()), places, FREQUENCY, PLANTED, max_depth=DEPTH, samples=500_000,
            refraction=True,
        )  # fmt: skip


def measure(gains: list[list[np.ndarray]], rng: np.random.Generator) -> pd.DataFrame:
    """Power shown by the laptop at every spot, one column per access point [dBm]."""
    table = pd.DataFrame(spots(), columns=["x", "y"])
    for point, (name, eirp) in enumerate(EIRP_DBM.items()):
        power = [
            np.mean([10 ** (sample(gains[point][spot], eirp, rng) / 10) for _ in range(SAMPLES)])
            for spot in range(len(table))
        ]
        table[f"rss_{name}"] = np.round(10 * np.log10(power), 1)
    return table


def main() -> None:
    """Write the plan, the values, the access points and the truth."""
    FOLDER.mkdir(exist_ok=True)
    plan = pd.DataFrame(WALLS, columns=["x0", "y0", "x1", "y1", "type", "thickness"])
    plan.to_csv(FOLDER / "plan.csv", index=False, lineterminator="\n")
    table = measure(received(), np.random.default_rng(SEED))
    table.to_csv(FOLDER / "rss.csv", index=False, lineterminator="\n")
    points = pd.DataFrame(list(ACCESS_POINTS.values()), columns=["x", "y", "z"])
    points.insert(0, "ap", list(ACCESS_POINTS))
    points.to_csv(FOLDER / "access_points.csv", index=False, lineterminator="\n")
    truth = {"frequency": FREQUENCY, "eirp_dbm": EIRP_DBM, "materials": PLANTED}
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=2) + "\n")


if __name__ == "__main__":
    main()
