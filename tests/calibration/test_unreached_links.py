"""Links without a path are counted, and the switches that reach them are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

import calibray as cb
from calibray.calibration.result import Result
from calibray.result import RemarkKind
from small_scenes import block, write_scene

BEHIND = 6


def calibrated(folder: Path, **trace: object) -> Result:
    """A calibration of the ground beside one house; `BEHIND` receivers are in its shadow."""
    ground = [[(-80.0, -80.0, 0.0), (80.0, -80.0, 0.0), (80.0, 80.0, 0.0), (-80.0, 80.0, 0.0)]]
    scene = write_scene(folder, {"ground": ground, "house": block((-10, -20, 0), (10, 20, 15))})
    number = np.arange(8)
    seen = np.stack([np.full(8, -20.0 - 4 * number), 3.0 * number - 10, np.full(8, 1.5)], axis=1)
    hidden = np.stack([np.full(BEHIND, 14.0), 2.0 * number[:BEHIND] - 5, np.full(BEHIND, 1.5)], axis=1)
    rx = np.concatenate([seen, hidden])
    table = pd.DataFrame(rx, columns=["rx_x", "rx_y", "rx_z"]).assign(tx_x=-20.0, tx_y=60.0, tx_z=6.0)
    table["path_loss_db"] = 90.0 + np.arange(len(rx)) % 3
    table.to_csv(folder / "links.csv", index=False)
    study = {
        "version": 1,
        "scene": {"file": scene.name, "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": ["tx_x", "tx_y", "tx_z"], "rx": ["rx_x", "rx_y", "rx_z"],
                  "value": "path_loss_db"},
        "antennas": {end: {"pattern": "iso", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 1, "samples": 20_000, **trace},
        "parameters": {"stone.relative_permittivity": {"bounds": [2.0, 12.0]}},
    }  # fmt: skip
    return cb.calibrate(cb.Study.from_content(study, folder / "study.toml"))


def test_many_links_without_a_path_are_reported_with_the_switch_that_reaches_them(tmp_path: Path) -> None:
    result = calibrated(tmp_path)
    (remark,) = (part for part in result.uncertainty.remarks if part.kind == RemarkKind.UNREACHED_LINKS)
    assert (remark.values["links"], remark.values["of"]) == (BEHIND, 8 + BEHIND)
    reached = dict(zip(remark.values["switches"], remark.values["reached"], strict=True))
    assert reached["diffraction = true"] == BEHIND
    assert reached["max_depth = 3"] == 0
    assert any("6 of 14 links have no path" in sentence for sentence in result.remarks)
    result.save(tmp_path / "out")
    assert cb.Result.load(tmp_path / "out").uncertainty.remarks == result.uncertainty.remarks


def test_links_that_all_have_a_path_are_not_reported(tmp_path: Path) -> None:
    result = calibrated(tmp_path, diffraction=True)
    assert result.links.has_path.all()
    assert RemarkKind.UNREACHED_LINKS not in {remark.kind for remark in result.uncertainty.remarks}
