"""Numbers such as 100, -200 and -999, which mean that nothing was measured, are never used as values."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import LinkColumns, Preparation, SourceTable, measured_links, select_rows
from calibray.measurements.selection import find_codes

COLUMNS = LinkColumns((0, 0, 5), ("x", 0, 1), "rssi", "rsrp")


@pytest.mark.parametrize(
    ("values", "codes"),
    [
        ([-71.0, -80.0, 100.0], (100.0,)),
        ([-71.0, -80.0, -200.0], (-200.0,)),
        ([-71.0, -999.0, 2147483647.0], (-999.0, 2147483647.0)),
        ([-71.0, 0.0], (0.0,)),
        ([-71.0, -15.0, 0.0], ()),  # 15 dB apart: a strong power
        ([80.0, 100.0, 127.0, 128.0], ()),  # path losses
        ([80.0, -1.0, 9999.0], (-1.0, 9999.0)),
        ([100.0, 100.0], ()),
        ([-71.0, 70.0], ()),
        ([np.nan, np.inf], ()),
    ],
)
def test_codes_are_found(values, codes):
    assert find_codes(values) == codes


def test_rows_with_codes_are_left_out_and_counted():
    frame = pd.DataFrame({"x": [10.0, 20.0, 30.0, 40.0], "rssi": [-70, 100, -200, -80]})
    links = measured_links(SourceTable(frame), COLUMNS)
    assert links.path_loss_db.tolist() == [70.0, 80.0]
    assert links.prepared == {"codes for missing values (-200, 100)": 2}


def test_codes_are_below_the_noise_floor():
    frame = pd.DataFrame({"x": [10.0, 20.0], "rssi": [-70, 100]})
    links = measured_links(SourceTable(frame), COLUMNS, Preparation(noise_floor_dbm=-95.0, censored=True))
    assert links.path_loss_db.tolist() == [70.0, 95.0]
    assert links.censored.tolist() == [False, True]


def test_codes_of_a_wide_table_are_empty_cells():
    wide = pd.DataFrame({"x": [0.0, 5.0], "ap1": [-40, 100], "ap2": [100, -61], "ap3": [np.nan, -62]})
    long = select_rows(SourceTable(wide), Preparation({"ap1": "1", "ap2": "2", "ap3": "3"}), "rssi")
    assert long.frame["rssi"].tolist() == [-40.0, -61.0, -62.0]
    # A code is counted once, as a code.
    assert long.changes == {"codes for missing values (100)": 2, "cells without a value": 1}


def test_codes_of_observables_are_stated_or_far_from_all_values():
    frame = pd.DataFrame(
        {"rssi": -70.0, "k_db": ["25", "999", "-1"], "ds": [5, 9, -999], "tof_ns": [50, 60, -1]}
    )
    steps = Preparation(missing=(999.0,), observables=["k_db", "ds", "tof_ns"], flights=["tof_ns"])
    rows = select_rows(SourceTable(frame), steps, "rssi")
    assert rows.numbers("k_db", gaps=True).tolist() == pytest.approx([25.0, np.nan, -1.0], nan_ok=True)
    assert rows.changes == {
        "codes for missing values in k_db (999)": 1,
        "codes for missing values in ds (-999)": 1,
        "codes for missing values in tof_ns (-1)": 1,
    }


def test_further_codes_are_stated():
    frame = pd.DataFrame({"x": [10.0, 20.0, 30.0], "rssi": [-70.0, -110.0, -101.0]})
    links = measured_links(SourceTable(frame), COLUMNS, Preparation(missing=(-110.0,)))
    assert links.path_loss_db.tolist() == [70.0, 101.0]
    with pytest.raises(InputError, match=r"contains no measured value; check links\.missing"):
        measured_links(SourceTable(frame[1:2].reset_index()), COLUMNS, Preparation(missing=(-110.0,)))
    text = frame.assign(rssi=["-70", "n.m.", "-110"])
    with pytest.raises(InputError, match=r"'n\.m\.' is not a number"):
        measured_links(SourceTable(text), COLUMNS, Preparation(missing=(-110.0,)))
