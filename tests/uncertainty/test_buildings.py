"""Buildings of a scene, their replay, and their effect on intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import planted
from calibray.fitting.problem import Problem
from calibray.fitting.search import search
from calibray.measurements import links_from_frame
from calibray.optimizers import LeastSquares
from calibray.scenes import Triangles, building_numbers
from calibray.study import Setup, Study
from calibray.uncertainty import between_buildings, indirect_inference
from calibray.uncertainty.assessment import certainty
from calibray.uncertainty.buildings import split_by_building

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
CORNERS = np.array([[0, 1, 2], [0, 2, 3]])


def upright(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    """The four walls of a box, 10 m high [8, 3, 3]."""
    plan = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    walls = []
    for start, end in zip(plan, np.roll(plan, -1, axis=0), strict=True):
        foot, top = np.array([*start, 0.0]), np.array([*end, 10.0])
        walls += [[foot, [*end, 0.0], top], [foot, top, [*start, 10.0]]]
    return np.array(walls)


def scene(*boxes: np.ndarray) -> Triangles:
    """The boxes as one mesh over a ground that reaches under all of them."""
    ground = (SQUARE * [400, 400, 0] - [200, 200, 0])[CORNERS]
    corners = np.concatenate([ground, *boxes])
    flat = np.arange(len(corners)) < len(ground)
    face = np.arange(3 * len(corners)).reshape(-1, 3)
    return Triangles(corners.reshape(-1, 3), face, np.zeros(len(corners), dtype=int), flat)


def test_streets_separate_buildings_and_touching_objects_are_one():
    found = scene(upright((0, 0), (20, 10)), upright((20.0, 0), (40, 10)), upright((45, 0), (60, 10)))
    first, second, beside, inside = building_numbers(
        found, np.array([[0.0, 5.0, 3.0], [40.0, 5.0, 3.0], [45.0, 5.0, 3.0], [52.0, 5.0, 10.0]])
    )
    assert first == second
    assert beside == inside  # on the roof, away from every edge
    assert first != beside


def test_a_scene_with_only_ground_has_no_buildings():
    assert building_numbers(scene(), np.zeros((2, 3))).tolist() == [-1, -1]


@pytest.fixture(scope="module")
def problem() -> Problem:
    study = Study.from_content(planted.content("links.csv"))
    return Problem.of(Setup.open(study, links=links_from_frame(planted.links())), planted.engine())


def test_equal_buildings_reproduce_the_material_and_factors_act_on_one_building(problem):
    """A factor on all buildings of a material acts like one on the material; the ground is no building."""
    apart = split_by_building(problem)
    assert apart is not None
    means = np.array([list(planted.TRUTH.values()), [5.0, 4.0, 3.0]])
    alike = apart.draw_factors(np.zeros(2))
    assert (alike == 1).all()
    assert apart.path_loss(means, alike) == pytest.approx(problem.engine.path_loss(means), abs=1e-9)
    factor = np.where(apart.parameter_of == 1, 1.1, 1.0)[None].repeat(2, axis=0)
    found = problem.engine.path_loss(means * [1.0, 1.1, 1.0])
    assert apart.path_loss(means, factor) == pytest.approx(found, abs=1e-9)
    # Concrete is the ground here, which is one and does not differ from itself.
    assert set(apart.building_of[apart.parameter_of == 0]) == {-1}
    assert (apart.building_of[apart.parameter_of > 0] >= 0).all()
    slope = apart.slopes(means)
    _, whole = problem.engine.path_loss_and_jacobian(means)
    for index in range(3):
        together = slope[:, :, apart.parameter_of == index].sum(axis=2)
        assert together == pytest.approx(whole[:, :, index] * means[:, None, index], abs=5e-3)
        assert np.abs(together).max() > 1.0
    drawn = np.log(apart.draw_factors(np.full(4000, 0.15)))
    assert drawn.std(axis=0) == pytest.approx(np.where(apart.building_of >= 0, 0.15, 0.0), rel=0.05)
    assert (
        np.abs(np.corrcoef(drawn[:, apart.building_of >= 0].T) - np.eye((apart.building_of >= 0).sum())).max()
        < 0.06
    )


def test_intervals_cover_the_mean_over_buildings():
    """Marble and wood are on one building each, which may differ from others; the ground does not differ."""
    measured = planted.campaign(noise_db=0.5).path_loss_db.to_numpy()

    def told(spread: float):
        study = Study.from_content(planted.content("links.csv", noise={"heterogeneity": spread}))
        here = Problem.of(Setup.open(study, links=links_from_frame(planted.links())), planted.engine())
        here = replace(here, objective=replace(here.objective, measured=measured))
        return certainty(here, search(here, LeastSquares(*here.parameters.search_bounds, starts=16)))

    alike = told(0.0)
    assert alike.means is alike.posterior
    apart = told(0.15)
    found = {}
    for name, draws in (("seen", apart.posterior), ("mean", apart.means)):
        assert draws is not None
        mean = draws.weight @ np.log(draws.point)
        found[name] = np.sqrt(draws.weight @ (np.log(draws.point) - mean) ** 2)
    marble = np.hypot(found["seen"][1], 0.15)
    # In straight lines it would be this. Populations of 1,000 that move 40 times a step, whose weights count in full,
    # find an eighth more; fewer moves and half the weight some 15 % more again. Without buildings it were a third less.
    assert 1.0 < found["mean"][1] / marble < 1.4
    assert found["seen"][1] < 0.75 * marble
    # The ground is one; but what walls have of their own may be taken for it: a quarter more, by 1,000 draws.
    assert 1.0 < found["mean"][0] / found["seen"][0] < 1.4


def test_sampling_and_indirect_inference_agree_roughly(problem, monkeypatch):
    measured = planted.campaign(noise_db=0.5).path_loss_db.to_numpy()
    here = replace(problem, objective=replace(problem.objective, measured=measured))
    trail = search(here, LeastSquares(*here.parameters.search_bounds, starts=16))
    drawn = certainty(here, trail)
    monkeypatch.setattr(between_buildings, "SWEPT_INTERACTIONS", 0)
    seldom = certainty(here, trail)
    monkeypatch.setattr(between_buildings, "MAX_INTERACTIONS", 0)
    behind = certainty(here, trail)
    assert seldom.means is not None
    assert drawn.means is not None
    assert behind.means is not None
    assert drawn.posterior is not drawn.means
    np.testing.assert_array_equal(drawn.posterior.point, behind.posterior.point)
    count = len(drawn.means.weight)
    assert count == between_buildings.POPULATION * between_buildings.KEPT_SWEEPS
    assert len(seldom.means.weight) == between_buildings.POPULATION * between_buildings.SWEEPS[0]
    assert len(behind.means.weight) <= indirect_inference.DRAWS[1]
    assert len(np.unique(drawn.means.point, axis=0)) > 0.2 * count
    # The last of every line of draws stands for how well it explains the links.
    last = np.arange(count) >= count - between_buildings.POPULATION
    np.testing.assert_array_equal(np.isfinite(drawn.means.density), last)
    # Two ways to the same answer, roughly: marble is on one building, and told by the same links.
    spread = [np.log(each.point[:, 1]).std() for each in (drawn.means, behind.means)]
    assert 0.5 < spread[0] / spread[1] < 2.0
