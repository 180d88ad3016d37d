"""Leverage against closed forms, and a planted region of extra loss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

import two_ray
from calibray.calibration.link_diagnostics import leverage, region_remark
from calibray.engines import Replay
from calibray.fitting.problem import Problem
from calibray.fitting.search import Trail
from calibray.result.verdict import RemarkKind
from calibray.result.wording import remark_text
from calibray.scenes.regions import Region
from calibray.study import Setup


def test_leverage_of_a_mean_is_shared_and_of_a_single_link_is_one():
    offset = np.zeros((5, 2))
    offset[:4, 0] = offset[4, 1] = 1.0
    assert leverage(np.zeros((5, 1)), offset) == pytest.approx([0.25] * 4 + [1.0])


def test_leverage_is_the_projection_and_sums_to_the_unknowns():
    random = np.random.default_rng(0)
    design = np.ones((30, 1))
    jacobian = random.standard_normal((30, 3))
    jacobian -= jacobian.mean(axis=0)  # as with the offset eliminated
    columns = np.hstack([jacobian, design])
    hat = columns @ np.linalg.solve(columns.T @ columns, columns.T)
    found = leverage(jacobian, design)
    assert found == pytest.approx(np.diag(hat))
    assert found.sum() == pytest.approx(4.0)


def test_dependent_columns_count_once():
    column = np.arange(1.0, 7.0)[:, None]
    assert leverage(np.hstack([column, 2 * column]), np.zeros((6, 0))).sum() == pytest.approx(1.0)


def test_a_loss_where_the_scene_has_nothing_is_a_remark_only_if_planted(tmp_path: Path) -> None:
    study = two_ray.study(tmp_path, links=200, objective={"combining": "power"})
    random = np.random.default_rng(0)
    table = pd.read_csv(tmp_path / "links.csv")
    table[["rx_x", "rx_y"]] = random.uniform(-120, 120, (200, 2))
    table.to_csv(tmp_path / "links.csv", index=False)
    setup = Setup.open(study, tracer=two_ray.TwoRay)
    engine, truth = Replay(setup.trace(), setup.parameters), np.array([two_ray.TRUTH])
    belt = Region(np.array([shapely.box(20, -90, 40, -10)]), np.zeros(1), np.full(1, 10.0))
    length = belt.length_inside(setup.links.tx, setup.links.rx)
    problem = Problem.of(setup, engine)

    def remarks(loss_db_per_m: float) -> tuple:
        loss = engine.path_loss(truth[None])[0] + random.normal(0, 3, 200) + loss_db_per_m * length
        trail = Trail(best=truth, best_modelled=engine.path_loss(truth[None])[0])
        return region_remark(replace(problem, objective=replace(problem.objective, measured=loss)), trail)

    assert remarks(0.0) == ()
    (remark,) = remarks(0.8)
    assert remark.kind == RemarkKind.MISSING_REGION
    assert remark.values["west"] < 40
    assert remark.values["east"] > 20
    text = remark_text(remark)
    assert text.startswith(f"Losses of {remark.values['attenuation']:.2g} dB/m within x = ")
    assert "state them under [regions]" in text
