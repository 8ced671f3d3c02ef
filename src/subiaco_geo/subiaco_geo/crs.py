"""Coordinate reference systems: local ENU to map grid and between grids, offline PROJ only.

Heights are ellipsoidal throughout. Nothing here fetches grids, and PROJ's
*ballpark* operations, which drop a datum shift without a word, are refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, make_pose

#: Frame of fixes that are given in the datum of the map's CRS.
MAP_FRAME = "map"
_FIX_ACCURACY = 0.2  # a datum shift that is worse than this spoils an RTK survey [m]
_STEP = 10.0


@lru_cache(maxsize=64)
def require_crs(text: str) -> CRS:
    """Return the CRS that a text names.

    Parameters
    ----------
    text : str
        ``EPSG:7850``, a compound such as ``EPSG:2154+5720``, or WKT.

    Raises
    ------
    InputError
        PROJ does not know it.
    """
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        shown = text if len(text) < 60 else text[:57] + "..."
        raise InputError(
            f"crs {shown!r}: not known; give an EPSG code such as EPSG:7850 (MGA zone 50)"
        ) from error


def require_map_crs(text: str) -> CRS:
    """Return a projected CRS in metres, the only kind a map can have.

    Raises
    ------
    InputError
        Unknown, not projected (degrees), or not in metres.
    """
    crs = require_crs(text)
    name = crs.name
    if not crs.is_projected:
        raise InputError(f"crs {name!r}: not a projected system; choose one in metres, e.g. EPSG:7850")
    factors = {axis.unit_conversion_factor for axis in crs.axis_info[:2]}
    if factors != {1.0}:
        unit = crs.axis_info[0].unit_name
        raise InputError(f"crs {name!r}: its unit is the {unit}; reproject the data to a system in metres")
    return crs


def require_ellipsoidal(text: str) -> CRS:
    """Return a CRS for a map that we make: as :func:`require_map_crs`, heights above the ellipsoid.

    Raises
    ------
    InputError
        It names another height, such as AHD: without the geoid's grid PROJ hands heights through unchanged.
    """
    crs = require_map_crs(text)
    if crs.is_compound:
        raise InputError(
            f"crs {crs.name!r}: maps are made with ellipsoidal heights; name the horizontal part alone, "
            "e.g. EPSG:7850 (fixes in AHD: gnss.heights and gnss.geoid_grid)"
        )
    return crs


def horizontal(crs: CRS) -> CRS:
    """Return the two-dimensional part of a map CRS."""
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    return crs.to_2d()


def crs_text(crs: CRS) -> str:
    """Return the shortest exact text of a CRS: codes if it has them, else WKT2."""
    code = crs.to_epsg(min_confidence=100)
    if code is not None:
        return f"EPSG:{code}"
    if crs.is_compound:
        codes = [part.to_epsg(min_confidence=100) for part in crs.sub_crs_list]
        if all(code is not None for code in codes):
            return "EPSG:" + "+".join(str(code) for code in codes)
    elif len(crs.axis_info) == 3 and not crs.is_geocentric:  # which has no horizontal part
        return crs_text(crs.to_2d())
    return str(crs.to_wkt())


def las_wkt(crs: CRS, *, ellipsoidal: bool = True) -> str:
    """Return the WKT1 text that LAS 1.4 readers expect.

    A two-dimensional projected CRS is given its height as the compound that
    GDAL writes: vertical datum type 2002 is *ellipsoid*, and PROJ reads the
    pair back as the three-dimensional projected CRS.
    """
    if crs.is_compound or not ellipsoidal:
        return str(crs.to_wkt("WKT1_GDAL"))
    flat = crs.to_2d()
    geodetic = flat.geodetic_crs
    frame = geodetic.name if geodetic is not None else "unknown"
    return (
        f'COMPD_CS["{flat.name} + {frame} ellipsoidal height",{flat.to_wkt("WKT1_GDAL")},'
        f'VERT_CS["{frame} ellipsoidal height",VERT_DATUM["{frame} ellipsoid",2002],'
        'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Ellipsoidal height",UP]]]'
    )


@dataclass(frozen=True)
class Transform:
    """A coordinate operation between two map systems.

    Parameters
    ----------
    apply : callable
        Maps (N, 3) east, north, height [m] to the same in the other system.
    accuracy_m : float
        PROJ's stated accuracy [m]; 0 for a change of projection alone.
    name : str
        The operation, for the record.
    """

    apply: Callable[[ArrayLike], Floats]
    accuracy_m: float
    name: str


def _identity(xyz: ArrayLike) -> Floats:
    return np.array(xyz, dtype=np.float64)


def transformer(crs_from: str, crs_to: str) -> Transform:
    """Return the best offline operation between two map systems.

    Heights are carried as ellipsoidal; both texts name projected systems.

    Raises
    ------
    InputError
        An unknown system, or PROJ has only a ballpark operation.
    """
    source, target = require_map_crs(crs_from), require_map_crs(crs_to)
    if source == target:
        return Transform(_identity, 0.0, "none")
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", UserWarning
        )  # a better one needs a grid that is not here: see accuracy_m
        group = TransformerGroup(source.to_3d(), target.to_3d(), always_xy=True, allow_ballpark=False)
    usable = [t for t in group.transformers if "ballpark" not in t.description.lower() and t.accuracy >= 0]
    if not usable:
        raise InputError(
            f"{crs_from} to {crs_to}: PROJ has only a ballpark operation or none; "
            "reproject one epoch yourself with the right datum shift"
        )
    best = usable[0]

    def apply(xyz: ArrayLike) -> Floats:
        return _run(best, np.asarray(xyz, dtype=np.float64), f"{crs_from} to {crs_to}")

    return Transform(apply, float(best.accuracy), str(best.description))


def _run(operation: Transformer, xyz: Floats, what: str) -> Floats:
    try:
        columns = operation.transform(xyz[:, 0], xyz[:, 1], xyz[:, 2], errcheck=True)
    except ProjError as error:
        raise InputError(
            f"{what}: coordinates outside the system's range ({error}); check the CRS"
        ) from error
    moved = np.stack(columns, axis=1)
    if not np.isfinite(moved).all():
        raise InputError(f"{what}: {int((~np.isfinite(moved)).any(axis=1).sum())} points cannot be projected")
    return moved


def fixes_to_datum(
    lat_lon_h: ArrayLike, frame: str, crs: str, epoch: float | None = None, setting: str = "gnss"
) -> Floats:
    """Bring GNSS fixes to the geodetic datum of a map's CRS.

    Parameters
    ----------
    lat_lon_h : (N, 3) float
        Degrees, degrees, ellipsoidal height [m].
    frame : str
        Geodetic system of the receiver's solution, that of its RTK base: ``map`` for the datum of the map's
        CRS, or a system that PROJ knows by name or code, such as ``GDA2020``, ``ETRS89``, ``ITRF2014``.
    crs : str
        Projected CRS of the map.
    epoch : float, optional
        Decimal year of the observation; needed where the system of the fixes is dynamic (plate motion).
    setting : str
        Group of settings that errors name.

    Returns
    -------
    (N, 3) float64

    Raises
    ------
    InputError
        An unknown system, a dynamic one without an epoch, or no operation between the datums within 0.2 m.
    """
    fixes = np.array(lat_lon_h, dtype=np.float64)
    if frame == MAP_FRAME:
        return fixes
    source, target = _geodetic(frame, setting), _geodetic_base(crs)
    if source.datum == target.datum:
        return fixes
    if epoch is None and "Dynamic" in (source.datum.type_name if source.datum is not None else ""):
        raise InputError(
            f"{setting}.declared_frame {frame}: set {setting}.epoch to the decimal year of the survey, "
            "e.g. 2026.8; coordinates in this system move with the plates"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a better operation needs a grid that is not here
        operations = TransformerGroup(source, target, always_xy=True, allow_ballpark=False).transformers
    if not operations or not 0.0 <= operations[0].accuracy <= _FIX_ACCURACY:
        stated = f"is good to {operations[0].accuracy:g} m only" if operations else "is not known"
        raise InputError(
            f"{setting}.declared_frame {frame}: its relation to {target.name} {stated}; declare the "
            f"system of the RTK base, or {MAP_FRAME} where the base has the datum of the map"
        )
    times = np.full(len(fixes), 0.0 if epoch is None else epoch)
    moved = operations[0].transform(fixes[:, 1], fixes[:, 0], fixes[:, 2], times, errcheck=True)
    return np.stack([moved[1], moved[0], moved[2]], axis=1)


def _geodetic(frame: str, setting: str) -> CRS:
    """Return the three-dimensional geographic CRS that a frame of fixes names."""
    try:
        found = CRS.from_user_input(frame)
    except CRSError as error:
        raise InputError(
            f"{setting}.declared_frame {frame!r}: not known; one such as GDA2020, ETRS89, ITRF2014, "
            f"EPSG:7843, or {MAP_FRAME}"
        ) from error
    if not found.is_geographic:
        raise InputError(
            f"{setting}.declared_frame {frame}: {found.name} is no system of latitude and longitude; "
            "give its base"
        )
    return found.to_3d()


def _geodetic_base(crs: str) -> CRS:
    base = horizontal(require_map_crs(crs)).geodetic_crs
    if base is None:
        raise InputError(f"crs {crs}: has no geodetic base; choose a projected one such as EPSG:7850")
    return base.to_3d()


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
        return _run(self._topocentric(), lon_lat_h, "geodetic to local ENU")

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
        return _run(projection_of(crs), geodetic[:, [1, 0, 2]], f"local ENU to {crs}")

    def points_from_map(self, xyz_map: ArrayLike, crs: str) -> Floats:
        """Return ENU coordinates (N, 3) [m] of map points (N, 3) [m]."""
        points = _check_points(xyz_map)
        lon, lat, height = projection_of(crs).transform(
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
def projection_of(crs: str) -> Transformer:
    """Return the operation from longitude, latitude [deg], height of a CRS's own datum to its grid."""
    flat = horizontal(require_map_crs(crs))
    return Transformer.from_crs(_geodetic_base(crs), flat.to_3d(), always_xy=True)
