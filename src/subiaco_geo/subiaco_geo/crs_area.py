"""The CRS of a place, and where a given CRS may be used: elsewhere a survey would be stretched unnoticed."""

from __future__ import annotations

import re
import warnings
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Geod, Proj, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from subiaco_geo.crs import horizontal, require_ellipsoidal, require_map_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Largest difference of the projection's scale from 1; the edge of a UTM zone at the equator has 0.00098.
MAX_SCALE = 0.001
#: Zones are used so far beyond their edge, by surveys that lie across it [deg].
MARGIN_DEG = 0.5
#: Setting that takes the CRS from the place of the fixes.
AUTO = "auto"
_WGS84 = 4326
_GLOBAL_DATUMS = {_WGS84, 4322, 4324}  # WGS 84, WGS 72, WGS 72BE
_SAME_DATUM = 3.0  # plate motion since 1990, and no datum from before satellites [m]
_ZONE = re.compile(r"\b(UTM|MGA) zone \d+")


def require_inside(latitude: float, longitude: float, crs: str) -> None:
    """Refuse a CRS that is not made for a place.

    Parameters
    ----------
    latitude, longitude : float
        [deg].
    crs : str
        Of the map.

    Raises
    ------
    InputError
        The place is outside the CRS's area of use, or lengths in it are off by more than ``MAX_SCALE`` there.
    """
    found = require_map_crs(crs)
    why = _why_not(latitude, longitude, found)
    if why is not None:
        raise InputError(
            f"crs {crs} ({horizontal(found).name}): the fixes, at latitude {latitude:.4f}, longitude "
            f"{longitude:.4f}, {why}; set crs to a system made for that place, e.g. --set "
            f"crs={suggested(latitude, longitude)}"
        )


def area_contains(crs: CRS, latitude: float, longitude: float, margin: float = 0.0) -> bool:
    """Tell whether the area of use of a CRS holds a place [deg]; one without an area holds every place."""
    area = crs.area_of_use
    if area is None:
        return True
    width = (area.east - area.west) % 360.0 or 360.0  # areas may cross the 180th meridian
    east = (longitude - area.west + margin) % 360.0
    return bool(area.south - margin <= latitude <= area.north + margin and east <= width + 2 * margin)


def _why_not(latitude: float, longitude: float, crs: CRS) -> str | None:
    flat = horizontal(crs)
    if not area_contains(flat, latitude, longitude, MARGIN_DEG):
        area = flat.area_of_use
        name = (area.name if area is not None else None) or "unnamed"
        return f"are outside its area of use ({name.split(':')[0].rstrip('.')})"
    scales = scale_factors(latitude, longitude, crs)
    worst = float(np.abs(scales - 1.0).max()) if np.isfinite(scales).all() else np.inf
    if worst > MAX_SCALE:
        return f"are where its lengths are off by {1e3 * min(worst, 9.999):.1f} m a kilometre"
    return None


def outside(place: Floats, crs: str) -> str | None:
    """Say why a CRS is not made for a place (3,) that is given in it [m]; None where it is.

    Returns
    -------
    str or None
        A clause such as ``latitude -32.0, longitude 115.9, are outside its area of use (...)``.
    """
    found = require_map_crs(crs)
    geodetic = horizontal(found).geodetic_crs
    if geodetic is None:
        return None
    projection = Transformer.from_crs(geodetic.to_3d(), horizontal(found).to_3d(), always_xy=True)
    lon, lat, _ = projection.transform(place[0], place[1], place[2], direction="INVERSE")
    if not np.isfinite([lon, lat]).all():
        return "are outside its range"
    why = _why_not(lat, lon, found)
    return None if why is None else f"latitude {lat:.4f}, longitude {lon:.4f}, {why}"


def scale_factors(latitude: float, longitude: float, crs: CRS) -> NDArray[np.float64]:
    """Return the largest and smallest scale (2,) of a projection at a place; infinite where it has none."""
    try:
        factors = Proj(horizontal(crs)).get_factors(longitude, latitude, errcheck=True)
    except ProjError:
        return np.full(2, np.inf)
    return np.array([factors.tissot_semimajor, factors.tissot_semiminor])


def require_usable(crs: str) -> None:
    """Refuse the setting of a map's CRS unless it is ``auto`` or a projected CRS with ellipsoidal heights.

    Raises
    ------
    InputError
        See :func:`subiaco_geo.crs.require_ellipsoidal`.
    """
    if crs != AUTO:
        require_ellipsoidal(crs)


def crs_at(latitude: float, longitude: float, crs: str) -> str:
    """Return the CRS of a map at a place: the given one, or for ``auto`` that of :func:`suggested`."""
    return suggested(latitude, longitude) if crs == AUTO else crs


@lru_cache(maxsize=64)
def suggested(latitude: float, longitude: float) -> str:
    """Return the projected CRS of a place: its UTM zone on the region's newest geodetic datum.

    PROJ's database is searched for UTM zones (in Australia the MGA zones) whose area of use contains the
    place and whose datum agrees with WGS 84 within 3 m, which leaves out the datums from before satellites.
    Of these the newest regional datum is taken, by its EPSG code; where there is none, WGS 84 itself.

    Parameters
    ----------
    latitude, longitude : float
        [deg].

    Returns
    -------
    str
        ``EPSG:7850`` in Perth, ``EPSG:25832`` in Karlsruhe, ``EPSG:6339`` in San Francisco.
    """
    zone = int((longitude + 180.0) % 360.0 // 6.0) + 1
    global_zone = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
    point = AreaOfInterest(longitude, latitude, longitude, latitude)
    found = query_crs_info("EPSG", PJType.PROJECTED_CRS, area_of_interest=point, contains=True)
    systems = [CRS.from_epsg(info.code) for info in found if _ZONE.search(info.name) is not None]
    regional: dict[int, str] = {}
    for system in systems:
        datum = system.geodetic_crs.to_epsg() if system.geodetic_crs is not None else None
        if datum is None or datum in _GLOBAL_DATUMS or not _is_utm_zone(system, zone):
            continue
        if _why_not(latitude, longitude, system) is None and _agrees_with_wgs84(system, point):
            regional[datum] = f"EPSG:{system.to_epsg()}"
    return regional[max(regional)] if regional else global_zone


def _is_utm_zone(crs: CRS, zone: int) -> bool:
    """Tell whether a CRS is a UTM zone with easting before northing and no zone prefix in its eastings."""
    operation = crs.coordinate_operation
    if operation is None or operation.method_name != "Transverse Mercator":
        return False
    values: dict[str, object] = {param.name: param.value for param in operation.params}
    return (
        [axis.direction for axis in crs.axis_info] == ["east", "north"]
        and values.get("Longitude of natural origin") == 6.0 * zone - 183.0
        and values.get("Scale factor at natural origin") == 0.9996
        and values.get("False easting") == 500_000.0
    )


def _agrees_with_wgs84(crs: CRS, point: AreaOfInterest) -> bool:
    """Tell whether PROJ knows, without a grid, that a datum lies within 3 m of WGS 84."""
    assert crs.geodetic_crs is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # better operations need grids that are not here
        group = TransformerGroup(
            crs.geodetic_crs,
            f"EPSG:{_WGS84}",
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=point,  # type: ignore[arg-type]  # pyproj's stubs declare this class twice
        )
    if not group.transformers:
        return False
    longitude, latitude = point.west_lon_degree, point.south_lat_degree
    moved = group.transformers[0].transform(longitude, latitude)
    _, _, metres = Geod(ellps="WGS84").inv(longitude, latitude, *moved)
    return bool(metres < _SAME_DATUM)
