"""Walls that are one plane but for rounding: in line afterwards, and traced as one; what is no plane stays."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate

from calibray.fields import path_loss
from calibray.paths import Paths
from calibray.scenes import read_scene
from calibray.scenes.authoring import scene_folder as making
from calibray.scenes.authoring.building_parts import take_apart
from calibray.scenes.authoring.extrusion import Shell, Windows, extrude
from calibray.scenes.authoring.scene_folder import make_scene
from calibray.scenes.authoring.wall_alignment import Alignment, align
from calibray.tracing.settings import Antenna, TraceSettings
from calibray.tracing.sionna import Tracer
from planted_maps import footprints

FREQUENCY = 3.5e9
SLANT = np.deg2rad(17.0)
"""Angle of the street."""
ALONG, ACROSS = np.array([np.cos(SLANT), np.sin(SLANT)]), np.array([-np.sin(SLANT), np.cos(SLANT)])


def row(gaps: tuple[float, ...] = (0, 0, 6, 0, 14), width: float = 11.0) -> list[shapely.Polygon]:
    """Houses with their fronts on one line, side by side or with gaps between, as deep as they like."""
    houses, west = [], 0.0
    for number, gap in enumerate(gaps):
        west += gap
        house = shapely.box(west, 0, west + width, 8 + number)
        houses.append(rotate(house, SLANT, (0, 0), use_radians=True))
        west += width
    return houses


def raised(polygons: list[shapely.Polygon], windows: Windows | None = None) -> Shell:
    """Buildings of 9 m, their corners on the grid of a map."""
    found = footprints(polygons, [9.0] * len(polygons))
    cells, _ = take_apart(found, found.bottom, found.top)
    return extrude(cells, windows)


def unevenness(places: np.ndarray) -> float:
    """How far corners of the street's front lie from one straight line [m]."""
    front = places[np.abs(places @ ACROSS) < 0.5]
    assert len(front) >= 8
    return float(
        np.abs(np.linalg.svd(front - front.mean(axis=0))[2][1] @ (front - front.mean(axis=0)).T).max()
    )


@pytest.mark.parametrize("windows", [None, Windows(0.4, module=3.0)], ids=["walls", "windows"])
def test_the_fronts_of_a_row_of_houses_are_one_plane(windows):
    aligned = align(raised(row(), windows).corners)
    assert unevenness(aligned.points / 1000) > 2e-3
    assert unevenness(aligned.places) < 1e-9
    assert np.abs(aligned.places - aligned.points / 1000).max() < 0.02


def test_corners_at_any_height_move_alike():
    shell = raised(row())
    aligned = align(shell.corners)
    corners = shell.corners.reshape(-1, 3)
    placed = aligned.placed(corners)
    np.testing.assert_array_equal(placed[:, 2], corners[:, 2] / 1000)
    where = {tuple(point): tuple(place) for point, place in zip(aligned.points, aligned.places, strict=True)}
    assert [tuple(place) for place in placed[:, :2]] == [where[tuple(corner)] for corner in corners[:, :2]]


@pytest.mark.parametrize(
    ("polygons", "most"),
    [
        ([shapely.box(0, 0, 10, 8), shapely.box(10, 0.1, 20, 8)], 1e-9),
        ([shapely.box(0, 0, 10, 8), rotate(shapely.box(15, 0, 25, 8), 4.0, (15, 0))], 1e-9),
        ([shapely.box(0, 0, 10, 8), shapely.box(80, 0.01, 90, 8)], 1e-9),
        # Short edges of a bow continue each other within what a map tells, and are bent a little.
        ([shapely.Point(0, 0).buffer(10, quad_segs=30)], 0.015),
    ],
    ids=["10 cm apart", "4 degrees apart", "far away", "a round tower"],
)
def test_what_is_no_plane_stays(polygons, most):
    aligned = align(raised(polygons).corners)
    np.testing.assert_allclose(aligned.places, aligned.points / 1000, atol=most)


def test_nothing_is_turned_over():
    """A step of 1 cm in a wall, and random houses over each other: every level triangle keeps its side."""
    rng = np.random.default_rng(5)
    step = shapely.Polygon([(0, 0), (10, 0), (10, 0.01), (20, 0.01), (20, 8), (0, 8)])
    heap = [
        rotate(shapely.box(x, y, x + 9, y + 7), angle)
        for x, y, angle in rng.uniform((0, 0, 0), (60, 60, 90), (40, 3))
    ]
    for polygons in ([step], heap):
        shell = raised(polygons)
        before = shell.corners.reshape(-1, 3)
        after = align(shell.corners).placed(before)
        areas = []
        for corners in (before / 1000, after):
            one, two = np.diff(corners.reshape(-1, 3, 3)[..., :2], axis=1).transpose(1, 0, 2)
            areas.append(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        level = np.abs(areas[0]) > 0
        assert (areas[0][level] * areas[1][level] > 0).all()
        assert np.linalg.norm(after - before / 1000, axis=1).max() <= 0.05


def traced(scene) -> tuple[Paths, np.ndarray]:
    """Paths of some links along the street, with one reflection."""
    rx = [(*tuple(step * ALONG - 6 * ACROSS), 1.5) for step in range(2, 118, 4)]
    tx = [(*tuple(60 * ALONG - 9 * ACROSS), 4.0)] * len(rx)
    tracer = Tracer(
        read_scene(scene, FREQUENCY),
        FREQUENCY,
        TraceSettings(max_depth=1, samples=100_000),
        Antenna(),
        Antenna(),
    )
    paths = tracer.trace(SimpleNamespace(tx=np.array(tx), rx=np.array(rx)))
    return paths, path_loss(paths)


def test_a_row_of_houses_reflects_once(tmp_path, monkeypatch):
    """One way leads straight to a receiver and one by the fronts; with corners as the map has them more seem to."""
    houses = footprints(row((0, 2, 2, 2), width=28.0), [9.0] * 4)

    def as_rounded(corners: np.ndarray) -> Alignment:
        points = np.unique(corners[..., :2].reshape(-1, 2), axis=0)
        return Alignment(points, points / 1000)

    made, loss = traced(make_scene(houses, tmp_path / "made", ground=False).path)
    assert np.bincount(made.link).max() == 2
    monkeypatch.setattr(making, "align", as_rounded)
    rounded, wrong = traced(make_scene(houses, tmp_path / "rounded", ground=False).path)
    assert np.bincount(rounded.link).max() > 2
    assert np.abs(wrong - loss).max() > 1.0
