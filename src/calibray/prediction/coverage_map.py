"""Coverage: path loss over an area with the calibrated scene, and how sure it is.

Every cell is a link to its middle, predicted as any other link is. Sionna's radio map solver would be another way: it
counts the rays that cross a cell and so averages over the cell. In the demo district 70 % of the cells then differ from
a sum of paths by more than 0.05 dB, 10 % by more than 0.7 dB (`python benchmarks/coverage_map.py --solver`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.engines.cluster.workers import Workers
from calibray.errors import InputError
from calibray.fitting.nuisance import CONSTANT, LOG_DISTANCE
from calibray.measurements import MIN_DISTANCE
from calibray.prediction.batches import piece_size, predicted
from calibray.prediction.map_files import save_map
from calibray.prediction.predict import as_links, opened
from calibray.prediction.predicted_grid import PredictedGrid
from calibray.result.record import Record
from calibray.scenes import Triangles, ground_heights, read_triangles
from calibray.study import Study
from calibray.study.row_steps import known_frame
from calibray.support.progress import Progress, with_total

MOST_CELLS: Final = 1_000_000


@final
@dataclass(frozen=True, eq=False)
class CoverageMap(PredictedGrid):
    """Path loss, or received power, over a grid of square cells; `PredictedGrid` lists the attributes."""

    def save(
        self, folder: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False
    ) -> tuple[str, ...]:
        """Write the map as GeoTIFF, picture and table.

        Args:
            folder: Folder to write `map.tif`, `map.png` and `map.csv` into; made if absent.
            inputs: Files that the work reads; none of them is ever replaced.
            overwrite: Replace files that Calibray did not write.

        Returns:
            Names of the files; without rasterio the GeoTIFF is not among them.

        Raises:
            InputError: The folder cannot be written, or a file there must not be replaced.
        """
        return save_map(self, folder, inputs, overwrite)


def coverage_map(
    result: Record,
    tx: Sequence[float] | None = None,
    *,
    height: float = 1.5,
    cell: float = 5.0,
    bounds: Sequence[float] | None = None,
    level: float | None = 0.9,
    power_dbm: float | None = None,
    samples: int | Literal["auto"] | None = None,
    columns: Mapping[str, object] | None = None,
    progress: Progress | None = None,
    workers: Workers | None = None,
    allow_changed_inputs: bool = False,
) -> CoverageMap:
    """Predict path loss over an area, with the interval that a measurement there would lie in.

    Args:
        result: The calibration.
        tx: Position of the transmitter [3], [m]; that of the calibration, if it had only one.
        height: Height of the receivers over the ground, or over the scene's lowest point where it has none, [m].
        cell: Width of the cells [m]; the receivers stand in their middles.
        bounds: West, south, east and north of the area [4], [m]; that of the scene if none are given.
        level: Probability that a measurement lies within the interval; None for no interval.
        power_dbm: Transmitted power [dBm], for a map of received power in place of path loss. After a calibration on
            RSRP 0 is taken, for the offset has the power in it.
        samples: Rays in place of the study's; the time goes with them, and with too few paths are missed. "auto" adds
            rays until path loss stands still, and takes less time than many.
        columns: What the study's columns of groups, carriers or nuisances hold for this transmitter, by name. The
            group of an offset is taken from the links measured there, where these have one.
        progress: Called with the stage "tracing" after every launch.
        workers: Where blocks of cells are traced and predicted (`engines.open_workers`); here if None.
        allow_changed_inputs: Predict although a file of the scene or an antenna changed since the calibration.

    Returns:
        The map.

    Raises:
        InputError: An argument is impossible, a column is missing, there would be more than a million cells, or
            `Record.predict_interval` refuses the links.
        EngineError: There are more paths than fit into memory.
    """
    if samples is not None:
        result = _with_samples(result, samples)
    study = result.study
    place = _transmitter(result, tx)
    held = _columns(result, place, columns or {})
    _check_size("height", height, -np.inf)
    _check_size("cell", cell, 0.0)
    if power_dbm is None and study.links.quantity == "rsrp":
        power_dbm = 0.0
    if power_dbm is not None:
        _check_size("power_dbm", power_dbm, -np.inf)
    frame = known_frame(study)
    above = pd.DataFrame({**_ends(place, place[None] + np.eye(3)[2]), **held})
    setup = opened(result, as_links(result, above), allow_changed_inputs=allow_changed_inputs)
    triangles = read_triangles(setup.scene)
    x, y = _grid(triangles, bounds, cell)
    z = ground_heights(triangles, x, y) + height
    east, north = np.meshgrid(x, y)
    rx = np.stack([east, north, z], axis=-1).reshape(-1, 3)
    wanted = np.flatnonzero(np.linalg.norm(rx - place, axis=1) > MIN_DISTANCE)
    found = np.full((3, len(rx)), np.nan)
    size = piece_size(setup, workers)
    for start in range(0, len(wanted), size):
        block = wanted[start : start + size]
        rows = pd.DataFrame({**_ends(place, rx[block]), **held})
        setup = setup.at(as_links(result, rows))
        told = predicted(result, setup, level, with_total(progress, int(block[0]), len(rx)), workers)
        for row, name in enumerate(("path_loss_db", "lower_db", "upper_db")[: 1 if level is None else 3]):
            found[row, block] = told[name]
    loss, lower, upper = found.reshape(3, *z.shape)
    return CoverageMap(place, height, cell, x, y, z, loss, lower, upper, level, power_dbm, frame, triangles)


def _transmitter(result: Record, tx: Sequence[float] | None) -> NDArray[np.float64]:
    """The transmitter's position, given or the only one that was measured."""
    if tx is not None:
        place = np.array(tx, dtype=float).reshape(-1)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"tx = {list(tx)}: must be x, y and z, three finite numbers of metres")
        return place
    names = ["tx_x", "tx_y", "tx_z"]
    known = np.unique(result.links[names].to_numpy(float), axis=0) if set(names) <= set(result.links) else []
    if len(known) != 1:
        several = f"has {len(known)} transmitters" if len(known) else "does not tell where transmitters stood"
        raise InputError(
            f"{result.study.path}: its result {several}; say which position the map is for: --tx X Y Z (tx=[x, y, z])"
        )
    return known[0]


def _with_samples(result: Record, samples: int | Literal["auto"]) -> Record:
    content = result.study.content()
    content["trace"]["samples"] = samples
    return replace(result, study=Study.from_content(content, result.study.path))


def _columns(result: Record, tx: NDArray[np.float64], given: Mapping[str, object]) -> dict[str, object]:
    """What the study's columns hold at every link from this transmitter."""
    study, held = result.study, dict(given)
    per = study.offset.per if study.offset is not None else None
    if isinstance(per, str) and per not in held and {"group", "tx_x"} <= set(result.links):
        apart = np.abs(result.links[["tx_x", "tx_y", "tx_z"]].to_numpy(float) - tx).max(axis=1)
        groups = set(result.links["group"].astype(str).to_numpy()[apart < MIN_DISTANCE])
        held |= {per: groups.pop()} if len(groups) == 1 else {}
    needed = [*([per] if isinstance(per, str) else per or ())]
    for section in study.nuisance.values():
        needed += [section.per] if section.per is not None else []
        needed += [section.by] if section.by not in (CONSTANT, LOG_DISTANCE) else []
    for name in needed:
        if name not in held:
            raise InputError(
                f"{study.path}: needs the column {name!r} of its links; say what it holds for this transmitter: "
                f"--column {name}=VALUE (columns={{{name!r}: value}})"
            )
    return held


def _grid(
    triangles: Triangles, bounds: Sequence[float] | None, cell: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles of the cells, by column and by row."""
    if bounds is None:
        if not len(triangles.face):
            raise InputError(
                "the scene has no mesh that can be read, so its area is not known; give --bounds"
            )
        ends = np.concatenate([triangles.vertex.min(axis=0)[:2], triangles.vertex.max(axis=0)[:2]])
    else:
        ends = np.array(bounds, dtype=float).reshape(-1)
    if ends.shape != (4,) or not np.isfinite(ends).all() or not (ends[:2] < ends[2:]).all():
        raise InputError(
            f"bounds = {ends.tolist()}: must be west, south, east and north in metres, west less than east and south "
            "less than north"
        )
    count = np.maximum(np.ceil((ends[2:] - ends[:2]) / cell - 1e-6), 1.0)
    if count.prod() > MOST_CELLS:
        raise InputError(
            f"cell = {cell:g} m: makes {count.prod():.0f} cells of {np.ptp(ends[::2]):.0f} m x "
            f"{np.ptp(ends[1::2]):.0f} m, must be at most {MOST_CELLS}; give a wider one, or less area by --bounds"
        )
    columns, rows = (
        start + cell * (np.arange(int(n)) + 0.5) for start, n in zip(ends[:2], count, strict=True)
    )
    return columns, rows


def _check_size(name: str, value: float, above: float) -> None:
    if not (np.isfinite(value) and value > above):
        bound = "" if np.isinf(above) else f" greater than {above:g}"
        raise InputError(f"{name} = {value:g}: must be a finite number{bound}")


def _ends(tx: NDArray[np.float64], rx: NDArray[np.float64]) -> dict[str, object]:
    """Columns of links from one transmitter to receivers [n, 3], [m]."""
    receivers = {f"rx_{axis}": rx[:, k] for k, axis in enumerate("xyz")}
    return {**{f"tx_{axis}": tx[k] for k, axis in enumerate("xyz")}, **receivers}
