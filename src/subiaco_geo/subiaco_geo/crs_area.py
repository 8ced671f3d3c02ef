"""Where a map's CRS may be used: a survey elsewhere is projected without a word, and stretched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import ProjError

from subiaco_geo.crs import horizontal, require_map_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Largest difference of the projection's scale from 1; the edge of a UTM zone at the equator has 0.00098.
MAX_SCALE = 0.001
#: Zones are used so far beyond their edge, by surveys that lie across it [deg].
MARGIN_DEG = 0.5


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
    lon, lat, _ = projection.transform(*place.tolist(), direction="INVERSE")
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


def suggested(latitude: float, longitude: float) -> str:
    """Return a UTM system for a place: MGA in Australia, ETRS89 in Europe, else WGS 84."""
    zone = int((longitude + 180.0) % 360.0 // 6.0) + 1
    candidates = [7800 + zone] * (49 <= zone <= 56) + [25800 + zone] * (28 <= zone <= 37)
    for code in candidates:
        if _why_not(latitude, longitude, require_map_crs(f"EPSG:{code}")) is None:
            return f"EPSG:{code}"
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
