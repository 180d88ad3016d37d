"""Coordinates: where a scene's metres lie on the globe.

A scene has its own frame, x to the east and y to the north of an origin. Far from the origin of a map projection a
metre on the map is no metre on the ground (UTM: 0.4 m in a kilometre), so the frame made for a scene by default is a
projection centred on the scene itself: the azimuthal equidistant one of PROJ (`aeqd`), true to 1 mm in a kilometre
over several kilometres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibray.errors import InputError
from calibray.support.extras import library

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

WGS84: Final = "EPSG:4326"
"""Longitude and latitude as satellite receivers give them."""


@dataclass(frozen=True)
class Frame:
    """A scene's frame: a projection whose unit is the metre, and the point of it that is the scene's origin.

    Attributes:
        crs: The projection, anything that PROJ reads: `EPSG:32632`, a `+proj` string, WKT.
        easting: What is taken off the projection's x [m].
        northing: What is taken off the projection's y [m].
        height: Height that is z = 0 [m], above whatever the heights given are above.

    Raises:
        InputError: PROJ does not know the projection, it is none in metres with x to the east, or a number is not
            finite.
    """

    crs: str
    easting: float = 0.0
    northing: float = 0.0
    height: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite([self.easting, self.northing, self.height]).all():
            raise InputError(f"frame {self.record()}: the origin must be finite numbers of metres")
        known = parse_crs(self.crs)
        units = {axis.unit_name for axis in known.axis_info[:2]}
        if not known.is_projected or units != {"metre"}:
            raise InputError(
                f"crs = {self.crs!r}: {known.name} is not a projection in metres; "
                "name one, such as the UTM zone EPSG:326xx, or leave it out for a local one"
            )

    @classmethod
    def local(cls, longitude: float, latitude: float, height: float = 0.0) -> Frame:
        """The frame centred on a place: distances from there are true.

        Args:
            longitude: East of Greenwich [deg].
            latitude: North of the equator [deg].
            height: Height of z = 0 [m].

        Returns:
            The frame.

        Raises:
            InputError: The place is not on the globe.
        """
        _check_degrees(np.array([longitude]), np.array([latitude]))
        # A tenth of a microdegree is 1 cm: the string stays short, and states the origin exactly.
        centre = f"+lat_0={round(float(latitude), 7)!r} +lon_0={round(float(longitude), 7)!r}"
        return cls(f"+proj=aeqd {centre} +datum=WGS84 +units=m", height=height)

    @classmethod
    def utm(cls, longitude: float, latitude: float, height: float = 0.0) -> Frame:
        """The UTM zone of a place, less the whole metres of the place.

        Args:
            longitude: East of Greenwich [deg].
            latitude: North of the equator [deg].
            height: Height of z = 0 [m].

        Returns:
            The frame.

        Raises:
            InputError: The place is not on the globe, or nearer to a pole than UTM goes.
        """
        _check_degrees(np.array([longitude]), np.array([latitude]))
        if not -80 <= latitude <= 84:
            raise InputError(f"latitude = {latitude:g}: UTM goes from -80 to 84 degrees; use a local frame")
        zone = min(int((longitude + 180) // 6) + 1, 60)
        crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
        easting, northing, _ = cls(crs).to_scene([longitude], [latitude])[0]
        return cls(crs, float(round(easting)), float(round(northing)), height)

    @classmethod
    def from_record(cls, record: object) -> Frame:
        """The frame that a record tells of.

        Args:
            record: What `record` gave.

        Returns:
            The frame.

        Raises:
            InputError: It is no such record.
        """
        keys = ("easting", "northing", "height")
        if not isinstance(record, Mapping) or not isinstance(record.get("crs"), str):
            raise InputError(f"frame {record!r}: needs crs, easting, northing and height")
        if not all(isinstance(record.get(key), float | int) for key in keys):
            raise InputError(f"frame {record!r}: needs easting, northing and height in metres")
        return cls(record["crs"], *(float(record[key]) for key in keys))

    def record(self) -> dict[str, str | float]:
        """The frame as JSON takes it."""
        return asdict(self)

    def __str__(self) -> str:
        return json.dumps(self.record())

    def to_scene(
        self, longitude: ArrayLike, latitude: ArrayLike, height: ArrayLike = 0.0, crs: str = WGS84
    ) -> NDArray[np.float64]:
        """Positions in the scene's frame.

        Args:
            longitude: East of Greenwich [n], [deg]; or x in the units of `crs`.
            latitude: North of the equator [n], [deg]; or y.
            height: Height [n] or one for all [m], above the same as the frame's.
            crs: What the coordinates are given in.

        Returns:
            Positions x, y, z [n, 3], [m].

        Raises:
            InputError: A coordinate is not on the globe, or not where the projection can be used.
        """
        x, y, z = (np.asarray(part, dtype=float) for part in np.broadcast_arrays(longitude, latitude, height))
        if crs == WGS84:
            _check_degrees(x, y)
        return np.stack([*self._projected(x, y, crs), z - self.height], axis=-1)

    def to_geographic(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Longitude, latitude and height of positions in the scene's frame.

        Args:
            positions: x, y and z [n, 3], [m].

        Returns:
            Longitude [deg], latitude [deg] and height [m], each one column [n, 3].
        """
        x, y, z = np.moveaxis(np.asarray(positions, dtype=float), -1, 0)
        to_degrees = transformer(self.crs, WGS84)
        longitude, latitude = to_degrees.transform(x + self.easting, y + self.northing)
        return np.stack([longitude, latitude, z + self.height], axis=-1)

    def _projected(
        self, x: NDArray[np.float64], y: NDArray[np.float64], crs: str
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        easting, northing = transformer(crs, self.crs).transform(x, y)
        lost = np.flatnonzero(~np.isfinite(np.ravel(easting) + np.ravel(northing)))
        if len(lost):
            where = f"({np.ravel(x)[lost[0]]:g}, {np.ravel(y)[lost[0]]:g})"
            raise InputError(
                f"position {where} of {crs} lies outside the projection {self.crs}; check the axes"
            )
        return easting - self.easting, northing - self.northing


def parse_crs(crs: object) -> CRS:
    """A coordinate reference system by its name.

    Args:
        crs: Anything that PROJ reads.

    Returns:
        The system.

    Raises:
        InputError: PROJ does not know it.
    """
    pyproj = library("pyproj", "geo")
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"crs = {crs!r}: PROJ does not know it ({reason}); name an EPSG code, EPSG:4326"
        ) from None


def transformer(source: object, target: object) -> Transformer:
    """What turns coordinates of one reference system into another's, x (longitude) always first.

    Args:
        source: The system that the coordinates are given in.
        target: The system that they are wanted in.

    Returns:
        The transformation.

    Raises:
        InputError: PROJ does not know one of them.
    """
    pyproj = library("pyproj", "geo")
    return pyproj.Transformer.from_crs(parse_crs(source), parse_crs(target), always_xy=True)


def _check_degrees(longitude: NDArray[np.float64], latitude: NDArray[np.float64]) -> None:
    for name, values, bound in (("latitude", latitude, 90.0), ("longitude", longitude, 180.0)):
        bad = np.flatnonzero(~(np.abs(np.ravel(values)) <= bound))
        if len(bad):
            raise InputError(
                f"{name} of position {bad[0]} is {np.ravel(values)[bad[0]]:g}, must be -{bound:g} to {bound:g} "
                "degrees; check the columns' order and their unit"
            )
