"""The antenna of each link, with its direction and port power, from a study and the columns of the links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calibray.errors import InputError
from calibray.measurements import Measurements, SourceTable
from calibray.parameters import Parameter, Parameters
from calibray.paths import Paths
from calibray.paths.chains import zenith_azimuth
from calibray.study.model import StudyModel
from calibray.study.sections import MountingSection
from calibray.support.messages import did_you_mean, shortened
from calibray.tracing.antennas import EVERY, NEW, POSE, AntennaPattern, Mounting, Pose, stated_jones, turns
from calibray.tracing.settings import Antenna

if TYPE_CHECKING:
    from calibray.fields import Effects


PORT_POWER: Final = "tx_port_power_dbm"
"""Name of the column with the power [dBm] that the transmitter of a link feeds into its antenna."""

LEAST_GAIN: Final = 1e-3
"""Minimum gain [1] along the straight line. If this line is in a null, paths in other directions carry the power. The
patterns of 3GPP TR 38.901 have a lower limit of 30 dB below the maximum gain."""


def mounting_columns(study: StudyModel) -> tuple[str, ...]:
    """The columns of antennas, antenna directions and, if parameters refer to transmitters, transmitter names."""
    columns = [name for section in study.links.mountings.values() for name in section.columns.values()]
    own = [
        name for name in study.parameters if name.startswith(POSE) and not name.startswith(POSE + EVERY + ".")
    ]
    return tuple(dict.fromkeys([*columns, *([study.links.transmitter] if own else [])]))


def check_mounting_columns(study: StudyModel, table: SourceTable) -> None:
    """Raise an error if a table lacks a column of the antennas or of their directions.

    Raises:
        InputError: A column is missing.
    """
    for end, section in study.links.mountings.items():
        for key, name in section.columns.items():
            if name in table.frame:
                continue
            remedy = did_you_mean(name, map(str, table.frame))
            if end == "tx" and study.transmitters_path is not None and not table.joined:
                own = [name for name in (study.links.transmitter, *study.links.rx) if isinstance(name, str)]
                remedy = (
                    f"add this column to {shortened(', '.join(map(str, table.frame)), 200)}, or leave out tx_x, "
                    f"tx_y and tx_z and give {', '.join(own)} as in the study's table, which takes the antennas from "
                    f"{study.transmitters_path}"
                )
            raise InputError(
                f"{table.tables}: no column {shortened(name)!r} (links.{end}_antenna.{key}); {remedy}"
            )


def link_mountings(study: StudyModel, links: Measurements) -> dict[str, Mounting]:
    """The mountings at those ends of the links ("tx", "rx") at which antennas differ between links.

    Raises:
        InputError: A column is missing or malformed, or names an unknown antenna.
    """
    return {end: _mounting(study, end, section, links) for end, section in study.links.mountings.items()}


def _mounting(study: StudyModel, end: str, section: MountingSection, links: Measurements) -> Mounting:
    antennas, index = link_antennas(study, end, links.table)
    away = links.rx - links.tx if end == "tx" else links.tx - links.rx
    limits = {"azimuth_deg": 360, "downtilt_deg": 90, "electrical_downtilt_deg": 90, "steering_deg": 360}
    without_direction = np.array([is_omnidirectional(antenna) for antenna in antennas])[index]
    degrees = [
        np.radians(_degrees(links.table, f"links.{end}_antenna.{key}", stated, limit, without_direction))
        for key, limit in limits.items()
        for stated in [getattr(section, key) or 0.0]
    ]
    yaw, downtilt, electrical, steering = degrees
    if section.aim is not None:
        yaw = np.arctan2(away[:, 1], away[:, 0])
        # Downtilt is positive downwards.
        downtilt = -np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))
    # A bearing is measured clockwise from north, and yaw is measured counter-clockwise from east. Steering is measured
    # in the same sense as azimuth.
    elif section.azimuth_deg is not None and section.azimuth_from == "north":
        yaw = np.pi / 2 - yaw
    if section.azimuth_from == "north":
        steering = -steering
    single = np.array([not antenna.is_array for antenna in antennas])[index]
    if (steering[single] != 0).any():
        raise InputError(
            f"{study.path}: links.{end}_antenna.steering_deg: the antenna is not an array; state rows and columns in "
            f"antennas.{end}, or remove this key"
        )
    return Mounting(antennas, index, Pose(yaw, downtilt, electrical, steering))


def direct_gain(study: StudyModel, links: Measurements) -> NDArray[np.float64]:
    """Sum [L], [dBi], of the stated antenna gains at both ends along the straight line of each link.

    The gain at an end is 0 dBi if all links share one antenna there, and its Sionna RT pattern has no main direction.

    Raises:
        InputError: A column is missing or malformed, or names an unknown antenna.
    """
    gain_db = np.zeros(len(links))
    away = (links.rx - links.tx) / links.distance[:, None]
    mountings = link_mountings(study, links)
    for end, antenna in study.stated_antennas.items():
        if (
            end not in mountings
            and antenna.pattern in ("iso", "dipole", "hw_dipole")
            and not antenna.is_array
        ):
            continue
        one = Mounting((antenna,), np.zeros(len(links), dtype=np.int64), Pose(*np.zeros((4, len(links)))))
        jones = stated_jones(mountings.get(end, one), zenith_azimuth(away if end == "tx" else -away))
        gain_db += 10 * np.log10(np.maximum((jones[:, 0] ** 2).sum(axis=-1), LEAST_GAIN))
    return gain_db


def pose_effects(
    study: StudyModel,
    mountings: Mapping[str, Mounting],
    table: SourceTable,
    parameters: Parameters,
    paths: tuple[Paths, NDArray[np.int64]],
) -> Effects:
    """The effects of antenna pose errors on paths; empty if no parameter, such as "tx:CELL.azimuth", turns an antenna.

    `mountings` and `table` describe all links. `paths` contains the paths of selected links and the indices of these
    links.

    Raises:
        InputError: The column of transmitters is missing.
    """
    # JAX is slow to import, and this module is imported whenever a study file is read.
    from calibray.engines.pose import pose_error

    items = [parameters.items[index] for index in parameters.of_effects]
    if not any(turns(item.name) for item in items):
        return ()
    stored, chosen = paths
    section = study.links.mountings["tx"]
    labels = transmitter_labels(study, table, items)[chosen]
    effect = pose_error(
        stored, mountings["tx"].of_paths(chosen), labels, items, section.azimuth_from == "north"
    )
    return () if effect is None else (effect,)


def transmitter_labels(study: StudyModel, table: SourceTable, items: Sequence[Parameter]) -> NDArray[np.str_]:
    """Transmitter names [rows]; empty strings if all parameters apply to every transmitter.

    Raises:
        InputError: The column of transmitters is missing.
    """
    if all(item.material == POSE + EVERY for item in items if turns(item.name)):
        return np.full(len(table), "")
    return table.labels(study.links.transmitter)


def link_antennas(
    study: StudyModel, end: str, table: SourceTable
) -> tuple[tuple[Antenna, ...], NDArray[np.int64]]:
    """The distinct antennas at one end ("tx" or "rx"), and the antenna index of every row [rows].

    Raises:
        InputError: The column of antennas is missing, or names an unknown antenna.
    """
    section = study.links.mountings.get(end)
    if section is None or section.type is None:
        return (study.stated_antennas[end],), np.zeros(len(table), dtype=np.int64)
    types, labels = study.antenna_types, table.labels(section.type)
    unknown = np.flatnonzero(~np.isin(labels, list(types)))
    if len(unknown):
        name = str(labels[unknown[0]])
        known = did_you_mean(name, types) if types else "there is none"
        raise InputError(
            f"{table.cell(int(unknown[0]), section.type)}: {name!r} is not an antenna of [antennas.types]; {known}"
        )
    names, index = np.unique(labels, return_inverse=True)
    return tuple(types[name] for name in names.tolist()), index.reshape(-1)


def _degrees(
    table: SourceTable, key: str, stated: float | str, limit: int, may_be_empty: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Angles [rows], [deg]. In rows that the mask `may_be_empty` [rows] selects, an empty cell counts as 0."""
    if isinstance(stated, str) and pd.api.types.is_numeric_dtype(column := table.column(stated)):
        table = table.assign(**{stated: column.mask(column.isna() & may_be_empty, 0.0)})
    values = table.numbers(stated)
    wrong = np.flatnonzero(np.abs(values) > limit)
    if len(wrong):
        place = table.cell(int(wrong[0]), stated) if isinstance(stated, str) else key
        raise InputError(f"{place}: {values[wrong[0]]:g} must be -{limit} to {limit}; give degrees")
    return values


def states_port_power(study: StudyModel) -> bool:
    """Whether the power at the antenna port is computed from an EIRP or a cable loss."""
    return study.links.eirp_dbm is not None or study.links.cable_loss_db is not None


def port_power(study: StudyModel, table: SourceTable, optional: bool = False) -> NDArray[np.float64] | None:
    """Power [rows], [dBm], that the transmitter of each row feeds into its antenna.

    This power is the transmitted power minus the cable loss, or the EIRP minus the maximum gain of the antenna. With
    `optional`, the result is None if a column is missing.

    Raises:
        InputError: A column is missing or malformed, or names an unknown antenna.
    """
    links = study.links
    section = links.tx_antenna
    stated = [links.eirp_dbm, links.tx_power_dbm, links.cable_loss_db, section.type if section else None]
    if optional and any(isinstance(name, str) and name not in table.frame for name in stated):
        return None
    if links.eirp_dbm is None:
        return table.numbers(links.tx_power_dbm or 0.0) - table.numbers(links.cable_loss_db or 0.0)
    antennas, index = link_antennas(study, "tx", table)
    gain = np.array([largest_gain_dbi(antenna) for antenna in antennas])
    return table.numbers(links.eirp_dbm) - gain[index]


def largest_gain_dbi(antenna: Antenna) -> float:
    """Maximum gain [dBi] of an antenna over all directions on a one-degree grid."""
    zenith, azimuth = np.meshgrid(np.radians(np.arange(181.0)), np.radians(np.arange(-180.0, 180.0)))
    # The amplitude of an array can be negative in side lobes.
    return float(20 * np.log10(np.abs(AntennaPattern.of(antenna).amplitude(zenith, azimuth)).max()))


def is_omnidirectional(antenna: Antenna) -> bool:
    """Whether the gain of an antenna varies by at most 3 dB in the horizontal plane of its mount.

    Example:
        >>> is_omnidirectional(Antenna("dipole")), is_omnidirectional(Antenna("tr38901"))
        (True, False)
    """
    azimuth = np.radians(np.arange(-180.0, 180.0))
    direction = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))])
    power = (np.abs(AntennaPattern.of(antenna).jones_vectors(direction)) ** 2).sum(axis=(1, 2))
    return bool(2 * power.min() >= power.max())


FIRST_SPREAD: Final = 0.25
"""Initial value of an estimated spread, as a fraction of the width of the bounds. The standard deviation of a uniform
distribution is 0.29 times its width."""


def estimated_fields(study: StudyModel) -> tuple[str, ...]:
    """The antenna fields whose spread across transmitters is estimated."""
    return tuple(
        name.rpartition(".")[2] for name, entry in study.parameters.items() if entry.spread == "auto"
    )


def with_population(study: StudyModel, links: Measurements) -> dict[str, Any]:
    """The content of a study in which each parameter with a `spread` has one further parameter per transmitter.

    One more parameter represents transmitters without measured links. This parameter has the prior of the population,
    and no link constrains it.

    Raises:
        InputError: The column of transmitters is missing.
    """
    content = study.content()
    labels = np.unique(links.table.labels(study.links.transmitter)).tolist()
    for name, entry in study.parameters.items():
        if entry.spread is None:
            continue
        lower, upper = entry.bounds
        std = FIRST_SPREAD * (upper - lower) if entry.spread == "auto" else entry.spread
        for label in (*labels, NEW):
            own = {"bounds": [lower, upper], "prior": {"std": std, "shared": True}}
            # A transmitter that has its own entry keeps this entry.
            content["parameters"].setdefault(f"{POSE}{label}.{name.rpartition('.')[2]}", own)
    return content


def with_spreads(study: StudyModel, spreads: Mapping[str, float]) -> dict[str, Any]:
    """The content of a study with new standard deviations of the transmitters' priors, keyed by field name."""
    content = study.content()
    for name, entry in content["parameters"].items():
        field = name.rpartition(".")[2]
        if field in spreads and entry.get("prior", {}).get("shared"):
            entry["prior"]["std"] = spreads[field]
    return content
