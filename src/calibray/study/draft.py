"""Drafts a study from a scene and a table of links. The draft is TOML; comments state the reason for each assumption.

Names of columns, groups and files are user input. `study_text` quotes this input, so TOML never interprets a name as
syntax.
"""

from __future__ import annotations

import json
import logging
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from calibray.errors import InputError
from calibray.measurements import column_names, transmitter_columns
from calibray.measurements.column_names import PositionColumns, ValueColumn, matches
from calibray.measurements.selection import find_codes, without_codes
from calibray.measurements.transmitter_columns import find_powers, plain_name
from calibray.scenes import Scene, read_frame, read_scene
from calibray.scenes.authoring import TREES_FILE
from calibray.scenes.checks import count_crossings
from calibray.study.calibration_sections import DEFAULT_BLOCKS
from calibray.study.content import BUNDLED, VERSION
from calibray.study.draft_links import Assumption, Given, LinksDraft
from calibray.study.link_checks import CELL_SHARE, LINKS_PER_UNKNOWN, count_unknowns
from calibray.study.mounting import is_omnidirectional
from calibray.study.regions import Place, RegionSection, dense_trees
from calibray.study.study import Study, permittivity_bounds
from calibray.study.toml_file import study_text
from calibray.support.messages import shortened
from calibray.support.output_files import exists
from calibray.tables import rows_text
from calibray.tracing.gain_table import TWO_CUT_SUFFIXES, read_gain_table, read_two_cuts
from calibray.tracing.settings import PATTERNS, Antenna

_LOG: Final = logging.getLogger(__name__)

AVERAGING_WAVELENGTHS: Final = 40
"""Width [wavelengths] of the cells over which fading is averaged (Lee 1985; see `calibray.measurements.reading`)."""

PLACE_SAMPLES: Final = 20
"""Samples are averaged by position, as in a stationary scan, if their median number per position is at least this
large. The logarithm of the mean of 20 samples of Rayleigh fading is biased by 0.1 dB."""

CLIPPED_SHARE: Final = 0.03
"""Clipping by the receiver is assumed only if at least this share of the values equals the lowest value."""

CLIPPED_RATIO: Final = 10
"""Clipping is assumed only if the lowest value occurs at least this many times as often as other values (median)."""

MISSING_SHARE: Final = 0.1
"""If more than this fraction of a device's powers is missing, its lowest power is used as its noise floor."""

FEWEST_OF_DEVICE: Final = 20
"""Minimum number of measured powers that are needed to infer the noise floor of a device. With a probability of 88 %,
the lowest of 20 powers is in the lowest tenth of the distribution."""


def draft_links(scene: str, links: Path, target: Path, given: Given) -> LinksDraft:
    """Draft ``[links]``. The arguments are those of `LinksDraft`.

    Raises:
        InputError: A file cannot be read, or a value is neither given nor in the files.
    """
    draft = LinksDraft(scene, links, target, given)
    value = _value(draft)
    draft.add_positions()
    draft.section |= {"value": value.column, "quantity": value.quantity}
    if value.quantity == "received_power":
        draft.section |= _powers(draft, value)
    draft.groups = _offset_groups(draft, value)
    _add_noise_floor(draft, value)
    _add_averaging(draft, draft.rx)
    draft.add_heights()
    _add_observables(draft)
    return draft


def _value(draft: LinksDraft) -> ValueColumn:
    value = column_names.find_value(draft.table)
    codes = find_codes(draft.table.frame[value.column])
    draft.assume_codes(codes, value.column)
    powers = _powers(draft, value)
    if value.quantity == "rsrp" and powers:
        reason = f"{value.reason}; {next(iter(powers.values()))} is the transmitted power"
        value = ValueColumn(value.column, "received_power", reason)
    draft.assume("links.value", value.column, value.reason)
    reason = "by name and sign"
    if value.quantity == "rsrp":
        reason = "the transmitted power is unknown and becomes part of [offset]"
    draft.assume("links.quantity", value.quantity, reason)
    return value


def _powers(draft: LinksDraft, value: ValueColumn) -> dict[str, str]:
    """Column of the EIRP or the transmitted power, by its key in ``[links]``; empty if there is no such column."""
    power = column_names.find_transmit_power(draft.table.frame)
    if power is not None:
        return {"eirp_dbm" if column_names.matches(power, "EIRP") else "tx_power_dbm": power}
    # A reference signal has the power of one subcarrier; a table of transmitters states the power of the whole carrier.
    if draft.sites is None or column_names.matches(value.column, "reference signal"):
        return {}
    return find_powers(draft.transmitter_rows)


def _offset_groups(draft: LinksDraft, value: ValueColumn) -> list[str]:
    """The columns whose labels define the groups of the offset."""
    if value.quantity != "rsrp":
        draft.assume(
            "offset", "one for all links", "the values include cable losses and unknown antenna gains"
        )
        return []
    name = draft.section.get("transmitter")
    devices = transmitter_columns.find_devices(draft.table.frame)
    carriers = _carriers_of_transmitters(draft)
    ends = [
        *(["each transmitter"] if name else []),
        *(["each receiver"] if devices else []),
        *(["each carrier"] if carriers else []),
    ]
    reasons = [] if devices else ["no column of receiving devices was found"]
    if ends:
        reasons.append(f"{' and '.join(ends)} has its own gain")
    groups = [*([name] if name else []), *devices, *carriers]
    groups = list(dict.fromkeys(groups))
    draft.assume("offset.per", ", ".join(groups) or "one", "; ".join(reasons))
    return groups


def _carriers_of_transmitters(draft: LinksDraft) -> list[str]:
    """The column of carriers, if any transmitter has several carriers."""
    frame, name, carrier = draft.table.frame, draft.section.get("transmitter"), draft.section.get("frequency")
    if (
        carrier is None
        or carrier not in frame
        or (name and frame.groupby(name)[carrier].nunique().max() == 1)
    ):
        return []
    return [carrier]


def _add_noise_floor(draft: LinksDraft, value: ValueColumn) -> None:
    raw = draft.table.frame[value.column]
    column = without_codes(raw)
    missing = f"{int(column.isna().sum())} values are missing"
    if value.quantity not in ("rsrp", "received_power"):
        if raw.isna().any():
            draft.add_filter(f"`{value.column}`.notna()")
            draft.assume("links.where", draft.section["where"], missing)
        return
    _leave_out_saturated(draft, value, column)
    floor, reason, share = -np.inf, "", _share_at_lowest(column)
    some_missing = share == 0 and "wide" not in draft.section and column.isna().any()
    if share > 0:
        floor, reason = float(column.min()), f"{100 * share:.0f} % of the values equal the lowest value"
    elif some_missing:
        floor, reason = float(np.floor(column.min())), f"{missing}, and no measured value is lower"
    # The noise floor is that of the least sensitive device, which misses powers that other devices can measure.
    for name in transmitter_columns.find_devices(draft.table.frame):
        for device, values in column.groupby(draft.table.frame[name]):
            if values.notna().sum() < FEWEST_OF_DEVICE:
                continue
            lowest, which = float(values.min()), f"{name} {shortened(str(device))}"
            if (share := _share_at_lowest(values)) and lowest > floor:
                floor = lowest
                reason = (
                    f"{100 * share:.0f} % of the values of {which}, the least sensitive device, equal its lowest "
                    "value"
                )
            elif some_missing and values.isna().mean() > MISSING_SHARE and np.floor(lowest) > floor:
                floor = float(np.floor(lowest))
                reason = f"{missing}, and no value of {which}, the least sensitive device, is lower"
    if not reason:
        return
    draft.section["noise_floor_dbm"] = floor
    draft.assume("links.noise_floor_dbm", f"{floor:g} dBm", reason)


def _leave_out_saturated(draft: LinksDraft, value: ValueColumn, column: pd.Series) -> None:
    """Leave out rows with the highest power, which a saturated receiver reports for all higher powers."""
    share = _share_at_lowest(-column)
    if share > 0:
        name, highest = value.column, float(column.max())
        draft.add_filter(f"(`{name}` < {highest} or `{name}`.isna())")
        reason = f"{100 * share:.0f} % of the values equal the highest value: the receiver is saturated"
        draft.assume("links.where", draft.section["where"], reason)


def _share_at_lowest(values: pd.Series) -> float:
    """Share of values equal to the lowest value if a receiver seems to report it for lower powers, otherwise 0."""
    counts = values.value_counts().sort_index()
    share = counts.iloc[0] / counts.sum()
    if share >= CLIPPED_SHARE and counts.iloc[0] >= CLIPPED_RATIO * counts.iloc[1:].median():
        return float(share)
    return 0.0


def _add_averaging(draft: LinksDraft, rx: PositionColumns) -> None:
    """Average samples by position in stationary scans and height profiles; average other dense samples in cells."""
    frame, name = draft.table.frame, draft.section.get("transmitter")
    heights = [] if rx.height is None else [rx.height]
    keys = [rx.x, rx.y, *heights, *draft.groups, *([name] if name and name not in draft.groups else [])]
    keys += [part for part in draft.section["tx"] if isinstance(part, str) and part in frame]
    positions = len(frame[keys].drop_duplicates())
    repeated = frame.duplicated([*keys, draft.section["value"]]).any()
    if draft.given.track is None and positions >= len(frame) / 2 and not repeated:
        return
    rows = f"{len(frame)} rows " + ("along a track" if draft.given.track else f"at {positions} positions")
    samples = int(frame.groupby(keys, dropna=False).size().median())
    # A cell is an area in plan, so averages in cells would mix the heights of a profile or of several storeys.
    stacked = any(frame.groupby([rx.x, rx.y])[height].nunique().median() > 1 for height in heights)
    if draft.given.track is None and (samples >= PLACE_SAMPLES or stacked):
        few = samples < PLACE_SAMPLES
        draft.section["average"] = {"by": "place", "unbiased": True} if few else "place"
        draft.assume("links.average", "place", f"{rows}, {samples} at each")
        return
    fading = float(np.clip(round(AVERAGING_WAVELENGTHS * speed_of_light / draft.frequency, 1), 1.0, 10.0))
    bounds = draft.overhead.bounds
    size = min(fading, float(f"{CELL_SHARE * min(bounds[3:5] - bounds[:2]):.2g}"))
    draft.section["average"] = {"by": "cell", "size": size, "unbiased": True}
    reason = f"{AVERAGING_WAVELENGTHS} wavelengths average out fading"
    if size < fading:
        reason = f"{100 * CELL_SHARE:.0f} % of the scene, less than {AVERAGING_WAVELENGTHS} wavelengths"
    draft.assume("links.average", f"cells of {size:g} m", f"{rows}; {reason}")


def _add_observables(draft: LinksDraft) -> None:
    # A row of a wide table contains the powers of several transmitters, but only one time of flight or delay spread.
    if "wide" in draft.section:
        return
    if (delay_spread := column_names.find_delay_spread(draft.table.frame)) is not None:
        name, unit = (json.dumps(part, ensure_ascii=False) for part in delay_spread)
        reason = (
            f"column {delay_spread[0]} is not used, because its value depends on the receiver; to fit it, add "
            f'[observables.spread] with kind = "rms_delay_spread", column = {name}, unit = {unit}, and the '
            "receiver's dynamic_range_db or bandwidth"
        )
        draft.assume("observables.spread", "none", reason)
    if (flight_time := column_names.find_flight_time(draft.table.frame)) is None:
        return
    column, kind, unit = flight_time
    # The clock of a device adds the same error to all times that it measures.
    devices = transmitter_columns.find_devices(draft.table.frame)
    transmitter = draft.section.get("transmitter")
    bias, whose = "all", "the device"
    if devices:
        bias, whose = devices[0], "each device"
    elif transmitter in draft.table.frame:
        bias, whose = transmitter, "each transmitter"
    draft.observables["flight"] = {
        "kind": kind, "column": column, "unit": unit, "bias": bias, "path": "first"
    }  # fmt: skip
    draft.assume("observables.flight", column, f"by its name; the bias of {whose} is unknown")


MOST_MATERIALS: Final = 6
"""Maximum number of materials that a draft calibrates, because links seldom determine more materials."""

INDOOR_DEPTHS: Final = (3, 5)
"""Minimum and maximum number of interactions along a path in an indoor study."""


@dataclass(frozen=True)
class Draft:
    """A drafted study.

    Attributes:
        text: The study file.
        study: The study that the text describes.
        assumptions: The assumptions, in the order of the file.
    """

    text: str
    study: Study
    assumptions: tuple[Assumption, ...]


def draft(scene: str, links: str | Path, target: str | Path, given: Given | None = None) -> Draft:
    """Draft a study from a scene (XML file or `sionna:NAME`) and a table of links; no file is written.

    File names in the study are relative to the folder of `target`, the future study file. `given` contains further user
    input.

    Raises:
        InputError: A file cannot be read, or a value is neither given nor in the files.
    """
    drafted = draft_links(scene, Path(links), Path(target), given or Given())
    content = _content(drafted)
    _hold_out_blocks(drafted, content)
    text = study_text(content, {assumption.what: assumption.reason for assumption in drafted.assumptions})
    study = Study.from_content(tomllib.loads(text), target)
    return Draft(text, study, tuple(drafted.assumptions))


def _content(links: LinksDraft) -> dict[str, Any]:
    """The sections of the study."""
    section = links.section
    indoors = _indoors(links)
    if section.get("position") == "geographic" and not indoors:
        section["inside"] = "move"
        reason = "satellite positions have errors of metres, and some positions are inside buildings"
        # Powers at displaced receivers can be averaged only at one carrier.
        reason += "" if "frequency" in section else "; position_error_m models these errors"
        links.assume("links.inside", "move", reason)
    antenna_section = add_antennas(links)
    trace: dict[str, Any] = {"max_depth": _depth(links) if indoors else 3, "samples": "auto"}
    # Most links behind buildings have only diffracted paths.
    trace["refraction" if indoors else "diffraction"] = True
    scene, constants = _scene(links)
    regions, attenuation = _trees(links)
    return {
        "version": VERSION,
        "scene": links.scene_section | {"frequency": links.frequency},
        **({"materials": constants} if constants else {}),
        "links": section,
        "antennas": antenna_section,
        "trace": trace,
        "parameters": _parameters(links, scene, indoors) | attenuation,
        **({"regions": regions} if regions else {}),
        **({"observables": links.observables} if links.observables else {}),
        "offset": {"per": links.groups} if links.groups else {},
        "method": {"name": "auto", "seed": 0},
    }


def _hold_out_blocks(links: LinksDraft, content: dict[str, Any]) -> None:
    """Hold out blocks in turn if there are enough links per unknown and enough receiver positions per block."""
    study = Study.from_content(content, links.target)
    measured = study.measurements()
    places = len(np.unique(measured.rx[:, :2], axis=0))
    if count_unknowns(study, measured) or places < DEFAULT_BLOCKS * LINKS_PER_UNKNOWN:
        return
    content["holdout"] = {"blocks": DEFAULT_BLOCKS}
    reason = (
        "each block of neighbouring links is predicted from the others; the prediction errors determine the prediction "
        "model"
    )
    links.assume("holdout.blocks", DEFAULT_BLOCKS, reason)


def _indoors(links: LinksDraft) -> bool:
    """Whether most receivers are below a ceiling or roof."""
    share = float(links.overhead.under_roof(links.measurements().rx).mean())
    indoors = share > 0.5
    reason = f"{100 * share:.0f} % of the receivers are below a ceiling or roof"
    links.assume("trace", "through walls" if indoors else "around buildings", reason)
    return indoors


def _depth(links: LinksDraft) -> int:
    """Maximum number of interactions: walls crossed in a straight line (95 % quantile) plus 2, in `INDOOR_DEPTHS`."""
    measured = links.measurements()
    walls = int(np.quantile(count_crossings(links.overhead.walls, measured.tx, measured.rx), 0.95))
    lowest, highest = INDOOR_DEPTHS
    depth = int(np.clip(walls + 2, lowest, highest))
    reason = f"walls on a straight line ({walls}) plus two reflections, limited to {lowest} to {highest}"
    links.assume("trace.max_depth", depth, reason)
    return depth


def _scene(links: LinksDraft) -> tuple[Scene, dict[str, dict[str, float]]]:
    """The scene, and the constants of materials for which ITU-R P.2040 has no law at the carrier.

    The constants are those at the nearest frequency that the law of the material covers.
    """
    try:
        return read_scene(links.scene, links.frequency), {}
    except InputError:
        # From 1 to 10 GHz, Table 3 of ITU-R P.2040 covers every material that occurs in scenes.
        covered = read_scene(links.scene, float(np.clip(links.frequency, 1e9, 10e9)))
    constants = {}
    for name, law in covered.laws.items():
        # The laws of ITU-R P.2040 are a f^b and c f^d, with f in GHz.
        nearest = float(np.clip(links.frequency / 1e9, law.lower, law.upper))
        if nearest != links.frequency / 1e9:
            permittivity, conductivity = law.a * nearest**law.b, law.c * nearest**law.d
            constants[name] = {"relative_permittivity": permittivity, "conductivity": conductivity}
    reason = (
        f"ITU-R P.2040 does not cover {links.frequency / 1e9:g} GHz: the constants are those at the nearest frequency "
        "covered"
    )
    links.assume("materials", ", ".join(constants), reason)
    return read_scene(links.scene, links.frequency, constants), constants


def _trees(links: LinksDraft) -> tuple[dict[str, Any], dict[str, Any]]:
    """The region of trees from the file next to the scene, and its parameter if a link's straight line crosses it."""
    file = Path(links.scene).parent / TREES_FILE
    # For other scenes, a file of this name need not contain the columns that `calibray scene` writes.
    if links.scene.startswith(BUNDLED) or read_frame(links.scene) is None or not exists(file):
        return {}, {}
    specific = round(dense_trees(links.frequency), 2)
    heights = {"heights": "ground", "bottom": "bottom", "top": "top"}
    content = {"file": links.relative(file), **heights, "specific_attenuation": specific}
    section = RegionSection.model_validate_json(json.dumps(content))
    region, measured = section.region(file, Place(links.frame, lambda: links.overhead)), links.measurements()
    crossing = int((region.length_inside(measured.tx, measured.rx) > 0).sum())
    reason = (
        f"the straight lines of {crossing} of {len(measured)} links cross trees; the value is typical of dense trees "
        "in leaf"
    )
    links.assume("regions", f"trees, {specific:g} dB/m", reason)
    parameter = {"region:trees.specific_attenuation": {"bounds": [0.0, 3.0]}} if crossing else {}
    return {"trees": content}, parameter


def _parameters(links: LinksDraft, scene: Scene, indoors: bool) -> dict[str, dict[str, Any]]:
    """The entries of ``[parameters]``: permittivities and, indoors, conductivities (these determine wall losses)."""
    bounds_of = permittivity_bounds(scene.materials)
    names, rest = list(bounds_of)[:MOST_MATERIALS], list(bounds_of)[MOST_MATERIALS:]
    if not names:
        raise InputError(
            f"{links.scene}: there is no material to calibrate, because all materials are metal or air"
        )
    entries: dict[str, dict[str, Any]] = {}
    for name in names:
        conductivity = scene.materials[name].conductivity
        entries[f"{name}.relative_permittivity"] = {"bounds": bounds_of[name]}
        if indoors and conductivity > 0:
            bounds = [min(1e-3, float(f"{conductivity / 10:.0e}")), 3.0]
            entries[f"{name}.conductivity"] = {"bounds": bounds, "scale": "log"}
    chosen = "the scene's materials except metal and air"
    if rest:
        chosen = (
            f"the first {MOST_MATERIALS} materials except metal and air; not calibrated: {', '.join(rest)}"
        )
    links.assume("parameters", ", ".join(names), f"{chosen}; start values are those of the scene")
    return entries


UNKNOWN: Final = {"pattern": "iso", "polarization": "V"}


def add_antennas(links: LinksDraft) -> dict[str, Any]:
    """Add the columns that describe transmit antennas to ``[links]``, and return the section ``[antennas]``.

    Raises:
        InputError: The folder of antennas cannot be used or has no file for an antenna.
    """
    folder = links.given.antennas
    frame, of_transmitters = links.transmitter_rows, links.given.transmitters is not None
    mount: dict[str, str] = {}
    antennas: dict[str, Any] = {"tx": dict(UNKNOWN), "rx": dict(UNKNOWN)}
    omnidirectional, tilted = np.zeros(len(frame), dtype=bool), False
    if folder is not None:
        patterns, omnidirectional, files = _patterns(links, folder, mount)
        antennas |= patterns
        tilted = any(
            abs(read_two_cuts(file).downtilt_deg) >= 1.0 for file in files
        )  # cuts have whole degrees
    for key, column in transmitter_columns.find_angles(frame, of_transmitters).items():
        electrical = folder is not None and key.startswith("electrical")
        if electrical and tilted and not matches(column, "additional"):
            cause = "the vertical cuts of the files include this downtilt"
        else:
            lacking = transmitter_columns.lacks_angle(frame[column], may_be_empty=omnidirectional)
            if folder is not None and lacking.any() and frame[column].notna().any():
                raise InputError(
                    f"{_cells(links, column, lacking)} contains no number; enter the angle [deg]; only cells of "
                    "omnidirectional antennas may be empty"
                )
            cause = transmitter_columns.unusable(frame, key, column, lacking)
        if cause:
            links.assume(f"links.tx_antenna.{key}", "none", f"column {column}: {cause}")
            continue
        mount[key] = column
        low, high = frame[column].min(), frame[column].max()
        reason = f"by its name, {low:g} to {high:g} degrees"
        reason += "; the main lobes in the files are horizontal" if electrical and not tilted else ""
        links.assume(f"links.tx_antenna.{key}", column, reason)
    if "azimuth_deg" not in mount and folder is not None and not omnidirectional.all():
        _LOG.warning(
            "%s: there are no azimuths, so directional antennas point east; add a column 'azimuth' [deg], clockwise "
            "from north",
            links.transmitter_table.source,
        )
    if folder is None and "azimuth_deg" in mount:
        antennas["tx"]["pattern"] = "tr38901"
    if mount:
        links.section["tx_antenna"] = mount
    for column in (
        name for name in links.table.frame if matches(name, "receiver") and matches(name, "azimuth")
    ):
        reason = (
            f"column {column} may describe the azimuth of a phone; if the antenna is directional, state this column "
            "and the pattern"
        )
        links.assume("links.rx_antenna.azimuth_deg", "none", reason)
    name = transmitter_columns.find_antenna_names(frame) if of_transmitters else None
    if folder is not None:
        reason = f"files of {folder.resolve().name}; the receiver's antenna is unknown"
    elif "azimuth_deg" in mount:
        reason = "azimuths are stated, so 3GPP sectors of 65 degrees are assumed; receivers are isotropic"
    else:
        reason = "unknown; state the antennas and their orientations"
    if folder is None and name is not None:
        reason += f"; give a folder of the MSI files named in column {name} with --antennas"
    links.assume(
        "antennas", f"{antennas['tx']['pattern']}, V" if folder is None else folder.resolve().name, reason
    )
    return antennas


def _patterns(
    links: LinksDraft, folder: Path, mount: dict[str, str]
) -> tuple[dict[str, Any], NDArray[np.bool_], list[Path]]:
    """The antennas named in a column of the transmitters, a mask of rows with omnidirectional antennas, and the files.

    Each name is that of a file in the folder or of a Sionna RT pattern. Without such a column, a single file is used
    for all transmitters.

    Raises:
        InputError: The folder cannot be used, or an antenna is not named or has no file.
    """
    rows = links.transmitter_rows
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in TWO_CUT_SUFFIXES)
    except OSError as error:
        raise InputError(f"--antennas {folder}: cannot be read ({error}); give a folder") from None
    if not files:
        raise InputError(
            f"--antennas {folder}: contains no *.msi, *.pln or *.ant file; export the antennas to this folder"
        )
    by_name = {plain_name(file.name): file for file in files}
    column = transmitter_columns.find_antenna_names(rows, by_name)
    if column is None and len(files) == 1:
        section = {"tx": _antenna(links, files[0])}
        return section, np.full(len(rows), is_omnidirectional(Antenna(str(files[0])))), files
    if column is None:
        raise InputError(
            f"--antennas {folder}: no column of {links.given.transmitters or links.links} contains the names of the "
            f"antennas; add a column with names such as {files[0].stem!r}, or keep only one file"
        )
    given = "; give the name of a file, or 'iso' or 'dipole' for an omnidirectional antenna"
    if (empty := rows[column].isna().to_numpy()).any():
        raise InputError(f"{_cells(links, column, empty)} is empty{given}")
    labels = sorted(rows[column].astype(str).unique().tolist())
    named = {label: by_name.get(plain_name(label)) or str(label).strip().lower() for label in labels}
    lacking = [label for label, name in named.items() if isinstance(name, str) and name not in PATTERNS]
    if lacking:
        raise InputError(
            f"--antennas {folder}: no file for {', '.join(map(repr, lacking[:5]))} of column {column!r}; the files are "
            f"{', '.join(file.name for file in files[:5])}{given}"
        )
    mount["type"] = column
    patterns = [label for label, name in named.items() if isinstance(name, str)]
    reason = f"{len(labels)} antennas, each with a file of the same name"
    reason += f", except {', '.join(patterns)}" if patterns else ""
    links.assume("links.tx_antenna.type", column, reason)
    types = {label: _antenna(links, name) for label, name in named.items()}
    omnidirectional = {label: is_omnidirectional(Antenna(str(name))) for label, name in named.items()}
    used = [name for name in named.values() if isinstance(name, Path)]
    return {"types": types}, rows[column].astype(str).map(omnidirectional).to_numpy(bool), used


def _cells(links: LinksDraft, column: str, rows: NDArray[np.bool_]) -> str:
    """Location (file, column and rows) of cells in the table of transmitters, formatted for messages."""
    table = links.transmitter_table
    return f"{table.source}: column {column!r} in {rows_text(table.row[rows].tolist())}"


def _antenna(links: LinksDraft, pattern: Path | str) -> dict[str, str]:
    """An antenna with a Sionna RT pattern or with the pattern in a file. The file must be readable."""
    if isinstance(pattern, Path):
        read_gain_table(pattern)
        pattern = links.relative(pattern)
    return {"pattern": pattern, "polarization": "V"}


def schema_text() -> str:
    """The schema as JSON text ending with a line break."""
    return json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"


def schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a study. Descriptions are the first paragraphs of docstrings."""
    content = Study.model_json_schema()
    _shorten(content)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Calibray study"} | {
        key: value for key, value in content.items() if key != "title"
    }


def _shorten(node: Any) -> None:
    """Keep only the first paragraph of each description; the other paragraphs describe attributes of Python classes."""
    if isinstance(node, dict):
        if isinstance(node.get("description"), str):
            node["description"] = node["description"].split("\n\n")[0].replace("\n", " ").replace("``", "")
        for part in node.values():
            _shorten(part)
    elif isinstance(node, list):
        for part in node:
            _shorten(part)
