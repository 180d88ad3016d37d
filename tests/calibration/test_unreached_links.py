"""Links without a path are counted with the switches that reach them, and the log-distance model predicts them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import calibray as cb
from calibray.calibration.result import Result
from calibray.cli.app import app
from calibray.prediction.batches import LOG, announce
from calibray.prediction.corrections import fill_missing
from calibray.prediction.map_files import figure
from calibray.reporting.wording import prediction_text
from calibray.result.verdict import RemarkKind
from link_tables import links_from_frame
from small_scenes import block, write_scene

BEHIND = 9
SHADOW_DB = 25.0


def calibrated(
    folder: Path, behind: int = BEHIND, engine: dict[str, int] | None = None, **trace: object
) -> Result:
    """A calibration of the ground beside one house, in whose shadow receivers measure `SHADOW_DB` more."""
    ground = [[(-80.0, -80.0, 0.0), (80.0, -80.0, 0.0), (80.0, 80.0, 0.0), (-80.0, 80.0, 0.0)]]
    scene = write_scene(folder, {"ground": ground, "house": block((-10, -20, 0), (10, 20, 15))})
    number = np.arange(8)
    seen = np.stack([np.full(8, -20.0 - 4 * number), 3.0 * number - 10, np.full(8, 1.5)], axis=1)
    hidden = np.stack([np.full(behind, 14.0), 2.0 * np.arange(behind) - 5, np.full(behind, 1.5)], axis=1)
    rx = np.concatenate([seen, hidden])
    table = pd.DataFrame(rx, columns=["rx_x", "rx_y", "rx_z"]).assign(tx_x=-20.0, tx_y=60.0, tx_z=6.0)
    distance = np.linalg.norm(rx - [-20.0, 60.0, 6.0], axis=1)
    shadow_db = np.where(np.arange(len(rx)) < 8, 0.0, SHADOW_DB)
    table["path_loss_db"] = 45.0 + 22.0 * np.log10(distance) + np.arange(len(rx)) % 3 + shadow_db
    table.to_csv(folder / "links.csv", index=False)
    study = {
        "version": 1,
        "scene": {"file": scene.name, "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": ["tx_x", "tx_y", "tx_z"], "rx": ["rx_x", "rx_y", "rx_z"],
                  "value": "path_loss_db"},
        "antennas": {end: {"pattern": "iso", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 1, "samples": 20_000, **trace},
        "parameters": {"stone.relative_permittivity": {"bounds": [2.0, 12.0]}},
        "noise": {"kind": "gaussian", "range_m": 0, "heterogeneity": 0, "constants_spread": 0},
        "engine": {"name": "replay", **(engine or {})},
    }  # fmt: skip
    return cb.calibrate(cb.Study.from_content(study, folder / "study.toml"))


@pytest.mark.parametrize("engine", [{}, {"chunk_links": 7}])
def test_many_links_without_a_path_are_reported_with_the_switch_that_reaches_them(
    tmp_path: Path, engine: dict[str, int]
) -> None:
    result = calibrated(tmp_path, behind=6, engine=engine)
    (remark,) = (part for part in result.uncertainty.remarks if part.kind == RemarkKind.UNREACHED_LINKS)
    assert (remark.values["links"], remark.values["of"]) == (6, 14)
    reached = dict(zip(remark.values["switches"], remark.values["reached"], strict=True))
    assert reached["diffraction = true"] == 6
    assert reached["max_depth = 3"] == 0
    assert any("6 of 14 links have no path" in sentence for sentence in result.remarks)
    result.save(tmp_path / "out")
    assert cb.Result.load(tmp_path / "out").uncertainty.remarks == result.uncertainty.remarks


def test_links_that_all_have_a_path_are_not_reported(tmp_path: Path) -> None:
    result = calibrated(tmp_path, diffraction=True)
    assert result.links.has_path.all()
    assert RemarkKind.UNREACHED_LINKS not in {remark.kind for remark in result.uncertainty.remarks}


@pytest.fixture(scope="module")
def shadowed(tmp_path_factory) -> Result:
    folder = tmp_path_factory.mktemp("shadowed")
    result = calibrated(folder)
    result.save(folder / "out")
    return result


def places(*rx: tuple[float, float]) -> pd.DataFrame:
    """New links from the transmitter to some receivers."""
    table = pd.DataFrame(rx, columns=["rx_x", "rx_y"]).assign(rx_z=1.5)
    return table.assign(tx_x=-20.0, tx_y=60.0, tx_z=6.0)


SEEN, HIDDEN = (-30.0, 0.0), (14.0, 6.0)


def test_a_link_without_a_path_gets_the_log_distance_model_s_prediction(shadowed: Result) -> None:
    links = shadowed.links
    lost = ~links.has_path
    assert lost.sum() == BEHIND
    assert links.basis[lost].str.startswith("no path: log-distance").all()
    assert not links.basis[~lost].str.contains("no path").any()
    # Without the mean residual of the shadowed links, their predictions would be some 25 dB too low.
    assert (links.predicted_db - links.measured_db)[lost].abs().max() < 3.0
    assert (links.log_distance_db - links.measured_db)[lost].mean() < -SHADOW_DB + 5
    predictions = shadowed.predict_interval(places(SEEN, HIDDEN))
    assert predictions.basis.tolist()[1] == f"no path: log-distance, errors of {BEHIND} links without a path"
    distance = np.linalg.norm([34.0, -54.0, -4.5])
    expected = 46.0 + 22.0 * np.log10(distance) + SHADOW_DB
    assert predictions.path_loss_db[1] == pytest.approx(expected, abs=2.0)
    assert predictions.lower_db[1] < expected < predictions.upper_db[1]
    assert shadowed.predict(places(SEEN, HIDDEN)) == pytest.approx(predictions.path_loss_db.to_numpy())
    assert "For links without a path, predictions use" in prediction_text(shadowed)


def test_the_interval_without_a_path_is_not_narrower(shadowed: Result) -> None:
    fallback = shadowed.prediction.fallback
    accurate = replace(fallback, residual_db=1e-6, sizes_db=(1e-6,) * 9)
    for model in (fallback, accurate):
        result = replace(shadowed, prediction=replace(shadowed.prediction, fallback=model))
        predictions = result.predict_interval(places(HIDDEN, (14.0, 8.0), SEEN))
        width = (predictions.upper_db - predictions.lower_db).to_numpy()
        assert (width[:2] > 1.0).all()
    own = shadowed.predict_interval(places(SEEN))
    assert width[0] >= float((own.upper_db - own.lower_db)[0]) * 0.8


def test_links_with_a_path_are_predicted_as_without_a_fallback(shadowed: Result) -> None:
    without = replace(shadowed, prediction=replace(shadowed.prediction, fallback=None))
    table = places(SEEN, (-40.0, 5.0))
    pd.testing.assert_frame_equal(
        shadowed.predict_interval(table), without.predict_interval(table), check_exact=True
    )
    predictions = pd.DataFrame({"path_loss_db": [90.0], "basis": ["calibrated"]})
    links = links_from_frame(table)
    assert fill_missing(shadowed.prediction, shadowed.study, links, predictions) is predictions
    assert np.isinf(without.predict(places(HIDDEN)))


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> tuple[Result, Path]:
    """A calibration of links that all have a path, and the cache of its traces."""
    folder = tmp_path_factory.mktemp("seen")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALIBRAY_CACHE", str(folder / "cache"))
        return calibrated(folder, behind=0), folder / "cache"


def test_the_fallback_is_fitted_although_every_link_has_a_path(seen: tuple[Result, Path]) -> None:
    result, _ = seen
    assert result.links.has_path.all()
    predictions = result.predict_interval(places(HIDDEN))
    assert predictions.basis[0] == "no path: log-distance, errors of 8 calibration links"
    expected = 46.0 + 22.0 * np.log10(np.linalg.norm([34.0, -54.0, -4.5]))
    assert predictions.lower_db[0] < expected < predictions.upper_db[0]


def test_links_out_of_sight_show_what_obstacles_cost_if_each_has_a_path(tmp_path: Path) -> None:
    """A link without a path is out of sight; a fit to mostly unobstructed links predicts too little path loss."""
    result = calibrated(tmp_path, behind=10, diffraction=True)
    assert result.links.has_path.all()
    hidden = result.links.out_of_sight.to_numpy(bool)
    assert hidden.tolist() == [False] * 8 + [True] * 10
    lost = pd.DataFrame({"path_loss_db": [np.inf], "basis": [""]})
    links = links_from_frame(places(HIDDEN))
    filled = fill_missing(result.prediction, result.study, links, lost, level=0.9)
    assert filled.basis[0] == "no path: log-distance, errors of 10 links out of sight"
    expected = 46.0 + 22.0 * np.log10(np.linalg.norm([34.0, -54.0, -4.5])) + SHADOW_DB
    assert filled.path_loss_db[0] == pytest.approx(expected, abs=1.5)
    assert filled.lower_db[0] < expected < filled.upper_db[0]


def test_the_map_marks_cells_without_a_path_and_leaves_buildings_blank(
    shadowed: Result, tmp_path: Path
) -> None:
    coverage = shadowed.coverage_map(bounds=(-30.0, -8.0, 34.0, 8.0), cell=8.0)
    inside = (np.abs(coverage.x) < 10)[None] & (np.abs(coverage.y) < 20)[:, None]
    assert np.isnan(coverage.path_loss_db[inside]).all()
    assert np.isfinite(coverage.path_loss_db[~inside]).all()
    assert coverage.no_path[:, coverage.x > 10].any()
    assert not coverage.no_path[:, coverage.x < -10].any()
    table = coverage.table()
    assert set(table.basis[table.path_loss_db.isna()]) == {""}
    assert (table.basis == "no path").sum() == coverage.no_path.sum()
    panel = figure(coverage).axes[0]
    assert any("hatched: no path" in text.get_text() for text in panel.texts)
    assert any(getattr(part, "hatches", None) == ["////"] for part in panel.collections)
    reached = replace(coverage, no_path=np.zeros_like(coverage.no_path))
    assert not any("hatched" in text.get_text() for text in figure(reached).axes[0].texts)


def test_the_colours_of_a_map_end_at_quantiles(shadowed: Result) -> None:
    coverage = shadowed.coverage_map(bounds=(-60.0, -60.0, 40.0, -20.0), cell=4.0, level=None)
    loss = coverage.path_loss_db.copy()
    loss[0, 0] = 352.0
    picture = figure(replace(coverage, path_loss_db=loss))
    low, high = picture.axes[0].images[0].get_clim()
    assert (low, high) == pytest.approx(np.quantile(loss, [0.02, 0.98]), abs=0.01)
    (bar,) = picture.axes[1:]
    assert f"colours: {low:.3g} to {high:.3g} (2 % to 98 % quantile)" in bar.get_ylabel()
    assert "values outside this range have the end colours" in bar.get_ylabel()
    # Neither end of the label is cut off.
    bar.figure.draw_without_rendering()
    label, page = bar.yaxis.label.get_window_extent(), bar.figure.bbox
    assert page.y0 <= label.y0 < label.y1 <= page.y1


def test_the_command_counts_links_without_a_path(shadowed: Result, tmp_path: Path) -> None:
    places(SEEN, HIDDEN).to_csv(tmp_path / "new.csv", index=False)
    folder = shadowed.study.path.parent / "out"
    run = CliRunner().invoke(app, ["predict", str(folder), str(tmp_path / "new.csv")])
    assert run.exit_code == 0, run.output
    assert run.stderr.startswith("Tracing 2 links: ")
    assert (
        "Warning: no path: 1 of 2 links, row 3\nFor links without a path, the log-distance model predicts"
        in run.stderr
    )
    assert run.stdout.splitlines()[0].endswith("path_loss_db,basis")
    assert run.stdout.splitlines()[2].endswith("no path: log-distance")


def test_the_rate_of_the_calibration_gives_the_cost(
    shadowed: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = replace(shadowed, cost=replace(shadowed.cost, trace_seconds=17.0))
    said: list[str] = []
    monkeypatch.setattr(LOG, "info", lambda text, *parts: said.append(text % parts))
    announce(slow, 1000, "cells")
    model = replace(shadowed.prediction.model, parameters=None)
    announce(replace(slow, prediction=replace(slow.prediction, model=model)), 1000)
    assert said[0].startswith(
        "Tracing 1,000 cells: up to about 17 minutes at the rate of the 17 calibration links"
    )
    assert "without a trace" in said[1]
    content = slow.study.content()
    content["trace"]["samples"] = "auto"
    announce(replace(slow, study=cb.Study.from_content(content, slow.study.path)), 1000, "cells")
    assert said[2] == (
        "Tracing 1,000 cells: about 17 minutes at the rate of the 17 calibration links, less if the paths are cached, "
        "much longer if the calibration read its paths from the cache"
    )


def test_calibrated_links_and_known_candidates_are_not_traced_again(
    seen: tuple[Result, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    result, cache = seen
    monkeypatch.setenv("CALIBRAY_CACHE", str(cache))
    assert result.uncertainty.draws
    opened: list[object] = []
    open_tracer = cb.Setup._open_tracer
    monkeypatch.setattr(
        cb.Setup, "_open_tracer", lambda setup, *rest: opened.append(setup) or open_tracer(setup, *rest)
    )
    result.predict(result.study.measurements())
    assert not opened
    # Candidates are traced by one tracer, and the prediction there takes their trace.
    result.suggest(places(SEEN, (-40.0, 5.0)), 1)
    assert len(opened) == 1
    result.predict(places(SEEN, (-40.0, 5.0)))
    assert len(opened) == 1


def test_every_cell_of_a_wide_table_counts_as_a_link(shadowed: Result, tmp_path: Path) -> None:
    """Two masts at one place, as columns of their own; a third one was never measured."""
    folder = shadowed.study.path.parent
    (folder / "masts.csv").write_text(
        "mast,tx_x,tx_y,tx_z\na,-20,60,6\nb,-20,60,6\nc,-20,60,6\n", encoding="utf-8"
    )
    table = pd.read_csv(folder / "links.csv")[["rx_x", "rx_y", "rx_z", "path_loss_db"]]
    table = table.rename(columns={"path_loss_db": "a"}).assign(b=lambda rows: rows["a"] + 2.0)
    table.to_csv(folder / "wide.csv", index=False)
    content = shadowed.study.content()
    content["links"] |= {
        "file": "wide.csv", "wide": {"a": "a", "b": "b"}, "transmitters": "masts.csv", "transmitter": "mast",
    }  # fmt: skip
    content["offset"] = {"per": "mast"}
    result = cb.calibrate(cb.Study.from_content(content, folder / "wide.toml"), out=tmp_path / "out")
    table.iloc[[0, -1]].to_csv(tmp_path / "new.csv", index=False)
    run = CliRunner().invoke(app, ["predict", str(tmp_path / "out"), str(tmp_path / "new.csv")])
    assert run.exit_code == 0, run.output
    assert "Tracing 4 links: " in run.stderr
    assert "Warning: no path: 2 of 4 links, row 3\n" in run.stderr
    found = result.predict_interval(places(SEEN, HIDDEN, HIDDEN).assign(mast=["c", "c", "a"]))
    assert found.basis.str.startswith("no path").tolist() == [False, True, True]
    assert found.basis.str.endswith("group without measurements").tolist() == [True, True, False]
