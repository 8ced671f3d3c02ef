"""Heights of outputs above a geoid (AHD), from heights above the ellipsoid."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import require_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.geoid import undulations

#: What says in an exported folder which heights its files have.
NOTE = "heights.json"


def geoid_shift(xy: Floats, crs: str | None, grid: Path) -> Floats:
    """Return what is added to heights (N,) above the ellipsoid for heights above a geoid [m].

    Parameters
    ----------
    xy : (N, 2) float64
        East, north [m].
    crs : str, optional
        Of the places.
    grid : Path
        Geoid model, see :func:`subiaco_geo.geoid.ellipsoidal_heights`.

    Raises
    ------
    InputError
        No CRS, a CRS whose heights are not ellipsoidal, or a grid that does not cover the places.
    """
    if crs is None:
        raise InputError("--geoid: the data have no CRS, so the geoid is not known where they are")
    if require_crs(crs).is_compound:
        raise InputError(f"--geoid: the heights of {crs} are not above the ellipsoid; leave it out")
    return -undulations(xy, crs, grid)


def above_geoid(cloud: PointCloud, grid: Path) -> PointCloud:
    """Return a cloud with heights above a geoid. Errors as for :func:`geoid_shift`."""
    xyz = cloud.xyz.copy()
    xyz[:, 2] += geoid_shift(cloud.world()[:, :2], cloud.crs, grid)
    return PointCloud(xyz, np.asarray(cloud.origin), cloud.crs, cloud.fields)


def write_heights_note(folder: Path, grid: Path) -> None:
    """Say in a folder that its heights are above the geoid of a grid."""
    digest = hashlib.sha256(grid.read_bytes()).hexdigest()
    note = {"heights": "above the geoid", "geoid_grid": grid.name, "sha256": digest}
    (folder / NOTE).write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
