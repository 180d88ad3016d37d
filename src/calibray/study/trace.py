"""`calibray.trace`: the paths of a study, or of links in a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import pandas as pd

from calibray.engines.rays.compile import RaySetting, compile_rays, rays_of
from calibray.engines.rays.other_programs import check_carrier, ray_rows
from calibray.engines.rays.table import RayTable, write_ray_file
from calibray.errors import InputError
from calibray.materials import Material, check_frequency
from calibray.measurements import Measurements
from calibray.paths import Paths
from calibray.scenes import Scene, read_scene
from calibray.study.setup import Setup
from calibray.study.study import Study
from calibray.support.messages import type_name
from calibray.support.progress import Progress
from calibray.tracing import SIONNA
from calibray.tracing.protocol import Links
from calibray.tracing.settings import Antenna, TraceSettings, as_antenna

Constants = Mapping[str, Material | Mapping[str, object]]


@overload
def trace(
    scene: Study,
    measurements: Measurements | None = None,
    *,
    materials: Mapping[str, Material] | None = None,
    progress: Progress | None = None,
) -> Paths: ...
@overload
def trace(
    scene: str | Path | Scene,
    measurements: Links,
    *,
    frequency: float,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Constants | None = None,
    progress: Progress | None = None,
    **settings: int | bool,
) -> Paths: ...
def trace(
    scene: str | Path | Scene | Study,
    measurements: Links | None = None,
    *,
    frequency: float | None = None,
    tx_antenna: Antenna | Mapping[str, object] | None = None,
    rx_antenna: Antenna | Mapping[str, object] | None = None,
    materials: Constants | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Paths:
    """Find the paths of every link and compile them into a path program.

    Args:
        scene: Mitsuba XML file, `sionna:NAME` for a bundled scene, or a `Scene`. Alternatively, a study that states
            links, carrier, antennas and settings. The trace of a study is cached.
        measurements: The links. Their measured values and carriers are not used (see `Paths.at` for other carriers).
            With a study, these links replace those of the study.
        frequency: Carrier frequency [Hz].
        tx_antenna: Transmit antenna, as an `Antenna` or as a mapping of its attributes.
        rx_antenna: Receive antenna, in the same form.
        materials: Constants that override those of the scene or the start values of a study, by material name. With a
            study or a `Scene`, each value must be a `Material`.
        progress: Called with ("tracing", receivers traced, number of receivers) after every launch.
        **settings: The attributes of `TraceSettings`.

    Returns:
        The path program; `links_without_path` lists the links without a path.

    Raises:
        InputError: The study, the scene, an antenna, a setting or a position cannot be used. A required argument is
            missing, or an argument is given although the study states its value.
        EngineError: The paths do not fit into memory.
    """
    if isinstance(scene, Study):
        arguments = {"frequency": frequency, "tx_antenna": tx_antenna, "rx_antenna": rx_antenna, **settings}
        for name, value in arguments.items():
            if value is not None:
                raise InputError(
                    f"trace: the study {scene.path} states {name}; change the value in the study"
                )
        return _trace_study(scene, measurements, materials or {}, progress)
    if measurements is None or frequency is None:
        missing = "measurements, the links" if measurements is None else "frequency, the carrier in Hz"
        raise InputError(f"trace: without a study, give {missing}")
    check_frequency(frequency)
    complete: dict[str, Material] = {}
    if isinstance(scene, Scene):
        scene.check_frequency(frequency)
        complete = _complete(materials or {}, "a scene already read")
    else:
        scene = read_scene(scene, frequency, materials)
    antennas = as_antenna(tx_antenna, "tx_antenna"), as_antenna(rx_antenna, "rx_antenna")
    names = TraceSettings().record()
    if unknown := set(settings) - set(names):
        raise InputError(f"trace: unknown setting {sorted(unknown)[0]!r}; known: {', '.join(names)}")
    return SIONNA(scene, frequency, TraceSettings(**settings), *antennas).trace(
        measurements, progress, complete
    )


def _trace_study(study: Study, links: Links | None, materials: Constants, progress: Progress | None) -> Paths:
    if not isinstance(links, Measurements | None):
        raise InputError(
            f"trace: the links of a study must be Measurements, not a {type_name(links)}; use read_measurements(...) "
            "for a file, or Measurements(tx, rx, path_loss_db) for arrays"
        )
    return Setup.open(study, links=links).trace(_complete(materials, "a study"), progress)


def _complete(materials: Constants, source: str) -> dict[str, Material]:
    complete: dict[str, Material] = {}
    for name, constants in materials.items():
        if not isinstance(constants, Material):
            raise InputError(
                f"trace: materials of {source}: {name!r} is not a Material; give all constants as a Material"
            )
        complete[name] = constants
    return complete


def read_rays(
    rays: str | Path | pd.DataFrame | Any,
    scene: str | Path | Scene | Study | Setup,
    *,
    frequency: float | None = None,
    antennas: tuple[Antenna, Antenna] | None = None,
    axes: str = "x y z",
    tx_power_dbm: float | None = None,
) -> Paths:
    """Read the paths computed by any engine (see docs/reference/ray-table.md).

    If the table contains the powers of the paths, the path program includes a correction. With this correction, every
    path has the power stated in the table for the materials of the scene or the start values of the study.

    Args:
        rays: The ray table: a .csv, .parquet, .json or .h5 file, or a DataFrame of its rows. Alternatively, the paths
            of another program: one or several .p2m files of Wireless InSite (a file, list or folder), the folder of an
            AODT run or a DeepMIMO scenario, or the `Paths` of Sionna RT.
        scene: Mitsuba XML file, `sionna:NAME`, or a `Scene`, with the constants that the engine used. Alternatively, a
            study that states carrier and links. Its start values must be those that the engine used.
        frequency: Carrier frequency [Hz]; required unless `scene` is a study.
        antennas: Transmit and receive antennas that the engine used. By default, the antennas that the study states are
            used. If no antennas are stated, the correction includes the antenna gains.
        axes: Axes of the table along x, y and z of the scene, such as "x -z y" for a table with an upward y axis.
        tx_power_dbm: Transmitted power [dBm]; needed for a file that states received power (Wireless InSite).

    Returns:
        The path program, with the links of the study. Without a study, the path program has the links of the table,
        identified by label or position. Labels are sorted naturally, with `rx2` before `rx10`.

    Raises:
        InputError: The table, the scene or an antenna cannot be used, or they are inconsistent with each other.

    Example:
        >>> from calibray.scenarios import demo_study_path
        >>> study = Study.load(demo_study_path())
        >>> read_rays("rays.csv", study)  # doctest: +SKIP
    """
    if frequency is not None:
        check_frequency(frequency)
    if antennas is not None and not (
        isinstance(antennas, tuple | list)
        and len(antennas) == 2
        and all(isinstance(each, Antenna) for each in antennas)
    ):
        raise InputError(
            f"read_rays: antennas = {antennas!r}: must be two Antenna objects, for transmitter and receiver"
        )
    rows = ray_rows(rays, tx_power_dbm)
    if isinstance(scene, Study | Setup):
        if frequency is not None:
            raise InputError("read_rays: the study states the frequency; change the value in the study")
        setup = scene.opened()
        if setup.links.frequency is not None:
            raise InputError("read_rays: a ray table contains powers at one carrier; remove links.frequency")
        setting = RaySetting.of(setup)
        setting = setting if antennas is None else replace(setting, antennas=antennas)
    elif frequency is None:
        raise InputError("read_rays: without a study, give frequency, the carrier in Hz")
    else:
        scene = scene if isinstance(scene, Scene) else read_scene(scene, frequency)
        scene.check_frequency(frequency)
        setting = RaySetting(scene, frequency, antennas)
    check_carrier(rays, setting.frequency)
    return compile_rays(RayTable.of(rows, axes), setting)


def write_rays(paths: Paths, file: str | Path, *, overwrite: bool = False) -> None:
    """Write paths as a ray table for other engines and programs. Powers are computed with the materials of `paths`.

    The file name must end in .csv, .parquet, .json or .h5. With `overwrite`, even an existing file that Calibray did
    not write is replaced.

    Raises:
        InputError: `paths` is not a Paths object, or the file cannot be written.
    """
    if not isinstance(paths, Paths):
        raise InputError(
            f"write_rays: paths is a {type_name(paths)}, must be Paths; use calibray.read_rays or calibray.trace first"
        )
    write_ray_file(file, rays_of(paths).frame(), overwrite)
