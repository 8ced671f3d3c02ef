"""The local frame ``map`` of the clouds on topics, and where it lies on the earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Proj, Transformer

from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import EnuFrame, horizontal, require_map_crs
from subiaco_geo.frames import Floats, make_pose

_TO_ECEF = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps="


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up [m] about an origin; the map's own axes where it has no CRS.

    Parameters
    ----------
    crs : str or None
    enu : EnuFrame or None
        None for a local map: points are then taken about ``origin``.
    origin : (3,) float64
        World coordinates of the zero of a local map [m].
    """

    crs: str | None
    enu: EnuFrame | None
    origin: Floats

    def from_world(self, xyz: Floats) -> Floats:
        """Turn world coordinates (N, 3) into local ones."""
        if self.enu is None or self.crs is None or len(xyz) == 0:
            return np.asarray(xyz - self.origin)
        return self.enu.points_from_map(xyz, self.crs)


def frame_at_origin(cloud: PointCloud) -> LocalFrame:
    """Put the zero of the local frame at a cloud's origin."""
    if cloud.crs is None:
        return LocalFrame(None, None, cloud.origin)
    easting, northing, height = cloud.origin.tolist()
    longitude, latitude = Proj(horizontal(require_map_crs(cloud.crs)))(easting, northing, inverse=True)
    return LocalFrame(cloud.crs, EnuFrame(latitude, longitude, height), cloud.origin)


def earth_from_enu(enu: EnuFrame) -> Floats:
    """Return ``T_earth_map`` (4, 4): earth-centred, earth-fixed from local east, north, up."""
    to_ecef = Transformer.from_pipeline(_TO_ECEF + enu.ellipsoid)
    centre = to_ecef.transform(enu.longitude_deg, enu.latitude_deg, enu.height)
    lat, lon = np.radians([enu.latitude_deg, enu.longitude_deg])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return make_pose(np.column_stack([east, north, up]), centre)
