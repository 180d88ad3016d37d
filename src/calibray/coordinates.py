"""Geographic coordinates of a scene.

A scene has a local coordinate frame, in which x points east and y points north from an origin. Map projections distort
lengths; UTM, for example, does so by up to 1 m per kilometre. The default frame is therefore PROJ's azimuthal
equidistant projection (`aeqd`), centred on the scene. In this projection, lengths are accurate to 1 mm per kilometre
within several kilometres of the centre.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.support.lazy_imports import library

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

WGS84: Final = "EPSG:4326"
"""Coordinate reference system that GPS receivers use: longitude and latitude."""


@dataclass(frozen=True)
class Frame:
    """The frame of a scene: a map projection in metres, with the coordinates of the scene's origin in that projection.

    Attributes:
        crs: The projection, in any form that PROJ reads, such as `EPSG:32632`, a `+proj` string or WKT.
        easting: Easting of the origin in the projection [m].
        northing: Northing of the origin in the projection [m].
        height: Height of the plane z = 0 above the vertical datum of the geographic heights [m].

    Raises:
        InputError: PROJ does not know the projection, its coordinates are not in metres with x pointing east and y
            pointing north, or the origin is not finite.
    """

    crs: str
    easting: float = 0.0
    northing: float = 0.0
    height: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite([self.easting, self.northing, self.height]).all():
            raise InputError(f"frame {self.record()}: easting, northing and height must be finite")
        projection = parse_crs(self.crs)
        axes = {(axis.direction, axis.unit_name) for axis in projection.axis_info[:2]}
        # In some projections (EPSG:2048), x points west and y south, which would rotate a scene by 180 degrees.
        if not projection.is_projected or axes != {("east", "metre"), ("north", "metre")}:
            raise InputError(
                f"crs = {self.crs!r}: {projection.name} is not a projection in metres with x pointing east and y "
                "pointing north; give such a projection, for example the UTM zone EPSG:326xx, or omit crs to use a "
                "local projection"
            )

    @classmethod
    def local(cls, longitude: float, latitude: float, height: float = 0.0) -> Frame:
        """Make the local frame centred on a point; distances from this point are not distorted.

        The longitude is positive east of Greenwich and the latitude positive north of the equator [deg]; `height` is
        the height of the plane z = 0 [m].

        Raises:
            InputError: The longitude or the latitude is out of range.
        """
        _check_degrees(np.array([longitude]), np.array([latitude]))
        # Coordinates rounded to 1e-7 degrees (1 cm) keep the string short, and the string states the origin exactly.
        centre = f"+lat_0={round(float(latitude), 7)!r} +lon_0={round(float(longitude), 7)!r}"
        return cls(f"+proj=aeqd {centre} +datum=WGS84 +units=m", height=height)

    @classmethod
    def utm(cls, longitude: float, latitude: float, height: float = 0.0) -> Frame:
        """Make the frame of the UTM zone that contains a point, with the origin rounded to whole metres.

        The arguments are the same as for `local`.

        Raises:
            InputError: The longitude or the latitude is out of range, or the point is too close to a pole for UTM.
        """
        _check_degrees(np.array([longitude]), np.array([latitude]))
        if not -80 <= latitude <= 84:
            raise InputError(f"latitude = {latitude:g}: must be -80 to 84 degrees for UTM; use a local frame")
        # A longitude of 180 degrees east would give zone 61. The regular zones are also adequate in Norway and
        # Svalbard.
        zone = min(int((longitude + 180) // 6) + 1, 60)
        crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
        easting, northing, _ = cls(crs).to_scene([longitude], [latitude])[0]
        return cls(crs, float(round(easting)), float(round(northing)), height)

    @classmethod
    def from_record(cls, record: object) -> Frame:
        """Read a frame from a dictionary that `record` returned.

        Raises:
            InputError: The record is not a dictionary with these keys.
        """
        keys = ("easting", "northing", "height")
        if not isinstance(record, Mapping) or not isinstance(record.get("crs"), str):
            raise InputError(f"frame {record!r}: must contain crs, easting, northing and height")
        if not all(isinstance(record.get(key), float | int) for key in keys):
            raise InputError(f"frame {record!r}: must contain easting, northing and height in metres")
        return cls(record["crs"], *(float(record[key]) for key in keys))

    def record(self) -> dict[str, str | float]:
        """Convert the frame to a dictionary that JSON can store."""
        return asdict(self)

    def __str__(self) -> str:
        return json.dumps(self.record())

    def to_scene(
        self,
        longitude: ArrayLike,
        latitude: ArrayLike,
        height: ArrayLike = 0.0,
        crs: str = WGS84,
        *,
        rows: NDArray[np.int64] | None = None,
    ) -> NDArray[np.float64]:
        """Convert positions to the scene's frame.

        Args:
            longitude: Longitude, positive east of Greenwich [n], [deg]; or x in the units of `crs`.
            latitude: Latitude, positive north of the equator [n], [deg]; or y in the units of `crs`.
            height: Height above the vertical datum of the frame [m]: one value per position [n], or one for all
                positions.
            crs: Coordinate reference system of the positions.
            rows: Row number of each position [n] in its table, for error messages; if None, messages state the
                position's index.

        Returns:
            Positions x, y, z [n, 3], [m].

        Raises:
            InputError: A longitude or latitude is out of range, or a position is outside the area where the projection
                is valid.
        """
        x, y, z = (np.asarray(part, dtype=float) for part in np.broadcast_arrays(longitude, latitude, height))
        if crs == WGS84:
            _check_degrees(x, y, rows)
        easting, northing = transformer(crs, self.crs).transform(x, y)
        # Outside the area where a projection is valid, PROJ returns infinity instead of raising an error.
        outside = np.flatnonzero(~np.isfinite(np.ravel(easting) + np.ravel(northing)))
        if len(outside):
            raise InputError(
                f"{_name(outside[0], rows)}: ({np.ravel(x)[outside[0]]:g}, {np.ravel(y)[outside[0]]:g}) of {crs} lies "
                f"outside the projection {self.crs}; check the order of the axes"
            )
        return np.stack([easting - self.easting, northing - self.northing, z - self.height], axis=-1)

    def to_geographic(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Convert positions x, y, z [n, 3], [m], to longitude and latitude [deg] and height [m], as an array [n, 3]."""
        x, y, z = np.moveaxis(np.asarray(positions, dtype=float), -1, 0)
        longitude, latitude = transformer(self.crs, WGS84).transform(x + self.easting, y + self.northing)
        return np.stack([longitude, latitude, z + self.height], axis=-1)


def parse_crs(crs: object) -> CRS:
    """Look up a coordinate reference system that is given in any form that PROJ reads.

    Raises:
        InputError: PROJ does not know the coordinate reference system.
    """
    pyproj = library("pyproj", "geo")
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"crs = {crs!r}: unknown to PROJ ({reason}); give an EPSG code, such as EPSG:4326"
        ) from None


@lru_cache
def transformer(source: object, target: object) -> Transformer:
    """The transformation between two coordinate reference systems; x or longitude is always the first coordinate.

    Creating a transformation takes up to 0.3 s, so each transformation is created only once per process.

    Raises:
        InputError: PROJ does not know one of the two coordinate reference systems.
    """
    pyproj = library("pyproj", "geo")
    return pyproj.Transformer.from_crs(parse_crs(source), parse_crs(target), always_xy=True)


def find_projection(
    x: NDArray[np.float64], y: NDArray[np.float64], frame: Frame, low: Sequence[float], high: Sequence[float]
) -> str | None:
    """Find the map projection of given coordinates by testing which projection places the most positions on a scene.

    The candidates are the UTM zone of the scene, Web Mercator, and the EPSG projections that cover the scene.

    Args:
        x: Eastings [n].
        y: Northings [n].
        frame: The scene's frame.
        low: West and south bounds of the scene [2], [m].
        high: East and north bounds of the scene [2], [m].

    Returns:
        The projection that places the most positions on the scene; None if no projection places at least half of them
        there.

    Example:
        >>> frame = Frame.local(11.5755, 48.1374)
        >>> find_projection(np.array([691607.0]), np.array([5334760.0]), frame, [-200, -200], [200, 200])
        'EPSG:32632'
    """
    pyproj = library("pyproj", "geo")
    longitude, latitude, _ = frame.to_geographic([0.0, 0.0, 0.0])
    here = pyproj.aoi.AreaOfInterest(longitude, latitude, longitude, latitude)
    known = pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.PROJECTED_CRS, here, contains=True)
    utm = [Frame.utm(longitude, latitude).crs] if -80 <= latitude <= 84 else []
    # At least half of the positions must lie on the scene; if several candidates have the same share, the first is
    # used.
    best, most = None, 0.5
    # The same coordinates in two geodetic datums denote points less than 3 km apart, and usually less than 1 km.
    reach = 3000.0 + 2 * float(np.max(np.subtract(high, low)))
    for crs in dict.fromkeys([*utm, "EPSG:3857", *sorted(f"EPSG:{info.code}" for info in known)]):
        try:
            # Projecting without a datum transformation is fast, and `reach` allows for the resulting error.
            east, north = pyproj.Proj(crs)(longitude, latitude)
            if not np.hypot(np.median(x) - east, np.median(y) - north) < reach:
                continue
            placed = frame.to_scene(x, y, 0.0, crs)[:, :2]
        except (InputError, pyproj.exceptions.ProjError):
            continue  # the scene is outside the projection, or the projection is for another celestial body
        share = float(((placed >= np.asarray(low)) & (placed <= np.asarray(high))).all(axis=1).mean())
        if share > most or (best is None and share == most):
            best, most = crs, share
        if most == 1.0:
            break  # no other candidate can be better, and each candidate takes up to 0.3 s to open
    return best


def _check_degrees(
    longitude: NDArray[np.float64], latitude: NDArray[np.float64], rows: NDArray[np.int64] | None = None
) -> None:
    for name, values, bound in (("latitude", latitude, 90.0), ("longitude", longitude, 180.0)):
        outside = np.flatnonzero(~(np.abs(np.ravel(values)) <= bound))
        if len(outside):
            raise InputError(
                f"{name} of {_name(outside[0], rows)} is {np.ravel(values)[outside[0]]:g}, must be -{bound:g} to "
                f"{bound:g} degrees; check the order of the columns and their unit"
            )


def _name(index: int, rows: NDArray[np.int64] | None) -> str:
    """Describe a position for error messages."""
    return f"position {index}" if rows is None else f"row {rows[index]}"
