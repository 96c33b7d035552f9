"""Where on earth a scene lies: an origin in WGS 84, local axes east, north and up in metres, and UTM coordinates.

Ellipsoid and geocentric coordinates: NIMA TR8350.2, "World Geodetic System 1984"; local axes are those of EPSG method 9837 ("geographic /
topocentric conversions"). UTM is left to pyproj (the extra `geo`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError, first_line
from fieldfuse.extras import extra

AXIS = 6378137.0  # metres: the ellipsoid's larger half axis
FLATTENING = 1 / 298.257223563
SQUARE = FLATTENING * (2 - FLATTENING)  # of the eccentricity
SOUTHERNMOST, NORTHERNMOST = -80.0, 84.0  # degrees that UTM covers
FARTHEST = 1e6  # metres above or below the ellipsoid


def ecef(places: Array) -> Array:
    """(..., 3) degrees north, degrees east, metres above the ellipsoid → (..., 3) geocentric metres."""
    places = np.asarray(places, dtype=np.float64)
    north, east, up = np.deg2rad(places[..., 0]), np.deg2rad(places[..., 1]), places[..., 2]
    normal = AXIS / np.sqrt(1 - SQUARE * np.sin(north) ** 2)
    around = (normal + up) * np.cos(north)
    return np.stack([around * np.cos(east), around * np.sin(east), (normal * (1 - SQUARE) + up) * np.sin(north)], axis=-1)


def geographic(points: Array) -> Array:
    """The reverse of `ecef`, to a tenth of a millimetre within a thousand kilometres of the ground."""
    points = np.asarray(points, dtype=np.float64)
    around = np.hypot(points[..., 0], points[..., 1])
    north = np.arctan2(points[..., 2], around * (1 - SQUARE))
    for _ in range(6):  # each step gains more than two digits
        normal = AXIS / np.sqrt(1 - SQUARE * np.sin(north) ** 2)
        north = np.arctan2(points[..., 2] + SQUARE * normal * np.sin(north), around)
    sine, cosine = np.sin(north), np.cos(north)
    up = around * cosine + points[..., 2] * sine - AXIS * np.sqrt(1 - SQUARE * sine**2)
    return np.stack([np.rad2deg(north), np.rad2deg(np.arctan2(points[..., 1], points[..., 0])), up], axis=-1)


@dataclass(frozen=True)
class Georeference:
    """Where the frame of a capture's poses, which exports have, lies on earth."""

    latitude: float  # degrees north, WGS 84, of the origin of the local axes
    longitude: float  # degrees east
    altitude: float  # metres, above what the source counts from: the ellipsoid or the sea
    enu_from_input: Similarity = field(default_factory=Similarity.identity)  # metres east, north, up of the origin
    source: str = "gps"  # gps: fitted to the images' GPS | reference: the source has it
    error: float | None = None  # metres: root mean square distance of cameras from their GPS; None: not measured

    def __post_init__(self) -> None:
        """Raises:
        InputError: it is no place on earth.
        """
        numbers = [self.latitude, self.longitude, self.altitude]
        if not (np.all(np.isfinite(numbers)) and abs(self.latitude) <= 90 and abs(self.longitude) <= 360 and abs(self.altitude) < FARTHEST):
            raise InputError(
                f"latitude {self.latitude:g}, longitude {self.longitude:g}, altitude {self.altitude:g} m is no place on earth; correct it"
            )

    @property
    def origin(self) -> Array:
        """(3,) degrees north, degrees east, metres."""
        return np.array([self.latitude, self.longitude, self.altitude])

    def _axes(self) -> Array:
        """(3, 3) rows east, north, up in geocentric axes."""
        north, east = math.radians(self.latitude), math.radians(self.longitude)
        turn = [-math.sin(east), math.cos(east), 0.0]
        up = [math.cos(north) * math.cos(east), math.cos(north) * math.sin(east), math.sin(north)]
        return np.array([turn, np.cross(up, turn), up])

    def enu_from_ecef(self) -> Similarity:
        """Metres east, north and up of the origin from geocentric metres."""
        axes = self._axes()
        return Similarity(1.0, axes, -(axes @ ecef(self.origin)))

    def to_enu(self, points: Array) -> Array:
        """(..., 3) points in the frame of exports → (..., 3) metres east, north and up of the origin, float64."""
        return self.enu_from_input.points(points)

    def enu_of(self, places: Array) -> Array:
        """(..., 3) degrees north, degrees east, metres → (..., 3) metres east, north and up of the origin."""
        return (ecef(places) - ecef(self.origin)) @ self._axes().T

    def to_geographic(self, points: Array) -> Array:
        """(..., 3) points in the frame of exports → (..., 3) degrees north, degrees east, metres."""
        return geographic(self.to_enu(points) @ self._axes() + ecef(self.origin))

    @property
    def epsg(self) -> int:
        """The EPSG code of the origin's UTM zone (WGS 84).

        Raises:
            InputError: so near to a pole there is no UTM.
        """
        if not SOUTHERNMOST <= self.latitude <= NORTHERNMOST:
            raise InputError(f"at latitude {self.latitude:.4f} there are no UTM coordinates, which go from 80° south to 84° north")
        zone = int(((self.longitude + 180) % 360) // 6) + 1
        return (32700 if self.latitude < 0 else 32600) + zone

    def to_utm(self, points: Array) -> Array:
        """(..., 3) points in the frame of exports → (..., 3) metres east and north in the UTM zone `epsg`, and altitude; float64.

        Raises:
            InputError: pyproj is not installed, or there is no UTM there.
        """
        proj, places = pyproj(), self.to_geographic(points)
        transform = proj.Transformer.from_crs(4326, self.epsg, always_xy=True)
        east, north = transform.transform(places[..., 1], places[..., 0])
        return np.stack([east, north, places[..., 2]], axis=-1)

    def utm_from_input(self) -> Array:
        """(4, 4) float64: the linear part of `to_utm` at the origin, right to a millimetre within some hundred metres of it.

        It holds the turn from true north to the zone's grid north and the zone's scale, 0.9996 to 1.001.

        Raises:
            InputError: as `to_utm`.
        """
        input_from_enu, step = self.enu_from_input.inverse(), 100.0
        ends = input_from_enu.points(np.concatenate([step * np.eye(3), -step * np.eye(3), np.zeros((1, 3))]))
        grid = self.to_utm(ends)
        enu = np.eye(4)
        enu[:3, :3], enu[:3, 3] = ((grid[:3] - grid[3:6]) / (2 * step)).T, grid[6]
        given = np.eye(4)
        given[:3, :3], given[:3, 3] = self.enu_from_input.scale * self.enu_from_input.rotation, self.enu_from_input.translation
        return enu @ given

    def wkt(self, esri: bool = False) -> str:
        """The UTM zone's definition as WKT: OGC's version 1, or as `.prj` files have it.

        Raises:
            InputError: as `to_utm`.
        """
        return str(pyproj().CRS.from_epsg(self.epsg).to_wkt("WKT1_ESRI" if esri else "WKT1_GDAL"))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "latitude": self.latitude,
            "longitude": self.longitude,
            "altitude": self.altitude,
            "enu_from_input": self.enu_from_input.to_dict(),
            "source": self.source,
            "error": self.error,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Georeference:
        """The reverse of `to_dict`.

        Raises:
            InputError: the data does not hold what `to_dict` writes.
        """
        try:
            return cls(
                latitude=float(data["latitude"]),
                longitude=float(data["longitude"]),
                altitude=float(data["altitude"]),
                enu_from_input=usable_similarity(data["enu_from_input"]),
                source=str(data["source"]),
                error=None if data["error"] is None else float(data["error"]),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"the georeference is not what a run writes ({first_line(error)}); find the poses again") from error


def usable_similarity(data: Any) -> Similarity:
    """A similarity from plain data.

    Raises:
        ValueError, TypeError or KeyError: it is none.
    """
    made = Similarity.from_dict(data)
    shapes = made.rotation.shape == (3, 3) and made.translation.shape == (3,)
    if not (shapes and 0 < made.scale < np.inf and np.isfinite(made.translation).all() and (np.abs(made.rotation) <= 1 + 1e-6).all()):
        raise ValueError("a similarity needs a positive scale, a rotation and a translation")
    if not np.allclose(made.rotation @ made.rotation.T, np.eye(3), atol=1e-6):
        raise ValueError("the rotation of a similarity is none")
    return made


def pyproj() -> Any:
    return extra("geo", "pyproj", "a system of coordinates on earth")
