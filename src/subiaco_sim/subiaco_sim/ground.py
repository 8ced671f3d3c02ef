"""The lie of the land: slope, road with crossfall and kerbs, and places dug or filled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import affinity
from shapely.geometry import Polygon
from shapely.geometry import box as shapely_box

from subiaco_geo.frames import Floats
from subiaco_sim.primitives import Material, Mesh

ROAD_HALF = 3.7  # kerb to crown [m]
KERB_HEIGHT = 0.13
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


class Road:
    """Distances to the crown of a road, given as a dense centreline (N, 2) [m]."""

    def __init__(self, centreline: Floats) -> None:
        self.centreline = centreline
        self._tree = cKDTree(centreline)

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return distances of places of any shape [m]."""
        distance, _ = self._tree.query(np.stack([np.ravel(x), np.ravel(y)], axis=1))
        return np.asarray(distance).reshape(np.shape(x))


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
    """

    road: Road
    bounds: tuple[float, float, float, float]
    slope: tuple[float, float]
    cell: float
    patches: tuple[Patch, ...] = ()

    def with_patches(self, *patches: Patch) -> Terrain:
        """Return the same land with more places changed."""
        return replace(self, patches=(*self.patches, *patches))

    def without_patches(self) -> Terrain:
        """Return the land as it was laid out."""
        return replace(self, patches=())

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return ground heights at places of any shape [m]."""
        land = self.slope[0] * x + self.slope[1] * y
        land = land + 0.35 * np.sin(x / 41.0 + 0.5) * np.cos(y / 37.0)
        height = land + road_profile(self.road.distance(x, y))
        for patch in self.patches:
            height = height + np.where(patch.contains(x, y), patch.rise, 0.0)
        return np.asarray(height)

    def height_at(self, x: float, y: float) -> float:
        """Return the ground height at one place [m]."""
        return float(self.height(np.array([x]), np.array([y]))[0])

    def mesh(self) -> Mesh:
        """Return the ground as a fine grid of triangles."""
        west, south, east, north = self.bounds
        xs, ys = np.arange(west, east, self.cell), np.arange(south, north, self.cell)
        x, y = np.meshgrid(xs, ys)
        vertices = np.stack([x, y, self.height(x, y)], axis=-1).reshape(-1, 3)
        index = np.arange(x.size).reshape(x.shape)
        a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        centre = vertices[triangles].mean(axis=1)
        return Mesh(vertices, triangles, road_material(self.road.distance(centre[:, 0], centre[:, 1])))


def road_profile(distance: Floats) -> Floats:
    """Return the height of road, kerb and verge by distance from the crown [m]."""
    corners = [0.0, ROAD_HALF, ROAD_HALF + 0.1, FOOTPATH[1], 14.0, 60.0]
    edge = -0.025 * ROAD_HALF
    heights = [0.0, edge, edge + KERB_HEIGHT, edge + KERB_HEIGHT + 0.06, 0.35, 0.5]
    return np.interp(distance, corners, heights)


def road_material(distance: Floats) -> NDArray[np.uint8]:
    """Return asphalt, concrete or grass by distance from the crown [m]."""
    kind = np.full(distance.shape, Material.GRASS, dtype=np.uint8)
    kind[distance < ROAD_HALF + 0.4] = Material.CONCRETE
    kind[distance < ROAD_HALF] = Material.ASPHALT
    kind[(distance > FOOTPATH[0]) & (distance < FOOTPATH[1])] = Material.CONCRETE
    return kind
