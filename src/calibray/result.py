"""What a calibration found: the record, its files, and path loss at links that were never measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from calibray import fields
from calibray.engines import make_parameters, make_replay, make_scene, traced_paths
from calibray.errors import InputError
from calibray.files import check_folder, write_text
from calibray.inference.likelihood import Interval
from calibray.materials import Material
from calibray.measurements import Measurements, links_from_frame
from calibray.report import glance, records
from calibray.scenes import export_scene
from calibray.study import Study
from calibray.tracing.sionna import Progress

VERSION: Final = 1
FILES: Final = ("result.json", "links.csv", "history.csv", "scene.xml")
RESULT_FILE, LINKS_FILE, HISTORY_FILE, SCENE_FILE = FILES


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished calibration.

    Attributes:
        study: The study, with the method, seed and engine that ran.
        parameters: Calibrated values by name, in the fields' units.
        initial_parameters: Values before calibration.
        intervals: 95 % intervals and verdicts by parameter; empty where the engine gives no derivatives.
        materials: All materials of the scene at its carrier, the calibrated values in place.
        offsets_db: Offsets by group, [dB]; the nameless group stands for all links; empty without `[offset]`.
        rmse_db: RMSE over the links calibrated on (paper eq. 1), [dB].
        initial_rmse_db: The same before anything was fitted, offsets included.
        offset_only_rmse_db: The same with only the offsets fitted; None without `[offset]`.
        holdout_rmse_db: RMSE over the links held out; None without `[holdout]`.
        initial_holdout_rmse_db: The same before anything was fitted.
        offset_only_holdout_rmse_db: The same with only the offsets fitted, on the links calibrated on.
        log_distance_rmse_db: RMSE of a log-distance model fitted to the links calibrated on.
        log_distance_holdout_rmse_db: Its RMSE over the links held out.
        retrace_gap_db: Largest change of a calibrated link's path loss when the scene is traced again with the
            materials found, [dB]; None where the paths do not depend on the materials.
        rt_calls: RT calls that the method spent, whether now or in an earlier run that left them in the ledger.
        ledger_hits: How many of them the ledger answered.
        seconds: Time that the method took, tracing not included.
        trace_seconds: Time that tracing and loading took before.
        links: One row per link: row in the source file, measured, before, after and log-distance path loss [dB],
            whether a path leads there, whether it was held out, and its own change on tracing again.
        history: One row per RT call: number, iteration, RMSE, best so far, seconds since the start.
        laws: How calibrated constants follow the frequency: the coefficients itu_a to itu_d of ITU-R P.2040's law, by
            material of which one is a parameter.
    """

    study: Study
    parameters: dict[str, float]
    initial_parameters: dict[str, float]
    intervals: dict[str, Interval]
    materials: dict[str, Material]
    offsets_db: dict[str, float]
    rmse_db: float
    initial_rmse_db: float
    offset_only_rmse_db: float | None
    holdout_rmse_db: float | None
    initial_holdout_rmse_db: float | None
    offset_only_holdout_rmse_db: float | None
    log_distance_rmse_db: float
    log_distance_holdout_rmse_db: float | None
    retrace_gap_db: float | None
    rt_calls: int
    ledger_hits: int
    seconds: float
    trace_seconds: float
    links: pd.DataFrame
    history: pd.DataFrame
    laws: dict[str, dict[str, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return glance.text(*records.result(self))

    def _repr_html_(self) -> str:
        return glance.html(*records.result(self))

    def save(self, folder: str | Path) -> None:
        """Write `result.json`, `links.csv`, `history.csv` and the calibrated `scene.xml`.

        Each file is written beside its place and then moved there, so that none is ever half-written.

        Args:
            folder: Folder to write into; made if absent.

        Raises:
            InputError: The folder cannot be written.
        """
        target = check_folder(folder)
        try:
            target.mkdir(parents=True, exist_ok=True)
            self._write(target)
        except OSError as error:
            raise InputError(
                f"output folder {target}: cannot be written ({error.strerror}); name another"
            ) from None

    def _write(self, target: Path) -> None:
        export_scene(self.study.scene_source, self.materials, target / SCENE_FILE, self.study.objects)
        write_text(target / LINKS_FILE, self.links.to_csv(index=False, float_format="%.6g"))
        write_text(target / HISTORY_FILE, self.history.to_csv(index=False, float_format="%.9g"))
        write_text(target / RESULT_FILE, json.dumps(self.content(), indent=2) + "\n")

    def content(self) -> dict[str, Any]:
        """The result as plain values, but for the tables of links and calls."""
        return {
            "version": VERSION,
            "study_file": str(self.study.path.resolve()),
            "study": self.study.content(),
            "rmse_db": self.rmse_db,
            "initial_rmse_db": self.initial_rmse_db,
            "offset_only_rmse_db": self.offset_only_rmse_db,
            "holdout_rmse_db": self.holdout_rmse_db,
            "initial_holdout_rmse_db": self.initial_holdout_rmse_db,
            "offset_only_holdout_rmse_db": self.offset_only_holdout_rmse_db,
            "log_distance_rmse_db": self.log_distance_rmse_db,
            "log_distance_holdout_rmse_db": self.log_distance_holdout_rmse_db,
            "retrace_gap_db": self.retrace_gap_db,
            "rt_calls": self.rt_calls,
            "ledger_hits": self.ledger_hits,
            "seconds": self.seconds,
            "trace_seconds": self.trace_seconds,
            "parameters": self.parameters,
            "initial_parameters": self.initial_parameters,
            "intervals": {name: asdict(interval) for name, interval in self.intervals.items()},
            "offsets_db": self.offsets_db,
            "materials": {name: asdict(material) for name, material in self.materials.items()},
            "laws": self.laws,
        }

    @classmethod
    def load(cls, folder: str | Path) -> Result:
        """Read a folder that `save` wrote.

        Args:
            folder: The folder.

        Returns:
            The result.

        Raises:
            InputError: The folder holds no result, or one of another version.
        """
        source = Path(folder) / RESULT_FILE
        try:
            content = json.loads(source.read_text(encoding="utf-8"))
            links, history = (pd.read_csv(source.with_name(name)) for name in (LINKS_FILE, HISTORY_FILE))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{source}: is no result of `calibray run` ({error}); name its --out folder"
            ) from None
        if content.get("version") != VERSION:
            raise InputError(
                f"{source}: has version {content.get('version')}, need {VERSION}; run the study again"
            )
        study = Study.from_content(content.pop("study"), content.pop("study_file"))
        del content["version"]
        content["intervals"] = {name: Interval(**entry) for name, entry in content["intervals"].items()}
        content["materials"] = {name: Material(**entry) for name, entry in content["materials"].items()}
        return cls(study=study, links=links, history=history, **content)

    def predict(self, links: Measurements | pd.DataFrame, progress: Progress | None = None) -> np.ndarray:
        """Path loss at links that were never measured, with the calibrated scene.

        Args:
            links: The links, or a table with columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m] and the study's group
                column, if it has one. The study's column of frequencies gives the links' carriers; without it all
                links have the scene's.
            progress: Called with (receivers traced, receivers in all) after every chunk.

        Returns:
            Path loss, offsets included [n], [dB]; +inf where no path leads.

        Raises:
            InputError: A column is missing, a position cannot be used, or a group has no calibrated offset.
        """
        per = self.study.offset.per if self.study.offset else None
        if not isinstance(links, Measurements):
            links = links_from_frame(links, group=per, frequency=self.study.links.frequency)
        offset = self._offset(links)
        paths = traced_paths(self.study, make_scene(self.study, self.materials), links, progress)
        if links.frequency is not None:
            parameters = make_parameters(self.study, make_scene(self.study), links)
            values = np.array([[self.parameters[name] for name in parameters.names]])
            return make_replay(self.study, paths, links, parameters).path_loss(values)[0] + offset
        objective = self.study.objective
        return fields.path_loss(paths, None, objective.combining, self.study.scene.bandwidth) + offset

    def _offset(self, links: Measurements) -> np.ndarray:
        if not self.offsets_db:
            return np.zeros(len(links))
        unknown = [name for name in links.group_names if name not in self.offsets_db]
        if unknown:
            raise InputError(
                f"{links.source}: group {unknown[0]!r} has no calibrated offset; known: {', '.join(self.offsets_db)}"
            )
        return np.array([self.offsets_db[name] for name in links.group_names])[links.group_index]


def by_group(names: tuple[str, ...], values: np.ndarray) -> Mapping[str, float]:
    """Values by group name."""
    return {name: float(value) for name, value in zip(names, values, strict=True)}
