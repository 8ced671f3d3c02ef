"""A scene: items that stand, or stood, on the ground, and the ray caster over all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.ground import Patch, Strip, Terrain
from subiaco_sim.plants import Hedge
from subiaco_sim.primitives import Mesh, join

EPOCHS = ("before", "after")
GROUND_ID = 0

# Point classes of the published evaluation.
GROUND, BUILDING, VEGETATION, MOBILE, OTHER = range(5)
CLASS_NAMES = ("ground", "building", "vegetation", "mobile", "other")


class Shape(Protocol):
    """Anything that gives a mesh about its own foot."""

    def mesh(self) -> Mesh:
        """Return the mesh, standing on z = 0."""
        ...


@runtime_checkable
class Foliage(Protocol):
    """A shape whose leaves change with the season while its form stays."""

    def solid(self) -> Shape:
        """Return the same form with dense leaves that do not depend on the season."""
        ...


class Moving(Protocol):
    """Something that moves; it is in no table, and its points are not reported."""

    @property
    def object_id(self) -> int:
        """Id of its points."""
        ...

    @property
    def epoch(self) -> str:
        """When it moves."""
        ...

    @property
    def shape(self) -> Shape:
        """What it is."""
        ...

    @property
    def radius(self) -> float:
        """Of a ball about its middle that holds it [m]."""
        ...

    def at(self, route: Floats, seconds: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad]."""
        ...


class Castable(Protocol):
    """What rays can be cast into."""

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """Cast rays (N, 3), unit directions."""
        ...


@dataclass(frozen=True)
class Placed:
    """A shape at a place in the scene [m, rad]; ``x`` and ``y`` in ENU."""

    shape: Shape
    x: float
    y: float
    yaw: float = 0.0


@dataclass(frozen=True)
class Item:
    """One real-world object through both epochs; None where it does not stand.

    ``event`` says in words what happened to it (empty: nothing).
    """

    object_id: int
    kind: str
    semantic: int
    before: Placed | None
    after: Placed | None
    event: str = ""

    def at(self, epoch: str) -> Placed | None:
        """Return its state in an epoch."""
        return self.before if epoch == "before" else self.after


@dataclass(frozen=True)
class GroundItem:
    """A place where the ground itself may change."""

    object_id: int
    patch: Patch | Strip
    event: str


@dataclass(frozen=True)
class Scene:
    """Everything there is, in local ENU [m]."""

    terrain: Terrain  # as it was before
    items: tuple[Item, ...]
    ground_items: tuple[GroundItem, ...]
    route: Floats  # (N, 2) centreline that the vehicle follows
    moving: tuple[Moving, ...] = ()

    def terrain_at(self, epoch: str) -> Terrain:
        """Return the ground of an epoch."""
        if epoch == "before":
            return self.terrain
        return self.terrain.with_patches(*(g.patch for g in self.ground_items))


def foot_height(placed: Placed, semantic: int, terrain: Terrain) -> float:
    """Return the height on which a thing stands [m]: what moves stands on new ground, the rest stays."""
    ground = terrain if semantic == MOBILE else terrain.without_patches()
    return ground.height_at(placed.x, placed.y)


def item_mesh(placed: Placed, semantic: int, terrain: Terrain) -> Mesh:
    """Return the mesh of a placed shape on the ground of an epoch."""
    z = foot_height(placed, semantic, terrain)
    return placed.shape.mesh().placed(placed.x, placed.y, z, placed.yaw)


def laid_mesh(placed: Placed, semantic: int, terrain: Terrain) -> Mesh:
    """Return the mesh of a placed shape as it lies on the land; buildings, trees and palms stand upright."""
    mesh = item_mesh(placed, semantic, terrain)
    upright = semantic == BUILDING or (semantic == VEGETATION and not isinstance(placed.shape, Hedge))
    return mesh if upright else terrain.laid(mesh, placed.x, placed.y)


@dataclass(frozen=True)
class Hits:
    """What N rays met; ``distance`` is infinite and ``object_id`` -1 where nothing."""

    distance: Floats
    object_id: Ints
    material: NDArray[np.uint8]
    cosine: Floats  # |cos| of the incidence angle

    def rows(self, index: Ints) -> Hits:
        """Return what the rays of an index (M,) met."""
        return Hits(self.distance[index], self.object_id[index], self.material[index], self.cosine[index])


@dataclass
class CompiledScene:
    """The meshes of one epoch, ready for rays in the local frame (float32)."""

    mesh: Mesh
    object_of_triangle: Ints
    threads: int = 0
    _engine: o3d.t.geometry.RaycastingScene = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._engine = o3d.t.geometry.RaycastingScene(nthreads=self.threads)
        vertices = o3d.core.Tensor(self.mesh.vertices.astype(np.float32))
        triangles = o3d.core.Tensor(self.mesh.triangles.astype(np.uint32))
        self._engine.add_triangles(vertices, triangles)
        self.cast(np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]))  # builds the tree, before threads come

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """Cast rays (N, 3), unit directions, and return what they met first."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        answer = self._engine.cast_rays(o3d.core.Tensor(rays), nthreads=self.threads)
        distance = answer["t_hit"].numpy().astype(np.float64)
        found = np.isfinite(distance)
        triangle = np.where(found, answer["primitive_ids"].numpy().astype(np.int64), 0)
        normals = answer["primitive_normals"].numpy()
        return Hits(
            distance=distance,
            object_id=np.where(found, self.object_of_triangle[triangle], -1),
            material=self.mesh.material[triangle],
            cosine=np.abs(np.einsum("ij,ij->i", normals, rays[:, 3:])).astype(np.float64),
        )

    def distance_to_surface(self, points: Floats) -> Floats:
        """Return the distance of points (N, 3) to the nearest triangle [m]."""
        query = o3d.core.Tensor(points.astype(np.float32))
        return np.asarray(self._engine.compute_distance(query).numpy(), dtype=np.float64)


def compile_meshes(meshes: Sequence[tuple[int, Mesh]], threads: int = 0) -> CompiledScene:
    """Join meshes, each with its object id, into one castable scene."""
    ids = np.repeat([k for k, _ in meshes], [len(m) for _, m in meshes])
    return CompiledScene(join([m for _, m in meshes]), ids.astype(np.int64), threads)


def compile_scene(scene: Scene, epoch: str, threads: int = 0) -> CompiledScene:
    """Compile what stands in an epoch; ground patches get their own ids afterwards."""
    terrain = scene.terrain_at(epoch)
    meshes = [(GROUND_ID, terrain.mesh())]
    for item in scene.items:
        placed = item.at(epoch)
        if placed is not None:
            meshes.append((item.object_id, laid_mesh(placed, item.semantic, terrain)))
    return compile_meshes(meshes, threads)


def ground_object(scene: Scene, xyz: Floats, object_id: Ints) -> Ints:
    """Give ground points (N, 3) inside a known patch the id of that patch."""
    named = object_id.copy()
    for item in scene.ground_items:
        inside = (object_id == GROUND_ID) & item.patch.contains(xyz[:, 0], xyz[:, 1])
        named[inside] = item.object_id
    return named
