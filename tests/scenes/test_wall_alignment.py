"""Wall alignment: walls that are one plane except for rounding become one plane; all others keep their position."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate

import calibray as cb
from calibray.scenes.authoring import Windows, made_scene, make_scene
from calibray.scenes.authoring.extrusion import Shell, extrude, split_overlaps
from calibray.scenes.authoring.wall_alignment import Alignment, align
from planted_maps import footprints

ANGLE = np.deg2rad(17.0)
"""Direction of the street."""
ALONG, ACROSS = np.array([np.cos(ANGLE), np.sin(ANGLE)]), np.array([-np.sin(ANGLE), np.cos(ANGLE)])


def row(gaps: tuple[float, ...] = (0, 0, 6, 0, 14), width: float = 11.0) -> list[shapely.Polygon]:
    """Houses of different depths with their fronts on one line, with gaps between them."""
    houses, west = [], 0.0
    for number, gap in enumerate(gaps):
        west += gap
        house = shapely.box(west, 0, west + width, 8 + number)
        houses.append(rotate(house, ANGLE, (0, 0), use_radians=True))
        west += width
    return houses


def raise_buildings(polygons: list[shapely.Polygon], windows: Windows | None = None) -> Shell:
    """Buildings 9 m high, with corners on the grid of a map."""
    buildings = footprints(polygons, [9.0] * len(polygons))
    cells, _ = split_overlaps(buildings, buildings.bottom, buildings.top)
    return extrude(cells, windows)


def unevenness(positions: np.ndarray) -> float:
    """Largest distance of the corners of the street's front from one straight line [m]."""
    front = positions[np.abs(positions @ ACROSS) < 0.5]
    assert len(front) >= 8
    offset = front - front.mean(axis=0)
    return float(np.abs(np.linalg.svd(offset)[2][1] @ offset.T).max())


@pytest.mark.parametrize("windows", [None, Windows(0.4, module=3.0)], ids=["walls", "windows"])
def test_the_fronts_of_a_row_of_houses_become_one_plane(windows):
    aligned = align(raise_buildings(row(), windows).corners)
    assert unevenness(aligned.points / 1000) > 2e-3
    assert unevenness(aligned.moved) < 1e-9
    assert np.abs(aligned.moved - aligned.points / 1000).max() < 0.02


def test_corners_move_alike_at_all_heights():
    shell = raise_buildings(row())
    aligned = align(shell.corners)
    corners = shell.corners.reshape(-1, 3)
    positions = aligned.positions(corners)
    np.testing.assert_array_equal(positions[:, 2], corners[:, 2] / 1000)
    moved = {tuple(point): tuple(target) for point, target in zip(aligned.points, aligned.moved, strict=True)}
    assert [tuple(each) for each in positions[:, :2]] == [moved[tuple(corner)] for corner in corners[:, :2]]


@pytest.mark.parametrize(
    ("polygons", "largest_move"),
    [
        ([shapely.box(0, 0, 10, 8), shapely.box(10, 0.1, 20, 8)], 1e-9),
        ([shapely.box(0, 0, 10, 8), rotate(shapely.box(15, 0, 25, 8), 4.0, (15, 0))], 1e-9),
        ([shapely.box(0, 0, 10, 8), shapely.box(80, 0.01, 90, 8)], 1e-9),
        # Short edges of a bow continue each other within the rounding of a map, and are bent a little.
        ([shapely.Point(0, 0).buffer(10, quad_segs=30)], 0.015),
    ],
    ids=["10 cm apart", "4 degrees apart", "far away", "a round tower"],
)
def test_walls_in_different_planes_keep_their_position(polygons, largest_move):
    aligned = align(raise_buildings(polygons).corners)
    np.testing.assert_allclose(aligned.moved, aligned.points / 1000, atol=largest_move)


def test_no_level_triangle_turns_over():
    """A step of 1 cm in a wall, and random overlapping houses."""
    rng = np.random.default_rng(5)
    step = shapely.Polygon([(0, 0), (10, 0), (10, 0.01), (20, 0.01), (20, 8), (0, 8)])
    overlapping = [
        rotate(shapely.box(x, y, x + 9, y + 7), angle)
        for x, y, angle in rng.uniform((0, 0, 0), (60, 60, 90), (40, 3))
    ]
    for polygons in ([step], overlapping):
        shell = raise_buildings(polygons)
        before = shell.corners.reshape(-1, 3)
        after = align(shell.corners).positions(before)
        areas = []
        for corners in (before / 1000, after):
            one, two = np.diff(corners.reshape(-1, 3, 3)[..., :2], axis=1).transpose(1, 0, 2)
            areas.append(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        level = np.abs(areas[0]) > 0
        assert (areas[0][level] * areas[1][level] > 0).all()
        assert np.linalg.norm(after - before / 1000, axis=1).max() <= 0.05


def paths_per_link(scene) -> np.ndarray:
    """Number of paths of links along the street, with at most one reflection."""
    rx = [(*tuple(step * ALONG - 6 * ACROSS), 1.5) for step in range(2, 118, 8)]
    tx = [(*tuple(60 * ALONG - 9 * ACROSS), 4.0)] * len(rx)
    links = SimpleNamespace(tx=np.array(tx), rx=np.array(rx))
    return np.bincount(cb.trace(scene, links, frequency=3.5e9, max_depth=1, samples=20_000).link)


def test_a_row_of_houses_reflects_once(tmp_path, monkeypatch):
    """Each receiver has the direct path and one reflection; corners as rounded on the map give false reflections."""
    houses = footprints(row((0, 2, 2, 2), width=28.0), [9.0] * 4)

    def keep_rounded(corners: np.ndarray) -> Alignment:
        points = np.unique(corners[..., :2].reshape(-1, 2), axis=0)
        return Alignment(points, points / 1000)

    aligned = make_scene(houses, tmp_path / "aligned", ground=False)
    assert paths_per_link(aligned.path).max() == 2
    monkeypatch.setattr(made_scene, "align", keep_rounded)
    rounded = make_scene(houses, tmp_path / "rounded", ground=False)
    assert paths_per_link(rounded.path).max() > 2
