"""Another tracer calibrates a study end to end, the package untouched."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import calibray as cb
import two_ray
from calibray.study import Study
from two_ray import TRUTH, TwoRay


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """Links over a flat ground, their path loss computed by the tracer with the planted permittivity."""
    monkeypatch.setenv("CALIBRAY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("calibray.tracing.SionnaFactory.__call__", refuse)
    return two_ray.study(tmp_path)


def refuse(*_: object) -> None:
    pytest.fail("Sionna RT was opened")


@pytest.mark.parametrize("engine", ["replay", "retrace"])
def test_a_study_is_calibrated_with_another_tracer(study: Study, engine: str) -> None:
    options = {"starts": 8} if engine == "replay" else {"budget": 6}
    content = study.replace(engine=engine).content() | {"method": {"name": "auto", "options": options}}
    result = cb.calibrate(Study.from_content(content, study.path), tracer=TwoRay)
    assert result.parameters["ground.relative_permittivity"] == pytest.approx(
        TRUTH, rel=1e-6 if engine == "replay" else 1e-2
    )
    assert result.rmse_db < (1e-6 if engine == "replay" else 1e-2)
    assert result.initial_rmse_db > 0.5


def test_a_setup_opens_the_tracer_it_is_given(study: Study) -> None:
    from calibray.study import Setup

    setup = Setup.open(study, tracer=TwoRay)
    assert setup.study is study
    assert list(setup.scene.materials) == ["ground"]
    assert len(setup.links) == 30


def test_an_antenna_below_the_ground_is_not_inside_a_building(study: Study) -> None:
    from calibray.study import Setup

    file = study.path.parent / "links.csv"
    table = pd.read_csv(file)
    table.loc[[1, 4], "tx_z"] = -2.0
    table.to_csv(file, index=False)
    enclosed = Setup.open(study, tracer=TwoRay).enclosed
    assert enclosed is not None
    assert (enclosed.tx, enclosed.tx_below, enclosed.rx_below) == ((), (3, 6), ())
