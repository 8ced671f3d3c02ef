"""The true label of every object, from its true geometry and the published thresholds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from subiaco_geo.clouds import voxel_keys
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats, Ints
from subiaco_sim.primitives import sample_surface
from subiaco_sim.scene import (
    BUILDING,
    EPOCHS,
    GROUND,
    MOBILE,
    VEGETATION,
    Foliage,
    GroundItem,
    Item,
    Placed,
    Scene,
    Shape,
    foot_height,
    item_mesh,
)

COLUMN = 0.5  # edge of the columns in which bodies are compared [m]


@dataclass(frozen=True)
class ClassRule:
    """Thresholds of one class: IoU for a change and for none, dc [m], dh [m], dV/V."""

    iou_changed: float
    iou_unchanged: float
    centroid: float
    height: float
    volume: float


RULES = {
    BUILDING: ClassRule(0.10, 0.20, 1.5, 0.50, 0.10),
    VEGETATION: ClassRule(0.08, 0.20, 2.0, 0.30, 0.15),
}
MOBILE_IOU, MOBILE_CENTROID = 0.20, 2.0
GROUND_RISE, GROUND_AREA = 0.15, 25.0


@dataclass(frozen=True)
class Body:
    """An object as solid columns over the ground: packed cells, their tops [m], centroid in ENU."""

    cells: Ints
    tops: Floats
    centroid: Floats

    @property
    def volume(self) -> float:
        """Volume of the columns [m3]."""
        return float(self.tops.sum() * COLUMN**2)

    @property
    def h95(self) -> float:
        """95th percentile of the column tops [m]."""
        return float(np.percentile(self.tops, 95))


@dataclass(frozen=True)
class TrueChange:
    """What truly happened to an object; NaN where a statistic needs both epochs."""

    change: Change
    before: Body | None
    after: Body | None
    delta_h: float = np.nan
    delta_v: float = np.nan
    delta_c: float = np.nan
    iou: float = np.nan


def body_of(item: Item, scene: Scene, epoch: str) -> Body | None:
    """Measure the columns of an item above the ground of an epoch; None where it does not stand.

    Foliage is measured by its form: which leaves it happens to carry is no change.
    """
    placed = item.at(epoch)
    if placed is None:
        return None
    points, foot = skin_of(placed, item.semantic, scene, epoch)
    return columns_of(points, foot)


def skin_of(
    placed: Placed, semantic: int, scene: Scene, epoch: str, leaves: int = 0, seed: int = 0
) -> tuple[Floats, float]:
    """Sample the surface of a placed shape above its foot: points (N, 3) in ENU, and the foot's height [m].

    ``leaves`` and ``seed`` choose other leaves of the same form and other places on the surface.
    """
    terrain = scene.terrain_at(epoch)
    placed = replace(placed, shape=solid_form(placed.shape, leaves))
    mesh = item_mesh(placed, semantic, terrain)
    points = sample_surface(mesh, 0.08, np.random.default_rng(seed))
    foot = foot_height(placed, semantic, terrain)
    return points[points[:, 2] > foot + 0.02], foot


def columns_of(points: Floats, foot: float, shift: tuple[float, float] = (0.0, 0.0)) -> Body:
    """Return the columns under a surface (N, 3), on a grid moved by ``shift`` [m]."""
    columns = np.floor((points[:, :2] - shift) / COLUMN).astype(np.int64)
    keys = voxel_keys(np.column_stack([columns, np.zeros(len(columns), dtype=np.int64)]))
    cells, slot = np.unique(keys, return_inverse=True)
    tops = np.zeros(len(cells))
    np.maximum.at(tops, slot, points[:, 2] - foot)
    middle = np.append(points[:, :2].mean(axis=0), foot + tops.mean() / 2)
    return Body(cells, tops, middle)


def solid_form(shape: Shape, leaves: int = 0) -> Shape:
    """Return a shape that does not depend on the leaves of the season; ``leaves`` is a seed of dense ones."""
    if not isinstance(shape, Foliage):
        return shape
    return replace(shape.solid(), leaves=leaves) if leaves else shape.solid()  # type: ignore[type-var]


def _same_form(item: Item, scene: Scene) -> bool:
    """Tell whether both epochs hold the same body, without building it."""
    first, second = item.before, item.after
    if first is None or second is None or (first.x, first.y, first.yaw) != (second.x, second.y, second.yaw):
        return False
    feet = [foot_height(first, item.semantic, scene.terrain_at(epoch)) for epoch in EPOCHS]
    return solid_form(first.shape) == solid_form(second.shape) and feet[0] == feet[1]


def column_iou(first: Body, second: Body) -> float:
    """Return the intersection over union of two bodies of columns."""
    shared, a, b = np.intersect1d(first.cells, second.cells, return_indices=True)
    overlap = float(np.minimum(first.tops[a], second.tops[b]).sum()) if len(shared) else 0.0
    return overlap / (first.tops.sum() + second.tops.sum() - overlap)


def true_change(item: Item, scene: Scene) -> TrueChange:
    """Apply the thresholds of the item's class to its true geometry."""
    before = body_of(item, scene, "before")
    after = before if _same_form(item, scene) else body_of(item, scene, "after")
    if before is None or after is None:
        return TrueChange(Change.ADDED if before is None else Change.REMOVED, before, after)
    delta_h = after.h95 - before.h95
    delta_v = after.volume - before.volume
    delta_c = float(np.linalg.norm(after.centroid - before.centroid))
    iou = column_iou(before, after)
    change = decide(item.semantic, delta_h, delta_v, delta_v / before.volume, delta_c, iou)
    return TrueChange(change, before, after, delta_h, delta_v, delta_c, iou)


def decide(
    semantic: int, delta_h: float, delta_v: float, relative_v: float, delta_c: float, iou: float
) -> Change:
    """Decide a matched pair; where rise and loss both fire, the sign of the volume decides."""
    rule = RULES.get(semantic)
    if rule is None:
        same = iou > MOBILE_IOU and delta_c < MOBILE_CENTROID
        return Change.UNCHANGED if same else Change.NOT_REPORTED
    if iou <= rule.iou_changed:
        return Change.UNCHANGED
    more = delta_h > rule.height or relative_v > rule.volume
    less = delta_h < -rule.height or relative_v < -rule.volume
    if more and less:
        return Change.INCREASED if delta_v > 0 else Change.DECREASED
    if more:
        return Change.INCREASED
    return Change.DECREASED if less else Change.UNCHANGED


def ground_change(item: GroundItem) -> Change:
    """Apply the ground thresholds: rise over +-0.15 m on more than 25 m2."""
    if item.patch.area <= GROUND_AREA or abs(item.patch.rise) <= GROUND_RISE:
        return Change.UNCHANGED
    return Change.INCREASED if item.patch.rise > 0 else Change.DECREASED


@dataclass(frozen=True)
class Labels:
    """Class and change code by object id (arrays indexed by id), and the measurements."""

    semantic: Ints
    change: Ints
    measured: dict[int, TrueChange]

    @property
    def reshaped(self) -> Ints:
        """Ids of objects that stand in both epochs in different shapes."""
        return np.flatnonzero(np.isin(self.change, [Change.INCREASED, Change.DECREASED]))


def label_scene(scene: Scene) -> Labels:
    """Label every object of a scene."""
    measured = {item.object_id: true_change(item, scene) for item in scene.items}
    size = 1 + len(scene.items) + len(scene.ground_items) + len(scene.moving)
    semantic = np.full(size, GROUND, dtype=np.int64)
    change = np.full(size, Change.UNCHANGED, dtype=np.int64)
    for item in scene.items:
        semantic[item.object_id] = item.semantic
        change[item.object_id] = measured[item.object_id].change
    for ground in scene.ground_items:
        change[ground.object_id] = ground_change(ground)
    for mover in scene.moving:
        semantic[mover.object_id] = MOBILE
        change[mover.object_id] = Change.NOT_REPORTED
    return Labels(semantic, change, measured)
