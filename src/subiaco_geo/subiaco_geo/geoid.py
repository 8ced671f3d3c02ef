"""Heights above a geoid and above the ellipsoid, by grids of undulations that the user has; no network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer
from pyproj.exceptions import ProjError

from subiaco_geo.crs import projection_of
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats


def ellipsoidal_heights(lat_lon_h: ArrayLike, grid: Path) -> Floats:
    """Bring heights above a geoid (AHD) to heights above the ellipsoid.

    Parameters
    ----------
    lat_lon_h : (N, 3) float
        Degrees, degrees, height above the geoid [m].
    grid : Path
        Geoid undulations [m] in a format of PROJ (``.gtx``, ``.tif``), AUSGeoid2020 for AHD.

    Returns
    -------
    (N, 3) float64

    Raises
    ------
    InputError
        No such grid, not a grid, or positions outside it.
    """
    return _shifted(lat_lon_h, grid, inverse=False)


def geoid_heights(lat_lon_h: ArrayLike, grid: Path) -> Floats:
    """Bring heights above the ellipsoid to a geoid, the inverse of :func:`ellipsoidal_heights`."""
    return _shifted(lat_lon_h, grid, inverse=True)


def undulations(xy: ArrayLike, crs: str, grid: Path) -> Floats:
    """Return the height (N,) of a geoid above the ellipsoid [m] at places of a map.

    Parameters
    ----------
    xy : (N, 2) float
        East, north [m].
    crs : str
        Of the map.
    grid : Path
        See :func:`ellipsoidal_heights`.

    Raises
    ------
    InputError
        As :func:`ellipsoidal_heights`.
    """
    places = np.asarray(xy, dtype=np.float64)
    if len(places) == 0:
        return np.zeros(0)
    lon, lat = projection_of(crs).transform(places[:, 0], places[:, 1], direction="INVERSE", errcheck=True)
    return ellipsoidal_heights(np.column_stack([lat, lon, np.zeros(len(places))]), grid)[:, 2]


def _shifted(lat_lon_h: ArrayLike, grid: Path, *, inverse: bool) -> Floats:
    rows = np.array(lat_lon_h, dtype=np.float64)
    path = grid.resolve()  # PROJ looks for a bare name among its own files only
    if not path.is_file() or any(letter in str(path) for letter in " ,"):
        raise InputError(f"{grid}: no such geoid grid, or blanks or commas in its path; give a .gtx or .tif")
    way = "+inv " if inverse else ""
    steps = f"+step {way}+proj=vgridshift +grids={path} +multiplier=1 +step +proj=unitconvert"
    pipeline = f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad {steps} +xy_in=rad +xy_out=deg"
    try:
        operation = Transformer.from_pipeline(pipeline)
        moved = operation.transform(rows[:, 1], rows[:, 0], rows[:, 2], errcheck=True)
    except ProjError as error:
        said = " ".join(str(error).split())[:120]
        raise InputError(f"{grid}: not a geoid grid, or it does not cover the positions ({said})") from error
    if not np.isfinite(moved[2]).all():
        raise InputError(f"{grid}: the geoid grid does not cover the positions; give the grid of the region")
    rows[:, 2] = moved[2]
    return rows
