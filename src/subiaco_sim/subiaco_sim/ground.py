"""The lie of the land: slope, road with crossfall and kerbs, and places dug or filled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import affinity, contains_xy
from shapely.geometry import Polygon
from shapely.geometry import box as shapely_box

from subiaco_geo.frames import Floats
from subiaco_sim.primitives import Material, Mesh, join, make_mesh

ROAD_HALF = 3.7  # kerb to crown [m]
KERB_HEIGHT = 0.13
_PAINT = 0.008  # how far paint lies above the ground mesh [m]
FOOTPATH = (5.4, 6.9)  # from the crown [m]


@dataclass(frozen=True)
class Patch:
    """A rectangle of changed ground: centre, length along yaw, width, rise (negative: dug) [m]."""

    x: float
    y: float
    length: float
    width: float
    yaw: float
    rise: float

    @property
    def area(self) -> float:
        """Area [m2]."""
        return self.length * self.width

    def contains(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Tell which places lie inside."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        along, across = c * (x - self.x) + s * (y - self.y), -s * (x - self.x) + c * (y - self.y)
        return np.asarray((np.abs(along) <= self.length / 2) & (np.abs(across) <= self.width / 2))

    def outline(self) -> Polygon:
        """Return the footprint in scene coordinates."""
        shape = shapely_box(-self.length / 2, -self.width / 2, self.length / 2, self.width / 2)
        turned = affinity.rotate(shape, self.yaw, origin=(0, 0), use_radians=True)
        return affinity.translate(turned, self.x, self.y)


@dataclass(frozen=True)
class Strip:
    """A strip of changed ground along a line: its corners in order, area and rise (negative: dug) [m]."""

    corners: tuple[tuple[float, float], ...]
    rise: float

    @property
    def area(self) -> float:
        """Area [m2]."""
        return float(Polygon(self.corners).area)

    @property
    def x(self) -> float:
        """A place inside, east [m]."""
        return float(Polygon(self.corners).representative_point().x)

    @property
    def y(self) -> float:
        """A place inside, north [m]."""
        return float(Polygon(self.corners).representative_point().y)

    def contains(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Tell which places lie inside."""
        low, high = np.min(self.corners, axis=0), np.max(self.corners, axis=0)
        inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        inside[inside] = contains_xy(self.outline(), x[inside], y[inside])
        return np.asarray(inside)

    def outline(self) -> Polygon:
        """Return the footprint in scene coordinates."""
        return Polygon(self.corners)


def strip_along(line: Floats, start: int, stop: int, offset: float, width: float, rise: float) -> Strip:
    """Return a strip beside part of a dense line (N, 2); ``offset`` of its middle, positive to the left."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    left = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    part = slice(start, stop, 4)
    sides = [line[part] + (offset + side * width / 2) * left[part] for side in (-1, 1)]
    corners = np.concatenate([sides[0], sides[1][::-1]])
    return Strip(tuple((float(x), float(y)) for x, y in corners), rise)


@dataclass(frozen=True)
class Line:
    """A painted line on the road: its middle, its direction and its size [m, rad]."""

    x: float
    y: float
    yaw: float
    length: float
    width: float = 0.12

    def corners(self) -> Floats:
        """Return its corners in order (4, 2)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (self.length, self.width)
        return np.asarray(half @ np.array([[c, s], [-s, c]]) + (self.x, self.y))


class Road:
    """Distances to the crown of a road, given as a dense centreline (N, 2) [m].

    ``widen`` makes each half of the road wider (for a lane of parked cars):
    distances are counted from there on. Places within ``median`` of the
    centreline are on a raised median and have the distance -1.
    """

    def __init__(self, centreline: Floats, widen: float = 0.0, median: float = 0.0) -> None:
        self.centreline = centreline
        self.widen = widen
        self.median = median
        self._tree = cKDTree(centreline)
        self._grid: tuple[tuple[object, float], tuple[Floats, Floats, Floats]] | None = None

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return distances of places of any shape [m]."""
        true, _ = self._tree.query(np.stack([np.ravel(x), np.ravel(y)], axis=1))
        distance = np.where(true < self.median, -1.0, np.maximum(true - self.widen, 0.0))
        return np.asarray(distance).reshape(np.shape(x))

    def grid(self, bounds: tuple[float, float, float, float], cell: float) -> tuple[Floats, Floats, Floats]:
        """Return x, y and distance (rows, columns) on a grid; the last one is kept [m]."""
        if self._grid is None or self._grid[0] != (bounds, cell):
            west, south, east, north = bounds
            x, y = np.meshgrid(np.arange(west, east, cell), np.arange(south, north, cell))
            self._grid = ((bounds, cell), (x, y, self.distance(x, y)))
        return self._grid[1]


@dataclass(frozen=True)
class Terrain:
    """Ground height over the scene.

    Parameters
    ----------
    road : Road
    bounds : (west, south, east, north) [m]
    slope : (2,) rise per metre to the east and to the north
    cell : edge of the ground mesh [m]
    patches : places dug or filled in this epoch
    lines : what is painted on the road
    """

    road: Road
    bounds: tuple[float, float, float, float]
    slope: tuple[float, float]
    cell: float
    patches: tuple[Patch | Strip, ...] = ()
    lines: tuple[Line, ...] = ()

    def with_patches(self, *patches: Patch | Strip) -> Terrain:
        """Return the same land with more places changed."""
        return replace(self, patches=(*self.patches, *patches))

    def without_patches(self) -> Terrain:
        """Return the land as it was laid out."""
        return replace(self, patches=())

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return ground heights at places of any shape [m]."""
        return self._shaped(x, y, self.road.distance(x, y))

    def _shaped(self, x: Floats, y: Floats, distance: Floats) -> Floats:
        land = self.slope[0] * x + self.slope[1] * y
        land = land + 0.35 * np.sin(x / 41.0 + 0.5) * np.cos(y / 37.0)
        height = land + road_profile(distance)
        for patch in self.patches:
            height = height + np.where(patch.contains(x, y), patch.rise, 0.0)
        return np.asarray(height)

    def height_at(self, x: float, y: float) -> float:
        """Return the ground height at one place [m]."""
        return float(self.height(np.array([x]), np.array([y]))[0])

    def mesh(self) -> Mesh:
        """Return the ground as a fine grid of triangles."""
        x, y, distance = self.road.grid(self.bounds, self.cell)
        vertices = np.stack([x, y, self._shaped(x, y, distance)], axis=-1).reshape(-1, 3)
        index = np.arange(x.size).reshape(x.shape)
        a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        land = Mesh(vertices, triangles, self.material(distance.ravel()[triangles].mean(axis=1)))
        return join([land, self._paint()]) if self.lines else land

    def laid(self, mesh: Mesh, x: float, y: float) -> Mesh:  # noqa: ARG002 - of land that slopes for things
        """Return a mesh that stands on x, y [m] as it lies on the land; here the land is level for things."""
        return mesh

    def material(self, distance: Floats) -> NDArray[np.uint8]:
        """Return the material of the ground by distance from the crown [m]."""
        return road_material(distance)

    def _paint(self) -> Mesh:
        """Return the painted lines, just above the ground."""
        xy = np.concatenate([line.corners() for line in self.lines])
        vertices = np.column_stack([xy, self.height(xy[:, 0], xy[:, 1]) + _PAINT])
        first = 4 * np.arange(len(self.lines))[:, None]
        triangles = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
        return make_mesh(vertices, triangles, Material.PAINT)


def road_profile(distance: Floats) -> Floats:
    """Return the height of road, kerb and verge by distance from the crown [m]."""
    corners = [0.0, ROAD_HALF, ROAD_HALF + 0.1, FOOTPATH[1], 14.0, 60.0]
    edge = -0.025 * ROAD_HALF
    heights = [0.0, edge, edge + KERB_HEIGHT, edge + KERB_HEIGHT + 0.06, 0.35, 0.5]
    return np.where(distance < -0.5, KERB_HEIGHT, np.interp(distance, corners, heights))


def road_material(distance: Floats) -> NDArray[np.uint8]:
    """Return asphalt, concrete or grass by distance from the crown [m]."""
    kind = np.full(distance.shape, Material.GRASS, dtype=np.uint8)
    kind[distance < ROAD_HALF + 0.4] = Material.CONCRETE
    kind[distance < ROAD_HALF] = Material.ASPHALT
    kind[distance < -0.5] = Material.GRASS
    kind[(distance > FOOTPATH[0]) & (distance < FOOTPATH[1])] = Material.CONCRETE
    return kind
