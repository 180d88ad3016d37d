"""Intervals follow paths that the study's settings leave out, if the measurements favour these."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
from calibray import fields
from calibray.calibration.result import Result
from calibray.errors import EngineError
from calibray.result.verdict import Remark, RemarkKind
from calibray.result.wording import remark_text
from small_scenes import write_scene

STONE = "stone.relative_permittivity"
TRUTH = 4.0
SETTINGS = ["refraction = true", "diffraction = true"]


def study(folder: Path, values: np.ndarray | None = None, **sections: dict[str, object]) -> cb.Study:
    """A long wall reflects to receivers in sight, and to others behind a screen."""
    ground = [[(-90.0, -90.0, 0.0), (90.0, -90.0, 0.0), (90.0, 90.0, 0.0), (-90.0, 90.0, 0.0)]]
    wall = [[(-90.0, 60.0, 0.0), (90.0, 60.0, 0.0), (90.0, 60.0, 20.0), (-90.0, 60.0, 20.0)]]
    screen = [[(0.0, -60.0, 0.0), (0.0, -60.0, 20.0), (0.0, 5.0, 20.0), (0.0, 5.0, 0.0)]]
    write_scene(folder, {"ground": ground, "wall": wall, "screen": screen})
    number = np.arange(15)
    seen = np.stack([-10.0 - 3 * number, 1.7 * number - 30, np.full(15, 1.5)], axis=1)
    hidden = np.stack([10.0 + 1.3 * number, -20.0 + 0.9 * number, np.full(15, 1.5)], axis=1)
    table = pd.DataFrame(np.concatenate([seen, hidden]), columns=["rx_x", "rx_y", "rx_z"])
    table = table.assign(tx_x=-40.0, tx_y=-5.0, tx_z=6.0, path_loss_db=80.0 if values is None else values)
    table.to_csv(folder / "links.csv", index=False)
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": 3.5e9},
        "links": {"file": "links.csv", "tx": ["tx_x", "tx_y", "tx_z"], "rx": ["rx_x", "rx_y", "rx_z"],
                  "value": "path_loss_db"},
        "antennas": {end: {"pattern": "iso", "polarization": "V"} for end in ("tx", "rx")},
        "trace": {"max_depth": 2, "samples": 20_000},
        "parameters": {STONE: {"bounds": [2.0, 12.0]}},
    }  # fmt: skip
    return cb.Study.from_content(content | sections, folder / "study.toml")


def measured(folder: Path, noise_db: float, *, refraction: bool) -> np.ndarray:
    """Path loss with the true constant, with or without paths through the screen."""
    setup = study(folder, trace={"max_depth": 2, "samples": 20_000, "refraction": refraction}).opened()
    paths = setup.trace()
    materials = setup.parameters.materials(np.array([TRUTH]), paths.materials)
    noise = np.random.default_rng(5).normal(0.0, noise_db, len(setup.links))
    return fields.path_loss(paths, materials, "power") + noise


@pytest.fixture(scope="module", params=[True, False], ids=["with refraction", "without"])
def calibrated(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[bool, Result, list[str]]:
    """A calibration without paths through the screen of measurements with or without them, and its stages."""
    folder, stages = tmp_path_factory.mktemp("screen"), list[str]()

    def seen(stage: str, *_: int | None) -> None:
        if stages[-1:] != [stage]:
            stages.append(stage)

    plan = study(folder, measured(folder, 1.0, refraction=request.param))
    return request.param, cb.calibrate(plan, progress=seen), stages


def test_measurements_decide_whether_paths_are_missing(calibrated: tuple[bool, Result, list[str]]) -> None:
    refracted, result, stages = calibrated
    remarks = [each for each in result.uncertainty.remarks if each.kind == RemarkKind.RICHER_PATHS]
    interval = result.intervals[STONE]
    assert interval.contains(TRUTH)
    assert len(remarks) == refracted
    # No stage seems to run twice.
    assert stages.count("drawing") == 1
    assert "fitting more paths" in stages
    # Work that takes long without a known amount is announced as well.
    announced = ["evaluating initial values", "finding minima", "drawing", "judging intervals"]
    assert [stage for stage in stages if stage in announced] == announced
    assert stages[-1] == "examining residuals"
    cost = result.cost
    assert cost.total_seconds >= cost.trace_seconds + cost.seconds + cost.uncertainty_seconds
    if refracted:
        assert "drawing with more paths" in stages
        values = remarks[0].values
        assert values["settings"] == SETTINGS
        assert values["probability"] > 0.99
        assert values["rmse_db"] < 1.5 < values["rmse_without_db"] == pytest.approx(result.rmse_db)
        # The calibrated value makes up for the missing power.
        assert values["outside"] == ([] if interval.contains(result.parameters[STONE]) else [STONE])


@pytest.mark.parametrize("calibrated", [True], indirect=True)
def test_a_stated_noise_model_or_no_further_traces_rule_the_check_out(
    calibrated: tuple[bool, Result, list[str]], tmp_path: Path
) -> None:
    _, result, _ = calibrated
    values = result.links.measured_db.to_numpy()
    for number, sections in enumerate([{"noise": {"kind": "gaussian"}}, {"fidelity": {"rounds": 0}}]):
        folder = tmp_path / str(number)
        folder.mkdir()
        stages = Counter[str]()
        plain = cb.calibrate(
            study(folder, values, **sections),
            progress=lambda stage, *_, seen=stages: seen.update([stage]),
        )
        assert "tracing more paths" not in stages
        assert RemarkKind.RICHER_PATHS not in {each.kind for each in plain.uncertainty.remarks}


def test_paths_that_explain_exact_measurements_are_certain(tmp_path: Path) -> None:
    result = cb.calibrate(study(tmp_path, measured(tmp_path, 0.0, refraction=True)))
    (remark,) = (each for each in result.uncertainty.remarks if each.kind == RemarkKind.RICHER_PATHS)
    assert remark.values["probability"] == 1.0
    assert result.intervals[STONE].contains(TRUTH, 1e-3)
    assert not result.intervals[STONE].contains(result.parameters[STONE])


def test_a_failing_trace_keeps_the_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    plan, trace = study(tmp_path, measured(tmp_path, 1.0, refraction=True)), cb.Setup.trace

    def failing(setup: cb.Setup, *rest: object, **named: object) -> object:
        if setup.study.trace.refraction:
            raise EngineError("too many paths")
        return trace(setup, *rest, **named)

    monkeypatch.setattr(cb.Setup, "trace", failing)
    result = cb.calibrate(plan)
    assert RemarkKind.RICHER_PATHS not in {each.kind for each in result.uncertainty.remarks}
    assert (
        "the trace with refraction and diffraction failed, so richer paths are not considered: too many paths"
        in caplog.text
    )


def test_the_remark_names_settings_errors_and_values_outside_of_their_intervals() -> None:
    values = {
        "probability": 0.987,
        "settings": SETTINGS,
        "rmse_db": 3.126,
        "rmse_without_db": 4.9,
        "outside": [STONE],
    }
    text = remark_text(Remark(RemarkKind.RICHER_PATHS, values))
    assert "probability of 0.99. With refraction = true, diffraction = true, the RMSE would be 3.13" in text
    assert "instead of 4.90 dB" in text
    assert f"outside their intervals: {STONE}." in text
    assert "outside" not in remark_text(Remark(RemarkKind.RICHER_PATHS, values | {"outside": []}))
