"""The straight line between the ends of links against closed forms and points sampled along it."""

import numpy as np
import pytest
from scipy.stats import norm

from calibray.errors import InputError
from calibray.scenes import Triangles
from calibray.scenes.obstruction import clutter_loss_db, obstruction


def box(low, high, bottom=0.0, top=10.0):
    """Twelve triangles of a box: four walls, a roof and a floor [12, 3, 3]."""
    (x0, y0), (x1, y1) = low, high
    plan = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    faces = []
    for start, end in zip(plan, np.roll(plan, -1, axis=0), strict=True):
        a, b, c, d = [*start, bottom], [*end, bottom], [*end, top], [*start, top]
        faces += [[a, b, c], [a, c, d]]
    for height in (bottom, top):
        corner = np.column_stack([plan, np.full(4, height)])
        faces += [corner[[0, 1, 2]], corner[[0, 2, 3]]]
    return np.array(faces, dtype=float)


def scene(*boxes):
    """The boxes over a ground that is no obstacle."""
    ground = np.array([[[-500, -500, 0], [500, -500, 0], [0, 900, 0]]], dtype=float)
    corners = np.concatenate([ground, *boxes])
    face = np.arange(3 * len(corners)).reshape(-1, 3)
    return Triangles(corners.reshape(-1, 3), face, np.zeros(len(corners), int), np.arange(len(corners)) < 1)


def test_a_line_through_a_box():
    found = obstruction(
        scene(box((10, -5), (30, 5))),
        np.array([[0, 1, 2.0], [0, 1, 2.0], [0, 1, 2.0], [0, 1, 14.0], [0, 1, 12.0], [20, 1, 2.0]]),
        np.array([[50, 1, 2.0], [5, 1, 2.0], [20, 1, 2.0], [50, 1, 14.0], [40, 1, 2.0], [20, 2, 2.0]]),
    )
    # The fifth line falls from 12 m to 2 m over 40 m: it is below the roof from 8 m on.
    slope = np.hypot(40, 10) / 40
    assert found.length_m == pytest.approx([20.0, 0.0, 10.0, 0.0, 20.0 * slope, 1.0])
    assert found.walls.tolist() == [2, 0, 1, 0, 2, 0]
    assert found.out_of_sight.tolist() == [True, False, True, False, True, True]


def test_boxes_that_overlap_count_once_and_neighbours_in_sum():
    start, end = np.array([[0, 1, 2.0]]), np.array([[60, 1, 2.0]])
    tower = box((15, -3), (25, 3), 0.0, 40.0)
    assert obstruction(scene(box((10, -5), (30, 5)), tower), start, end).length_m == pytest.approx([20.0])
    touching = obstruction(scene(box((10, -5), (30, 5)), box((30, -5), (40, 5))), start, end)
    assert touching.length_m == pytest.approx([30.0])
    assert touching.walls.tolist() == [3]  # two coincident walls are one crossing


def test_random_lines_agree_with_points_along_them_either_way_round():
    random = np.random.default_rng(4)
    boxes = []
    for low in random.uniform(-80, 60, (12, 2)):
        boxes.append((low, low + random.uniform(5, 30, 2), random.uniform(4, 25)))
    triangles = scene(*(box(low, high, 0.0, top) for low, high, top in boxes))
    start = np.column_stack([random.uniform(-100, 100, (60, 2)), random.uniform(1, 30, 60)])
    start[20:] = start[0]  # many links of one transmitter
    end = np.column_stack([random.uniform(-100, 100, (60, 2)), random.uniform(1, 5, 60)])
    found = obstruction(triangles, start, end)
    share = (np.arange(20_000) + 0.5) / 20_000
    for index in range(60):
        point = start[index] + share[:, None] * (end[index] - start[index])
        inside = np.zeros(len(point), dtype=bool)
        for low, high, top in boxes:
            inside |= ((point[:, :2] > low) & (point[:, :2] < high)).all(axis=1) & (point[:, 2] < top)
        expected = inside.mean() * np.linalg.norm(end[index] - start[index])
        assert found.length_m[index] == pytest.approx(expected, abs=0.05)
    backwards = obstruction(triangles, end, start)
    assert backwards.length_m == pytest.approx(found.length_m, abs=1e-9)
    assert backwards.walls.tolist() == found.walls.tolist()
    assert found.walls.max() > 2


def test_the_knife_edge_is_that_of_p_526():
    """A screen 5 m above the line half way over 200 m, at a wavelength of 0.1 m."""
    found = obstruction(
        scene(box((99.999, -50), (100.001, 50), 0.0, 15.0)),
        np.array([[0, 0, 10.0], [0, 0, 60.0]]),
        np.array([[200, 0, 10.0], [200, 0, 60.0]]),
    )
    parameter = 5.0 * np.sqrt(2 / 0.1 * (1 / 100 + 1 / 100))
    expected = 6.9 + 20 * np.log10(np.sqrt((parameter - 0.1) ** 2 + 1) + parameter - 0.1)
    assert found.knife_edge_db(0.1) == pytest.approx([expected, 0.0], abs=1e-3)
    # At grazing incidence the loss is 6 dB.
    grazing = obstruction(
        scene(box((99.999, -50), (100.001, 50), 0.0, 10.0)),
        np.array([[0, 0, 10.0]]),
        np.array([[200, 0, 10.0]]),
    )
    assert grazing.knife_edge_db(0.1) == pytest.approx([6.03], abs=0.02)


def test_a_floor_over_the_whole_scene_blocks_links_between_storeys():
    """The ends of two links are above each other; floors and the ceiling are no obstacles within a storey."""
    corners = np.concatenate([box((0, 0), (12, 9), z, z)[-2:] for z in (0.0, 3.0, 6.0)])
    face = np.arange(3 * len(corners)).reshape(-1, 3)
    storeys = Triangles(corners.reshape(-1, 3), face, np.zeros(len(face), int), np.ones(len(face), bool))
    tx, beyond = (2.0, 2.0, 2.5), (20.0, 2.0, 1.5)
    start = np.array([tx, tx, tx, (2.0, 2.0, 5.5), tx])
    end = np.array([(9.0, 5.0, 1.5), (9.0, 5.0, 4.5), (2.0, 2.0, 4.5), (9.0, 5.0, 4.5), beyond])
    found = obstruction(storeys, start, end)
    assert found.out_of_sight.tolist() == [False, True, True, False, False]
    assert obstruction(storeys, end, start).out_of_sight.tolist() == found.out_of_sight.tolist()


def test_a_scene_without_obstacles_blocks_nothing():
    found = obstruction(scene(), np.array([[0, 0, 10.0]]), np.array([[200, 0, 10.0]]))
    assert (found.length_m[0], found.walls[0], found.knife_edge_db(0.1)[0]) == (0.0, 0, 0.0)
    assert not found.out_of_sight.any()


def test_clutter_loss_is_that_of_the_recommendation():
    # Values of the ITU's test table for p % of locations: the median minus sigma_cb times the normal quantile.
    for carrier, distance, percent, expected in (
        (0.5e9, 250.0, 50, 17.4),
        (0.5e9, 250.0, 1, 3.9),
        (26.6e9, 15_800.0, 45, 32.5),
        (3.5e9, 1000.0, 0.1, 16.8),
    ):
        ghz, kilometres = carrier / 1e9, min(distance / 1e3, 2.0)
        long_db = -2 * np.log10(10 ** (-5 * np.log10(ghz) - 12.5) + 10**-16.5)
        short_db = 32.98 + 23.9 * np.log10(kilometres) + 3 * np.log10(ghz)
        weight = 10 ** (-0.2 * np.array([long_db, short_db]))
        sigma_db = np.sqrt(weight @ [16, 36] / weight.sum())
        found = clutter_loss_db([distance], carrier)[0] + sigma_db * norm.ppf(percent / 100)
        assert found == pytest.approx(expected, abs=0.051)
    assert clutter_loss_db([249.0, 2000.0, 9000.0], 3.5e9) == pytest.approx([0.0, 30.3849, 30.3849], abs=1e-3)
    with pytest.raises(InputError, match="not 70 GHz"):
        clutter_loss_db([300.0, 300.0], [3e9, 70e9])
