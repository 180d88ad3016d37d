"""Path loss at links that were never measured, with the calibrated scene and offsets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray import fields
from calibray.engines.kinds.replay import replay
from calibray.errors import InputError
from calibray.measurements import Measurements, links_from_frame
from calibray.progress import Progress
from calibray.study import Setup

if TYPE_CHECKING:
    from calibray.result import Result


def predict(
    result: Result,
    links: Measurements | pd.DataFrame,
    progress: Progress | None = None,
    *,
    anyway: bool = False,
) -> NDArray[np.float64]:
    """Path loss at links that were never measured.

    Args:
        result: The calibration.
        links: The links, or a table with columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m] and the study's group
            column, if it has one. The study's column of frequencies gives the links' carriers; without it all
            links have the scene's.
        progress: Called with the stage "tracing" after every launch.
        anyway: Predict although a file of the scene or an antenna changed since the calibration.

    Returns:
        Path loss, offsets included [n], [dB]; +inf where no path leads.

    Raises:
        InputError: A column is missing, a position cannot be used, a group has no calibrated offset, or a file of the
            scene or an antenna changed since the calibration.
    """
    study = result.study
    if not isinstance(links, Measurements):
        per = study.offset.per if study.offset else None
        links = links_from_frame(links, group=per, frequency=study.links.frequency)
    offset = _offset(result, links)
    setup = Setup.open(study, links=links)
    if not anyway:
        _check_files(result, setup)
    paths = setup.trace(result.materials, progress)
    if links.frequency is None:
        return fields.path_loss(paths, None, study.objective.combining, study.scene.bandwidth) + offset
    values = np.array([[result.parameters[name] for name in setup.parameters.names]])
    return replay(setup, paths).path_loss(values)[0] + offset


def _offset(result: Result, links: Measurements) -> NDArray[np.float64]:
    if not result.offsets_db:
        return np.zeros(len(links))
    unknown = [name for name in links.group_names if name not in result.offsets_db]
    if unknown:
        known = ", ".join(result.offsets_db)
        raise InputError(f"{links.source}: group {unknown[0]!r} has no calibrated offset; known: {known}")
    return np.array([result.offsets_db[name] for name in links.group_names])[links.group_index]


def _check_files(result: Result, setup: Setup) -> None:
    """Refuse a scene that is not the one that was calibrated; results of the version before cannot tell."""
    if not result.files:
        return
    # By name, for the folder may have moved as a whole.
    before, now = (
        sorted((Path(file).name, digest) for file, digest in files.items())
        for files in (result.files, setup.files)
    )
    changed = sorted({name for name, _ in set(before) ^ set(now)})
    if changed:
        raise InputError(
            f"{result.study.path}: {', '.join(changed[:5])} changed since the calibration, which may no longer hold; "
            "calibrate again, or give --anyway (anyway=True)"
        )
