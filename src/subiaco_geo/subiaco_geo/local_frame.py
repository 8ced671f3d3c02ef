"""East, north and up at a point of the Earth, and the way to map coordinates and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer

from subiaco_geo.crs import horizontal, require_map_crs, run_operation
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, make_pose

_STEP = 10.0


@dataclass(frozen=True)
class EnuFrame:
    """Local east, north, up frame, tangent to the ellipsoid at its origin.

    True north, scale 1: rigid, so the graph is optimised in it and only the
    result is projected.

    Parameters
    ----------
    latitude_deg, longitude_deg : float
        Geodetic origin [deg], in the datum of the map's CRS.
    height : float
        Ellipsoidal height of the origin [m].
    ellipsoid : str
        PROJ's name; GDA2020 and all ITRF frames use GRS80.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    ellipsoid: str = "GRS80"

    def __post_init__(self) -> None:
        values = (self.latitude_deg, self.longitude_deg, self.height)
        if not np.isfinite(values).all() or abs(self.latitude_deg) > 90 or abs(self.longitude_deg) > 360:
            raise InputError(f"ENU origin {values}: not a latitude, longitude [deg] and height [m]")

    def _topocentric(self) -> Transformer:
        """Operation from longitude, latitude [deg], height to east, north, up."""
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=cart +ellps={self.ellipsoid} +step +proj=topocentric +ellps={self.ellipsoid} "
            f"+lon_0={float(self.longitude_deg)!r} +lat_0={float(self.latitude_deg)!r} "
            f"+h_0={float(self.height)!r}"
        )

    def from_geodetic(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height: ArrayLike) -> Floats:
        """Return east, north, up (N, 3) [m] of geodetic positions (N,) [deg, deg, m]."""
        lat, lon, h = (
            np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (latitude_deg, longitude_deg, height)
        )
        lon_lat_h = np.stack(np.broadcast_arrays(lon, lat, h), axis=1)
        return run_operation(self._topocentric(), lon_lat_h, "geodetic to local ENU")

    def to_geodetic(self, xyz_enu: ArrayLike) -> Floats:
        """Return latitude, longitude [deg] and height [m] (N, 3) of ENU points (N, 3) [m]."""
        enu = _check_points(xyz_enu)
        lon, lat, height = self._topocentric().transform(
            enu[:, 0], enu[:, 1], enu[:, 2], direction="INVERSE", errcheck=True
        )
        return np.stack([lat, lon, height], axis=1)

    def points_to_map(self, xyz_enu: ArrayLike, crs: str) -> Floats:
        """Project ENU points (N, 3) [m] to east, north, ellipsoidal height (N, 3) [m]."""
        geodetic = self.to_geodetic(xyz_enu)
        return run_operation(_projection(crs), geodetic[:, [1, 0, 2]], f"local ENU to {crs}")

    def points_from_map(self, xyz_map: ArrayLike, crs: str) -> Floats:
        """Return ENU coordinates (N, 3) [m] of map points (N, 3) [m]."""
        points = _check_points(xyz_map)
        lon, lat, height = _projection(crs).transform(
            points[:, 0], points[:, 1], points[:, 2], direction="INVERSE", errcheck=True
        )
        return self.from_geodetic(lat, lon, height)

    def grid_axes(self, xyz_enu: ArrayLike, crs: str) -> Floats:
        """Return rotations (N, 3, 3) from ENU axes to grid east, north, up at ENU points (N, 3).

        They hold the meridian convergence and the tilt between the vertical at
        the frame's origin and the local one; projection scale is left out.
        """
        points = _check_points(xyz_enu)
        plus, minus = (
            np.stack([self.points_to_map(points + side * _STEP * axis, crs) for axis in np.eye(3)], axis=2)
            for side in (1.0, -1.0)
        )
        u, _, vt = np.linalg.svd((plus - minus) / (2.0 * _STEP))
        return np.asarray(u @ vt)

    def poses_to_map(self, T_enu_x: ArrayLike, crs: str) -> Floats:
        """Bring poses (N, 4, 4) in ENU to the map: grid east, grid north, up.

        Returns
        -------
        (N, 4, 4) float64
            ``T_map_x`` with translations in world coordinates [m].
        """
        poses = np.asarray(T_enu_x, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise InputError(f"T_enu_x must have shape (N, 4, 4), got {poses.shape}")
        positions = poses[:, :3, 3]
        rotation = self.grid_axes(positions, crs) @ poses[:, :3, :3]
        return make_pose(rotation, self.points_to_map(positions, crs))


def _check_points(xyz: ArrayLike) -> Floats:
    points = np.asarray(xyz, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points must have shape (N, 3), got {points.shape}")
    return points


@lru_cache(maxsize=16)
def _projection(crs: str) -> Transformer:
    """Operation from longitude, latitude [deg], height of a CRS's own datum to its grid."""
    flat = horizontal(require_map_crs(crs))
    geodetic = flat.geodetic_crs
    if geodetic is None:
        raise InputError(f"crs {crs}: has no geodetic base; choose a projected one such as EPSG:7850")
    return Transformer.from_crs(geodetic.to_3d(), flat.to_3d(), always_xy=True)
