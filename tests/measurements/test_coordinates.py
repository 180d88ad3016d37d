"""Coordinates: round trips to a millimetre, true lengths, and refused positions."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from calibray.coordinates import Frame
from calibray.errors import InputError

PLACES = [(11.5755, 48.1374), (-43.2, -22.9), (174.76, -36.85), (179.999, 0.0), (25.7, 66.5)]


@pytest.mark.parametrize("make", [Frame.local, Frame.utm])
@pytest.mark.parametrize("place", PLACES)
def test_positions_survive_a_round_trip_to_a_millimetre(make, place):
    frame = make(*place, height=123.0)
    positions = np.random.default_rng(0).uniform(-5000, 5000, (50, 3))
    degrees = frame.to_geographic(positions)
    returned = frame.to_scene(degrees[:, 0], degrees[:, 1], degrees[:, 2])
    np.testing.assert_allclose(returned, positions, atol=1e-3)
    np.testing.assert_allclose(degrees[:, 2], positions[:, 2] + 123.0)


@pytest.mark.parametrize("place", PLACES)
def test_a_local_frame_has_true_lengths_and_directions(place):
    frame = Frame.local(*place)
    ellipsoid = pyproj.Geod(ellps="WGS84")
    for azimuth in (0.0, 90.0, 213.0):
        longitude, latitude, _ = ellipsoid.fwd(*place, azimuth, 2000.0)
        east, north, _ = frame.to_scene([longitude], [latitude])[0]
        bearing = np.radians(azimuth)
        np.testing.assert_allclose([east, north], [2000 * np.sin(bearing), 2000 * np.cos(bearing)], atol=2e-2)


def test_lengths_are_true_away_from_the_origin():
    """Two points 1 km apart, 3 km from the origin; UTM distorts their distance."""
    ellipsoid = pyproj.Geod(ellps="WGS84")
    start = ellipsoid.fwd(11.5755, 48.1374, 70.0, 3000.0)[:2]
    end = ellipsoid.fwd(*start, 160.0, 1000.0)[:2]
    ends = Frame.local(11.5755, 48.1374).to_scene(*np.array([start, end]).T)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(1000.0, abs=1e-3)
    ends = Frame.utm(11.5755, 48.1374).to_scene(*np.array([start, end]).T)
    assert abs(np.linalg.norm(ends[1] - ends[0]) - 1000.0) > 0.02


def test_utm_frames_have_the_right_zone_and_origin():
    frame = Frame.utm(11.5755, 48.1374)
    assert frame.crs == "EPSG:32632"
    assert np.abs(frame.to_scene([11.5755], [48.1374])[0]).max() <= 0.5
    assert Frame.utm(174.76, -36.85).crs == "EPSG:32760"


def test_a_frame_survives_its_record():
    frame = Frame("EPSG:32632", 691_000.0, 5_334_000.0, 510.0)
    assert Frame.from_record(frame.record()) == frame
    with pytest.raises(InputError, match="must contain easting"):
        Frame.from_record({"crs": "EPSG:32632"})


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", "not a projection in metres"),
        ("EPSG:999999", "unknown to PROJ"),
        ("EPSG:2263", "in metres"),
        # Transverse Mercator of southern Africa: x counts to the west and y to the south.
        ("EPSG:2048", "with x pointing east and y pointing north"),
    ],
)
def test_systems_without_metres_are_refused(crs, message):
    with pytest.raises(InputError, match=message):
        Frame(crs)


def test_positions_off_the_globe_are_refused():
    frame = Frame.local(11.5755, 48.1374)
    with pytest.raises(InputError, match=r"latitude of position 1 is 111\.6, must be -90 to 90"):
        frame.to_scene([48.1, 48.2], [11.6, 111.6])
    with pytest.raises(InputError, match="must be -80 to 84 degrees for UTM"):
        Frame.utm(0.0, 89.0)
    with pytest.raises(InputError, match="longitude"):
        Frame.local(np.nan, 0.0)


def test_positions_may_be_given_in_another_projection():
    frame = Frame.local(11.5755, 48.1374, height=515.0)
    positions = np.array([[0.0, 0.0, 1.5], [120.0, -35.5, 2.0]])
    longitude, latitude, height = frame.to_geographic(positions).T
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    np.testing.assert_allclose(frame.to_scene(east, north, height, "EPSG:32632"), positions, atol=1e-3)
