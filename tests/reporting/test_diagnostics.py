"""Diagnostics find planted trends, trade-offs and shares of power."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import shapely

import shown
from calibray.calibration.link_diagnostics import _depth_and_power
from calibray.calibration.result import Result
from calibray.fields import path_gains
from calibray.reporting.diagnostics import CLASSES
from calibray.reporting.link_map import marks, plan
from calibray.reporting.link_survey import survey
from calibray.reporting.trust_figures import by_depth
from calibray.reporting.wording import diagnostics_table
from calibray.result.verdict import Remark, RemarkKind
from calibray.scenes.obstruction import Region
from changed import changed
from made_up_report import made_up


@pytest.fixture(scope="module")
def result() -> Result:
    return made_up(60, 20)[0]


def planted(result: Result, errors: np.ndarray, **columns: np.ndarray) -> Result:
    """The calibration with the given residuals; all links have a path and are calibration links."""
    links = result.links.assign(held_out=False, has_path=True, **columns)
    return changed(result, links=links.assign(predicted_db=links.measured_db + errors))


def finding(result: Result, name: str) -> str:
    return dict(diagnostics_table(result).rows)[name]


def test_a_trend_with_distance_is_reported_only_if_planted(result):
    ends = [result.links[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() for end in ("tx", "rx")]
    decades = np.log10(np.linalg.norm(ends[1] - ends[0], axis=1))
    noise = np.random.default_rng(0).standard_normal(len(decades))
    steep = planted(result, 8.0 * (decades - decades.mean()) + noise)
    assert finding(steep, "by distance").startswith("a trend: the residuals change by +")
    table = steep.diagnostics["distance"]
    assert table["links"].sum() == len(decades)
    assert (np.diff(table["mean_db"]) > 0).all()
    assert finding(planted(result, noise), "by distance").startswith("no trend")


def test_the_group_with_the_largest_mean_residual_is_named(result):
    group = np.where(np.arange(60) % 3 == 0, "east", "west")
    noise = np.random.default_rng(1).standard_normal(60)
    off = planted(result, noise + 4.0 * (group == "east"), group=group)
    assert finding(off, "by group").startswith("largest mean residual: +")
    assert "group east" in finding(off, "by group")
    assert "not significant" not in finding(off, "by group")
    assert off.diagnostics["group"].set_index("group").links.to_dict() == {"east": 20, "west": 40}


def test_unknowns_with_correlated_draws_are_named(result):
    first = np.random.default_rng(2).uniform(2, 6, 50)
    names = list(result.parameters)[:2]
    draws = {names[0]: first.tolist(), names[1]: (8 - first).tolist()}
    correlated = changed(result, draws=draws)
    assert correlated.diagnostics["trade_offs"].correlation.tolist() == pytest.approx([-1.0])
    assert finding(correlated, "trade-offs") == f"{names[0]} and {names[1]} (-1.00)"


def test_held_out_links_are_excluded(result):
    errors = np.where(np.arange(60) < 30, 0.0, 100.0)
    half = planted(result, errors)
    half = changed(half, links=half.links.assign(held_out=errors > 0))
    assert half.diagnostics["distance"].mean_db.abs().max() == 0


def test_links_near_or_below_the_noise_floor_are_no_residuals(result):
    faint = np.arange(60) < 15
    half = planted(result, np.where(faint, 100.0, 1.0), faint=faint)
    assert half.diagnostics["distance"].mean_db.tolist() == pytest.approx([1.0] * CLASSES)
    assert half.diagnostics["distance"].links.sum() == half.counts["calibrated_on"] == 45
    links = survey(half)
    assert links is not None
    assert np.array_equal(np.isnan(links.residual_db), faint)
    drawn = marks(links, plan(links, None))
    assert sum(color == "none" for *_, color, _ in drawn["links"]) == 15
    assert drawn["kinds"] == ["faint"]


def test_shares_of_power_are_those_of_paths_that_interact_with_a_material(result):
    paths = result.paths
    depth, shares, reached = _depth_and_power(paths, paths.materials)
    gain = np.abs(path_gains(paths).reshape(paths.num_paths, -1)) ** 2
    power = gain.sum(axis=1)
    for index in range(len(paths.materials)):
        expected = []
        for link in np.unique(paths.link):
            of_link = np.flatnonzero(paths.link == link)
            interacts = [index in paths.material[paths.first[p] : paths.first[p + 1]] for p in of_link]
            expected.append(power[of_link][np.array(interacts)].sum() / power[of_link].sum())
        # With several types of interaction, the shares overlap.
        kinds = shares[index][shares[index] > 0] / reached
        if len(kinds) == 1:
            assert kinds[0] == pytest.approx(np.mean(expected))
        else:
            assert kinds.sum() >= np.mean(expected) - 1e-12
    for link in range(len(result.links)):
        of_link = np.flatnonzero(paths.link == link)
        if len(of_link):
            assert depth[link] == np.diff(paths.first)[of_link[np.argmax(power[of_link])]]
        else:
            assert np.isnan(depth[link])


def test_a_mean_over_few_links_has_a_bar_of_two_standard_errors_and_one_link_has_none():
    residuals = np.array([-3.0, 5.0])
    row = {"links": 2, "mean_db": residuals.mean(), "standard_deviation_db": residuals.std()}
    single = {"links": 1, "mean_db": 4.0, "standard_deviation_db": 0.0}
    figure = by_depth(pd.DataFrame([{"depth": 1.0, **row}, {"depth": 2.0, **single}]))
    (bars,) = figure.axes[0].collections
    (drawn,) = (segment for segment in bars.get_segments() if np.isfinite(segment).all() and len(segment))
    half_width = 2 * residuals.std(ddof=1) / np.sqrt(2)
    np.testing.assert_allclose(drawn[:, 1], [1 - half_width, 1 + half_width])


def test_tables_without_data_are_left_out():
    result = shown.result()
    for share, overlap in ((0.59, True), (0.3, False)):
        stated = changed(result, power_shares={"walls": {"specular": share}, "line of sight": {"": 0.5}})
        text = dict(diagnostics_table(stated).rows)["power"]
        assert ("; shares overlap, because a path counts for each of its interactions" in text) == overlap
    bare = changed(result, draws={}, intervals={}, power_shares={})
    assert "trade_offs" not in bare.diagnostics
    assert "power" not in bare.diagnostics
    assert isinstance(bare.diagnostics["moved"], pd.DataFrame)


def test_the_page_points_at_a_region_of_extra_loss_only_if_planted():
    result = made_up(160, 20)[0]
    tx, rx = (result.links[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() for end in ("tx", "rx"))
    (west, south), (east, north) = np.quantile(rx[:, :2], [0.2, 0.5], axis=0)
    belt = Region(np.array([shapely.box(west, south, east, north)]), np.zeros(1), np.full(1, 10.0))
    length = belt.length_inside(tx, rx)
    noise = np.random.default_rng(6).standard_normal(160)
    shaded = planted(result, noise - 0.8 * length)
    text = finding(shaded, "missing region")
    assert text.startswith("losses of ")
    assert shaded.diagnostics["missing_region"].share.item() > 0.3
    assert "than chance" in finding(planted(result, noise), "missing region")
    # The remark has searched the residuals of the calibrated model; the page names no second region.
    values = shaded.diagnostics["missing_region"].drop(columns="significant").iloc[0].to_dict()
    remark = Remark(RemarkKind.MISSING_REGION, {**values, "attenuation": 0.25})
    assert finding(changed(shaded, remarks=(remark,)), "missing region").startswith(
        "losses of 0.25 dB/m within"
    )


def test_residuals_by_obstruction_and_by_street(result):
    random = np.random.default_rng(3)
    blocked = random.random(60) < 0.5
    length = np.where(blocked, random.uniform(1, 90, 60), 0.0)
    noise = 0.1 * random.standard_normal(60)
    columns = {"out_of_sight": blocked.astype(float), "obstruction_m": length}
    shaded = planted(result, noise - 0.1 * length, **columns)
    table = shaded.diagnostics["obstruction"]
    assert table.links.sum() == 60
    assert table.out_of_sight.tolist() == [False] + [True] * (len(table) - 1)
    assert table.mean_db.iloc[0] == pytest.approx(0.0, abs=0.1)
    assert (np.diff(table.mean_db) < 0).all()
    assert "m below roofs" in finding(shaded, "by obstruction")
    indoors = planted(result, noise, **columns | {"obstruction_m": np.zeros(60)})
    assert indoors.diagnostics["obstruction"].out_of_sight.tolist() == [False, True]
    assert "dB out of sight" in finding(indoors, "by obstruction")
    west = (result.links["rx_x"] < result.links["rx_x"].median()).to_numpy()
    streets = planted(result, noise + 5.0 * west).diagnostics["streets"]
    assert streets.links.sum() == 60
    middle = result.links["rx_x"].median()
    assert ((streets.x_m < middle) == (streets.mean_db > 2.5)).all()
