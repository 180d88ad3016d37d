"""A small campaign whose truth is known: a street canyon, its path loss computed from planted values."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from calibray import engines
from calibray.engines import Replay
from calibray.study import Setup, Study
from link_tables import links_from_frame

TRUTH = {
    "concrete.relative_permittivity": 3.2,
    "marble.relative_permittivity": 8.1,
    "wood.relative_permittivity": 2.6,
}
BOUNDS = [1.5, 12.0]
LINKS = 12
INSIDE = 5  # link whose receiver can be moved into the building of marble
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")


def links(blocked: bool = False) -> pd.DataFrame:
    """Links along a street between a wall of marble and one of wood, the ground of concrete, in two groups.

    If `blocked`, the receiver of link `INSIDE` stands in a building, where no path leads.
    """
    y = np.random.default_rng(7).uniform(-6, 6, LINKS)
    rx = np.stack([np.linspace(-25, 25, LINKS), y, np.full(LINKS, 1.5)], axis=1).round(2)
    if blocked:
        rx[INSIDE, 1] = 20.0
    table = pd.DataFrame(np.hstack([np.tile([0.0, 0.0, 3.0], (LINKS, 1)), rx]), columns=COLUMNS)
    return table.assign(half=np.where(rx[:, 0] < 0, "west", "east"), weight=1.0)


def content(file: str, **sections: Any) -> dict[str, Any]:
    """The content of a study of these links; sections given replace those here, and None leaves one out.

    With one noise model and exact constants, intervals are quick; `noise = None` has the defaults.
    """
    study = {
        "version": 1,
        "scene": {"file": "sionna:simple_street_canyon", "frequency": 3.5e9},
        "links": {"file": file, "tx": list(COLUMNS[:3]), "rx": list(COLUMNS[3:]), "value": "path_loss_db"},
        "trace": {"max_depth": 2, "samples": 20_000, "line_of_sight": False},
        "parameters": {name: {"bounds": BOUNDS} for name in TRUTH},
        "noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0},
        **sections,
    }
    return {name: section for name, section in study.items() if section is not None}


def study(folder: Path, table: pd.DataFrame, **sections: Any) -> Study:
    """A study in a folder, its links written there."""
    table.to_csv(folder / "links.csv", index=False, float_format="%.17g")
    return Study.from_content(content("links.csv", **sections), folder / "study.toml")


@cache
def engine(blocked: bool = False) -> Replay:
    """The replay engine over the links, traced and compiled once."""
    plan = Study.from_content(content("links.csv"))
    return engines.make(Setup.open(plan, links=links_from_frame(links(blocked))))


def path_loss(values: Mapping[str, float] = TRUTH, blocked: bool = False) -> np.ndarray:
    """Path loss [L] of the links for given values of the parameters, [dB]."""
    run = engine(blocked)
    return run.path_loss(np.array([[values[name] for name in run.parameters.names]]))[0]


def campaign(
    values: Mapping[str, float] = TRUTH, noise_db: float = 0.0, blocked: bool = False
) -> pd.DataFrame:
    """The links with their path loss for given values, with seeded Gaussian noise if asked for."""
    noise = noise_db * np.random.default_rng(3).standard_normal(LINKS)
    return links(blocked).assign(path_loss_db=path_loss(values, blocked) + noise)
