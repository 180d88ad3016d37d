"""The example town, from a map and a phones' log to the planted walls, by the functions that a study will use."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from calibray import trace
from calibray.fields import path_loss
from calibray.measurements import Averaging, LinkColumns, Preparation, measured_links, read_table
from calibray.scenes.authoring import make_scene, read_openstreetmap
from calibray.scenes.checks import building_outlines, move_outside
from small_scenes import write_scene

EXAMPLE = Path(__file__).parents[2] / "examples" / "bring_your_own"


def test_planted_walls_and_phones_are_found_from_a_map_and_a_log(tmp_path):
    truth = json.loads((EXAMPLE / "truth.json").read_text())
    footprints, frame = read_openstreetmap(EXAMPLE / "town.osm")
    assert len(footprints) == 11
    assert footprints.guessed() == {"levels": ["way-3", "way-6", "way-11"], "default": ["way-8"]}
    made = make_scene(footprints, tmp_path, frame)

    columns = LinkColumns(
        ("cell_longitude", "cell_latitude", 6.0), ("longitude", "latitude", 1.5), "rsrp_dbm", "rsrp"
    )
    steps = Preparation(
        where="rsrp_dbm.notna()",
        transmitters=read_table(EXAMPLE / "cells.csv"),
        transmitter="cell",
        frame=frame,
        averaging=Averaging("cell", 0.01),  # Each stop is one position.
        keep=("device",),
    )
    averages = measured_links(read_table(EXAMPLE / "rsrp.csv"), columns, steps).frame
    # If some samples of a stop are below the noise floor, the others are the strong ones.
    links = averages[averages["count"] == 10]
    rx, moved = move_outside(links[["rx_x", "rx_y", "rx_z"]], building_outlines(made.path))
    assert len(links) > 100
    assert moved.max() == 0

    ends = SimpleNamespace(tx=links[["tx_x", "tx_y", "tx_z"]].to_numpy(), rx=rx)
    antenna = {"pattern": "iso", "polarization": "V"}
    paths = trace(
        made.path, ends, frequency=truth["frequency"], max_depth=3, samples=25_000, tx_antenna=antenna,
        rx_antenna=antenna,
    )  # fmt: skip
    group = pd.factorize(links["cell"] + " " + links["device"])
    design = np.eye(len(group[1]))[group[0]]

    def fitted(permittivity: float) -> tuple[float, np.ndarray]:
        """RMSE [dB] and offset of every cell and phone [dBm] for walls of a permittivity."""
        materials = {
            "walls": replace(
                paths.materials["walls"], **truth["walls"] | {"relative_permittivity": permittivity}
            ),
            "ground": replace(paths.materials["ground"], **truth["ground"]),
        }
        power = links["rsrp_dbm"] + path_loss(paths, materials)
        there = np.isfinite(power)
        offsets = np.linalg.lstsq(design[there], power[there])[0]
        return float(np.sqrt(np.mean((power - design @ offsets)[there] ** 2))), offsets

    grid = np.arange(2.0, 14.1, 0.2)
    errors = [fitted(permittivity)[0] for permittivity in grid]
    found = grid[int(np.argmin(errors))]
    planted = truth["walls"]["relative_permittivity"]
    # The likelihood ratio of Gaussian errors of unknown spread, against the 99 % point of chi squared.
    doubt = 2 * len(links) * np.log(np.array([fitted(planted)[0], fitted(planted / 2)[0]]) / min(errors))
    assert doubt[0] < 6.63 < doubt[1]
    assert abs(found - planted) < 2.0
    offsets = dict(zip(group[1], fitted(found)[1], strict=True))
    for name, offset in offsets.items():
        cell, device = name.split()
        assert abs(offset - truth["eirp_dbm"][cell] - truth["phone_db"][device]) < 1.0


def test_the_makers_amplitudes_are_those_of_the_planted_materials(tmp_path):
    """A planted perfect conductor reflects everything: the amplitudes decrease with the lengths of the paths."""
    corners = [(-50.0, -50.0, 0.0), (50.0, -50.0, 0.0), (50.0, 50.0, 0.0), (-50.0, 50.0, 0.0)]
    scene, mast = write_scene(tmp_path, {"ground": [corners]}), np.array([0.0, 0.0, 10.0])
    places = np.array([[20.0, 0.0, 1.5], [-30.0, 5.0, 1.5]])
    amplitudes = runpy.run_path(str(EXAMPLE / "synthetic.py"))["amplitudes"]
    planted = {"stone": {"conductivity": 1e9}}
    (gains,) = amplitudes(scene, [mast], places, 3.6e9, planted, max_depth=1, samples=2000)
    for place, found in zip(places, gains, strict=True):
        length = np.linalg.norm([place - mast, place * [1, 1, -1] - mast], axis=1)
        assert sorted(found) == pytest.approx(sorted(299792458 / 3.6e9 / (4 * np.pi * length)), rel=1e-3)
