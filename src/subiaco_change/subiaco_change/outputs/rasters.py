"""Rasters of a change directory: ground change, what each epoch saw, level of detection."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin

from subiaco_change.records import GroundChange
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

#: Codes of ``coverage.tif`` band 1.
COVERAGE = {0: "neither", 1: "both", 2: "only before", 3: "only after", 4: "undecided"}

_BUDGET = 1 << 24  # cells
_MOSTLY = 0.5  # share of the points of a cell that must have a level of detection
_FAIR = 0.25  # share of a cell's points with which an epoch was there to be compared


@dataclass(frozen=True)
class Coverage:
    """What was seen per cell: codes of :data:`COVERAGE` and median LoD95 [m], row 0 north."""

    code: NDArray[np.uint8]
    lod95: NDArray[np.float32]
    west: float
    north: float
    cell: float

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north [m]."""
        rows, columns = self.code.shape
        return self.west, self.north - rows * self.cell, self.west + columns * self.cell, self.north

    def area(self, code: int) -> float:
        """Return the area of a code [m2]."""
        return float(np.count_nonzero(self.code == code) * self.cell**2)


@dataclass(frozen=True)
class LodRaster:
    """Level of detection per cell, row 0 north.

    ``lod95`` is the median of the points of both epochs that claim anything
    [m], NaN where none does; ``claimed`` the share of points that do, NaN
    without points.
    """

    lod95: NDArray[np.float32]
    claimed: NDArray[np.float32]
    west: float
    north: float
    cell: float


def write_bands(
    path: Path,
    bands: dict[str, NDArray[np.float32]],
    raster: GroundChange | Coverage | LodRaster,
    crs: str | None,
) -> None:
    """Write named bands as a float32 GeoTIFF on the grid of a raster, NaN where nothing is known."""
    arrays = list(bands.values())
    profile = {
        "driver": "GTiff",
        "height": arrays[0].shape[0],
        "width": arrays[0].shape[1],
        "count": len(arrays),
        "dtype": "float32",
        "crs": crs,
        "transform": from_origin(raster.west, raster.north, raster.cell, raster.cell),
        "nodata": float("nan"),
        "compress": "deflate",
        "predictor": 3,
    }
    with rasterio.open(path, "w", **profile) as dataset:
        for index, (name, values) in enumerate(bands.items(), 1):
            dataset.write(values.astype(np.float32), index)
            dataset.set_band_description(index, name)


def write_ground_change(path: Path, ground: GroundChange, crs: str | None) -> None:
    """Write elevation change [m] and its confidence as a two-band GeoTIFF."""
    write_bands(path, {"dz": ground.dz, "confidence": ground.confidence}, ground, crs)


def write_coverage(path: Path, coverage: Coverage, crs: str | None) -> None:
    """Write coverage codes and median LoD95 [m] as a two-band GeoTIFF."""
    write_bands(path, {"coverage": coverage.code.astype(np.float32), "lod95": coverage.lod95}, coverage, crs)


def read_coverage(path: Path) -> Coverage:
    """Read what :func:`write_coverage` wrote.

    Raises
    ------
    InputError
        Missing or damaged.
    """
    try:
        with rasterio.open(path) as dataset:
            code, lod95 = dataset.read()
            west, north, cell = dataset.transform.c, dataset.transform.f, dataset.transform.a
    except (rasterio.errors.RasterioError, ValueError) as error:
        raise InputError(
            f"{path}: no coverage could be read ({error}); run 'subiaco change' again"
        ) from error
    return Coverage(code.astype(np.uint8), lod95, west, north, cell)


def write_lod(path: Path, raster: LodRaster, crs: str | None) -> None:
    """Write LoD95 [m] and the share of points that claim one as a two-band GeoTIFF."""
    write_bands(path, {"lod95": raster.lod95, "claimed": raster.claimed}, raster, crs)


def lod_statement(raster: LodRaster) -> dict[str, float | None]:
    """State the level of detection of a whole map.

    Returns
    -------
    dict
        ``median_m``: median LoD95 over all cells with points, None where half of them or more have
        none; ``median_where_known_m``: the same over the cells that have one; ``share_without``: share
        of the cells with points in which fewer than half of the points have one.
    """
    seen = np.isfinite(raster.claimed)
    if not seen.any():
        return {"median_m": None, "median_where_known_m": None, "share_without": 1.0}
    without = ~(raster.claimed[seen] >= _MOSTLY)
    levels = np.where(without | np.isnan(raster.lod95[seen]), np.inf, raster.lod95[seen])
    median, known = float(np.median(levels)), levels[np.isfinite(levels)]
    return {
        "median_m": median if np.isfinite(median) else None,
        "median_where_known_m": float(np.median(known)) if len(known) else None,
        "share_without": float(without.mean()),
    }


def build_lod_raster(before: PointCloud, after: PointCloud, cell: float = 5.0) -> LodRaster:
    """Reduce LoD95 of the labelled clouds to cells of an edge [m] on whole multiples of it."""
    world = np.concatenate([before.world()[:, :2], after.world()[:, :2]])
    lod95 = np.concatenate([np.asarray(c.fields["lod95"], dtype=np.float64) for c in (before, after)])
    low, high = np.floor(world.min(axis=0) / cell), np.floor(world.max(axis=0) / cell) + 1
    columns, rows = (high - low).astype(int).tolist()
    if rows * columns > _BUDGET:
        raise InputError(f"a raster of {rows} x {columns} cells is too large; remove far outliers")
    ij = (np.floor(world / cell) - low).astype(np.int64)
    flat = (rows - 1 - ij[:, 1]) * columns + ij[:, 0]
    median = _median_per_cell(flat, lod95, rows * columns)
    total = np.bincount(flat, minlength=rows * columns)
    claims = np.bincount(flat, np.isfinite(lod95), rows * columns)
    share = np.where(total > 0, claims / np.maximum(total, 1), np.nan).astype(np.float32)
    west, north = float(low[0] * cell), float(high[1] * cell)
    return LodRaster(median.reshape(rows, columns), share.reshape(rows, columns), west, north, cell)


def build_coverage(before: PointCloud, after: PointCloud, cell: float = 2.0) -> Coverage:
    """Tell per cell which epochs saw it, from the labelled clouds.

    A cell with points is *both* when most of them could be decided, that is,
    the other epoch observed their place; *undecided* where each epoch holds a fair share of
    the points, but most could not be decided: too few for an object, or for a level of detection.
    Else it belongs to the epoch with more points there.
    """
    world = np.concatenate([before.world()[:, :2], after.world()[:, :2]])
    west, south = np.floor(world.min(axis=0) / cell) * cell
    north = float(np.floor(world[:, 1].max() / cell + 1) * cell)
    rows = round((north - float(south)) / cell)
    columns = int(np.floor((world[:, 0].max() - west) / cell)) + 1
    flat = np.minimum(((north - world[:, 1]) // cell).astype(np.int64), rows - 1) * columns
    flat = flat + ((world[:, 0] - west) // cell).astype(np.int64)
    change = np.concatenate([np.asarray(c.fields["change"]) for c in (before, after)])
    size, is_before = rows * columns, np.arange(len(world)) < len(before)
    total = np.bincount(flat, minlength=size)
    decided = np.bincount(flat, weights=change != Change.UNOBSERVED, minlength=size)
    older = np.bincount(flat, weights=is_before, minlength=size)
    code = np.where(2 * decided >= total, 1, np.where(2 * older >= total, 2, 3))
    code[(2 * decided < total) & (np.minimum(older, total - older) >= _FAIR * total)] = 4
    code[total == 0] = 0
    lod95 = np.concatenate([np.asarray(c.fields["lod95"], dtype=np.float64) for c in (before, after)])
    shape = (rows, columns)
    lod_cells = _median_per_cell(flat, lod95, size)
    return Coverage(code.astype(np.uint8).reshape(shape), lod_cells.reshape(shape), float(west), north, cell)


def join_coverage(parts: Iterable[Coverage]) -> Coverage:
    """Lay coverages side by side; where two say something of a cell, the first holds."""
    found = list(parts)
    west, north, shape = _union([(p.west, p.north, p.code.shape) for p in found], found[0].cell)
    code = np.zeros(shape, dtype=np.uint8)
    lod95 = np.full(shape, np.nan, dtype=np.float32)
    for part in found:
        window = _window(part.west, part.north, part.code.shape, west, north, part.cell)
        fresh = (code[window] == 0) & (part.code != 0)
        code[window][fresh], lod95[window][fresh] = part.code[fresh], part.lod95[fresh]
    return Coverage(code, lod95, west, north, found[0].cell)


def join_lod(parts: Iterable[LodRaster]) -> LodRaster:
    """Lay rasters side by side; where two say something of a cell, the first holds."""
    found = list(parts)
    west, north, shape = _union([(p.west, p.north, p.lod95.shape) for p in found], found[0].cell)
    lod95, claimed = (np.full(shape, np.nan, dtype=np.float32) for _ in range(2))
    for part in found:
        window = _window(part.west, part.north, part.lod95.shape, west, north, part.cell)
        fresh = np.isnan(claimed[window]) & np.isfinite(part.claimed)
        lod95[window][fresh], claimed[window][fresh] = part.lod95[fresh], part.claimed[fresh]
    return LodRaster(lod95, claimed, west, north, found[0].cell)


def _union(
    boxes: Sequence[tuple[float, float, tuple[int, ...]]], cell: float
) -> tuple[float, float, tuple[int, int]]:
    """West, north and shape that hold all of some rasters."""
    west, north = min(b[0] for b in boxes), max(b[1] for b in boxes)
    east = max(b[0] + b[2][1] * cell for b in boxes)
    south = min(b[1] - b[2][0] * cell for b in boxes)
    rows, columns = round((north - south) / cell), round((east - west) / cell)
    if rows * columns > _BUDGET:
        raise InputError(f"a raster of {rows} x {columns} cells is too large; remove far outliers")
    return west, north, (rows, columns)


def _window(
    west: float, north: float, shape: tuple[int, ...], whole_west: float, whole_north: float, cell: float
) -> tuple[slice, slice]:
    row, column = round((whole_north - north) / cell), round((west - whole_west) / cell)
    return slice(row, row + shape[0]), slice(column, column + shape[1])


def _median_per_cell(flat: NDArray[np.int64], values: Floats, size: int) -> NDArray[np.float32]:
    """Return the lower median of the finite values per cell, NaN where there is none."""
    finite = np.isfinite(values)
    order = np.lexsort((values[finite], flat[finite]))
    cells, ordered = flat[finite][order], values[finite][order]
    result = np.full(size, np.nan, dtype=np.float32)
    occupied, starts, counts = np.unique(cells, return_index=True, return_counts=True)
    result[occupied] = ordered[starts + (counts - 1) // 2]
    return result
