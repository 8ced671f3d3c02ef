"""Ground height of every tile, as a table beside the map."""

from __future__ import annotations

import numba
import numpy as np

from subiaco_geo.clouds import PointCloud, unique_cells
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.method_numbers import NUMBERS

_CELL = NUMBERS.fusion.ground_cell
_PART = 1 << 20  # points in memory at a time
_MIN_SHARE = NUMBERS.fusion.ground_fraction
_MIN_SPREAD = NUMBERS.fusion.ground_spread
_MAX_TILT = np.radians(NUMBERS.fusion.ground_tilt_deg)
_TUKEY = NUMBERS.fusion.ground_kernel


def _lowest_of_cells(xyz: Floats) -> Floats:
    """Return the lowest point of every 1 m cell, its x and y kept."""
    cells, member = unique_cells(np.floor(xyz[:, :2] / _CELL).astype(np.int64))
    return xyz[_lowest(xyz, member, len(cells))]


@numba.njit(cache=True)
def _lowest(xyz: Floats, member: Ints, cells: int) -> Ints:
    """Return which point (N, 3) of every cell (M,) is the lowest, the first of equal ones."""
    lowest = np.full(cells, -1, np.int64)
    for i in range(len(xyz)):
        other = lowest[member[i]]
        if other < 0 or xyz[i, 2] < xyz[other, 2]:
            lowest[member[i]] = i
    return lowest


def _robust_plane(xyz: Floats) -> tuple[Floats, Floats]:
    """Fit z = a dx + b dy + c by Tukey-weighted least squares; return coefficients and weights."""
    design = np.column_stack([xyz[:, 0], xyz[:, 1], np.ones(len(xyz))])
    offset = np.percentile(xyz[:, 2], 20)
    weight = np.where(xyz[:, 2] <= offset + 0.5, 1.0, 0.0)
    plane = np.zeros(3)
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        plane = np.linalg.lstsq(design * root, xyz[:, 2] * root[:, 0], rcond=None)[0]
        ratio = (xyz[:, 2] - design @ plane) / _TUKEY
        weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
        if (weight > 0).sum() < 3:
            break
    return plane, weight


def _ground_of_tile(lowest: Floats, tile: float) -> tuple[float, int, float]:
    """Return median ground height [m], ground cells and tilt [rad] of one tile; NaN where unknown."""
    enough = max(_MIN_SHARE * (tile / _CELL) ** 2, 4)
    if len(lowest) < enough:
        return np.nan, 0, np.nan
    plane, weight = _robust_plane(lowest)
    ground = lowest[weight > 0]
    tilt = float(np.arctan(np.hypot(plane[0], plane[1])))
    if len(ground) < enough or tilt > _MAX_TILT:
        return np.nan, len(ground), np.nan
    narrow = np.sqrt(max(np.linalg.eigvalsh(np.cov(ground[:, :2].T))[0], 0.0))
    held = narrow >= _MIN_SPREAD * tile
    return float(np.median(ground[:, 2])), len(ground), tilt if held else np.nan


def height_table(cloud: PointCloud, tile: float) -> Floats:
    """Fit the ground of every tile.

    Parameters
    ----------
    cloud : PointCloud
    tile : float
        Edge [m].

    Returns
    -------
    (K, 5) float64
        Columns of ``subiaco_geo.map_tables.HEIGHT_COLUMNS``, a row for every tile with points. Height and
        tilt are NaN where too few of the tile's 1 m cells (15 %) show ground; the tilt alone is NaN
        where these lie in a narrow strip that cannot hold a plane.
    """
    parts = range(0, len(cloud), _PART)
    lowest = _lowest_of_cells(
        np.concatenate([_lowest_of_cells(cloud.xyz[k : k + _PART] + cloud.origin) for k in parts])
    )
    index = np.floor(lowest[:, :2] / tile).astype(np.int64)
    tiles, member = np.unique(index, axis=0, return_inverse=True)
    rows = []
    for number, corner in enumerate(tiles):
        centre = (corner + 0.5) * tile
        local = lowest[member.ravel() == number] - np.append(centre, 0.0)
        rows.append([*centre, *_ground_of_tile(local, tile)])
    return np.array(rows, dtype=np.float64).reshape(-1, 5)
