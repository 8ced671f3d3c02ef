"""Objects as 0.5 m voxels, each with what the other epoch knows of it: occupied, free or unknown."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.geometry import in_box_around, tree_for_few
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_of_them, switchable
from subiaco_change.objects.known_space import Free
from subiaco_change.objects.vehicle_bodies import inside_vehicles
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.clustering import group_indices
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

UNCERTAIN = NUMBERS.voxel_objects.brief_probability
NO_OBJECT = -1  # instance of a point of no object
OTHERS = -2  # instance of a point of an object that is compared elsewhere
_GROUND_NEAR = NUMBERS.voxel_objects.ground_neighbours
_STRAYED = NUMBERS.voxel_objects.foot_factor
_PASSED_THROUGH = NUMBERS.voxel_objects.passes_per_return


@dataclass(frozen=True)
class EpochView:
    """One epoch in the common local frame, ready to be measured.

    ``xyz`` (N, 3) [m]; ``normals`` (N, 3); ``semantic`` (N,) uint8; ``instance`` (N,) int32,
    :data:`NO_OBJECT` or :data:`OTHERS`;
    ``height`` (N,) above ground [m]; ``lod`` (N,) [m], inf where no claim; ``score`` (N,) of the class;
    ``passed`` (N,) beams of the epoch itself that passed a place for each that returned, where counted;
    ``moved`` (N,) probability that what stood there moved, where mapping kept the times of beams.
    """

    xyz: Floats
    normals: Floats
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    height: Floats
    lod: Floats
    score: Floats
    passed: Floats | None = None
    moved: Floats | None = None


@dataclass(frozen=True)
class Voxels:
    """Occupied voxels of objects; a voxel is represented by the mean of its points.

    ``owner`` (M,) instance; ``xyz`` (M, 3) and ``normal`` (M, 3); ``height`` (M,)
    above ground [m]; ``observed`` (M,): the other epoch observed the place;
    ``occupied_in_other`` (M,): the other epoch has points there, of any class, or one of its vehicles around
    the place. Its ground counts too, except at the foot of an object, which is neither observed nor occupied;
    ``free_space_confirmed`` (M,): the place is not occupied, and the other epoch observed free space on both
    sides of the surface, so that its beams would have met the surface.
    """

    owner: Ints
    xyz: Floats
    normal: Floats
    height: Floats
    observed: Mask
    occupied_in_other: Mask
    free_space_confirmed: Mask

    def __len__(self) -> int:
        return len(self.owner)

    @property
    def observed_unoccupied(self) -> Mask:
        """The other epoch observed the place (M,) and has no points there."""
        return self.observed & ~self.occupied_in_other

    def ground_near(self, xy: Floats) -> Floats:
        """Return the level (N,) of the ground beneath the voxels nearest to places (N, 2) [m]."""
        nearest = cKDTree(self.xyz[:, :2]).query(xy)[1]
        return np.asarray((self.xyz[:, 2] - self.height)[nearest])

    def select(self, index: NDArray[np.generic]) -> Voxels:
        """Return the voxels of a mask or of indices."""
        return Voxels(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def add(self, other: Voxels) -> Voxels:
        """Return these voxels and others.

        With those of the other epoch that it occupies too, two samplings of one surface differ only by
        what is new or gone, not by where the beams happened to fall (Decision 13).
        """
        return Voxels.joined([self, other])

    @staticmethod
    def joined(parts: Sequence[Voxels]) -> Voxels:
        """Return the voxels of several."""
        names = Voxels.__dataclass_fields__
        return Voxels(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class ObjectInstance:
    """One instance of one epoch: its class, points (indices and places) and voxels.

    ``passed`` (N,): beams of its own epoch that passed each of its points for each that returned there;
    empty where nothing counted them. ``moved`` (N,): probability that each moved, empty where not known.
    ``whole``: the instance it was parted from, -1 where it is none's part.
    """

    instance: int
    semantic: Semantic
    score: float
    points: Ints
    voxels: Voxels
    lod: float
    xyz: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    passed: Floats = field(default_factory=lambda: np.zeros(0))
    moved: Floats = field(default_factory=lambda: np.zeros(0))
    whole: int = -1

    @property
    def body(self) -> int:
        """The instance it was parted from, or itself."""
        return self.instance if self.whole < 0 else self.whole

    @property
    def is_part(self) -> bool:
        """Whether it was parted from another instance."""
        return self.whole >= 0 and self.whole != self.instance


def build_voxels(
    view: EpochView,
    other: EpochView,
    is_observed: Callable[[Floats], Mask],
    edge: float,
    reach: Reach,
    step: float = 1.0,
    free: Free | None = None,
) -> Voxels:
    """Group the object points of an epoch into voxels and ask the other epoch about each.

    Parameters
    ----------
    view, other : EpochView
        In one common frame.
    is_observed : callable
        (M, 3) points of that frame -> (M,) bool, seen by the other epoch.
    edge : float
        Voxel edge [m].
    reach : Reach
        When something of the other epoch occupies the place.
    step : float
        How far on both sides of a surface the other epoch must have looked to
        have crossed it [m].
    free : callable, optional
        (M, 3) points -> (M,) probability that the place was free in the other epoch; certain where
        observed if None.
    """
    members = np.flatnonzero(view.instance >= 0)
    owner, normal, height, xyz = _voxel_means(view, members, edge)
    if len(owner) == 0:
        none = np.zeros(0, dtype=bool)
        return Voxels(owner, xyz, normal, height, none, none, none)
    standing, loose = is_standing(other), is_loose(other)
    in_other = occupied(xyz, other.xyz[standing & ~loose], reach)
    in_other |= _touching(xyz, other.xyz[standing & loose], reach)
    in_other |= inside_vehicles(xyz, other)
    ground = occupied_by_ground(xyz, other.xyz[other.semantic == Semantic.GROUND], reach)
    foot = ground & (height <= reach.standing) & ~in_other
    in_other |= ground & ~foot
    observed = is_observed(xyz)
    if free is not None:
        observed[observed] = free(xyz[observed]) >= reach.free
    observed = (observed | in_other) & ~foot
    confirmed = observed & ~in_other
    confirmed[confirmed] = observed_on_both_sides(xyz[confirmed], normal[confirmed], is_observed, step)
    return Voxels(owner, xyz, normal, height, observed, in_other, confirmed)


def is_standing(view: EpochView) -> Mask:
    """Tell which points (N,) occupy their place above the ground: neither ground nor a trail by its beams.

    Where nothing counted beams, a trail was recognised by its shape alone. What lies at the same place in
    the other epoch contradicts that verdict, so such points occupy their place.
    """
    above = np.asarray(view.semantic != Semantic.GROUND)
    return above if view.passed is None else above & ~_passable(view)


@switchable("trails_do_not_stand", lambda view: np.zeros(len(view.xyz), dtype=bool))
def _passable(view: EpochView) -> Mask:
    """Tell which points (N,) do not occupy their place although they lie above the ground."""
    return is_ghost_trail(view)


def is_ghost_trail(view: EpochView) -> Mask:
    """Tell which points (N,) are ghost trails: mobile, no object, and passed by beams."""
    loose = is_loose(view)
    if view.moved is not None:
        return np.asarray(loose & (view.moved > UNCERTAIN))
    if view.passed is None:
        return np.zeros(len(view.xyz), dtype=bool)
    return np.asarray(loose & (view.passed >= _PASSED_THROUGH))


def is_loose(view: EpochView) -> Mask:
    """Tell which points (N,) are mobile and of no object: what traffic left, mostly."""
    return np.asarray((view.semantic == Semantic.MOBILE) & (view.instance == NO_OBJECT))


def observed_on_both_sides(
    xyz: Floats, normal: Floats, is_observed: Callable[[Floats], Mask], step: float
) -> Mask:
    """Tell at which surface places (M, 3) an epoch observed the space before and behind.

    A beam that grazes a standing wall passes through the wall's own voxel,
    never through the one behind it: coverage cannot pass for absence.
    """
    return is_observed(xyz + step * normal) & is_observed(xyz - step * normal)


@dataclass(frozen=True)
class Reach:
    """Distance [m] at which points of another sampling count as the same place.

    ``factor`` times the spacing of the other sampling there, within ``low`` and ``high``: where an epoch is
    sparse, the nearest of its points is far although nothing changed. Ground extends sideways alone: above
    and below it occupies ``foot``, the height up to which standing and lying surfaces cannot be
    distinguished. A place that nothing occupies is free from a probability of ``free`` on; below, it was
    not seen.
    """

    low: float
    high: float
    factor: float
    foot: float = 0.3
    free: float = 0.7

    @property
    def standing(self) -> float:
        """Height above its own ground from which on a place is no foot [m]: either ground may be off."""
        return _STRAYED * self.foot


def occupied(query: Floats, points: Floats, reach: Reach) -> Mask:
    """Tell which places (M, 3) something among points (N, 3) occupies."""
    if len(points) < 5:
        return np.zeros(len(query), dtype=bool)
    tree = tree_for_few(points)
    distance, slot = tree.query(query, distance_upper_bound=reach.high)
    found = np.isfinite(distance)
    spacing = tree.query(points[slot[found]], k=[5])[0][:, 0]
    still = np.zeros(len(query), dtype=bool)
    still[found] = distance[found] <= np.clip(reach.factor * spacing, reach.low, reach.high)
    return still


@switchable("trails_occupy_what_they_touch", occupied)
def _touching(query: Floats, points: Floats, reach: Reach) -> Mask:
    """Tell which places (M, 3) loose points (N, 3) occupy.

    Their spacing is not that of a sampled surface: a trail in the lane does not occupy the car parked beside.
    """
    return occupied(query, points, replace(reach, factor=0.0))


@switchable("occupied_by_ground", none_of_them)
def occupied_by_ground(query: Floats, ground: Floats, reach: Reach) -> Mask:
    """Tell which places (M, 3) ground points (N, 3) occupy: sideways within reach, and as high.

    What one epoch calls a plant and the other a bank is the same surface.
    """
    lies = np.zeros(len(query), dtype=bool)
    if len(ground) < 5 or len(query) == 0:
        return lies
    ground = ground[in_box_around(ground, query, reach.high)]
    if len(ground) < 5:
        return lies
    tree = tree_for_few(ground[:, :2])
    distance, slot = tree.query(
        query[:, :2], k=min(_GROUND_NEAR, len(ground)), distance_upper_bound=reach.high
    )
    beside = np.isfinite(distance)
    first = np.flatnonzero(beside[:, 0])
    spacing = np.zeros(len(query))
    spacing[first] = tree.query(ground[slot[first, 0], :2], k=[5])[0][:, 0]
    beside &= distance <= np.clip(reach.factor * spacing, reach.low, reach.high)[:, None]
    apart = np.abs(ground[np.where(beside, slot, 0), 2] - query[:, 2:])
    return np.asarray((beside & (apart <= reach.foot)).any(axis=1))


def _voxel_means(view: EpochView, members: Ints, edge: float) -> tuple[Ints, Floats, Floats, Floats]:
    owner = view.instance[members].astype(np.int64)
    keys = voxel_keys(voxel_indices(view.xyz[members], edge))
    order = np.lexsort((keys, owner))
    change = np.diff(owner[order], prepend=-1).astype(bool) | np.diff(keys[order], prepend=-1).astype(bool)
    slot = np.cumsum(change) - 1
    count = np.maximum(np.bincount(slot), 1)

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(slot, v) / count for v in values[members][order].T], axis=1)

    if len(members) == 0:
        return owner, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    normal = mean(view.normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return owner[order][change], normal, mean(view.height[:, None])[:, 0], mean(view.xyz)


def build_instances(view: EpochView, voxels: Voxels) -> list[ObjectInstance]:
    """Collect the instances of an epoch in the order of their ids."""
    objects = []
    by_voxel = group_indices(voxels.owner)
    for instance, members in enumerate(group_indices(view.instance.astype(np.int64))):
        if len(members) == 0:
            continue
        semantic = Semantic(int(np.bincount(view.semantic[members]).argmax()))
        lods = view.lod[members]
        finite = lods[np.isfinite(lods)]
        lod = float(np.median(finite)) if len(finite) else float("inf")
        score = float(view.score[members].mean())
        own = voxels.select(by_voxel[instance])
        passed = np.zeros(0) if view.passed is None else view.passed[members]
        moved = np.zeros(0) if view.moved is None else view.moved[members]
        objects.append(
            ObjectInstance(instance, semantic, score, members, own, lod, view.xyz[members], passed, moved)
        )
    return objects


def join_voxels(objects: Sequence[ObjectInstance]) -> Voxels:
    """Concatenate the voxels of the parts of an object."""
    if not objects:
        flags = np.zeros(0, dtype=bool)
        return Voxels(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), flags, flags, flags
        )
    return Voxels.joined([t.voxels for t in objects])


def height_of(objects: Sequence[ObjectInstance]) -> float:
    """Height above ground that 95 % of the voxels of an object stay under [m]; NaN without voxels."""
    voxels = join_voxels(objects)
    return quantile_of(voxels.height, 0.95) if len(voxels) else math.nan
