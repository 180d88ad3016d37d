"""Another tracer calibrates a study end to end, the package untouched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import calibray as cb
from calibray.fields import path_loss
from calibray.measurements import links_from_frame
from calibray.scenes import read_scene
from calibray.study import Study
from calibray.tracing.settings import Antenna, TraceSettings
from small_scenes import write_scene
from two_ray import TwoRay

FREQUENCY = 3.5e9
TRUTH = 6.3
COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z")
GROUND = (
    '<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="3.0"/>'
    '<float name="conductivity" value="0.5"/><float name="thickness" value="1.0"/></bsdf>'
)


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """Links over a flat ground, their path loss computed by the tracer with the planted permittivity."""
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("calibray.tracing.factory.Sionna.__call__", refuse)
    corners = [(-300.0, -300.0, 0.0), (300.0, -300.0, 0.0), (300.0, 300.0, 0.0), (-300.0, 300.0, 0.0)]
    file = write_scene(tmp_path, {"floor": [corners]}, GROUND, "mat-ground")
    rx = np.stack([np.geomspace(3, 150, 30), np.zeros(30), np.full(30, 1.5)], axis=1)
    table = pd.DataFrame(np.hstack([np.tile([0.0, 0.0, 10.0], (30, 1)), rx]), columns=COLUMNS)
    antenna = Antenna("dipole")
    truth = {"ground": {"relative_permittivity": TRUTH, "conductivity": 0.5, "thickness": 1.0}}
    tracer = TwoRay(read_scene(file, FREQUENCY, truth), FREQUENCY, TraceSettings(), antenna, antenna)
    loss = path_loss(tracer.trace(links_from_frame(table)), combining="coherent")
    table.assign(path_loss_db=loss).to_csv(tmp_path / "links.csv", index=False, float_format="%.17g")
    dipole = {"pattern": "dipole", "polarization": "V"}
    content = {
        "version": 1,
        "scene": {"file": "scene.xml", "frequency": FREQUENCY},
        "links": {"file": "links.csv", "tx": COLUMNS[:3], "rx": COLUMNS[3:], "value": "path_loss_db"},
        "antennas": {"tx": dipole, "rx": dipole},
        "objective": {"combining": "coherent"},
        "parameters": {"ground.relative_permittivity": {"bounds": [1.5, 15.0]}},
    }
    return Study.from_content(content, tmp_path / "study.toml")


def refuse(*_: object) -> None:
    pytest.fail("Sionna RT was opened")


@pytest.mark.parametrize("engine", ["replay", "retrace"])
def test_a_study_is_calibrated_with_another_tracer(study: Study, engine: str) -> None:
    result = cb.calibrate(study.replace(engine=engine), tracer=TwoRay)
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(
        TRUTH, rel=1e-6 if engine == "replay" else 1e-2
    )
    assert result.rmse_db < (1e-6 if engine == "replay" else 1e-2)
    assert result.initial_rmse_db > 0.5


def test_a_setup_opens_the_tracer_it_is_given(study: Study) -> None:
    from calibray.study.setup import Setup

    setup = Setup.open(study, tracer=TwoRay)
    assert setup.study is study
    assert list(setup.scene.materials) == ["ground"]
    assert len(setup.links) == 30
