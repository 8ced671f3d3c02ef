"""Whether a place was seen and free: by counted beams, expected visibility, points alone, or assumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.geometry import ColumnIndex, build_index, nearest, nearest_points
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.expected_visibility import ExpectedVisibility
from subiaco_geo.visibility import VisibilityGrid

_PRIOR = NUMBERS.visibility_evidence.prior_beams
_EXPOSED = NUMBERS.visibility_evidence.exposed_share
_SIDES = 8  # of a place: the main and half directions of the compass

Flags = NDArray[np.bool_]


class VisibilityTest(Protocol):
    """Tells which world points (N, 3) were seen, and through which beams went on."""

    def observed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) the epoch could see."""

    def passed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) were seen empty: beams went on."""

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that world points (N, 3) were free; 0.5 where nothing is known."""


@dataclass(frozen=True)
class CountedBeams:
    """Counts of beams that mapping measured."""

    grid: VisibilityGrid
    min_beams: int

    def observed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) the epoch could see."""
        return self.grid.observed(world, self.min_beams)

    def passed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) were seen empty: beams went on."""
        hits, passes = self.grid.lookup(world)
        return np.asarray((passes >= self.min_beams) & (hits == 0))

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that world points (N, 3) were free; 0.5 where nothing is known."""
        hits, passes = (counts.astype(np.float64) for counts in self.grid.lookup(world))
        return np.asarray((passes + _PRIOR) / (hits + passes + 2.0 * _PRIOR))


@dataclass(frozen=True)
class Surroundings:
    """Lowest points of a cloud by fine columns, and on how many sides of a place they lie.

    The ground in front of a wall is seen although the wall hides its own place, and what lies beyond the rim
    of the field of view is not seen although its neighbourhood is. A place that was free lies among places
    that were seen, on all sides.

    Parameters
    ----------
    lowest : (nx, ny) float64
        Height of the lowest point of every column [m]; inf where there is none.
    corner : (2,) float64
        Outer corner [m].
    cell : float
        Edge of a column [m].
    reach : float
        Distance within which a side must hold a point [m].
    sides : int
        Number of the eight sides that must.
    """

    lowest: Floats
    corner: Floats
    cell: float
    reach: float
    sides: int

    @classmethod
    def of(cls, xyz: Floats, cell: float, reach: float, sides: int) -> Surroundings:
        """Find the lowest of points (N, 3) of every column."""
        index = build_index(xyz, cell)
        lowest = np.full(tuple(index.shape.tolist()), np.inf)
        filled = np.flatnonzero(np.diff(index.starts) > 0)
        lowest.ravel()[filled] = index.xyz[index.starts[filled], 2]
        return cls(lowest, index.corner, index.cell, reach, sides)

    def enclose(self, local: Floats) -> Flags:
        """Tell which places (N, 3) have lower points on enough sides."""
        ij = np.floor((local[:, :2] - self.corner) / self.cell).astype(np.int64)
        cells = max(round(self.reach / self.cell), 1)
        found = np.zeros((len(local), _SIDES), dtype=bool)
        shape = np.array(self.lowest.shape)
        for x, y in np.argwhere(np.ones((2 * cells + 1, 2 * cells + 1))) - cells:
            if not 0 < np.hypot(x, y) <= cells:
                continue
            at = ij + np.array([x, y])
            inside = np.flatnonzero(((at >= 0) & (at < shape)).all(axis=1))
            lower = np.zeros(len(local), dtype=bool)
            lower[inside] = self.lowest[at[inside, 0], at[inside, 1]] <= local[inside, 2]
            found[:, round(np.arctan2(y, x) / (2 * np.pi / _SIDES)) % _SIDES] |= lower
        return np.asarray(found.sum(axis=1) >= self.sides)


@dataclass(frozen=True)
class PointShadow:
    """Points alone: a place is seen where something near it, or beneath it, was."""

    index: ColumnIndex
    origin: Floats
    radius: float
    height: float
    trust: float
    touch: float
    level: Floats  # (nx, ny) how high the view reached at a column at least [m], see view_level
    around: Surroundings
    from_above: bool = False  # no height over a point is too high for the view

    def observed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) the epoch could see."""
        local = np.ascontiguousarray(world - self.origin)
        near = nearest(self.index, local, self.radius)[0] >= 0
        return near | self._above(local)

    def passed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) were seen empty: beams went on.

        A surface further below than it may occupy its surroundings ends below the place: half a storey above
        an old roof is free space.
        """
        local = np.ascontiguousarray(world - self.origin)
        found = np.flatnonzero(self._above(local))
        lifted = local[found] + np.array([0.0, 0.0, max(self.radius - self.touch, 0.0)])
        near = (nearest(self.index, local[found], self.radius)[0] >= 0) & (
            nearest(self.index, lifted, self.radius)[0] >= 0
        )
        passed = np.zeros(len(local), dtype=np.bool_)
        passed[found[~near]] = True
        return passed

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that world points (N, 3) were free; 0.5 where nothing is known."""
        local = np.ascontiguousarray(world - self.origin)
        chance = np.full(len(local), 0.5)
        above = np.flatnonzero(self._above(local))
        chance[above[self.around.enclose(local[above])]] = self.trust
        chance[nearest(self.index, local, self.touch)[0] >= 0] = 1.0 - self.trust
        return chance

    def nearest_points(self, world: Floats) -> Floats:
        """Return the point (N, 3) nearest to world points (N, 3); NaN where none lies within the radius."""
        local = np.ascontiguousarray(world - self.origin)
        return nearest_points(self.index, local, self.radius) + self.origin

    def tops(self, world: Floats) -> Floats:
        """Return the height (N,) of the highest point in the columns of places (N, 3); NaN where none is."""
        _, end, held = self._points_of_columns(world - self.origin)
        return np.where(held, self.index.xyz[end - 1, 2] + self.origin[2], np.nan)

    def lowest(self, world: Floats) -> Floats:
        """Return the height (N,) of the lowest point in the columns of places (N, 3); inf where none is."""
        return self._lowest(world - self.origin) + self.origin[2]

    def levelled(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) are no higher than what the cloud shows its view to have reached."""
        if self.from_above:
            return np.ones(len(world), dtype=np.bool_)
        local = np.ascontiguousarray(world - self.origin)
        ij, inside = self._columns(local)
        level = np.full(len(local), -np.inf)
        level[inside] = self.level[ij[inside, 0], ij[inside, 1]]
        return np.asarray(local[:, 2] <= level)

    def _columns(self, local: Floats) -> tuple[NDArray[np.int64], Flags]:
        ij = np.floor((local[:, :2] - self.index.corner) / self.index.cell).astype(np.int64)
        return ij, np.asarray(np.all((ij >= 0) & (ij < self.index.shape), axis=1))

    def _above(self, local: Floats) -> Flags:
        """Tell which points stand above a seen one in their column."""
        gap = local[:, 2] - self._lowest(local)  # -inf where no point is
        return np.asarray((gap >= 0) & (gap <= (np.inf if self.from_above else self.height)))

    def _lowest(self, local: Floats) -> Floats:
        first, _, held = self._points_of_columns(local)
        lowest = np.full(len(local), np.inf)
        lowest[held] = self.index.xyz[first[held], 2]
        return lowest

    def _points_of_columns(self, local: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Flags]:
        """First and end (N,) of the points, upwards, of the columns of places (N, 3), and which hold any."""
        ij, inside = self._columns(local)
        column = np.where(inside, ij[:, 0] * self.index.shape[1] + ij[:, 1], 0)
        first, end = self.index.starts[column], self.index.starts[column + 1]
        return first, end, np.asarray(inside & (end > first))


@dataclass(frozen=True)
class PosesAndPoints:
    """Expected visibility; where the poses that have a place in view tell nothing of it, the points.

    Beams reach the ground beneath a crown that a depth image shows closed, and the margin in front of a
    surface is neither free nor occupied by the image alone. Where the nearest point of the epoch lies behind
    that surface too, beams did reach the place, and the points are trusted as in a cloud without poses. Out
    of view of all poses nothing is known, whatever the points say.
    """

    poses: ExpectedVisibility
    points: PointShadow
    trust: float

    def observed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) the epoch could see."""
        return self._either(self.poses.observed(world), self.points.observed, world)

    def passed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) were seen empty: beams went on."""
        return self._either(self.poses.passed(world), self.points.passed, world)

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that world points (N, 3) were free; 0.5 where nothing is known."""
        chance, by_points = self._combined(world)
        ask = np.flatnonzero(by_points)
        chance[ask] = np.where(self._reached(world[ask]), max(self.points.trust, self.trust), self.trust)
        return chance

    def free_in_view(self, world: Floats) -> Floats:
        """Return the probability (N,) that points (N, 3) above the tops of plants were free.

        A field of view that ends in a crown leaves points below its end and none above, as a top does: where
        the poses send the place fewer beams than the top beneath it, points prove no free space.
        """
        chance, by_points = self._combined(world)
        ask = np.flatnonzero(by_points)
        chance[ask] = np.where(self._as_exposed(world[ask]), max(self.points.trust, self.trust), self.trust)
        return chance

    def _as_exposed(self, world: Floats) -> Flags:
        """Tell which places (N, 3) the poses send about as many beams as the highest point beneath them."""
        tops = np.minimum(self.points.tops(world), world[:, 2])
        known = np.isfinite(tops)
        exposed = np.zeros(len(world), dtype=np.bool_)
        beneath = np.column_stack([world[known, :2], tops[known]])
        exposed[known] = self.poses.exposure(world[known]) >= _EXPOSED * self.poses.exposure(beneath)
        return exposed

    def rests_on_points(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) are called free by the points of the epoch alone."""
        return self._combined(world)[1]

    def _reached(self, world: Floats) -> Flags:
        """Tell beside which places (N, 3) the epoch holds a point that no pose should have met either."""
        points = self.points.nearest_points(world)
        reached = np.isfinite(points[:, 0])
        reached[reached] = self.poses.behind_surfaces(points[reached])
        return reached

    def _combined(self, world: Floats) -> tuple[Floats, Flags]:
        """Probabilities (N,) by the poses, and which places they tell nothing of and the points call free."""
        chance, undecided = self.poses.free_and_undecided(world)
        by_points = undecided & (chance == _PRIOR)
        by_points[by_points] = self._looked_down_on(world[by_points])
        ask = np.flatnonzero(by_points)
        by_points[ask] = self.points.free_probability(world[ask]) > _PRIOR
        return chance, by_points

    def _either(self, known: Flags, points: Callable[[Floats], Flags], world: Floats) -> Flags:
        ask = self._hidden(world, ~known)
        known[ask] = points(world[ask])
        return known

    def _hidden(self, world: Floats, unknown: Flags) -> NDArray[np.int64]:
        """Which of the places of which the poses know nothing are hidden from them."""
        ask = np.flatnonzero(unknown)
        ask = ask[self.poses.hidden(world[ask])]
        return ask[self._looked_down_on(world[ask])]

    def _looked_down_on(self, world: Floats) -> Flags:
        """Tell which places (N, 3) have a point beneath them that lies lower than the nearest pose.

        A beam to a point above the sensor comes from below: it tells nothing of the space above the point.
        """
        eyes = self.poses.images.eyes
        if len(eyes) == 0 or len(world) == 0:
            return np.zeros(len(world), dtype=np.bool_)
        near = cKDTree(eyes[:, :2]).query(world[:, :2])[1]
        return np.asarray(self.points.lowest(world) < eyes[near, 2])


@dataclass(frozen=True)
class EverythingSeen:
    """The paper's rule: absence is taken as evidence everywhere."""

    def observed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) the epoch could see."""
        return np.ones(len(world), dtype=np.bool_)

    def passed(self, world: Floats) -> Flags:
        """Tell which world points (N, 3) were seen empty: beams went on."""
        return np.ones(len(world), dtype=np.bool_)

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that world points (N, 3) were free; 0.5 where nothing is known."""
        return np.full(len(world), 0.5)


def view_level(index: ColumnIndex, reach: float, slope: float) -> Floats:
    """Height (nx, ny) up to which the points of a cloud show that the view reached, by column [m].

    A point shows that the view reached its own height at its place. Nearer to the sensor the view of the same
    beam is lower: it falls by ``slope`` a metre, to a distance ``reach`` [m]. -inf where no point is.
    """
    top = np.full(tuple(index.shape.tolist()), -np.inf)
    filled = np.flatnonzero(np.diff(index.starts) > 0)
    top.ravel()[filled] = index.xyz[index.starts[filled + 1] - 1, 2]
    cells = max(round(reach / index.cell), 1)
    x, y = np.mgrid[-cells : cells + 1, -cells : cells + 1]
    steps = np.hypot(x, y)
    level: Floats = ndimage.grey_dilation(
        top, footprint=steps <= cells, structure=-slope * index.cell * steps, mode="constant", cval=-np.inf
    )
    return level
