"""Smooth displacement field: nodes at the centres of square blocks, linear in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class BlockGrid:
    """Square blocks in the common frame: south-west corner (2,) [m], edge [m], rows (north) and columns."""

    corner: Floats
    cell: float
    shape: tuple[int, int]

    def block_of(self, xy: Floats) -> Ints:
        """Return the flat index (N,) of the block that holds, or lies nearest to, points (N, 2 or 3)."""
        index = np.floor((xy[:, :2] - self.corner) / self.cell).astype(np.int64)
        index = np.clip(index, 0, np.array(self.shape[::-1]) - 1)
        return np.asarray(index[:, 1] * self.shape[1] + index[:, 0])

    def nodes(self, xy: Floats) -> Floats:
        """Return positions (2, N) in rows and columns; whole numbers are the centres of blocks."""
        return ((xy[:, :2] - self.corner) / self.cell - 0.5)[:, ::-1].T

    def centres(self) -> Floats:
        """Return the centres (rows * columns, 2) of the blocks [m]."""
        row, column = np.divmod(np.arange(self.shape[0] * self.shape[1]), self.shape[1])
        return self.corner + (np.column_stack([column, row]) + 0.5) * self.cell


@dataclass(frozen=True)
class SmoothField:
    """A displacement [m] for every place: ``values`` (rows, columns, 3) at the centres of blocks."""

    grid: BlockGrid
    values: Floats

    def at(self, xyz: Floats) -> Floats:
        """Return the displacement (N, 3) at points (N, 3), bilinear, constant beyond the outer centres."""
        where = self.grid.nodes(xyz)
        parts = [
            ndimage.map_coordinates(self.values[:, :, k], where, order=1, mode="nearest") for k in range(3)
        ]
        return np.stack(parts, axis=1)
