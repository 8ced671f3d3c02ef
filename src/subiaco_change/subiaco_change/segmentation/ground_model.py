"""Local ground model: a raster that follows crossfall, kerbs and driveways (method, part C3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage

from subiaco_change.method_rules.switches import first_argument, second_argument, switchable
from subiaco_change.segmentation.clustering import connect
from subiaco_change.segmentation.raised_surfaces import RaisedSurfaces
from subiaco_geo.clouds import extent_of, unique_keys
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

_LATTICE = 8  # cells between the places where a raster may begin: tiles of a cloud share their cells
_ABSENT = 1e9  # height of a cell that nobody saw [m]

Mask = NDArray[np.bool_]


class GroundConfig(StrictModel):
    """Progressive morphological filter on a raster of low points.

    After Pingel, Clarke and McBride (2013), *An improved simple morphological
    filter*, with a refit of the surface to the points that it keeps.
    """

    cell: float = Field(0.5, gt=0, description="Edge of the cells of the ground raster [m]")
    max_window: float = Field(
        14.0,
        gt=0,
        description="Largest radius of the morphological opening [m]; must exceed half the width of the "
        "widest roof",
    )
    slope: float = Field(
        0.15,
        gt=0,
        description="Steepest terrain slope that the morphological opening accepts [m/m]; raise it in "
        "hilly areas",
    )
    step: float = Field(
        0.30,
        gt=0,
        description="Largest height above the opened surface, besides the slope, at which a cell is "
        "ground [m]; kerbs and driveways need some",
    )
    slope_reach: float = Field(
        4.0, gt=0, description="Largest opening radius over which the accepted slope accumulates [m]"
    )
    trend: float = Field(
        4.0,
        gt=0,
        description="Standard deviation of the Gaussian that smooths the terrain before its slope is "
        "subtracted [m]",
    )
    thin_step: float = Field(
        0.07,
        gt=0,
        description="Height above the opened surface accepted for each cell of opening radius, up to step "
        "[m]; removes low feet of walls",
    )
    low_outlier: float = Field(
        0.8, gt=0, description="Depth below all surrounding cells from which a cell is a low outlier [m]"
    )
    low_reach: float = Field(
        4.0, gt=0, description="Radius of the surroundings with which low outliers are compared [m]"
    )
    refit_band: float = Field(
        0.30,
        gt=0,
        description="Distance from the lowest surface within which points refine the ground height [m]",
    )
    max_spread: float = Field(
        0.06,
        gt=0,
        description="Standard deviation of the heights in a cell above which the cell is no ground [m]",
    )
    run_step: float = Field(
        0.1,
        ge=0,
        description="Largest step between neighbouring cells of a surface that continues the ground [m]",
    )
    run_slope: float = Field(
        0.4,
        ge=0,
        description="Steepest slope between neighbouring cells of a surface that continues the ground [m/m]",
    )
    run_reach: float = Field(
        3.0,
        gt=0,
        description="Largest distance between two cells that are compared when the ground is continued [m]",
    )
    run_area: float = Field(
        5.0,
        ge=0,
        description="Smallest area of a surface that is returned to the ground because it continues the "
        "ground [m2]",
    )
    run_share: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of the border with the ground that must be free of steps for a surface to "
        "continue the ground",
    )
    support: float = Field(
        4.0,
        gt=0,
        description="Distance from the nearest ground cell up to which a ground height counts as known [m]",
    )


@dataclass(frozen=True)
class GroundModel:
    """Ground heights on a raster, free of NaN, with a mask of where they are supported.

    ``heights`` and ``known`` are (rows, columns), row 0 in the south; the
    centre of cell (0, 0) is ``(west + cell / 2, south + cell / 2)``, in the
    local frame of the cloud it was fitted to [m].
    """

    west: float
    south: float
    cell: float
    heights: Floats
    known: Mask

    def _grid(self, xy: Floats) -> Floats:
        column = (xy[:, 0] - self.west) / self.cell - 0.5
        row = (xy[:, 1] - self.south) / self.cell - 0.5
        return np.stack([row, column])

    def height(self, xy: Floats) -> Floats:
        """Interpolate ground heights (N,) at xy (N, 2) [m]; the nearest edge outside."""
        return np.asarray(ndimage.map_coordinates(self.heights, self._grid(xy), order=1, mode="nearest"))

    def normal(self, xy: Floats) -> Floats:
        """Return upward unit normals (N, 3) of the ground over 2 m."""
        smooth = ndimage.gaussian_filter(self.heights, 1.0 / self.cell, mode="nearest")
        d_row, d_column = (
            np.gradient(smooth, self.cell) if min(smooth.shape) > 1 else (smooth * 0, smooth * 0)
        )
        grid = self._grid(xy)
        slope = [ndimage.map_coordinates(d, grid, order=1, mode="nearest") for d in (d_column, d_row)]
        normals = np.stack([-slope[0], -slope[1], np.ones(len(xy))], axis=1)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def supported(self, xy: Floats) -> Mask:
        """Tell where (N,) ground points stand near enough for the height to count."""
        grid = np.rint(self._grid(xy)).astype(np.int64)
        row, column = (np.clip(grid[i], 0, self.known.shape[i] - 1) for i in (0, 1))
        return np.asarray(self.known[row, column])


def fit_ground(xyz: Floats, config: GroundConfig, raised: RaisedSurfaces | None = None) -> GroundModel:
    """Fit the ground under a cloud.

    Parameters
    ----------
    xyz : (N, 3) float64
        Local coordinates [m].
    config : GroundConfig
    raised : RaisedSurfaces, optional
        Roofs and decks, known from farther around; none of their points is ground.

    Returns
    -------
    GroundModel

    Raises
    ------
    InputError
        The cloud is empty.
    """
    if len(xyz) == 0:
        raise InputError("ground: the cloud has no points; check the crop or the filter before it")
    low, high = extent_of(xyz[:, :2])
    if raised is not None:
        xyz = xyz[~raised.holds(xyz)]
    lattice = _LATTICE * config.cell
    south_west = np.floor(low / lattice) * lattice
    shape, flat = _cells(xyz, south_west, config.cell, high)
    if len(xyz) == 0 and raised is not None:  # a tile that a roof fills
        none = np.zeros(shape, dtype=bool)
        west, south = south_west.tolist()
        return GroundModel(west, south, config.cell, np.full(shape, raised.below), none)
    lowest = _reject_low(_lowest(xyz[:, 2], flat, shape), config)
    is_ground = _progressive_filter(lowest, config)
    surface = fill_gaps(np.where(is_ground, lowest, np.nan))
    surface, is_ground = _refit(xyz, flat, surface, is_ground, config)
    distance = ndimage.distance_transform_edt(~is_ground) * config.cell
    west, south = south_west.tolist()
    return GroundModel(west, south, config.cell, surface, np.asarray(distance <= config.support))


def _cells(
    xyz: Floats, south_west: Floats, cell: float, north_east: Floats
) -> tuple[tuple[int, int], NDArray[np.int64]]:
    """Shape of the raster up to a corner (2,) [m], and the flat cell (N,) of every point."""
    index = np.maximum(np.floor((xyz[:, :2] - south_west) / cell).astype(np.int64), 0)
    columns, rows = (np.floor((north_east - south_west) / cell).astype(np.int64) + 1).tolist()
    return (rows, columns), np.asarray(index[:, 1] * columns + index[:, 0])


def _lowest(z: Floats, flat: NDArray[np.int64], shape: tuple[int, int]) -> Floats:
    lowest = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(lowest, flat, z)
    lowest[np.isinf(lowest)] = np.nan
    return lowest.reshape(shape)


def fill_gaps(raster: Floats) -> Floats:
    """Fill NaN cells by averaging ever coarser levels of the raster (pull, then push).

    Linear in cells and bounded by the known values; a raster without any
    known cell raises.
    """
    known = np.isfinite(raster)
    if known.all():
        return raster
    if not known.any():
        raise InputError(
            "ground: no cell holds a point of the ground; the cloud may lack it or be upside down"
        )
    rows, columns = raster.shape
    padded = np.full((rows + rows % 2, columns + columns % 2), np.nan)
    padded[:rows, :columns] = raster
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2).transpose(0, 2, 1, 3)
    count = np.isfinite(blocks).sum(axis=(2, 3))
    total = np.nansum(blocks, axis=(2, 3))
    coarse = fill_gaps(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    row, column = np.mgrid[:rows, :columns]
    pushed = ndimage.map_coordinates(coarse, [(row - 0.5) / 2, (column - 0.5) / 2], order=1, mode="nearest")
    filled = np.where(known, raster, pushed)
    for _ in range(8):  # relaxation on every level: slopes run on through the gap
        filled = np.where(known, raster, ndimage.uniform_filter(filled, 3, mode="nearest"))
    return filled


@switchable("low_outliers", first_argument)
def _reject_low(lowest: Floats, config: GroundConfig) -> Floats:
    """Remove cells far below all others around (multipath, cellars seen through grates).

    Ground seen through leaves is a pit too, but other pits as deep are near it.
    """
    seen = np.where(np.isfinite(lowest), lowest, _ABSENT)
    reach = max(2, round(config.low_reach / config.cell))
    ring = np.ones((2 * reach + 1, 2 * reach + 1), dtype=bool)
    ring[reach - 1 : reach + 2, reach - 1 : reach + 2] = False
    around = ndimage.minimum_filter(seen, footprint=ring, mode="constant", cval=_ABSENT)
    return np.where((around < _ABSENT) & (around - seen > config.low_outlier), np.nan, lowest)


def _progressive_filter(lowest: Floats, config: GroundConfig) -> Mask:
    """Tell which cells (rows, columns) hold ground: openings twice, then without the slope."""
    first = _openings(lowest, config)
    if not first.any():
        return first
    filled = fill_gaps(np.where(first, lowest, np.nan))
    slope = ndimage.gaussian_filter(filled, config.trend / config.cell, mode="nearest")
    return _run_on(lowest, _openings(lowest - slope, config), config)


@switchable("continued_ground", second_argument)
def _run_on(lowest: Floats, ground: Mask, config: GroundConfig) -> Mask:
    """Give back to the ground cells what goes on from them without a step: banks, what walls retain.

    Roofs and crowns end in steps all around; objects on a hill do so along most of their border.
    """
    known = np.isfinite(lowest)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    source = (nearest[0] * lowest.shape[1] + nearest[1]).astype(np.int64)
    pairs = np.concatenate(
        [
            np.stack([source[:-1].ravel(), source[1:].ravel()]),
            np.stack([source[:, :-1].ravel(), source[:, 1:].ravel()]),
        ],
        axis=1,
    )
    pairs = pairs[:, pairs[0] != pairs[1]]
    pairs = np.stack(np.divmod(unique_keys(np.minimum(*pairs) * known.size + np.maximum(*pairs)), known.size))
    place = np.stack(np.divmod(pairs, lowest.shape[1]), axis=-1) * config.cell
    apart = np.linalg.norm(place[0] - place[1], axis=1)
    height, is_ground = lowest.ravel(), ground.ravel()
    smooth = np.abs(height[pairs[0]] - height[pairs[1]]) < config.run_step + config.run_slope * apart
    smooth &= apart < config.run_reach
    inside = ~is_ground[pairs[0]] & ~is_ground[pairs[1]]
    label = connect(lowest.size, pairs[:, inside & smooth].T)
    border = is_ground[pairs[0]] != is_ground[pairs[1]]
    outer = np.where(is_ground[pairs[0]], pairs[1], pairs[0])[border]
    size = np.bincount(label, known.ravel() & ~is_ground)
    touching = np.bincount(label[outer], minlength=len(size))
    joined = np.bincount(label[outer], smooth[border], minlength=len(size))
    runs = (size * config.cell**2 > config.run_area) & (joined > config.run_share * np.maximum(touching, 1))
    return np.asarray(ground | (known & runs[label].reshape(ground.shape)))


def _openings(lowest: Floats, config: GroundConfig) -> Mask:
    """Tell which cells survive openings of growing radius, as in SMRF.

    Unseen cells take no part: a roof at the end of what was seen then stands above all seen cells
    in reach, and falls, where a surface filled in behind it would have kept it.
    """
    known = np.isfinite(lowest)
    surface = np.where(known, lowest, _ABSENT)
    obstacle = np.zeros(surface.shape, dtype=bool)
    for radius in _radii(max(1, round(config.max_window / config.cell))):
        size = 2 * radius + 1
        eroded = ndimage.minimum_filter(surface, size, mode="constant", cval=_ABSENT)
        low = np.where(known, eroded, -_ABSENT)
        opened = ndimage.maximum_filter(low, size, mode="constant", cval=-_ABSENT)
        reach = radius * config.cell
        limit = min(config.step, config.thin_step * radius) + config.slope * min(reach, config.slope_reach)
        obstacle |= known & (surface - opened > limit)
        surface = np.where(known, opened, _ABSENT)
    return np.asarray(known & ~obstacle)


def _radii(largest: int) -> list[int]:
    """Grow by about a quarter each time: as good as every radius, several times faster."""
    radii = [1]
    while radii[-1] < largest:
        radii.append(min(largest, max(radii[-1] + 1, int(radii[-1] * 1.25))))
    return radii


def _refit(
    xyz: Floats, flat: NDArray[np.int64], surface: Floats, is_ground: Mask, config: GroundConfig
) -> tuple[Floats, Mask]:
    """Move the low surface to the mean of the points near it: the lowest of many is biased by noise."""
    low = surface.ravel()[flat]
    near = (np.abs(xyz[:, 2] - low) < config.refit_band) & is_ground.ravel()[flat]
    near &= ~_foot_of_wall(xyz[:, 2] - low, flat, surface.size, config)[flat]
    for _ in range(2):
        mean, spread = _cell_moments(xyz[near, 2], flat[near], surface.size)
        near &= np.abs(xyz[:, 2] - mean[flat]) < 0.5 * config.refit_band
        near &= spread[flat] < config.max_spread  # the foot of a wall, or leaves
    mean, _ = _cell_moments(xyz[near, 2], flat[near], surface.size)
    mean = mean.reshape(surface.shape)
    known = np.isfinite(mean)
    if not known.any():  # a sliver of a tile: feet of walls and leaves only
        return surface, is_ground
    return fill_gaps(mean), known


def _no_cells(_: Floats, __: NDArray[np.int64], size: int, *___: object) -> Mask:
    """Return a mask of no cells."""
    return np.zeros(size, dtype=bool)


@switchable("foot_of_wall", _no_cells)
def _foot_of_wall(above: Floats, flat: NDArray[np.int64], size: int, config: GroundConfig) -> Mask:
    """Tell which cells (size,) go on upwards: as many points in the next metre as near the lowest."""
    near = np.bincount(flat[above < config.refit_band], minlength=size)
    higher = (above >= config.refit_band) & (above < config.refit_band + 1.0)
    return np.bincount(flat[higher], minlength=size) > np.maximum(near, 1)


def _cell_moments(z: Floats, flat: NDArray[np.int64], size: int) -> tuple[Floats, Floats]:
    """Mean and standard deviation of the heights of every cell, NaN where empty."""
    count = np.bincount(flat, minlength=size)
    safe = np.maximum(count, 1)
    mean = np.where(count > 0, np.bincount(flat, z, size) / safe, np.nan)
    spread = np.sqrt(np.bincount(flat, (z - mean[flat]) ** 2, size) / safe)
    return mean, np.where(count > 0, spread, np.nan)
