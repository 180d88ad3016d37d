"""The study: one calibration problem, as stated in a study file."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from numbers import Real
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.materials import Material
from calibray.measurements import (
    POSITION_COLUMNS,
    TRACK_COLUMNS,
    Measurements,
    Preparation,
    SourceTable,
    links_from_table,
    mask_codes,
    melt,
    read_table,
    select_rows,
)
from calibray.scenes import write_scene
from calibray.study.calibration_sections import OFFSET, HoldoutSection
from calibray.study.model import StudyModel
from calibray.study.mounting import mounting_columns
from calibray.study.row_steps import position_steps, row_track, study_links
from calibray.study.setup import Setup
from calibray.study.toml_file import study_text
from calibray.support.messages import first_line, shortened, type_name
from calibray.support.output_files import check_outputs, write_table, write_text
from calibray.tables import Column, Table, hertz, numbers, short_html, short_text

if TYPE_CHECKING:
    from calibray.tracing.sionna.live_scene import LiveScene

_LOG: Final = logging.getLogger(__name__)


@final
class Study(StudyModel):
    """One calibration problem, as stated in a study file (see ``docs/reference/study-file.md``).

    Attributes:
        version: Version of the file format.
        scene: The scene and the carrier.
        objects: Patterns of object names, keyed by the name of the new material of these objects.
        materials: Constants that override those of the scene, by material name.
        links: The measured links.
        antennas: The antennas.
        trace: Settings of the ray tracer.
        objective: How path loss is computed from the paths, and how links without a path are treated.
        parameters: The parameters by name, in the order of the values of a candidate.
        offset: The nuisance term "offset" in its short form; None if there is no offset.
        nuisance: Further nuisance terms by name; `nuisance_terms` contains all terms.
        noise: The errors of the measured links.
        holdout: The held-out links; None if no links are held out.
        fidelity: The conditions under which paths are traced again.
        method: The optimizer.
        engine: The engine.
    """

    @classmethod
    def from_sionna(
        cls,
        scene: object,
        /,
        measured: Any,
        folder: str | Path | None = None,
        *,
        overwrite: bool = False,
        **sections: Mapping[str, Any],
    ) -> Study:
        """Create a study from a Sionna RT scene in memory: carrier, transmitters, receivers, arrays and materials.

        Args:
            scene: The `sionna.rt.Scene`.
            measured: Path loss [tx, rx], [dB], in the order of the scene's transmitters and receivers, with NaN where
                nothing was measured. Alternatively, a pandas DataFrame with the names of transmitters as rows and the
                names of receivers as columns. Masked values and pd.NA are treated as NaN.
            folder: Folder in which the scene, the links and `study.toml` are written for `Study.load`; a temporary
                folder if None.
            overwrite: Whether to replace files in the folder that Calibray did not write.
            **sections: Sections of the study file that replace the defaults, such as ``trace={"max_depth": 5}`` or
                ``links={"quantity": "received_power"}``. Materials, constants and antennas that are not given are those
                of the scene. Without `parameters`, the permittivities of all materials except air and metal are
                calibrated.

        Returns:
            The study; `Result.apply` sets the calibrated materials in the scene.

        Raises:
            InputError: The scene or a value cannot be used, or the folder cannot be written.
        """
        for name, section in sections.items():
            if not isinstance(section, Mapping):
                raise InputError(
                    f"{name}: is {shortened(repr(section))}, must be a dictionary with keys of this section of the "
                    "study file; omit the argument for the defaults"
                )
        target = mkdtemp(prefix="calibray-study-") if folder is None else folder
        target = check_outputs(target, ("links.csv", "study.toml"), overwrite=overwrite)
        content = _write_live_study(scene, measured, target, sections, overwrite)
        study = cls.from_content(content, target / "study.toml")
        write_text(target / "study.toml", study_text(content, {}))
        return study

    def __repr__(self) -> str:
        return short_text(*summary(self))

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return short_html(*summary(self))

    def measurements(self) -> Measurements:
        """All links of the study, including held-out links, with the groups of the offset.

        Raises:
            InputError: The table cannot be used (see `read_measurements`), or the scene is not georeferenced.
        """
        return study_links(self)

    def places(self, table: SourceTable) -> Measurements:
        """Links without measured values, for predictions, with the groups of the offset.

        Args:
            table: Rows in the format of the study's table, or with the columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z [m]
                in the scene frame, as in `result-links.csv`. No row is left out. A row of a wide table becomes one link
                per transmitter.

        Returns:
            One link per row, with carriers if the table contains the carrier column of the study.

        Raises:
            InputError: A column is missing or malformed, or a position is not finite.
        """
        links, columns = self.links, {*table.frame}
        group: str | Sequence[str] | None = self.offset_groups or None
        if columns >= {*POSITION_COLUMNS}:
            # A table of links that Calibray writes has one column of groups and one column of carriers.
            if "group" in columns and not columns & {*self.offset_groups}:
                group = "group"
            carrier = "frequency" if links.frequency not in columns else links.frequency
            own = {*POSITION_COLUMNS} & {*links.tx, *links.rx}
            if own and links.value in columns and (links.heights is not None or links.position_unit != 1):
                _LOG.warning(
                    "%s: columns tx_x to rx_z are read as metres in the scene frame; links.heights and "
                    "links.position_unit are not applied. To apply these keys, rename %s in both tables and in the "
                    "study",
                    table.source, ", ".join(sorted(own)),
                )  # fmt: skip
            return links_from_table(table, group, carrier if links.frequency else None)
        wide = {column: name for column, name in links.wide.items() if column in columns}
        if wide and links.transmitter not in columns:
            table, _ = mask_codes(table, list(wide), links.missing)
            table = melt(table, wide, links.value, links.transmitter, keep_empty=True)
        steps = position_steps(self)
        table = self._freed_for_join(table, steps)
        if links.track is not None and links.track.time in columns and not columns & {*TRACK_COLUMNS}:
            rows, table = len(table), select_rows(table, Preparation(track=row_track(self)))
            if len(table) < rows:
                raise InputError(
                    f"{table.source}: {rows - len(table)} of {rows} rows have times outside the track and therefore no "
                    "position; remove these rows"
                )
        elif not wide and not columns & {*links.tx, *links.rx}:
            return links_from_table(table, group, links.frequency)
        return links_from_table(table, group, links.frequency, steps=steps, tx=links.tx, rx=links.rx)

    def _freed_for_join(self, table: SourceTable, steps: Preparation) -> SourceTable:
        """The table, with new names for columns that the study's links took from the table of transmitters.

        If a column of the table kept such a name, the join would rename the column from the table of transmitters.
        """
        if steps.transmitters is None:
            return table
        used = {*self.links.tx, *mounting_columns(self)} - {*self.links.rx, self.links.transmitter}
        shared = used & {*table.frame} & {*steps.transmitters.frame}
        joined = shared - {*read_table(self.links_path).frame} if shared else shared
        if joined:
            _LOG.warning(
                "%s: column %s is ignored, because the calibration took this column from %s; to avoid this warning, "
                "rename the column",
                table.source, ", ".join(sorted(joined)), self.transmitters_path,
            )  # fmt: skip
        return replace(table, frame=table.frame.rename(columns={name: f"input_{name}" for name in joined}))

    def opened(self) -> Setup:
        """Open the study: read its links, scene and parameters (see `Setup.open`)."""
        return Setup.open(self)


def _held_out(section: HoldoutSection) -> str:
    if section.where is not None:
        return section.where
    return f"{section.blocks} blocks in turn" if section.by is None else f"each {section.by} in turn"


def summary(study: StudyModel) -> tuple[Table, Table]:
    """The sections of a study and its parameters, as two tables."""
    rows = [
        ("scene", study.scene.file),
        ("frequency", hertz(study.scene.frequency)),
        *([("of each link", study.links.frequency)] if study.links.frequency else []),
        ("links", f"{study.links.file}: {study.links.value}, {study.links.quantity}"),
        ("combining", study.objective.combining),
    ]
    for name, term in study.nuisance_terms.items():
        groups = f"per {' and '.join(term.per)}" if term.per else "one for all links"
        rows.append((name, groups if name == OFFSET else f"{term.by}, {groups}"))
    if study.holdout is not None:
        rows.append(("held out", _held_out(study.holdout)))
    rows.append(("method", f"{study.method.name}, seed {study.method.seed}"))
    rows.append(("engine", study.engine.name))
    bounds = tuple(
        (name, f"{entry.bounds[0]:g}", f"{entry.bounds[1]:g}", entry.scale)
        for name, entry in study.parameters.items()
    )
    columns = (Column(), numbers("lower"), numbers("upper"), Column("scale"))
    return (
        Table(f"Study {study.path.name}", (Column(), Column()), tuple(rows)),
        Table("Parameters", columns, bounds),
    )


VALUE: Final = "measured"
AIR: Final = 1.1
"""Largest permittivity that counts as air; all other ITU-R P.2040 materials have a permittivity of at least 1.26
(ceiling board)."""

LARGEST_PERMITTIVITY: Final = 15.0
"""Default upper bound of a calibrated permittivity. The value is more than twice the largest permittivity of a building
material in ITU-R P.2040."""


METAL: Final = 1e6
"""Smallest conductivity [S/m] of a material that counts as metal; ITU-R P.2040 states 1e7. Metal reflects nearly all
power at any permittivity."""


def permittivity_bounds(materials: Mapping[str, Material]) -> dict[str, list[float]]:
    """Default permittivity bounds of all materials except air and metal, by material name.

    Compared with other building materials, ceiling board has a lower permittivity and wet ground a much higher
    permittivity.
    """
    return {
        name: [min(1.5, round(1 + 0.75 * (start - 1), 3)), max(LARGEST_PERMITTIVITY, round(2 * start))]
        for name, start in ((name, item.relative_permittivity) for name, item in materials.items())
        if start > AIR and materials[name].conductivity < METAL
    }


def _write_live_study(
    scene: object, measured: Any, folder: Path, sections: Mapping[str, Any], overwrite: bool
) -> dict[str, Any]:
    """Write the files of a scene in memory and the measured values, and return the content of the study.

    Raises:
        InputError: The scene or the measured values cannot be used, or the folder cannot be written.
    """
    from calibray.tracing.sionna.live_scene import LiveScene

    if "scene" in sections:
        raise InputError(
            "scene: the carrier is that of the scene in memory; set the attribute frequency of this scene instead"
        )
    live = LiveScene.of(scene)
    links = dict(sections.get("links", {}))
    table = _links(live, measured)
    constants = {
        name: {key: value for key, value in asdict(item).items() if not isinstance(value, str)}
        for name, item in live.materials.items()
    }
    write_scene(folder, live.objects, constants, overwrite=overwrite)
    write_table(folder / "links.csv", table)
    bounds = permittivity_bounds(live.materials)
    if not bounds and "parameters" not in sections:
        raise InputError(
            "parameters: all materials of the scene are metal or air; give the parameters to calibrate"
        )
    power = {"tx_power_dbm": "tx_power_dbm"} if links.get("quantity") == "received_power" else {}
    ends = {"tx": POSITION_COLUMNS[:3], "rx": POSITION_COLUMNS[3:]}
    antennas = {
        end: asdict(antenna) | {"orientation": list(antenna.orientation)}
        for end, antenna in zip(ends, live.antennas, strict=True)
    }
    # The default scattering coefficient of Sionna RT is 0, but a value of 0 stated in the study would count as exact.
    materials = {
        name: {
            key: value for key, value in constants[name].items() if value or key != "scattering_coefficient"
        }
        | {"scattering_pattern": item.scattering_pattern}
        for name, item in live.materials.items()
    }
    given = dict(sections.get("materials", {}))
    return {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": live.frequency},
        "parameters": {
            f"{name}.relative_permittivity": {"bounds": default} for name, default in bounds.items()
        },
        **sections,
        # Keys that a section does not state keep the values of the scene.
        "materials": materials | {name: _stated(materials.get(name, {}), own) for name, own in given.items()},
        "antennas": antennas | {"known": True, **sections.get("antennas", {})},
        "links": {"file": "links.csv", **ends, "value": VALUE, **power, **links},
    }


def _stated(constants: Mapping[str, Any], given: Any) -> Any:
    """The constants of a material in a scene, overridden by the constants or the ITU-R P.2040 material of the user."""
    if not isinstance(given, Mapping):
        return given
    law = {"relative_permittivity", "conductivity"} if "itu" in given else set[str]()
    return {key: value for key, value in constants.items() if key not in law} | dict(given)


def _links(live: LiveScene, measured: pd.DataFrame | ArrayLike) -> pd.DataFrame:
    """A table with one row per measured value, including the names of both ends."""
    values = _matrix(live, measured)
    tx, rx = (np.array(list(ends.values())) for ends in (live.tx, live.rx))
    row, column = np.nonzero(~np.isnan(values))
    if not len(row):
        raise InputError(
            "measured: contains no number; give a value for each transmitter and receiver, or NaN where nothing was "
            "measured"
        )
    table = pd.DataFrame(np.hstack([tx[row], rx[column]]), columns=list(POSITION_COLUMNS))
    return table.assign(
        transmitter=np.array(list(live.tx))[row],
        receiver=np.array(list(live.rx))[column],
        tx_power_dbm=np.array(list(live.tx_power_dbm.values()))[row],
        **{VALUE: values[row, column]},
    )


def _matrix(live: LiveScene, measured: pd.DataFrame | ArrayLike) -> NDArray[np.float64]:
    """Measured values [tx, rx] in the order of the scene. Values that were not measured are NaN."""
    if isinstance(measured, pd.DataFrame):
        for what, labels, names in (("row", measured.index, live.tx), ("column", measured.columns, live.rx)):
            kind = "transmitter" if what == "row" else "receiver"
            if labels.has_duplicates:
                label = str(labels[labels.duplicated()][0])
                raise InputError(f"measured: {what} {label!r} is repeated; give one {what} for each {kind}")
            if unknown := [str(label) for label in labels if label not in names]:
                raise InputError(
                    f"measured: {what} {unknown[0]!r} is not a {kind} of the scene; rows must be transmitters and "
                    "columns must be receivers"
                )
        measured = measured.reindex(index=list(live.tx), columns=list(live.rx)).to_numpy()
    elif isinstance(measured, str | Path):
        raise InputError(
            f"measured: is the text {shortened(str(measured))!r}, must be the measured values; read the file first, "
            "for instance with pandas.read_csv(file, index_col=0)"
        )
    elif hasattr(measured, "columns"):
        raise InputError(
            f"measured: is a {type_name(measured)}, which has no row names; give a pandas DataFrame with names of "
            "transmitters as rows (.to_pandas().set_index(...)), or an array in the order of the scene (.to_numpy())"
        )
    try:
        given = np.ma.asanyarray(measured)
    except (TypeError, ValueError) as error:
        raise InputError(f"measured: is not a matrix of numbers ({first_line(error)})") from None
    if given.shape != (shape := (len(live.tx), len(live.rx))):
        raise InputError(
            f"measured: shape {given.shape}, must be {shape}: one row per transmitter and one column per receiver"
        )
    present = ~(np.ma.getmaskarray(given) | pd.isna(np.ma.getdata(given)))
    values, stated = np.full(shape, np.nan), np.ma.getdata(given).astype(object)
    for tx, rx in np.argwhere(present).tolist():
        value = stated[tx, rx]
        if isinstance(value, bool) or not (isinstance(value, Real) and np.isfinite(float(value))):
            raise InputError(
                f"measured: {list(live.tx)[tx]}, {list(live.rx)[rx]}: {shortened(repr(value))}, must be a finite real "
                "number in decibels, or NaN where nothing was measured"
            )
        values[tx, rx] = value
    return values
