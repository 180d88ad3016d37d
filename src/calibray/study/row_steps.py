"""The steps that convert the rows of a study's table into links."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from calibray.coordinates import WGS84, Frame
from calibray.errors import InputError
from calibray.measurements import (
    POSITION_COLUMNS,
    Averaging,
    LinkColumns,
    Measurements,
    Preparation,
    SourceTable,
    Track,
    measured_links,
    read_table,
)
from calibray.measurements.observables import FLIGHTS
from calibray.scenes.obstruction import CLUSTER
from calibray.scenes.obstruction import COLUMNS as OBSTRUCTION
from calibray.study.calibration_sections import HoldoutSection
from calibray.study.model import StudyModel
from calibray.study.mounting import (
    PORT_POWER,
    check_mounting_columns,
    mounting_columns,
    port_power,
    states_port_power,
)
from calibray.study.observables import FILTERED, filtered_values
from calibray.study.regions import Place

if TYPE_CHECKING:
    from calibray.measurements import Ground, MoveOutside
    from calibray.measurements.preparation import Compute
    from calibray.scenes.checks import SceneSurfaces
    from calibray.scenes.obstruction import Region

_LOG: Final = logging.getLogger(__name__)
_COLUMN_KEYS: Final = {"tx", "rx", "value", "quantity", "weight", "std", "tx_power_dbm", "frequency"}
"""Keys of ``[links]`` that are fields of `LinkColumns`."""


def study_links(study: StudyModel) -> Measurements:
    """All links of a study, including held-out links.

    Raises:
        InputError: The table cannot be used, or the scene is not georeferenced.
    """
    return measured_links(read_table(study.links_path), link_columns(study), row_steps(study))


def link_columns(study: StudyModel) -> LinkColumns:
    """The columns of the table of links, including those that define the groups of the offset.

    Raises:
        InputError: Keys of ``[links]`` contradict each other.
    """
    columns = study.links.model_dump(include=_COLUMN_KEYS)
    if states_port_power(study):
        columns["tx_power_dbm"] = PORT_POWER
    return LinkColumns(**columns, group=study.offset_groups or None)


def row_steps(study: StudyModel) -> Preparation:
    """The steps, stated in a study, that convert rows to links.

    Raises:
        InputError: The scene is not georeferenced or cannot be read.
    """
    links = study.links
    inside = None if links.inside == "keep" else links.inside
    groups = [label for term in study.nuisance_terms.values() for label in term.per]
    groups += [item.bias for item in study.observables.values() if item.bias not in (None, "all")]
    # The file of an observable identifies links by this label.
    groups += [item.id for item in study.observables.values() if item.file is not None]
    # Columns computed from the scene are added to the links later.
    keep = [label for label in groups if label not in (*OBSTRUCTION, CLUSTER)]
    keep += [links.frequency] if links.frequency else []
    # The mean over the rows of a link must not include values that a filter excludes.
    filtered: dict[str, Compute] = {
        FILTERED.format(column=item.column, name=name): partial(filtered_values, item)
        for name, item in study.observables.items()
        if item.column is not None and item.where is not None
    }
    # The mean of equal labels or positions could differ from the common value in the last digit.
    others = {*keep, *links.tx, *links.rx, *POSITION_COLUMNS, links.value, "constant", "log_distance"}
    means = {*(term.by for term in study.nuisance_terms.values()), links.position_error_m}
    return replace(
        position_steps(study),
        track=row_track(study),
        wide=links.wide,
        where=links.where,
        missing=links.missing,
        noise_floor_dbm=links.noise_floor_dbm,
        censored=links.below_floor == "censor",
        averaging=None if links.average is None else Averaging(**links.average.model_dump()),
        keep=list(
            dict.fromkeys([*keep, *mounting_columns(study), *([links.device] if links.device else [])])
        ),
        held_out=None if study.holdout is None else partial(_held_out_parts, study.holdout, links.value),
        observables=[
            *(item.column for item in study.observables.values() if item.column is not None),
            *filtered,
        ],
        means=sorted(name for name in means - others if isinstance(name, str)),
        flights=[item.column for item in study.observables.values() if item.column and item.kind in FLIGHTS],
        computed=filtered | ({PORT_POWER: partial(port_power, study)} if states_port_power(study) else {}),
        check=partial(check_mounting_columns, study),
        inside=inside,
        outside=None if inside is None else _move_outside(study),
    )


def _held_out_parts(holdout: HoldoutSection, value: str, table: SourceTable) -> NDArray[Any]:
    """Labels [rows] that assign each row to a separately held-out part of a table.

    All labels are 0 if the parts depend on the measured value or on columns that averaging adds. Such parts are
    determined later from the averaged and merged links.
    """
    table, none = replace(table, frame=table.frame.drop(columns=value, errors="ignore")), np.zeros(len(table))
    if holdout.by is not None:
        return table.column(holdout.by).to_numpy() if holdout.by in table.frame else none
    try:
        return none if holdout.where is None else table.where(holdout.where)
    except InputError:
        return none


def row_track(study: StudyModel) -> Track | None:
    """The track with the positions of the rows; None if there is no track."""
    track = study.links.track
    return None if track is None else Track(str(study.track_path), track.time, track.longest_gap, track.clock)


def position_steps(study: StudyModel) -> Preparation:
    """The steps that determine the antenna positions of rows. No row is removed.

    Raises:
        InputError: The scene is not georeferenced or cannot be read.
    """
    links, transmitters = study.links, study.transmitters_path
    return Preparation(
        ground=None if links.heights is None else _ground(study),
        transmitters=None if transmitters is None else read_table(transmitters),
        transmitter=links.transmitter,
        crs=links.crs or WGS84,
        unit_m=links.position_unit,
        computed={PORT_POWER: partial(port_power, study, optional=True)} if states_port_power(study) else {},
        frame=scene_frame(study) if links.position == "geographic" else None,
    )


# Code that reads meshes imports SciPy, so this code is imported only for studies that need meshes.


def _ground(study: StudyModel) -> Ground:
    return _surfaces(study.scene_source).ground_height


def _move_outside(study: StudyModel) -> MoveOutside:
    from calibray.scenes.checks import building_outlines, move_outside

    return partial(move_outside, outlines=building_outlines(study.scene_source))


def scene_frame(study: StudyModel) -> Frame:
    """The georeference of the scene, from the study or, if the study states none, from the scene file.

    Raises:
        InputError: Neither the study nor the scene file states a georeference, or the projection is unknown.
    """
    frame = known_frame(study)
    if frame is None:
        raise InputError(
            f"{study.path}: links.position = 'geographic': the scene is not georeferenced; give scene.origin = "
            "[longitude, latitude], and scene.crs if the scene is in a map projection"
        )
    return frame


def known_frame(study: StudyModel) -> Frame | None:
    """The georeference of the scene; None if neither the study nor the scene file states one.

    Raises:
        InputError: The projection is unknown.
    """
    origin, crs = study.scene.origin, study.scene.crs
    if crs is not None:
        if origin is None:
            return Frame(crs)
        # In a frame without an origin, positions are the coordinates of the reference system.
        easting, northing, _ = Frame(crs).to_scene([origin[0]], [origin[1]])[0]
        return Frame(crs, float(easting), float(northing))
    if origin is not None:
        return Frame.local(*origin)
    from calibray.scenes import read_frame

    return read_frame(study.scene_source)


def study_regions(study: StudyModel) -> dict[str, Region]:
    """The regions of a study, by name.

    Raises:
        InputError: A file cannot be read, or the scene is not georeferenced.
    """
    if not study.regions:
        return {}

    place, paths = scene_place(study), study.region_paths
    regions = {name: section.region(paths[name], place) for name, section in study.regions.items()}
    for name in [name for name, region in regions.items() if not len(region.outline)]:
        _LOG.warning(
            "%s: [regions.%s] is outside the scene and has no effect; check the position of the region, or remove the "
            "region",
            study.path, name,
        )  # fmt: skip
    return regions


def scene_place(study: StudyModel) -> Place:
    """The georeference and the surfaces of the scene, for regions and facades."""
    return Place(known_frame(study), partial(_surfaces, study.scene_source))


def _surfaces(source: str) -> SceneSurfaces:
    from calibray.scenes.checks import SceneSurfaces

    return SceneSurfaces.read(source)
