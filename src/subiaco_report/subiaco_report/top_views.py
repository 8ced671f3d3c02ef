"""Top views of point clouds: the highest point of every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import CHANGED, Change
from subiaco_geo.frames import Floats, Ints

#: What hides all else in a view of changes.


@dataclass(frozen=True)
class Frame:
    """A north-up pixel frame: outer bounds and pixel edge [m], world or local alike."""

    west: float
    south: float
    east: float
    north: float
    pixel: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows = int(np.ceil((self.north - self.south) / self.pixel - 1e-9))
        columns = int(np.ceil((self.east - self.west) / self.pixel - 1e-9))
        return max(rows, 1), max(columns, 1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north: the order in which plots want it."""
        return self.west, self.east, self.south, self.north


def top_view(xyz: Floats, frame: Frame, priority: NDArray[np.bool_] | None = None) -> Ints:
    """Return the index of the point seen in every pixel, -1 where there is none.

    Parameters
    ----------
    xyz : (N, 3) float64
        In the coordinates of the frame [m].
    frame : Frame
    priority : (N,) bool, optional
        Points that hide all others; height decides among equals.

    Returns
    -------
    (rows, columns) int64
        Row 0 in the north.
    """
    rows, columns = frame.shape
    column = np.floor((xyz[:, 0] - frame.west) / frame.pixel).astype(np.int64)
    row = np.floor((frame.north - xyz[:, 1]) / frame.pixel).astype(np.int64)
    inside = np.flatnonzero((row >= 0) & (row < rows) & (column >= 0) & (column < columns))
    flat = row[inside] * columns + column[inside]
    view = np.full(rows * columns, -1, dtype=np.int64)
    _show_highest(view, xyz[:, 2], inside, flat)
    if priority is not None:
        first = priority[inside]
        _show_highest(view, xyz[:, 2], inside[first], flat[first])
    return view.reshape(rows, columns)


def _show_highest(view: Ints, z: Floats, points: Ints, pixel: Ints) -> None:
    """Let pixels (P,) show the highest of the points (K,) that fall into them; of equals the last wins."""
    top = np.full(len(view), -np.inf)
    np.maximum.at(top, pixel, z[points])
    highest = z[points] == top[pixel]
    view[pixel[highest]] = points[highest]


class Above:
    """What is seen from above of clouds that come part by part: the height and the change of every pixel.

    Changed points hide others, height decides among equals: as :func:`top_view` of all points at once.

    Parameters
    ----------
    frame : Frame
        World coordinates.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        count = frame.shape[0] * frame.shape[1]
        self._height = np.full(count, -np.inf)
        self._change = np.full(count, Change.UNCHANGED, dtype=np.uint8)

    def add(self, world: Floats, change: NDArray[np.uint8]) -> None:
        """Take points (N, 3) [m] and their changes (N,)."""
        view = top_view(world, self.frame, np.isin(change, CHANGED)).ravel()
        pixel = np.flatnonzero(view >= 0)
        seen = view[pixel]
        own, held = np.isin(change[seen], CHANGED), np.isin(self._change[pixel], CHANGED)
        hidden = np.where(own == held, world[seen, 2] < self._height[pixel], held)
        pixel, seen = pixel[~hidden], seen[~hidden]
        self._height[pixel], self._change[pixel] = world[seen, 2], change[seen]

    def cloud(self) -> PointCloud:
        """Return one point a pixel that anything was seen in, with field ``change``."""
        pixel = np.flatnonzero(np.isfinite(self._height))
        row, column = np.divmod(pixel, self.frame.shape[1])
        x = (column + 0.5) * self.frame.pixel
        y = (self.frame.north - self.frame.south) - (row + 0.5) * self.frame.pixel
        origin = np.array([self.frame.west, self.frame.south, 0.0])
        xyz = np.stack([x, y, self._height[pixel]], axis=1)
        return PointCloud(xyz, origin, None, {"change": self._change[pixel]})


def fill_holes(view: Ints, passes: int = 1) -> Ints:
    """Let empty pixels show a neighbour's point, ``passes`` pixels far."""
    filled = view
    for _ in range(passes):
        padded = np.pad(filled, 1, constant_values=-1)
        result = filled.copy()
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            shifted = padded[1 + down : 1 + down + view.shape[0], 1 + right : 1 + right + view.shape[1]]
            result = np.where(result < 0, shifted, result)
        filled = result
    return filled
