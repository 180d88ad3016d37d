"""Lengths of lines in regions against closed forms and points along them."""

import numpy as np
import pytest
import shapely

from calibray.scenes.obstruction import Region


def region(*polygons, bottom=0.0, top=8.0):
    count = len(polygons)
    return Region(np.array(polygons), np.full(count, bottom), np.full(count, top))


def test_lines_in_a_box():
    belt = region(shapely.box(10, -5, 30, 5), bottom=2.0)
    start = np.array(
        [[0, 0, 4.0], [0, 0, 1.0], [0, 0, 12.0], [20, 0, 4.0], [20, 0, 0.0], [20, 0, 9.0], [0, 9, 4.0]]
    )
    end = np.array(
        [[40, 0, 4.0], [40, 0, 1.0], [40, 0, 0.0], [60, 0, 4.0], [20, 0, 20.0], [20, 0, 30.0], [40, 9, 4.0]]
    )
    # The third line falls from 12 m to 0 over 40 m: it is between 8 and 2 m from x = 13.3 to 33.3.
    slope = np.hypot(40, 12) / 40
    assert belt.length_inside(start, end) == pytest.approx(
        [20.0, 0.0, (30 - 40 / 3) * slope, 10.0, 6.0, 0.0, 0.0], abs=1e-9
    )


def test_overlapping_polygons_count_once_and_heights_apart():
    start, end = np.array([[0, 0, 4.0]]), np.array([[60, 0, 4.0]])
    both = region(shapely.box(10, -5, 30, 5), shapely.box(20, -5, 40, 5))
    assert both.length_inside(start, end) == pytest.approx([30.0])
    stacked = Region(
        np.array([shapely.box(10, -5, 30, 5), shapely.box(40, -5, 50, 5)]),
        np.array([0.0, 0.0]),
        np.array([8.0, 3.0]),
    )
    assert stacked.length_inside(start, end) == pytest.approx([20.0])
    # A tree of 8 m in a wood of 3 m: above 3 m it counts alone, below both count once.
    mixed = Region(
        np.array([shapely.box(10, -5, 30, 5), shapely.box(20, -5, 40, 5)]),
        np.array([0.0, 0.0]),
        np.array([8.0, 3.0]),
    )
    low, high = np.array([[0, 0, 2.0]]), np.array([[60, 0, 2.0]])
    assert mixed.length_inside(start, end) == pytest.approx([20.0])
    assert mixed.length_inside(low, high) == pytest.approx([30.0])
    upright = np.array([[25, 0, 0.0]]), np.array([[25, 0, 10.0]])
    assert mixed.length_inside(*upright) == pytest.approx([8.0])


def test_a_polygon_with_a_hole_and_an_inlet_counts_every_piece():
    ring = shapely.difference(shapely.box(0, -20, 40, 20), shapely.box(10, -5, 20, 5))
    inlet = shapely.difference(ring, shapely.box(30, -5, 35, 20))
    start, end = np.array([[-10, 0, 4.0]]), np.array([[50, 0, 4.0]])
    assert region(inlet).length_inside(start, end) == pytest.approx([25.0])


def test_random_lines_agree_with_points_along_them():
    random = np.random.default_rng(2)
    angle = np.sort(random.uniform(0, 2 * np.pi, 9))
    polygon = shapely.Polygon(
        np.column_stack([np.cos(angle), np.sin(angle)]) * random.uniform(10, 40, (9, 1))
    )
    start, end = random.uniform([-60, -60, 0], [60, 60, 20], (2, 40, 3))
    found = region(polygon, bottom=3.0, top=12.0).length_inside(start, end)
    share = (np.arange(20_000) + 0.5) / 20_000
    for index in range(40):
        point = start[index] + share[:, None] * (end[index] - start[index])
        inside = shapely.contains_xy(polygon, point[:, 0], point[:, 1]) & (np.abs(point[:, 2] - 7.5) < 4.5)
        assert found[index] == pytest.approx(
            inside.mean() * np.linalg.norm(end[index] - start[index]), abs=0.05
        )
    assert (found > 0).sum() > 8
