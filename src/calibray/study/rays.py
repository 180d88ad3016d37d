"""`calibray.read_rays` and `calibray.write_rays`: paths of any engine, from and to a ray table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from calibray.engines.rays.aodt import FILES, read_aodt
from calibray.engines.rays.compile import RaySetting, compile_rays, rays_of
from calibray.engines.rays.deepmimo import is_deepmimo, read_deepmimo
from calibray.engines.rays.files import read_ray_file, write_ray_file
from calibray.engines.rays.insite import read_insite
from calibray.engines.rays.sionna_paths import is_sionna_paths, read_sionna_paths
from calibray.engines.rays.table import RayTable
from calibray.errors import InputError
from calibray.measurements import SourceTable
from calibray.paths import Paths
from calibray.scenes import Scene, read_scene
from calibray.study.study import Setup, Study
from calibray.tracing.settings import Antenna


def read_rays(
    rays: str | Path | pd.DataFrame | Any,
    scene: str | Path | Scene | Study | Setup,
    *,
    frequency: float | None = None,
    antennas: tuple[Antenna, Antenna] | None = None,
    axes: str = "x y z",
    tx_power_dbm: float | None = None,
) -> Paths:
    """Read the paths of any engine (docs/reference/ray-table.md).

    If the table states the power of the paths, the program has a correction: at the materials of the scene, or at the
    study's start values, every path then has the power of the table.

    Args:
        rays: The table: a .csv, .parquet, .json or .h5 file, or its rows. Or the paths of another program: a .p2m file
            of Wireless InSite, the folder of an AODT run or of a DeepMIMO scenario, or Sionna RT's `Paths`.
        scene: Mitsuba XML file, `sionna:NAME`, or a scene already read, with the constants that the engine used. Or a
            study, which states carrier and links; its start values are those that the engine used.
        frequency: Carrier frequency [Hz]; without a study.
        antennas: Transmit and receive antenna, if the engine used these; else the correction contains the antennas.
        axes: The table's axes along x, y and z of the scene, as "x -z y" for a table whose y axis points up.
        tx_power_dbm: Transmitted power of a file that states received power [dBm]: Wireless InSite.

    Returns:
        The path program. Its links are those of the study; without a study, those of the table by label or position.

    Raises:
        InputError: The table, the scene or an antenna cannot be used, or they do not agree.

    Example:
        >>> from calibray.scenarios import demo_study_path
        >>> study = Study.load(demo_study_path())
        >>> read_rays("rays.csv", study)  # doctest: +SKIP
    """
    rows = _rows(rays, tx_power_dbm)
    if isinstance(scene, Study | Setup):
        if frequency is not None:
            raise InputError("read_rays: the study states the frequency; change it there")
        setup = scene.opened()
        setting = RaySetting(setup.scene, setup.radio.frequency, antennas, setup.links)
    elif frequency is None:
        raise InputError("read_rays: without a study, give frequency, the carrier in Hz")
    else:
        scene = scene if isinstance(scene, Scene) else read_scene(scene, frequency)
        setting = RaySetting(scene, frequency, antennas)
    return compile_rays(RayTable.of(rows, axes), setting)


def _rows(rays: Any, tx_power_dbm: float | None) -> SourceTable:
    """The rows of a table, or of the paths of another program."""
    if isinstance(rays, pd.DataFrame):
        return SourceTable(rays)
    if is_sionna_paths(rays):
        return read_sionna_paths(rays)
    path = Path(rays)
    if path.suffix.lower() == ".p2m" and path.is_file():
        return read_insite(path, tx_power_dbm)
    if not path.is_dir():
        return read_ray_file(path)
    if is_deepmimo(path):
        return read_deepmimo(path)
    if (path / FILES[0]).is_file():
        return read_aodt(path)
    raise InputError(
        f"{path}: a folder must have {' and '.join(FILES)} (AODT) or power_t*.mat (DeepMIMO); otherwise name a file"
    )


def write_rays(paths: Paths, file: str | Path, *, overwrite: bool = False) -> None:
    """Write paths as a ray table, for other engines and programs.

    Args:
        paths: The path program; powers are those for its materials.
        file: A .csv, .parquet, .json or .h5 file.
        overwrite: Replace a file that Calibray did not write.

    Raises:
        InputError: The file cannot be written, or a path has no power.
    """
    write_ray_file(file, rays_of(paths).frame(), overwrite)
