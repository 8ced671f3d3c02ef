"""Triangle meshes with a material per triangle, and the few solids that everything is built of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from subiaco_geo.frames import Floats, Ints


class Material(IntEnum):
    """What a triangle is made of; the order is that of :data:`REFLECTIVITY`."""

    ASPHALT = 0
    CONCRETE = 1
    GRASS = 2
    BRICK = 3
    RENDER = 4
    TILE = 5
    SHEET_METAL = 6
    LEAF = 7
    BARK = 8
    PAINT = 9
    GLASS = 10
    TIMBER = 11
    WIRE = 12


#: Diffuse reflectivity at 865 nm, by material (typical textbook values).
REFLECTIVITY = np.array([0.12, 0.35, 0.45, 0.30, 0.60, 0.28, 0.50, 0.50, 0.22, 0.45, 0.06, 0.35, 0.25])


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3) float64 [m], triangles (T, 3) int64 and materials (T,) uint8."""

    vertices: Floats
    triangles: Ints
    material: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.triangles)

    def placed(self, x: float, y: float, z: float, yaw: float = 0.0) -> Mesh:
        """Return the mesh turned about its own z and moved [m, rad]."""
        c, s = np.cos(yaw), np.sin(yaw)
        turned = self.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return Mesh(turned + np.array([x, y, z]), self.triangles, self.material)

    def corners(self) -> Floats:
        """Return the corners of every triangle (T, 3, 3)."""
        return self.vertices[self.triangles]

    def areas(self) -> Floats:
        """Return the area of every triangle (T,) [m2]."""
        a, b, c = np.moveaxis(self.corners(), 1, 0)
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def make_mesh(vertices: ArrayLike, triangles: ArrayLike, material: Material) -> Mesh:
    """Build a mesh of one material."""
    faces = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    return Mesh(points, faces, np.full(len(faces), material, dtype=np.uint8))


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes into one."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + k for m, k in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.material for m in meshes]),
    )


def polygons(vertices: ArrayLike, faces: Sequence[Sequence[int]], material: Material) -> Mesh:
    """Build a mesh from convex polygons, each split into a fan of triangles."""
    fans = [[f[0], f[k], f[k + 1]] for f in faces for k in range(1, len(f) - 1)]
    return make_mesh(vertices, fans, material)


def box(length: float, width: float, height: float, material: Material) -> Mesh:
    """Build a box centred on x and y that stands on z = 0 [m]."""
    x, y = length / 2, width / 2
    base = [(-x, -y), (x, -y), (x, y), (-x, y)]
    return extrude_up(base, height, material)


def extrude_up(outline: Sequence[tuple[float, float]], height: float, material: Material) -> Mesh:
    """Extrude a convex outline in x, y from z = 0 to a height [m], closed."""
    n = len(outline)
    vertices = [(x, y, z) for z in (0.0, height) for x, y in outline]
    sides = [(k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n)]
    return polygons(vertices, [*sides, tuple(range(n)), tuple(range(n, 2 * n))], material)


def cylinder(radius: float, height: float, material: Material, sides: int = 10) -> Mesh:
    """Build an upright closed cylinder on z = 0 [m]."""
    angle = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    outline = list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))
    return extrude_up(outline, height, material)


def extrude_across(profile: Sequence[tuple[float, float]], width: float, material: Material) -> Mesh:
    """Extrude a star-shaped side view in x, z across y, centred, closed [m]."""
    n = len(profile)
    centre = np.mean(profile, axis=0)
    vertices = [(x, y, z) for y in (-width / 2, width / 2) for x, z in [*profile, tuple(centre)]]
    faces: list[tuple[int, ...]] = []
    for k in range(n):
        j = (k + 1) % n
        faces += [(k, j, n + 1 + j, n + 1 + k), (n, k, j), (2 * n + 1, n + 1 + j, n + 1 + k)]
    return polygons(vertices, faces, material)


def facets(centres: Floats, size: float, rng: np.random.Generator, material: Material) -> Mesh:
    """Scatter small triangles of random orientation about centres (N, 3): foliage.

    Parameters
    ----------
    size : float
        Mean circumradius of a facet [m].
    """
    count = len(centres)
    first, second = np.linalg.qr(rng.normal(size=(count, 3, 2)))[0].transpose(2, 0, 1)
    angle = rng.uniform(0, 2 * np.pi, (count, 1)) + np.array([0.0, 2.1, 4.2])
    radius = size * rng.uniform(0.6, 1.4, (count, 1))
    corner = first[:, None] * np.cos(angle)[..., None] + second[:, None] * np.sin(angle)[..., None]
    vertices = centres[:, None] + radius[..., None] * corner
    return make_mesh(vertices.reshape(-1, 3), np.arange(3 * count), material)


def sample_surface(mesh: Mesh, spacing: float, rng: np.random.Generator) -> Floats:
    """Sample points (N, 3) on a mesh, about one per spacing squared [m], corners included."""
    areas = mesh.areas()
    counts = rng.poisson(areas / spacing**2)
    a, b, c = np.moveaxis(np.repeat(mesh.corners(), counts, axis=0), 1, 0)
    u, v = rng.uniform(size=(2, len(a), 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return np.concatenate([a + u * (b - a) + v * (c - a), mesh.vertices])
