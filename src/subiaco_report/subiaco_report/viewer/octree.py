"""Point clouds as octrees with levels of detail: every node holds a thinned part of its cube.

A node draws one point from every cell of a grid of :data:`GRID` cells a side; the points that it leaves go to
its eight children (Wand et al. 2008; the additive octree of COPC and Potree). A node with few points keeps
them all. A cloud is taken column by column of the root cube, so that memory holds one column, and of the
levels above the columns the points that were chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud, stable_order
from subiaco_geo.frames import Floats, Ints

#: Cells of a node along each edge; a power of two, so that cells never cross a border of nodes.
GRID = 128
#: A node with at most so many points has no children.
CAPACITY = 30_000
#: Points of a column, about.
COLUMN_POINTS = 1_500_000
_GRID_BITS, _DEEPEST = 7, 13


@dataclass(frozen=True)
class RootCube:
    """The cube that holds both epochs: lower corner (3,) in world coordinates and edge [m]."""

    corner: Floats
    size: float

    @staticmethod
    def around(low: Floats, high: Floats) -> RootCube:
        """Return the smallest cube in whole metres around bounds (3,) [m]."""
        corner = np.floor(low)
        return RootCube(corner, float(np.ceil((high - corner).max() + 1e-3)))

    def column(self, level: int, i: int, j: int) -> tuple[float, float, float, float]:
        """Return west, south, east, north of one of the ``2**level`` columns along each axis [m]."""
        edge = self.size / 2**level
        west, south = self.corner[0] + i * edge, self.corner[1] + j * edge
        return west, south, west + edge, south + edge


@dataclass(frozen=True)
class NodeKey:
    """Level, 0 for the root, and position of a node among the ``2**level`` along each axis."""

    level: int
    x: int
    y: int
    z: int

    def name(self) -> str:
        """Return ``r`` and the octant at every level below the root; its bits are x, y, z."""
        octants = [
            ((self.x >> shift) & 1) << 2 | ((self.y >> shift) & 1) << 1 | ((self.z >> shift) & 1)
            for shift in reversed(range(self.level))
        ]
        return "r" + "".join(map(str, octants))


def column_level(points: int) -> int:
    """Return the level of columns that hold about :data:`COLUMN_POINTS` of so many points."""
    level = 0
    while points > COLUMN_POINTS * 4**level and level < _GRID_BITS:
        level += 1
    return level


def nodes_of(
    unit: Floats, preferred: NDArray[np.bool_], first_level: int, seed: int = 0
) -> Iterator[tuple[NodeKey, Ints]]:
    """Distribute the points of a column over nodes.

    Parameters
    ----------
    unit : (N, 3) float64
        Positions in the root cube, 0 to 1.
    preferred : (N,) bool
        Points that a cell shows rather than others: changed ones, so that a change is seen from afar.
    first_level : int
        Level of the columns. Nodes above it share their cubes with other columns: they get a point a cell
        of this column, and never all.
    seed : int
        Of the order in which points of a cell are drawn.

    Yields
    ------
    NodeKey
    (M,) int64
        Points of the node. Every point is in one node.
    """
    order = np.random.default_rng(seed).permutation(len(unit))
    remaining = order[np.argsort(~preferred[order], kind="stable")]
    steps = GRID << _DEEPEST
    finest = np.clip((unit * steps).astype(np.int64), 0, steps - 1)[remaining]  # levels halve its cells
    for level in range(_DEEPEST + 1):
        if len(remaining) == 0:
            return
        cells = finest >> (_DEEPEST - level)
        node = _key(cells >> _GRID_BITS)
        taken = np.zeros(len(remaining), dtype=np.bool_)
        if level >= first_level:
            _, inverse, counts = np.unique(node, return_inverse=True, return_counts=True)
            taken = counts[inverse] <= CAPACITY
        if level == _DEEPEST:
            taken[:] = True
        crowded = np.flatnonzero(~taken)
        taken[crowded[_first_of_each(_key(cells[crowded]))]] = True
        yield from _grouped(level, node[taken], remaining[taken])
        remaining, finest = remaining[~taken], finest[~taken]


def _key(index: Ints) -> Ints:
    return index[:, 0] << 42 | index[:, 1] << 21 | index[:, 2]


def _first_of_each(keys: Ints) -> Ints:
    """Return where every distinct key stands first."""
    order = stable_order(keys)
    return np.asarray(order[np.diff(keys[order], prepend=-1) != 0])


def _grouped(level: int, node: Ints, points: Ints) -> Iterator[tuple[NodeKey, Ints]]:
    order = stable_order(node)
    keys, starts = np.unique(node[order], return_index=True)
    mask = (1 << 21) - 1
    for key, part in zip(keys.tolist(), np.split(points[order], starts[1:]), strict=True):
        yield NodeKey(level, key >> 42, key >> 21 & mask, key & mask), part


def unit_positions(cloud: PointCloud, root: RootCube) -> Floats:
    """Return the positions (N, 3) of points in the root cube, 0 to 1."""
    return np.clip((cloud.xyz + (cloud.origin - root.corner)) / root.size, 0.0, np.nextafter(1.0, 0.0))
