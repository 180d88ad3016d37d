"""A small campaign, transformations that must not change its results, and the largest changes.

`benchmarks/invariance.py` prints what `tests/calibration/test_invariance.py` checks in part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import small_scenes
from calibray.calibration.calibrate import calibrate
from calibray.fields import path_loss
from calibray.scenes.meshes import Mesh, MeshObject
from calibray.scenes.scene_file import write_scene
from calibray.study import Setup, Study

TX, RX = ("tx_x", "tx_y", "tx_z"), ("rx_x", "rx_y", "rx_z")
HOUSES = {
    "north": ((-42.3, 8.1, 0.0), (-3.2, 19.7, 11.3)),
    "east": ((4.4, 9.3, 0.0), (39.8, 21.2, 8.7)),
    "south": ((-29.6, -18.4, 0.0), (31.5, -7.9, 14.6)),
}
GROUND = [[(-70.0, -60.0, 0.0), (70.0, -60.0, 0.0), (70.0, 60.0, 0.0), (-70.0, 60.0, 0.0)]]
TRUTH = {
    "walls": {"relative_permittivity": 6.2, "conductivity": 0.4, "thickness": 0.3},
    "ground": {"relative_permittivity": 3.4, "conductivity": 0.2, "thickness": 1.0},
}
"""Lossy enough to have one minimum; resonances of slabs with less loss have minima within 3e-5 dB of each other."""
START = {
    "walls": {"relative_permittivity": 4.0, "conductivity": 0.4, "thickness": 0.3},
    "ground": {"relative_permittivity": 5.0, "conductivity": 0.2, "thickness": 1.0},
}


@dataclass(frozen=True, eq=False)
class Campaign:
    """A scene, links and a study, with what makes its results comparable.

    Attributes:
        objects: Vertices [V, 3], [m], and faces [F, 3] of each object; the ground is called "ground".
        walls: Name of the material of all other objects.
        ground: Name of the ground's material.
        links: Measured links, then links to predict at, without a value; the index identifies them.
        shift_db: Constant in the measured values, which the offsets take [dB].
        sections: Further sections of the study.
    """

    objects: Mapping[str, tuple[np.ndarray, np.ndarray]]
    walls: str
    ground: str
    links: pd.DataFrame
    shift_db: float = 0.0
    sections: Mapping[str, Any] = field(default_factory=dict)

    @property
    def measured(self) -> pd.DataFrame:
        """The links with a value."""
        return self.links[self.links["path_loss_db"].notna()]

    def study(self, folder: Path) -> Study:
        """Write the scene and the measured links."""
        is_ground = [faces.shape == (2, 3) for _, faces in self.objects.values()]
        objects = [
            MeshObject(name, self.ground if flat else self.walls, Mesh(*surface))
            for (name, surface), flat in zip(self.objects.items(), is_ground, strict=True)
        ]
        write_scene(folder, objects, {self.walls: START["walls"], self.ground: START["ground"]})
        self.measured.to_csv(folder / "links.csv", index_label="link", float_format="%.17g")
        content = {
            "version": 1,
            "scene": {"file": "scene.xml", "frequency": 3.5e9},
            "links": {"file": "links.csv", "tx": list(TX), "rx": list(RX), "value": "path_loss_db"},
            "trace": {"max_depth": 2, "samples": 200_000, "line_of_sight": False},
            "parameters": {
                f"{name}.relative_permittivity": {"bounds": [1.5, 12.0]} for name in (self.walls, self.ground)
            },
            "offset": {"per": "mast"},
            "holdout": {"blocks": 4},
            **self.sections,
        }
        content = {name: section for name, section in content.items() if section is not None}
        return Study.from_content(content, folder / "study.toml")

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> Campaign:
        """The campaign with all positions moved."""
        links = self.links.copy()
        for ends in (TX, RX):
            links[list(ends)] = move(links[list(ends)].to_numpy())
        objects = {name: (move(vertices), faces) for name, (vertices, faces) in self.objects.items()}
        return replace(self, objects=objects, links=links)


def campaign(folder: Path) -> Campaign:
    """Two masts between three houses; path loss of planted materials, offsets of the masts and errors of 0.5 dB."""
    random = np.random.default_rng(5)
    quads = {name: small_scenes.block(*corners) for name, corners in HOUSES.items()} | {"ground": GROUND}
    objects = {}
    for name, sides in quads.items():
        points, index = np.unique(np.array(sides).reshape(-1, 3), axis=0, return_inverse=True)
        corners = index.reshape(-1, 4)
        objects[name] = points, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    masts = {"a": (-1.1, 2.3, 6.2), "b": (36.4, 1.7, 5.1)}
    receivers = np.column_stack([random.uniform((-45, -5.5), (45, 6.5), (30, 2)), np.full(30, 1.5)])
    rows = [(*tx, *rx, mast) for mast, tx in masts.items() for rx in receivers]
    links = pd.DataFrame(rows, columns=[*TX, *RX, "mast"]).assign(path_loss_db=80.0)
    plain = Campaign(objects, "walls", "ground", links)
    paths = Setup.open(plain.study(folder)).trace()
    materials = {name: replace(paths.materials[name], **constants) for name, constants in TRUTH.items()}
    values = (
        path_loss(paths, materials)
        + random.normal(0, 0.5, len(links))
        + links["mast"].map({"a": 3.0, "b": -5.0})
    )
    links["path_loss_db"] = np.where(np.arange(len(links)) % 3 < 2, values, np.nan)
    return replace(plain, links=links[np.isfinite(values)])


def shift(*offset: float) -> Callable[[np.ndarray], np.ndarray]:
    """A translation [m]."""
    return lambda positions: positions + np.array(offset)


def turned(degrees: float) -> Callable[[np.ndarray], np.ndarray]:
    """A rotation about a vertical axis."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    matrix = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return lambda positions: positions @ matrix.T


def permuted(plain: Campaign) -> Campaign:
    """Rows in another order."""
    return replace(plain, links=plain.links.sample(frac=1.0, random_state=2))


def renamed(plain: Campaign) -> Campaign:
    """Other names of objects, materials and masts, so that all sort the other way round."""
    names = dict(zip(sorted(plain.objects), ["z9", "y b", "x.c", "w-d"], strict=True))
    objects = {names[name]: plain.objects[name] for name in reversed(plain.objects)}
    links = plain.links.assign(mast=plain.links["mast"].map({"a": "omega", "b": "alpha"}))
    return replace(plain, objects=objects, links=links, walls="xylophone", ground="asphalt")


def swapped(plain: Campaign) -> Campaign:
    """Transmitters and receivers exchanged, and no blocks, which are parts of the receivers' area."""
    links = plain.links.rename(columns=dict(zip([*TX, *RX], [*RX, *TX], strict=True)))
    return replace(plain, links=links, sections={"holdout": None})


def shifted(plain: Campaign) -> Campaign:
    """A constant in all values, which the offsets take."""
    links = plain.links.assign(path_loss_db=plain.links["path_loss_db"] + 7.3)
    return replace(plain, links=links, shift_db=7.3)


def with_far_object(plain: Campaign) -> Campaign:
    """A house 3 km away."""
    vertices, faces = plain.objects["east"]
    return replace(
        plain, objects={"a far one": (vertices + np.array([2900.0, 700.0, 0.0]), faces), **plain.objects}
    )


TRANSFORMATIONS: Mapping[str, Callable[[Campaign], Campaign]] = {
    "the same again": lambda plain: plain,
    "rows permuted": permuted,
    "names changed": renamed,
    "moved by 10 km": lambda plain: plain.moved(shift(1e4, -3e3, 40.0)),
    "moved to UTM": lambda plain: plain.moved(shift(690_000.0, 5_330_000.0, 500.0)),
    "turned by 90 degrees": lambda plain: plain.moved(turned(90.0)),
    "turned by 33 degrees": lambda plain: plain.moved(turned(33.0)),
    "ends swapped": swapped,
    "in blocks of 7": lambda plain: replace(
        plain, sections=plain.sections | {"engine": {"name": "replay", "chunk_links": 7}}
    ),
    "7.3 dB added": shifted,
    "a house 3 km away": with_far_object,
}

TOLERANCES = {
    "paths": 0.0,
    "traced path loss": 0.002,
    "parameter": 0.01,
    "RMSE": 0.001,
    "held-out error": 0.001,
    "prediction": 0.01,
    "interval": 0.05,
}
"""Largest allowed change: [1], [dB], [1], and [dB] for the rest. The tracer's single precision leaves 0.001 dB."""


def quantities(campaign: Campaign, folder: Path, calibrated: bool = True) -> dict[str, pd.Series]:
    """The results of a campaign, by link or parameter.

    Args:
        campaign: The campaign.
        folder: An empty folder.
        calibrated: Whether to calibrate as well, or only to trace.

    Returns:
        The quantities of `TOLERANCES`.
    """
    setup = Setup.open(campaign.study(folder))
    paths = setup.trace()
    link = campaign.measured.index
    results = {
        "paths": pd.Series(np.bincount(paths.link, minlength=len(link)), link),
        "traced path loss": pd.Series(np.asarray(path_loss(paths)), link),
    }
    if not calibrated:
        return results
    result = calibrate(setup)
    new = campaign.links[campaign.links["path_loss_db"].isna()]
    predicted = result.predict_interval(new[[*TX, *RX, "mast"]])
    roles = {campaign.walls: "walls", campaign.ground: "ground"}
    values = {roles[name.split(".")[0]]: value for name, value in result.parameters.items()}
    results |= {
        "parameter": pd.Series(values),
        "RMSE": pd.Series({"links": result.rmse_db}),
        "prediction": pd.Series(predicted["path_loss_db"].to_numpy() - campaign.shift_db, new.index),
    }
    if "holdout" in campaign.sections:
        return results
    return results | {
        "held-out error": pd.Series({"links": result.prediction.model.residual_db}),
        "interval": pd.Series((predicted["upper_db"] - predicted["lower_db"]).to_numpy(), new.index),
    }


def largest_changes(before: Mapping[str, pd.Series], after: Mapping[str, pd.Series]) -> dict[str, float]:
    """The largest change of each quantity that both have; infinite where a link has a path in one of them only."""
    changes = {}
    for name, values in before.items():
        if name not in after:
            continue
        old, new = values.align(after[name])
        same = (old == new) | (old.isna() & new.isna())
        changes[name] = float(
            np.nan_to_num((old - new).abs()[~same], nan=np.inf, posinf=np.inf).max(initial=0.0)
        )
    return changes
