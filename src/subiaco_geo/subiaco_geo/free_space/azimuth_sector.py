"""Azimuths into which a sensor never looked, estimated from its cloud and its poses.

A roof, a mast or a second sensor may close a part of the circle. What the sensor met ahead lies behind it a
moment later, so that the points of a whole drive surround every pose. The blind azimuths show where nothing
but them has a place in view: behind the first pose, ahead of the last one, and outside bends. Such places
hold points if the sensor looked that way, and none if it did not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_geo.clouds import unique_cells
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.numbers import FREE_SPACE

#: Arcs of azimuths from the heading of the vehicle, counter-clockwise: first angle and extent [rad].
Arcs = tuple[tuple[float, float], ...]

_CELL = FREE_SPACE.sector_cell
_BINS = FREE_SPACE.sector_steps
_BESIDE = FREE_SPACE.sector_beside

Flags = NDArray[np.bool_]
Bits = NDArray[np.uint64]


def in_arcs(azimuth: Floats, arcs: Arcs) -> Flags:
    """Tell which azimuths (N,) [rad, from the heading] lie in arcs."""
    found = np.zeros(np.shape(azimuth), dtype=np.bool_)
    for first, extent in arcs:
        found |= np.mod(azimuth - first, 2.0 * np.pi) < extent
    return found


@dataclass(frozen=True)
class _Places:
    """Horizontal cells (N,) around a drive: the azimuths that have them in view, as bits, and what they hold.

    ``far`` are the azimuths from which a cell lies in range, ``near`` those from which its ground is surely
    met by a pose that has the cloud around it, and ``filled`` tells whether the cell holds a point.
    """

    far: Bits
    near: Bits
    filled: Flags

    def empty(self, blind: int) -> bool:
        """Tell whether cells that only these azimuths have in view hold next to no points."""
        due, held = self._expected(blind, self._alone(blind) & self._near(blind))
        return due >= FREE_SPACE.sector_evidence and held <= FREE_SPACE.sector_stray * due

    def shows_blind(self, blind: int, step: int) -> bool:
        """Tell whether cells that only ``blind`` has in view, and not without a step of it, lack points."""
        due, held = self._of_step(blind, step)
        return due >= FREE_SPACE.sector_edge and held <= FREE_SPACE.sector_seen * due

    def shows_seen(self, blind: int, beside: int) -> bool:
        """Tell whether cells hold points that only ``blind`` and steps beside it have in view."""
        due, held = self._of_step(blind | beside, beside)
        return due >= FREE_SPACE.sector_edge and held > FREE_SPACE.sector_seen * due

    def _of_step(self, blind: int, step: int) -> tuple[float, int]:
        needed = self._alone(blind) & ~self._alone(blind & ~step) & self._near(step)
        return self._expected(blind, needed)

    def _alone(self, blind: int) -> Flags:
        return np.asarray((self.far & ~np.uint64(blind)) == 0)

    def _near(self, arc: int) -> Flags:
        return np.asarray((self.near & np.uint64(arc)) != 0)

    def _expected(self, blind: int, cells: Flags) -> tuple[float, int]:
        """Count cells that would hold points, as those in view otherwise do, and cells that do."""
        others = (self.near & ~np.uint64(blind)) != 0
        share = self.filled[others].mean() if others.any() else 0.0
        return float(share * np.count_nonzero(cells)), int(np.count_nonzero(self.filled[cells]))


def estimate_blind_arcs(eyes: Floats, headings: Floats, columns: Floats, far: float) -> Arcs:
    """Estimate the azimuths into which a sensor never looked; none where the cloud does not show them.

    Parameters
    ----------
    eyes : (K, 2) float64
        Positions of the sensor along its whole drive [m, world].
    headings : (K,) float64
        Azimuth of the axis that points ahead, see
        :func:`~subiaco_geo.free_space.sensor_view.spin_headings` [rad, world].
    columns : (M, 2) float64
        Horizontal positions that hold points of the cloud [m, world].
    far : float
        Range beyond which no place counts as in view [m].

    Returns
    -------
    tuple of (float, float)
        Blind arcs. None where less than a sector of them would be left, or where the sensor would have
        looked to both sides alone: then the cloud ends at the drive.
    """
    if len(eyes) < 2 or len(columns) == 0:
        return ()
    blind, arcs, step = 0, [], 2.0 * np.pi / _BINS
    for first, width in _blind_arcs(_places(eyes, headings, columns, far)):
        blind |= _bits(first, width)
        arcs.append((first * step, width * step))
    if _cut_at_both_ends(arcs):
        return ()
    seen = _BINS - blind.bit_count()
    return tuple(arcs) if seen * step >= np.radians(FREE_SPACE.sector_least_deg) else ()


def _cut_at_both_ends(arcs: list[tuple[float, float]]) -> bool:
    """Tell whether one arc is blind ahead, another one behind, and both are half of the circle or more.

    No sensor looks to both sides alone.
    """
    ends = [in_arcs(np.array([0.0, np.pi]), (arc,)) for arc in arcs]
    if not ends or any(side.all() for side in ends) or sum(extent for _, extent in arcs) < np.pi:
        return False
    return bool(np.any(ends, axis=0).all())


def path_poses(positions: Floats) -> Ints:
    """Return indices of positions (M, 3) that show blind azimuths: the first of every stretch, and the last.

    Where the way comes by again, the vehicle may face elsewhere: all passes count.
    """
    if len(positions) == 0:
        return np.zeros(0, dtype=np.int64)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    _, first = np.unique(np.floor(way / FREE_SPACE.sector_pose_spacing), return_index=True)
    return np.union1d(first, [len(positions) - 1])


def _blind_arcs(places: _Places) -> list[tuple[int, int]]:
    """Find blind arcs that do not overlap, the widest first: first step and number of steps of each.

    Where a cloud was cut, the azimuths beside an arc show no points either: then nothing is known of it.
    """
    blind, found = 0, []
    for width in range(_BINS - 1, 0, -1):
        for start in range(_BINS):
            arc = _bits(start, width)
            if arc & blind or not places.empty(arc):
                continue
            first, extent = _trimmed(places, start, width)
            arc = _bits(first, extent)
            if places.shows_seen(arc, _bits(first - _BESIDE, _BESIDE)) and places.shows_seen(
                arc, _bits(first + extent, _BESIDE)
            ):
                blind |= arc
                found.append((first, extent))
    return found


def _trimmed(places: _Places, first: int, width: int) -> tuple[int, int]:
    """Take off the steps at both ends of an arc that no cells show to be blind."""
    while width > 1 and not places.shows_blind(_bits(first, width), _bits(first, 1)):
        first, width = (first + 1) % _BINS, width - 1
    while width > 1 and not places.shows_blind(_bits(first, width), _bits(first + width - 1, 1)):
        width -= 1
    return first, width


def _bits(first: int, width: int) -> int:
    """Return the steps of an arc as bits; the circle closes in itself."""
    return sum(1 << (step % _BINS) for step in range(first, first + width))


def _places(eyes: Floats, headings: Floats, columns: Floats, far: float) -> _Places:
    """Find the cells along a drive, which azimuths have them in view, and which hold points."""
    corner = np.floor(np.vstack([eyes, columns]).min(axis=0)) - far
    held, _ = unique_cells(np.floor((columns - corner) / _CELL).astype(np.int64))
    cells = _cells_along(eyes - corner)
    tree = cKDTree((cells + 0.5) * _CELL)
    filled = cKDTree(held).query(cells, distance_upper_bound=0.5)[0] < 0.5
    seen, near = np.zeros(len(cells), dtype=np.uint64), np.zeros(len(cells), dtype=np.uint64)
    for eye, heading in zip(eyes - corner, headings, strict=True):
        index = np.asarray(tree.query_ball_point(eye, far), dtype=np.int64)
        way = (cells[index] + 0.5) * _CELL - eye
        distance = np.hypot(way[:, 0], way[:, 1])
        close = distance < FREE_SPACE.sector_near[0]
        seen[index[close]] = np.uint64((1 << _BINS) - 1)
        index, way, distance = index[~close], way[~close], distance[~close]
        bits = _steps(np.arctan2(way[:, 1], way[:, 0]) - heading, np.arcsin(np.sqrt(0.5) * _CELL / distance))
        seen[index] |= bits
        ground = distance < FREE_SPACE.sector_near[1]
        if not ground.any() or filled[index[ground]].mean() < FREE_SPACE.sector_cloud:
            continue
        near[index[ground]] |= bits[ground]
    return _Places(seen, near, filled)


def _steps(azimuth: Floats, half: Floats) -> Bits:
    """Return the steps (N,) that cells at an azimuth touch, half a cell and less than a step wide [rad]."""
    bits = np.zeros(len(azimuth), dtype=np.uint64)
    for side in (-1.0, 0.0, 1.0):
        turns = np.mod(azimuth + side * half, 2.0 * np.pi) / (2.0 * np.pi)
        bits |= np.uint64(1) << (np.floor(turns * _BINS).astype(np.uint64) % np.uint64(_BINS))
    return bits


def _cells_along(local: Floats) -> Ints:
    """Return cells (N, 2) within sure view of positions (K, 2), evenly thinned where a drive is long."""
    reach = int(FREE_SPACE.sector_near[1] / _CELL)
    disc = np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach
    disc = disc[np.hypot(disc[:, 0], disc[:, 1]) <= reach]
    block = int(FREE_SPACE.sector_near[0] / _CELL)
    centres = unique_cells(np.floor(local / (block * _CELL)).astype(np.int64))[0] * block + block // 2
    cells, _ = unique_cells((centres[:, None] + disc[None]).reshape(-1, 2))
    return cells[:: max(-(-len(cells) // FREE_SPACE.sector_places), 1)]
