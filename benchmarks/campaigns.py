"""Check that the measured campaigns agree with their descriptions.

    CALIBRAY_DATA=FOLDER python benchmarks/campaigns.py

The measured data are not part of the repository, so this check is not a test. It prints the comparisons; the exit
status is 1 if something differs.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from scipy.constants import speed_of_light

from calibray.measurements import read_measurements
from calibray.tables import Column, Table, render


def boulder(folder: Path) -> dict[str, bool]:
    """Downtown Boulder, 28.5 GHz: 133 rows, 117 of them with a fixed position; two of these are one link."""
    arguments = {
        "tx": [0.0, 0.0, 2.5],
        "rx": ["rx_x_m", "rx_y_m", 1.6],
        "value": "pl_total_db",
        "group": "set",
    }
    links = read_measurements(folder / "links.csv", **arguments)
    fixed = read_measurements(folder / "links.csv", where="gpsmode == 4", **arguments)
    free_space = 20 * np.log10(4 * np.pi * links.distance * 28.5e9 / speed_of_light)
    excess = (links.path_loss_db - free_space)[links.where("set == 'LOS'")]
    counted = dict(zip(*np.unique(np.asarray(links.group), return_counts=True), strict=True))
    return {
        "132 links of 133 rows, 50 of them in sight": len(links) + sum(links.prepared.values()) == 133
        and counted == {"LOS": 50, "NLOS": 82},
        # The campaign's own distances are from raw GPS.
        "distances are the campaign's to 3 %": np.allclose(
            links.distance, links.frame["dist3d_m"], rtol=0.03
        ),
        "in sight: free space less 2 dBi, to 1 dB": bool(abs(np.median(excess) + 2) < 1),
        "116 links have a fixed position": bool(len(fixed) == (links.frame["gpsmode"] == 4).sum() == 116),
    }


def auckland(folder: Path) -> dict[str, bool]:
    """A tower's floor in Auckland, 1.88 GHz: 104 links from two transmitters."""
    links = read_measurements(
        folder / "links.csv",
        tx=["tx_x_m", "tx_y_m", "tx_z_m"],
        rx=["rx_x_m", "rx_y_m", "rx_z_m"],
        value="path_gain_db",
        quantity="path_gain",
        std="sample_std_db",
        group="tx_id",
    )
    return {
        "104 links of transmitters 5 and 6": len(links) == 104 and links.group_names == ("5", "6"),
        "distances are the campaign's to 2 mm": np.allclose(
            links.distance, links.frame["dist3d_m"], rtol=0, atol=2e-3
        ),
        "path loss is path gain turned around": np.array_equal(
            links.path_loss_db, -links.frame["path_gain_db"]
        ),
    }


def main() -> None:
    """Print the comparisons, and exit with a status of 1 if one fails."""
    data = Path(os.environ.get("CALIBRAY_DATA", Path(__file__).parents[2] / "shared" / "data"))
    found = [
        (name, shown, right)
        for name, campaign in (("nist_boulder", boulder), ("auckland_tower", auckland))
        for shown, right in campaign(data / name).items()
    ]
    rows = [(name, shown, "yes" if right else "NO") for name, shown, right in found]
    columns = tuple(Column(name) for name in ("campaign", "what its description says", "holds"))
    print(render(Table("Campaigns", columns, tuple(rows))))
    sys.exit(not all(right for *_, right in found))


if __name__ == "__main__":
    main()
