"""Coordinates: round trips to a millimetre, true lengths, and positions that are refused."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyproj
import pytest

from calibray.coordinates import Frame
from calibray.errors import InputError
from calibray.measurements.geographic import with_scene_positions

PLACES = [(11.5755, 48.1374), (-43.2, -22.9), (174.76, -36.85), (179.999, 0.0), (25.7, 66.5)]


@pytest.mark.parametrize("make", [Frame.local, Frame.utm])
@pytest.mark.parametrize("place", PLACES)
def test_positions_come_back_to_a_millimetre(make, place):
    frame = make(*place, height=123.0)
    positions = np.random.default_rng(0).uniform(-5000, 5000, (50, 3))
    degrees = frame.to_geographic(positions)
    again = frame.to_scene(degrees[:, 0], degrees[:, 1], degrees[:, 2])
    np.testing.assert_allclose(again, positions, atol=1e-3)
    np.testing.assert_allclose(degrees[:, 2], positions[:, 2] + 123.0)


@pytest.mark.parametrize("place", PLACES)
def test_a_local_frame_has_the_lengths_and_directions_of_the_globe(place):
    frame = Frame.local(*place)
    ellipsoid = pyproj.Geod(ellps="WGS84")
    for azimuth in (0.0, 90.0, 213.0):
        longitude, latitude, _ = ellipsoid.fwd(*place, azimuth, 2000.0)
        east, north, _ = frame.to_scene([longitude], [latitude])[0]
        turned = np.radians(azimuth)
        np.testing.assert_allclose([east, north], [2000 * np.sin(turned), 2000 * np.cos(turned)], atol=2e-2)


def test_lengths_away_from_the_origin_are_true_as_well():
    """Two places 1 km apart, 3 km from the origin; in UTM they are 0.3 m further or nearer."""
    ellipsoid = pyproj.Geod(ellps="WGS84")
    start = ellipsoid.fwd(11.5755, 48.1374, 70.0, 3000.0)[:2]
    end = ellipsoid.fwd(*start, 160.0, 1000.0)[:2]
    ends = Frame.local(11.5755, 48.1374).to_scene(*np.array([start, end]).T)
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(1000.0, abs=1e-3)
    ends = Frame.utm(11.5755, 48.1374).to_scene(*np.array([start, end]).T)
    assert abs(np.linalg.norm(ends[1] - ends[0]) - 1000.0) > 0.02


def test_utm_has_its_zones_and_its_origin():
    frame = Frame.utm(11.5755, 48.1374)
    assert frame.crs == "EPSG:32632"
    assert np.abs(frame.to_scene([11.5755], [48.1374])[0]).max() <= 0.5
    assert Frame.utm(174.76, -36.85).crs == "EPSG:32760"


def test_a_frame_is_recorded():
    frame = Frame("EPSG:32632", 691_000.0, 5_334_000.0, 510.0)
    assert Frame.from_record(frame.record()) == frame
    with pytest.raises(InputError, match="needs easting"):
        Frame.from_record({"crs": "EPSG:32632"})


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", "not a projection in metres"),
        ("EPSG:999999", "PROJ does not know"),
        ("EPSG:2263", "in metres"),
    ],
)
def test_a_system_that_is_no_frame_is_refused(crs, message):
    with pytest.raises(InputError, match=message):
        Frame(crs)


def test_positions_off_the_globe_are_refused():
    frame = Frame.local(11.5755, 48.1374)
    with pytest.raises(InputError, match=r"latitude of position 1 is 111\.6, must be -90 to 90"):
        frame.to_scene([48.1, 48.2], [11.6, 111.6])
    with pytest.raises(InputError, match="UTM goes from -80 to 84"):
        Frame.utm(0.0, 89.0)
    with pytest.raises(InputError, match="longitude"):
        Frame.local(np.nan, 0.0)


def test_a_log_gets_the_scenes_metres():
    frame = Frame.local(11.5755, 48.1374, height=515.0)
    truth = np.array([[0.0, 0.0, 1.5], [120.0, -35.5, 2.0]])
    longitude, latitude, height = frame.to_geographic(truth).T
    rows = pd.DataFrame({"lon": longitude, "lat": latitude, "alt": height, "above": [1.5, 2.0]})
    placed = with_scene_positions(rows, "rx", frame, "lon", "lat", "alt")
    np.testing.assert_allclose(placed[["rx_x", "rx_y", "rx_z"]], truth, atol=1e-3)
    over = with_scene_positions(
        rows, "rx", frame, "lon", "lat", "above", ground=lambda x, y: 0.1 * x
    )  # fmt: skip
    np.testing.assert_allclose(over["rx_z"], [1.5, 14.0], atol=1e-3)
    utm = frame.to_geographic(truth)
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(utm[:, 0], utm[:, 1])
    metres = with_scene_positions(
        pd.DataFrame({"e": east, "n": north}), "tx", frame, "e", "n", 515.0 + 1.5, "EPSG:32632"
    )
    np.testing.assert_allclose(metres[["tx_x", "tx_y"]], truth[:, :2], atol=1e-3)
    np.testing.assert_allclose(metres["tx_z"], 1.5)
    with pytest.raises(InputError, match="no column 'lng'"):
        with_scene_positions(rows, "rx", frame, "lng", "lat", 1.5)
