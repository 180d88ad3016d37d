"""The result of a calibration: a record, with methods to store, show, predict, suggest and export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.measurements import Measurements
from calibray.reporting import diagnostics, result_tables
from calibray.result import files, wording
from calibray.result.record import Record
from calibray.support.progress import Progress
from calibray.tables import short_html, short_text
from calibray.validation.validation import Validation

if TYPE_CHECKING:
    from calibray.engines.cluster.workers import Workers
    from calibray.prediction.coverage_map import CoverageMap

# Methods that trace or evaluate paths import modules only when they are called, so that a stored result is shown
# quickly.


@final
@dataclass(frozen=True, eq=False, repr=False)
class Result(Record):
    """A finished calibration; `Record` lists its sections."""

    def __repr__(self) -> str:
        return short_text(*result_tables.summary(self))

    def _repr_html_(self) -> str:
        return short_html(*result_tables.summary(self))

    @classmethod
    def load(cls, folder: str | Path, *, allow_changed_inputs: bool = False) -> Result:
        """Read a result that `save` wrote; with `allow_changed_inputs`, its files may have been edited.

        Raises:
            InputError: The folder contains no result, or the result was written by another version, is damaged, or was
                edited.
        """
        return cls(**files.read(folder, allow_changed_inputs=allow_changed_inputs))

    @cached_property
    def validation(self) -> Validation | None:
        """The validation, if blocks were held out in turn; None otherwise."""
        return None if self.held_out is None else Validation.of(self.held_out)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Warnings, advice, the judgement on held-out links, and the reason for the choice of the prediction model."""
        return wording.remarks(self, "" if self.validation is None else self.validation.choice)

    @property
    def diagnostics(self) -> dict[str, pd.DataFrame]:
        """Tables of residuals, leverage, power, trade-offs and neighbours; see `calibray.reporting.diagnostics`."""
        return diagnostics.diagnostics(self)

    def content(self) -> dict[str, Any]:
        """The result as a dictionary, as in `result.json`."""
        return files.content(self, self.remarks)

    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write `result.json`, `result-links.csv`, `result-history.csv` and the calibrated `result-scene.xml`.

        After a validation, `result-validation.json` is also written. Every file is written completely or not at all.
        The folder is created if it does not exist. With `overwrite`, files that Calibray did not write are also
        replaced.

        Raises:
            InputError: The folder cannot be written to, or a file in it must not be replaced.
        """
        validation = None if self.validation is None else self.validation.content()
        files.write(self, folder, overwrite, sentences=self.remarks, validation=validation)

    def predict(
        self,
        links: Measurements | pd.DataFrame,
        progress: Progress | None = None,
        *,
        allow_changed_inputs: bool = False,
    ) -> NDArray[np.float64]:
        """Predict the path loss of new links.

        Args:
            links: The links, or a table of links. Its columns are tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m], or the
                position columns that the study names, and the study's group column, if any. The study's frequency
                column contains the carriers; without this column, all links have the scene's carrier.
            progress: Called with the stage "tracing" after every launch.
            allow_changed_inputs: Predict even if a scene or antenna file has changed since the calibration.

        Returns:
            Path loss with nuisances [links], [dB]; for a link without a path, the prediction of the fallback.

        Raises:
            InputError: A column is missing, a position cannot be used, a group has no calibrated offset, or a scene or
                antenna file has changed since the calibration.
        """
        from calibray.prediction.predict import predict

        return predict(self, links, progress, allow_changed_inputs=allow_changed_inputs)

    def predict_interval(
        self,
        links: Measurements | pd.DataFrame,
        level: float = 0.9,
        progress: Progress | None = None,
        *,
        allow_changed_inputs: bool = False,
    ) -> pd.DataFrame:
        """Predict the path loss of new links, with an interval for a measurement of each link.

        Args:
            links: The links, or a table, as for `predict`; groups without measurements are allowed.
            level: Probability that a measurement lies in the interval.
            progress: Called with the stage "tracing" after every launch.
            allow_changed_inputs: Predict even if a scene or antenna file has changed since the calibration.

        Returns:
            One row per link, with the index of the table: path_loss_db, lower_db and upper_db [dB]; the same three
            columns in the measured quantity if path loss was not measured; basis, the source of the interval; and
            remark, a warning about an unlikely antenna position or an unusually weak link.

        Raises:
            InputError: `predict` would refuse the links for a reason other than unknown groups, the level is not
                between 0 and 1, or the calibration had too few links to estimate the spread of residuals.
        """
        from calibray.prediction.predict import predict_interval

        return predict_interval(self, links, level, progress, allow_changed_inputs=allow_changed_inputs)

    def coverage_map(
        self,
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
        """Predict path loss over an area; see `calibray.coverage_map` for the arguments, the result and errors."""
        from calibray.prediction.coverage_map import coverage_map

        return coverage_map(
            self, tx, height=height, cell=cell, bounds=bounds, level=level, power_dbm=power_dbm, samples=samples,
            columns=columns, progress=progress, workers=workers, allow_changed_inputs=allow_changed_inputs,
        )  # fmt: skip

    def suggest(
        self,
        candidates: Measurements | pd.DataFrame,
        count: int = 5,
        progress: Progress | None = None,
        *,
        allow_changed_inputs: bool = False,
        observables: bool = False,
    ) -> pd.DataFrame:
        """Suggest where to measure next; see `calibray.suggest` for the arguments, the result and errors."""
        from calibray.prediction.suggestion import suggest

        return suggest(
            self,
            candidates,
            count,
            progress,
            allow_changed_inputs=allow_changed_inputs,
            observables=observables,
        )

    def report(self, file: str | Path, *, overwrite: bool = False, progress: Progress | None = None) -> Path:
        """Write the result as one HTML page; see `calibray.report` for the arguments and errors."""
        from calibray.reporting.page import report

        return report(self, file, overwrite=overwrite, progress=progress)

    def apply(self, scene: object) -> None:
        """Set the materials in a `sionna.rt.Scene` in memory, at the study's carrier.

        As in exports, these are `scene_materials`: the materials of the prediction model, or the calibrated materials
        if that model uses no scene. If the scene has a different carrier, a warning states both carriers. Unlike the
        constants of ITU materials, these constants do not change when `scene.frequency` is set.

        Raises:
            InputError: The object is not a Sionna RT scene, or the scene lacks a material.
        """
        from calibray.tracing.sionna.live_scene import apply_materials

        apply_materials(scene, self.scene_materials, self.study.scene.frequency)

    def export(
        self,
        folder: str | Path,
        *,
        copy: bool = False,
        overwrite: bool = False,
        allow_changed_inputs: bool = False,
    ) -> tuple[str, ...]:
        """Write the calibrated scene for Sionna RT, and its materials as tables; see `calibray.reporting.export`."""
        from calibray.reporting.export import export

        return export(self, folder, copy, overwrite, allow_changed_inputs=allow_changed_inputs)
