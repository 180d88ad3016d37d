"""The measured values of a draft: column, quantity, power, offset, noise floor, averages and flight times."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from scipy.constants import speed_of_light

from calibray.measurements import column_names, transmitter_columns
from calibray.measurements.column_names import PositionColumns, ValueColumn
from calibray.measurements.selection import find_codes, without_codes
from calibray.measurements.transmitter_columns import find_powers
from calibray.study.draft_links import Given, LinksDraft
from calibray.study.link_checks import CELL_SHARE

AVERAGING_WAVELENGTHS: Final = 40
"""Width of the cells over which fading is averaged (Lee 1985; see `calibray.measurements.averaging`)."""

PLACE_SAMPLES: Final = 20
"""Median number of samples at one position above which samples are averaged by position: a stationary scan. The
logarithm of the mean of 20 samples of Rayleigh fading is biased by 0.1 dB."""


def draft_links(scene: str, links: Path, target: Path, given: Given) -> LinksDraft:
    """Draft ``[links]``; arguments as for `LinksDraft`.

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
    _add_flight_times(draft)
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
        reason = "the transmitted power is unknown, and is part of [offset]"
    draft.assume("links.quantity", value.quantity, reason)
    return value


def _powers(draft: LinksDraft, value: ValueColumn) -> dict[str, str]:
    """Column of EIRP or transmitted power by the key of ``[links]``; empty if there is none.

    Tables of transmitters state the power of the whole carrier, but a reference signal is only a part of it.
    """
    power = column_names.find_transmit_power(draft.table.frame)
    if power is not None:
        return {"eirp_dbm" if column_names.matches(power, "EIRP") else "tx_power_dbm": power}
    if draft.sites is None or column_names.matches(value.column, "reference signal"):
        return {}
    return find_powers(draft.transmitter_rows)


def _offset_groups(draft: LinksDraft, value: ValueColumn) -> list[str]:
    """The columns that group the offset."""
    if value.quantity != "rsrp":
        draft.assume("offset", "one for all links", "the values include cables and unknown antenna gains")
        return []
    name = draft.section.get("transmitter")
    groups = [*([name] if name else []), *transmitter_columns.find_devices(draft.table.frame)]
    groups = list(dict.fromkeys(groups))
    reason = "each transmitter and each receiver has its own gain"
    draft.assume("offset.per", ", ".join(groups) or "one", reason)
    return groups


def _add_noise_floor(draft: LinksDraft, value: ValueColumn) -> None:
    raw = draft.table.frame[value.column]
    column = without_codes(raw)
    if "wide" in draft.section or not column.isna().any():
        return
    missing = f"{int(column.isna().sum())} values are missing"
    if value.quantity in ("rsrp", "received_power"):
        floor = float(np.floor(column.min()))
        draft.section["noise_floor_dbm"] = floor
        draft.assume("links.noise_floor_dbm", f"{floor:g} dBm", f"{missing}, and none is lower")
    elif raw.isna().any():
        draft.add_filter(f"`{value.column}`.notna()")
        draft.assume("links.where", draft.section["where"], missing)


def _add_averaging(draft: LinksDraft, rx: PositionColumns) -> None:
    """Average along tracks, and if most positions or some values repeat; by position if scans are stationary."""
    frame, name = draft.table.frame, draft.section.get("transmitter")
    keys = [rx.x, rx.y, *draft.groups, *([name] if name and name not in draft.groups else [])]
    keys += [part for part in draft.section["tx"] if isinstance(part, str) and part in frame]
    positions = len(frame[keys].drop_duplicates())
    repeated = frame.duplicated([*keys, draft.section["value"]]).any()
    if draft.given.track is None and positions >= len(frame) / 2 and not repeated:
        return
    rows = f"{len(frame)} rows " + ("along a track" if draft.given.track else f"at {positions} positions")
    samples = int(frame.groupby(keys, dropna=False).size().median())
    if draft.given.track is None and samples >= PLACE_SAMPLES:
        draft.section["average"] = "place"
        draft.assume("links.average", "place", f"{rows}, {samples} at each")
        return
    fading = float(np.clip(round(AVERAGING_WAVELENGTHS * speed_of_light / draft.frequency, 1), 1.0, 10.0))
    bounds = draft.overhead.bounds
    size = min(fading, float(f"{CELL_SHARE * min(bounds[3:5] - bounds[:2]):.2g}"))
    draft.section["average"] = {"by": "cell", "size": size, "unbiased": True}
    reason = f"{AVERAGING_WAVELENGTHS} wavelengths average out fading"
    if size < fading:
        reason = f"{CELL_SHARE:.0%} of the scene, less than {AVERAGING_WAVELENGTHS} wavelengths"
    draft.assume("links.average", f"cells of {size:g} m", f"{rows}; {reason}")


def _add_flight_times(draft: LinksDraft) -> None:
    flight_time = column_names.find_flight_time(draft.table.frame)
    # Averages of samples keep the observables of the first one.
    if flight_time is None or "average" in draft.section or "wide" in draft.section:
        return
    column, kind, unit = flight_time
    transmitter = draft.section.get("transmitter")
    bias = transmitter if transmitter in draft.table.frame else "all"
    draft.observables["flight"] = {
        "kind": kind, "column": column, "unit": unit, "bias": bias, "path": "first"
    }  # fmt: skip
    draft.assume(
        "observables.flight",
        column,
        f"its name; the bias of {'each ' if bias != 'all' else ''}device is unknown",
    )
