"""Positions in a scene: under roofs, underground, outside, behind walls; outlines of buildings, positions moved out."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from calibray.errors import InputError
from calibray.scenes.authoring import Terrain, Windows, make_scene
from calibray.scenes.checks import SceneSurfaces, building_outlines, count_crossings, move_outside
from planted_maps import L_SHAPE, footprints


def test_positions_are_known_by_the_surfaces_above_and_below(tmp_path):
    surfaces = SceneSurfaces.read(make_scene(footprints([L_SHAPE], [10.0]), tmp_path).path)
    points = [[20, 5, 2], [6, 5.5, 2], [20, 5, 11], [20, 5, -1], [40, 5, -1], [90, 5, 2]]
    # In the building, in its courtyard, on its roof, in its basement, under the street, outside the scene.
    assert surfaces.under_roof(points).tolist() == [True, False, False, True, True, False]
    assert surfaces.underground(points).tolist() == [False, False, False, True, True, False]
    assert surfaces.outside(points).tolist() == [False] * 5 + [True]
    assert not surfaces.outside(points, margin=15.0).any()
    np.testing.assert_allclose(surfaces.ground_height([20, 6, 40], [5, 5.5, 5]), 0.0, atol=1e-6)
    with pytest.raises(InputError, match=r"no ground at 1 of 2 positions, the first at \(90\.0, 5\.0\) m"):
        surfaces.ground_height([20, 90], [5, 5])
    # Through the arm of the L west of the courtyard, and through both arms.
    assert count_crossings(surfaces.walls, [[-5, 5, 2], [-5, 5, 2]], [[6, 5, 2], [40, 5, 2]]).tolist() == [
        2,
        4,
    ]


def test_the_outlines_of_a_made_scene_are_its_footprints(tmp_path):
    axis = np.linspace(-50, 110, 17)
    hill = Terrain(axis, axis, np.add.outer(0.02 * axis, 0.01 * axis) + 2.0)
    polygons = [L_SHAPE, shapely.box(60, 0, 70, 10)]
    for folder, terrain in (("level", None), ("hill", hill)):
        made = make_scene(
            footprints(polygons, [10.0, 4.0]), tmp_path / folder, terrain=terrain, windows=Windows(0.3)
        )
        outlines = building_outlines(made.path)
        assert outlines.symmetric_difference(shapely.union_all(polygons)).area < 0.05


def test_positions_in_buildings_move_to_the_nearest_street():
    points = [[6, 20, 1.5], [11, 30, 1.5], [6, 5, 1.5], [29, 5, 2.0], [50, 50, 1.5]]
    moved, distance = move_outside(points, L_SHAPE, clearance=0.5)
    # The third stands in the courtyard, the last in the street.
    np.testing.assert_allclose(distance, [6.5, 1.5, 0.0, 1.5, 0.0])
    np.testing.assert_allclose(moved[[1, 3]], [[12.5, 30, 1.5], [30.5, 5, 2.0]])
    assert not shapely.contains_xy(L_SHAPE, moved[:, 0], moved[:, 1]).any()
    moved, _ = move_outside(points, L_SHAPE, clearance=0.5, furthest=2.0)
    assert np.isnan(moved).any(axis=1).tolist() == [True, False, False, False, False]
    assert move_outside(points, shapely.Polygon())[1].tolist() == [0.0] * 5


@pytest.mark.parametrize(("clearance", "points"), [(0.0, [[0, 0, 0]]), (1.0, [[0, np.nan, 0]])])
def test_bad_clearances_and_positions_are_refused(clearance, points):
    with pytest.raises(InputError):
        move_outside(points, L_SHAPE, clearance)
