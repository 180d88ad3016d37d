"""Outlines of buildings and positions led out of them."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from calibray.errors import InputError
from calibray.scenes.authoring.extrusion import Windows
from calibray.scenes.authoring.outlines import led_outside, outlines
from calibray.scenes.authoring.scene_folder import make_scene
from calibray.scenes.authoring.terrain import Terrain
from planted_maps import L_SHAPE, footprints


def test_the_outlines_of_a_made_scene_are_its_footprints(tmp_path):
    axis = np.linspace(-50, 110, 17)
    hill = Terrain(axis, axis, np.add.outer(0.02 * axis, 0.01 * axis) + 2.0)
    polygons = [L_SHAPE, shapely.box(60, 0, 70, 10)]
    for folder, terrain in (("level", None), ("hill", hill)):
        made = make_scene(
            footprints(polygons, [10.0, 4.0]), tmp_path / folder, terrain=terrain, windows=Windows(0.3)
        )
        covered = outlines(made.path)
        assert covered.symmetric_difference(shapely.union_all(polygons)).area < 0.05


def test_positions_are_led_to_the_nearest_street():
    points = [[6, 20, 1.5], [11, 30, 1.5], [6, 5, 1.5], [29, 5, 2.0], [50, 50, 1.5]]
    places, moved = led_outside(points, L_SHAPE, clearance=0.5)
    # The third stands in the courtyard, the last in the street.
    np.testing.assert_allclose(moved, [6.5, 1.5, 0.0, 1.5, 0.0])
    np.testing.assert_allclose(places[[1, 3]], [[12.5, 30, 1.5], [30.5, 5, 2.0]])
    assert not shapely.contains_xy(L_SHAPE, places[:, 0], places[:, 1]).any()
    given_up, _ = led_outside(points, L_SHAPE, clearance=0.5, furthest=2.0)
    assert np.isnan(given_up).any(axis=1).tolist() == [True, False, False, False, False]
    assert led_outside(points, shapely.Polygon())[1].tolist() == [0.0] * 5


@pytest.mark.parametrize(("clearance", "points"), [(0.0, [[0, 0, 0]]), (1.0, [[0, np.nan, 0]])])
def test_what_cannot_be_led_is_refused(clearance, points):
    with pytest.raises(InputError):
        led_outside(points, L_SHAPE, clearance)
