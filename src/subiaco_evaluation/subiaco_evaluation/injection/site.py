"""Free ground near the drive where an object can be injected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_CELL = 0.5  # [m]
_KNOWN = 0.6  # share of the footprint that stands on ground that was seen


@dataclass
class Site:
    """Ground heights on a grid, and the cells that objects occupy; grows as objects are inserted.

    ``height`` (rows, columns) [m], NaN where no ground was seen; ``blocked`` alike.
    """

    corner: Floats
    height: Floats
    blocked: Mask

    @classmethod
    def of_map(cls, xyz: Floats, semantic: NDArray[np.uint8]) -> Site:
        """Build it from labelled points (N, 3), (N,)."""
        corner = xyz[:, :2].min(axis=0)
        index = np.floor((xyz[:, :2] - corner) / _CELL).astype(np.int64)
        shape = (int(index[:, 1].max()) + 1, int(index[:, 0].max()) + 1)
        flat = index[:, 1] * shape[1] + index[:, 0]
        is_ground = semantic == Semantic.GROUND
        size = shape[0] * shape[1]
        count = np.bincount(flat[is_ground], minlength=size)
        total = np.bincount(flat[is_ground], xyz[is_ground, 2], minlength=size)
        height = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        blocked = np.bincount(flat[~is_ground], minlength=size) > 0
        return cls(corner, height.reshape(shape), blocked.reshape(shape))

    def cells(self, xy: Floats) -> tuple[Ints, Ints, Mask]:
        """Return rows, columns and whether inside, of places (N, 2)."""
        column, row = np.floor((xy - self.corner) / _CELL).astype(np.int64).T
        inside = (row >= 0) & (column >= 0) & (row < self.height.shape[0]) & (column < self.height.shape[1])
        limit = np.array(self.height.shape) - 1
        return np.clip(row, 0, limit[0]), np.clip(column, 0, limit[1]), inside

    def places(self, poses: Floats, max_range: float, clearance: float) -> Floats:
        """Return free ground (K, 3) near the drive, that far from all that stands."""
        distance = _CELL * ndimage.distance_transform_edt(~self.blocked)
        row, column = np.nonzero(np.isfinite(self.height) & (distance > clearance))
        xy = self.corner + (np.column_stack([column, row]) + 0.5) * _CELL
        near = cKDTree(poses[:, :2]).query(xy)[0] < max_range
        return np.column_stack([xy, self.height[row, column]])[near]

    def fits(self, xy: Floats, clearance: float) -> bool:
        """Tell whether a footprint (N, 2) stands free, on ground that was seen."""
        row, column, inside = self.cells(xy)
        if not inside.all():
            return False
        margin = int(np.ceil(clearance / _CELL))
        low, high = (row.min(), column.min()), (row.max() + 1, column.max() + 1)
        window = tuple(slice(max(a - margin, 0), b + margin) for a, b in zip(low, high, strict=True))
        mine = np.zeros(self.blocked.shape, dtype=bool)[window]
        mine[row - window[0].start, column - window[1].start] = True
        around = ndimage.binary_dilation(mine, iterations=max(margin, 1))
        known = np.isfinite(self.height[window][mine]).mean()
        return bool(known > _KNOWN and not (around & self.blocked[window]).any())

    def occupy(self, xy: Floats) -> None:
        """Let a footprint (N, 2) stand."""
        row, column, inside = self.cells(xy)
        self.blocked[row[inside], column[inside]] = True

    def ground_below(self, xy: Floats) -> float:
        """Median height of the ground under a footprint (N, 2) [m]; NaN where none was seen."""
        row, column, inside = self.cells(xy)
        known = self.height[row[inside], column[inside]]
        known = known[np.isfinite(known)]
        return float(np.median(known)) if len(known) else float("nan")
