"""Tables of what is remarkable about a calibration: planted trends, trade-offs and powers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import shown
from calibray.calibration.result import Result
from calibray.fields import path_gains
from calibray.reporting.diagnostics import remarkable
from calibray.uncertainty.link_diagnostics import _depth_and_power
from changed import changed
from made_up_report import made_up


@pytest.fixture(scope="module")
def result() -> Result:
    return made_up(60, 20)[0]


def planted(result: Result, errors: np.ndarray, **columns: np.ndarray) -> Result:
    """The calibration with errors in place of its own, all links with a path and calibrated on."""
    links = result.links.assign(held_out=False, has_path=True, **columns)
    return changed(result, links=links.assign(after_db=links.measured_db + errors))


def said(result: Result, name: str) -> str:
    return dict(remarkable(result).rows)[name]


def test_a_trend_with_distance_is_said_and_none_where_there_is_none(result):
    ends = [result.links[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() for end in ("tx", "rx")]
    decades = np.log10(np.linalg.norm(ends[1] - ends[0], axis=1))
    noise = np.random.default_rng(0).standard_normal(len(decades))
    steep = planted(result, 8.0 * (decades - decades.mean()) + noise)
    assert said(steep, "over distance").startswith("a trend: residuals change by +")
    table = steep.diagnostics["distance"]
    assert table["links"].sum() == len(decades)
    assert (np.diff(table["mean_db"]) > 0).all()
    assert said(planted(result, noise), "over distance").startswith("no trend")


def test_the_group_that_is_off_is_named(result):
    group = np.where(np.arange(60) % 3 == 0, "east", "west")
    noise = np.random.default_rng(1).standard_normal(60)
    off = planted(result, noise + 4.0 * (group == "east"), group=group)
    assert said(off, "by group").startswith("furthest off are group east: +")
    assert "chance" not in said(off, "by group")
    assert off.diagnostics["group"].set_index("group").links.to_dict() == {"east": 20, "west": 40}


def test_unknowns_that_make_up_for_one_another_are_named(result):
    first = np.random.default_rng(2).uniform(2, 6, 50)
    names = list(result.parameters)[:2]
    draws = {names[0]: first.tolist(), names[1]: (8 - first).tolist()}
    traded = changed(result, draws=draws)
    assert traded.diagnostics["trade_offs"].correlation.tolist() == pytest.approx([-1.0])
    assert said(traded, "trade-offs") == f"{names[0]} and {names[1]} (-1.00)"


def test_links_held_out_take_no_part(result):
    errors = np.where(np.arange(60) < 30, 0.0, 100.0)
    half = planted(result, errors)
    half = changed(half, links=half.links.assign(held_out=errors > 0))
    assert half.diagnostics["distance"].mean_db.abs().max() == 0


def test_shares_of_power_are_those_of_paths_that_meet_a_material(result):
    paths = result.paths
    depth, shares = _depth_and_power(paths, paths.materials)
    gain = np.abs(path_gains(paths).reshape(paths.num_paths, -1)) ** 2
    power = gain.sum(axis=1)
    for index, name in enumerate(paths.materials):
        expected = []
        for link in np.unique(paths.link):
            mine = np.flatnonzero(paths.link == link)
            meets = [index in paths.material[paths.first[p] : paths.first[p + 1]] for p in mine]
            expected.append(power[mine][np.array(meets)].sum() / power[mine].sum())
        # In the made-up paths a material is met by one kind of interaction, or the shares overlap.
        kinds = shares.get(name, {})
        if len(kinds) == 1:
            assert next(iter(kinds.values())) == pytest.approx(np.mean(expected))
        else:
            assert sum(kinds.values()) >= np.mean(expected) - 1e-12
    for link in range(len(result.links)):
        mine = np.flatnonzero(paths.link == link)
        if len(mine):
            assert depth[link] == np.diff(paths.first)[mine[np.argmax(power[mine])]]
        else:
            assert np.isnan(depth[link])


def test_a_result_that_knows_little_has_fewer_tables():
    result = shown.result()
    bare = changed(result, draws={}, intervals={}, power_shares={})
    assert "trade_offs" not in bare.diagnostics
    assert "power" not in bare.diagnostics
    assert isinstance(bare.diagnostics["moved"], pd.DataFrame)
