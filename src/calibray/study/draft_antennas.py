"""Draft of a study's transmit antennas: directions and models from a planner's columns, patterns from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from calibray.errors import InputError
from calibray.measurements import planner_columns
from calibray.measurements.column_names import matches
from calibray.measurements.planner_columns import plain_name
from calibray.study.draft_links import LinksDraft
from calibray.tracing.gain_table import read_gain_table
from calibray.tracing.two_cuts import TWO_CUT_SUFFIXES

UNKNOWN: Final = {"pattern": "iso", "polarization": "V"}


def add_antennas(links: LinksDraft, folder: Path | None) -> dict[str, Any]:
    """Add the columns of transmit antennas to ``[links]``, and record the assumptions.

    Args:
        links: The draft.
        folder: Folder of MSI files that are named like the antennas; None if there is none.

    Returns:
        The section ``[antennas]``.

    Raises:
        InputError: The folder has no such file, or none for some antenna.
    """
    frame, of_transmitters = links.transmitter_rows, links.transmitters is not None
    mount: dict[str, str] = {}
    antennas: dict[str, Any] = {"tx": dict(UNKNOWN), "rx": dict(UNKNOWN)}
    if folder is not None:
        antennas |= _patterns(links, folder, mount)
    for key, column in planner_columns.find_angles(frame, of_transmitters).items():
        cause = planner_columns.unusable(frame, key, column)
        if not cause and folder is not None and key.startswith("electrical") and not _is_additional(column):
            cause = "it is part of the files' vertical cuts"
        if cause:
            links.assume(f"links.tx_antenna.{key}", "none", f"column {column}: {cause}")
            continue
        mount[key] = column
        links.assume(f"links.tx_antenna.{key}", column, f"a column named so, {_range(frame[column])}")
    if folder is None and "azimuth_deg" in mount:
        antennas["tx"]["pattern"] = "tr38901"
    if mount:
        links.section["tx_antenna"] = mount
    name = planner_columns.find_antenna_names(frame) if of_transmitters else None
    if folder is not None:
        reason = f"files of {folder.name}; the receiver's antenna is unknown"
    elif "azimuth_deg" in mount:
        reason = "azimuths are stated: 3GPP's 65-degree sectors, iso receivers"
    else:
        reason = "unknown; state yours, with their orientation"
    if folder is None and name is not None:
        reason += f"; give --antennas, a folder of the MSI files that column {name} names"
    links.assume("antennas", f"{antennas['tx']['pattern']}, V" if folder is None else folder.name, reason)
    return antennas


def _is_additional(column: str) -> bool:
    return matches(column, "additional")


def _range(values: Any) -> str:
    return f"{values.min():g} to {values.max():g} degrees"


def _patterns(links: LinksDraft, folder: Path, mount: dict[str, str]) -> dict[str, Any]:
    """Antennas by the names of a column, with the files of these names; one file serves all transmitters."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in TWO_CUT_SUFFIXES)
    except OSError as error:
        raise InputError(f"--antennas {folder}: cannot be read ({error}); give a folder") from None
    if not files:
        raise InputError(f"--antennas {folder}: has no file *.msi, *.pln or *.ant; export the antennas there")
    by_name = {plain_name(file.name): file for file in files}
    column = planner_columns.find_antenna_names(links.transmitter_rows, by_name)
    if column is None and len(files) == 1:
        return {"tx": _antenna(links, files[0])}
    if column is None:
        raise InputError(
            f"--antennas {folder}: no column of {links.transmitters or links.links} names the antennas; add one with "
            f"names such as {files[0].stem!r}, or keep one file"
        )
    labels = sorted(links.transmitter_rows[column].astype(str).unique().tolist())
    lacking = [label for label in labels if plain_name(label) not in by_name]
    if lacking:
        raise InputError(
            f"--antennas {folder}: no file for {', '.join(map(repr, lacking[:5]))} of column {column!r}; its files are "
            f"{', '.join(file.name for file in files[:5])}; rename them, or the antennas"
        )
    mount["type"] = column
    links.assume("links.tx_antenna.type", column, f"{len(labels)} antennas, each with a file of its name")
    return {"types": {label: _antenna(links, by_name[plain_name(label)]) for label in labels}}


def _antenna(links: LinksDraft, file: Path) -> dict[str, str]:
    """An antenna with a pattern that can be read."""
    read_gain_table(file)
    return {"pattern": links.relative(file), "polarization": "V"}
