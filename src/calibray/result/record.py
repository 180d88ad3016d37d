"""What a calibration found: the record, its files, and path loss at links that were never measured."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import Measurements
from calibray.result.chosen import Chosen, ChosenTerm
from calibray.result.residuals import ResidualField
from calibray.result.rows import COLUMNS, read_rows
from calibray.result.stored import VERSION, read_stored
from calibray.result.tables import summary
from calibray.result.validation import FILE as VALIDATION_FILE
from calibray.result.validation import read_validation, write_validation
from calibray.scenes import Scene, export_scene, read_scene
from calibray.study import Study
from calibray.support.output_files import check_outputs, check_unchanged, write_text
from calibray.support.progress import Progress
from calibray.tables import display as glance
from calibray.tracing.positions import EnclosedAntennas
from calibray.uncertainty.intervals import Interval

if TYPE_CHECKING:
    from calibray.paths import Paths
    from calibray.validation.validation import Validation

FILES: Final = ("result.json", "result-links.csv", "result-history.csv", "result-scene.xml")
"""What a result is written to; users have files called links.csv and scene.xml themselves."""

RESULT_FILE, LINKS_FILE, HISTORY_FILE, SCENE_FILE = FILES


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished calibration.

    Attributes:
        study: The study, with the method, seed and engine that ran.
        parameters: Calibrated values by name, in the fields' units.
        initial_parameters: Values before calibration.
        intervals: 95 % intervals and verdicts with their reasons, by parameter; approximate ones where the engine
            gives no derivatives.
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
            whether a path leads there, whether it was held out, and its own change on tracing again; then the positions
            tx_x to rx_z [m], the group and the carrier [Hz] where links have them, path loss with the offsets alone
            [dB] where there are any, and, where not path loss was measured, the three values as what was. Where the
            model expects some too near the noise floor, `faint` says which. Results of the version before lack what
            follows the change.
        history: One row per RT call: number, iteration, RMSE, best so far, seconds since the start.
        laws: How calibrated constants follow the frequency: the coefficients itu_a to itu_d of ITU-R P.2040's law, by
            material of which one is a parameter.
        groups_without_path: Groups that have no offset, because no link of theirs to calibrate on has a path.
        enclosed: Antennas that stand inside closed bodies of the scene; None where nothing was looked for.
        scene: The scene as it was read, from which the calibrated one is written; None in a result that was loaded.
        nuisances: Coefficients of the study's further nuisances by name and group, [dB] per unit of the column.
        nuisance_centres: What was taken off the column of those that turn about a point.
        draws: Values of the parameters, and of nuisances, that explain the links about as well as those found; empty
            where none could be drawn.
        noise: Weights of the kinds of noise that intervals allow for, and of an offset that was forgotten.
        free_offset_db: The offset that would fit best beside a study without `[offset]`, [dB]; None where not tried.
        free_offset_error_db: Its standard error, [dB].
        remarks: What is to be said aloud of this calibration, a sentence each.
        power_shares: Share of the links' power that paths with an interaction carry, by material and kind; "line of
            sight" for those without.
        validation: Held-out errors of every model, where blocks were held out in turn; None where none were.
        profile_calls: Replays that intervals and draws took, beside the RT calls of the method.
        profile_seconds: Time that these took [s].
        cheap_calls: Replays of the cheap model that the method had beside the engine; none of them is an RT call.
        cheap_seconds: Time that these took [s].
        residual_db: Standard deviation of a link's error that predictions are given, [dB]; None where not known.
        residual_basis: What it was taken from.
        files: SHA-256 of every file that the scene and the antennas were read from, by path; empty where not known.
        paths: The paths calibrated on, for drawing; None in a result that was loaded, or where they are not at hand.
        chosen: The model that blocks held out in turn speak for, which predictions go by; None where none were.
        residual_field: What neighbouring links' errors share, which predictions beside measured links are corrected
            by; None where they show nothing.
        prepared: What was left out, averaged or moved before rows were links, and how many of them.
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
    groups_without_path: tuple[str, ...] = ()
    enclosed: EnclosedAntennas | None = None
    scene: Scene | None = None
    files: dict[str, str] = field(default_factory=dict)
    paths: Paths | None = None
    prepared: dict[str, int] = field(default_factory=dict)
    nuisances: dict[str, dict[str, float]] = field(default_factory=dict)
    nuisance_centres: dict[str, float] = field(default_factory=dict)
    draws: dict[str, list[float]] = field(default_factory=dict)
    noise: dict[str, float] = field(default_factory=dict)
    free_offset_db: float | None = None
    free_offset_error_db: float | None = None
    remarks: tuple[str, ...] = ()
    power_shares: dict[str, dict[str, float]] = field(default_factory=dict)
    validation: Validation | None = None
    profile_calls: int = 0
    profile_seconds: float = 0.0
    cheap_calls: int = 0
    cheap_seconds: float = 0.0
    residual_db: float | None = None
    residual_basis: str = ""
    chosen: Chosen | None = None
    residual_field: ResidualField | None = None

    @property
    def counts(self) -> dict[str, Any]:
        """The links of the calibration in numbers, with the rows that need a look.

        Of the links held out only those count that the hold-out's RMSE is taken over.
        """
        has_path = self.links["has_path"].to_numpy(bool)
        held_out = self.links["held_out"].to_numpy(bool)
        usable = has_path | (self.study.objective.no_path == "censor")
        if "faint" in self.links:
            usable &= ~self.links["faint"].to_numpy(bool)
        return {
            "calibrated_on": int((~held_out & usable).sum()),
            "held_out": int((held_out & usable).sum()),
            "rows_without_path": self.links["row"][~has_path].tolist(),
            "rows_with_enclosed_tx": None if self.enclosed is None else list(self.enclosed.tx),
            "rows_with_enclosed_rx": None if self.enclosed is None else list(self.enclosed.rx),
        }

    @property
    def diagnostics(self) -> dict[str, pd.DataFrame]:
        """Residuals, leverage, power, trade-offs and neighbours as tables; see `calibray.result.diagnostics`."""
        from calibray.result.diagnostics import diagnostics

        return diagnostics(self)

    def __repr__(self) -> str:
        return glance.text(*summary(self))

    def _repr_html_(self) -> str:
        return glance.html(*summary(self))

    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write `result.json`, `result-links.csv`, `result-history.csv` and the calibrated `result-scene.xml`.

        Where blocks were held out in turn, `result-validation.json` as well. Each file is written beside its place and
        then moved there, so that none is ever half-written.

        Args:
            folder: Folder to write into; made if absent.
            overwrite: Replace files that Calibray did not write.

        Raises:
            InputError: The folder cannot be written, or a file there must not be replaced.
        """
        target = check_outputs(folder, (*FILES, VALIDATION_FILE), self.study.files(), overwrite)
        try:
            target.mkdir(parents=True, exist_ok=True)
            self._write(target)
        except OSError as error:
            raise InputError(
                f"output folder {target}: cannot be written ({error.strerror}); name another"
            ) from None

    def _write(self, target: Path) -> None:
        scene = self.scene or read_scene(
            self.study.scene_source, self.study.scene.frequency, self.study.overrides, self.study.objects
        )
        export_scene(scene, self.materials, target / SCENE_FILE)
        write_text(target / LINKS_FILE, self.links.to_csv(index=False, float_format="%.10g"))
        write_text(target / HISTORY_FILE, self.history.to_csv(index=False, float_format="%.9g"))
        # One of an earlier calibration is of that calibration.
        (target / VALIDATION_FILE).unlink(missing_ok=True)
        if self.validation is not None:
            write_validation(self.validation, target)
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
            "groups_without_path": list(self.groups_without_path),
            "links": self.counts,
            "antennas_indoors": None if self.enclosed is None else self.enclosed.indoors,
            "files": self.files,
            "prepared": self.prepared,
            "nuisances": self.nuisances,
            "nuisance_centres": self.nuisance_centres,
            "draws": self.draws,
            "noise": self.noise,
            "free_offset_db": self.free_offset_db,
            "free_offset_error_db": self.free_offset_error_db,
            "remarks": list(self.remarks),
            "power_shares": self.power_shares,
            "profile_calls": self.profile_calls,
            "profile_seconds": self.profile_seconds,
            "cheap_calls": self.cheap_calls,
            "cheap_seconds": self.cheap_seconds,
            "residual_db": self.residual_db,
            "residual_basis": self.residual_basis,
            "chosen": None if self.chosen is None else asdict(self.chosen),
            "residual_field": None if self.residual_field is None else asdict(self.residual_field),
        }

    @classmethod
    def load(cls, folder: str | Path, *, anyway: bool = False) -> Result:
        """Read a folder that `save` wrote.

        Args:
            folder: The folder.
            anyway: Read it although its files changed since they were written.

        Returns:
            The result.

        Raises:
            InputError: The folder holds no result, one of another version, or one that was damaged or edited.
        """
        source = Path(folder) / RESULT_FILE
        stored, study = read_stored(source)
        links, history = (read_rows(source.parent, name, columns) for name, columns in COLUMNS.items())
        for name in () if anyway else (RESULT_FILE, *COLUMNS, VALIDATION_FILE):
            if (source.parent / name).exists():
                check_unchanged(source.parent / name)
        given = {name: getattr(stored, name) for name in type(stored).model_fields}
        for name in ("version", "study_file", "links", "antennas_indoors"):
            del given[name]
        # Results of the version before say nothing of enclosed antennas.
        if stored.links is not None and stored.antennas_indoors is not None:
            tx, rx = stored.links.rows_with_enclosed_tx or (), stored.links.rows_with_enclosed_rx or ()
            given["enclosed"] = EnclosedAntennas(tx, rx, stored.antennas_indoors)
        if stored.chosen is not None:
            terms = tuple(ChosenTerm(**asdict(each)) for each in stored.chosen.terms)
            given["chosen"] = replace(Chosen(**asdict(stored.chosen)), terms=terms)
        if stored.residual_field is not None:
            given["residual_field"] = ResidualField(**asdict(stored.residual_field))
        given["intervals"] = {name: Interval(**asdict(each)) for name, each in stored.intervals.items()}
        given["materials"] = {name: Material(**asdict(each)) for name, each in stored.materials.items()}
        given["validation"] = read_validation(source.parent, len(links))
        return cls(**{**given, "study": study, "links": links, "history": history})

    def predict(
        self,
        links: Measurements | pd.DataFrame,
        progress: Progress | None = None,
        *,
        anyway: bool = False,
    ) -> NDArray[np.float64]:
        """Path loss at links that were never measured; see `calibray.prediction.predict.predict`.

        Args:
            links: The links, or a table with columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m], or else with those that
                the study names for positions, and with its group column, if it has one. The study's column of
                frequencies gives the links' carriers; without it all links have the scene's.
            progress: Called with the stage "tracing" after every launch.
            anyway: Predict although a file of the scene or an antenna changed since the calibration.

        Returns:
            Path loss, offsets included [n], [dB]; +inf where no path leads.

        Raises:
            InputError: A column is missing, a position cannot be used, a group has no calibrated offset, or a file of
                the scene or an antenna changed since the calibration.
        """
        from calibray.prediction.predict import predict

        return predict(self, links, progress, anyway=anyway)

    def predict_interval(
        self,
        links: Measurements | pd.DataFrame,
        level: float = 0.9,
        progress: Progress | None = None,
        *,
        anyway: bool = False,
    ) -> pd.DataFrame:
        """Path loss with its interval at links that were never measured; see `calibray.prediction.predict`.

        Args:
            links: The links, or a table, as for `predict`; groups need not have been measured.
            level: Probability that a measurement lies within.
            progress: Called with the stage "tracing" after every launch.
            anyway: Predict although a file of the scene or an antenna changed since the calibration.

        Returns:
            One row per link: path_loss_db, lower_db, upper_db [dB], and basis, what the interval was taken from; where
            not path loss was measured, the three as what was; and remark, on a place where no link should be.

        Raises:
            InputError: What `predict` refuses but for groups, the level is not between 0 and 1, or the calibration had
                too few links to tell the size of errors.
        """
        from calibray.prediction.predict import predict_interval

        return predict_interval(self, links, level, progress, anyway=anyway)
