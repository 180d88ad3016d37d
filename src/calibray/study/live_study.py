"""The study of a Sionna RT scene in memory: its scene, links and study file are written into a folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import Material
from calibray.scenes import write_scene
from calibray.study.toml_file import study_text
from calibray.support.output_files import check_folder, write_text
from calibray.support.output_tables import write_table

if TYPE_CHECKING:
    from calibray.tracing.sionna.live_scene import LiveScene

ENDS: Final = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
VALUE: Final = "measured"
LARGEST_PERMITTIVITY: Final = 15.0
"""Upper bound of a permittivity that is calibrated by default, twice that of any building material of ITU-R P.2040."""


def write_live_study(
    scene: object, measured: Any, folder: Path, sections: Mapping[str, Any]
) -> dict[str, Any]:
    """Write the files of a scene in memory and its measured values; returns the content of the study.

    Raises:
        InputError: The scene or the measured values cannot be used, or the folder cannot be written.
    """
    from calibray.tracing.sionna.live_scene import LiveScene

    live = LiveScene.of(scene)
    links = dict(sections.get("links", {}))
    table = _links(live, measured)
    check_folder(folder)
    write_scene(folder, live.objects, {name: _numbers(item) for name, item in live.materials.items()})
    write_table(folder / "links.csv", table)
    power = {"tx_power_dbm": "tx_power_dbm"} if links.get("quantity") == "received_power" else {}
    antennas = zip(("tx", "rx"), live.antennas, strict=True)
    return {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": live.frequency},
        "materials": {
            name: _numbers(item) | {"scattering_pattern": item.scattering_pattern}
            for name, item in live.materials.items()
        },
        "antennas": {
            end: asdict(antenna) | {"orientation": list(antenna.orientation)} for end, antenna in antennas
        },
        "parameters": _parameters(live.materials),
        **sections,
        "links": {"file": "links.csv", "tx": ENDS[:3], "rx": ENDS[3:], "value": VALUE, **power, **links},
    }


def write_study_file(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the study file of a study."""
    write_text(folder / "study.toml", study_text(content, {}))


def _numbers(material: Material) -> dict[str, float]:
    return {name: value for name, value in asdict(material).items() if not isinstance(value, str)}


def _parameters(materials: Mapping[str, Material]) -> dict[str, dict[str, Any]]:
    """The permittivity of every material but air and metal."""
    names = [name for name, item in materials.items() if item.relative_permittivity > 1.5]
    return {f"{name}.relative_permittivity": {"bounds": [1.5, LARGEST_PERMITTIVITY]} for name in names}


def _links(live: LiveScene, measured: pd.DataFrame | ArrayLike) -> pd.DataFrame:
    """One row for each measured value, with the ends by name."""
    values = _matrix(live, measured)
    tx, rx = (np.array(list(ends.values())) for ends in (live.tx, live.rx))
    row, column = np.nonzero(np.isfinite(values))
    if not len(row):
        raise InputError(
            "measured: no value is a number; give one for each transmitter and receiver, NaN if none"
        )
    table = pd.DataFrame(np.hstack([tx[row], rx[column]]), columns=list(ENDS))
    return table.assign(
        transmitter=np.array(list(live.tx))[row],
        receiver=np.array(list(live.rx))[column],
        tx_power_dbm=np.array(list(live.tx_power_dbm.values()))[row],
        **{VALUE: values[row, column]},
    )


def _matrix(live: LiveScene, measured: pd.DataFrame | ArrayLike) -> NDArray[np.float64]:
    """Measured values [tx, rx] in the order of the scene; NaN where nothing was measured."""
    if isinstance(measured, pd.DataFrame):
        for what, labels, names in (("row", measured.index, live.tx), ("column", measured.columns, live.rx)):
            if unknown := [str(label) for label in labels if label not in names]:
                kind = "transmitter" if what == "row" else "receiver"
                raise InputError(
                    f"measured: {what} {unknown[0]!r} is no {kind} of the scene; rows are transmitters, "
                    "columns receivers"
                )
        measured = measured.reindex(index=list(live.tx), columns=list(live.rx))
    values = np.asarray(measured, dtype=float)
    if values.shape != (shape := (len(live.tx), len(live.rx))):
        raise InputError(
            f"measured: shape {values.shape}, must be {shape}: a row for each transmitter, a column for each receiver"
        )
    return values
