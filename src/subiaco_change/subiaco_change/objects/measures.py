"""Measures of objects: height, volume, displacement, overlap, certainty of absence (part E, Decision 13).

A beam that crosses the place of a wall proves that the wall is gone; one that crosses the place of a hedge
may have found a gap. The share of the beams of its own survey that an object let pass tells which of the two
it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import expit, logit
from shapely.geometry.base import BaseGeometry

from subiaco_change.geometry import outline_of_cells
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.carving_config import CarvingConfig
from subiaco_change.objects.column_volumes import (
    BUILT_UP,
    OpenGround,
    compare_volumes,
    exists_in_one_epoch,
)
from subiaco_change.objects.known_space import Certainty, KnownSpaces
from subiaco_change.objects.space_carving import CarvingEpoch, Interval, carve
from subiaco_change.objects.voxel_objects import ObjectInstance, Reach, Voxels, join_voxels
from subiaco_change.quantiles import quantile_of
from subiaco_geo.clouds import unique_cells
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

_SURE = NUMBERS.absence.least_doubt


class MeasureConfig(StrictModel):
    """Voxels and histograms of the measures."""

    voxel: float = Field(
        0.5, gt=0, description="Edge of the voxels in which objects are compared [m] (paper)"
    )
    tolerance: float = Field(
        0.5,
        gt=0,
        description="Largest distance of overlapping voxels of two objects [m]; compensates voxel aliasing",
    )
    same_low: float = Field(
        0.35,
        gt=0,
        description="Smallest distance to a point of the other epoch at which a place counts as occupied [m]",
    )
    same_high: float = Field(
        1.0,
        gt=0,
        description="Largest distance to a point of the other epoch at which a place counts as occupied, "
        "used where points are sparse [m]",
    )
    same_factor: float = Field(
        1.25,
        gt=0,
        description="Distance at which a place counts as occupied, as a multiple of the point spacing of "
        "the other epoch",
    )
    foot: float = Field(
        0.3,
        ge=0,
        description="Height above ground below which voxels of an object are left out where the other "
        "epoch observed ground [m]",
    )
    free: float = Field(
        0.7,
        gt=0.5,
        lt=1,
        description="Probability of being free from which a place without points counts as observed; one "
        "passing beam gives 0.75",
    )
    crossing: float = Field(
        1.0,
        gt=0,
        description="Distance on both sides of a surface that an epoch must have observed for the place "
        "to count as crossed by beams [m]",
    )
    closing: float = Field(
        1.5,
        ge=0,
        description="Half width of gaps of occluded columns that are filled when volumes are compared [m]",
    )
    top_quantile: float = Field(
        0.95,
        gt=0.5,
        le=1,
        description="Quantile of the heights that is the top of an object, as a fraction (0.95 for h95, "
        "paper)",
    )
    patch_voxels: float = Field(
        4.0,
        ge=1,
        description="Number of neighbouring voxels whose errors of free space are one error, because the "
        "same beams cross them; falls with the square of a point spacing above the edge of a voxel",
    )
    carving: CarvingConfig = CarvingConfig()


def same_place(config: MeasureConfig) -> Reach:
    """Return when points of the other epoch occupy a place."""
    return Reach(config.same_low, config.same_high, config.same_factor, config.foot, config.free)


@dataclass(frozen=True)
class Measures:
    """Differences, after minus before, in space that both epochs observed.

    Lengths [m], volumes [m3]; NaN where a side is empty. ``volume`` is that of
    the columns that stood before; ``observed_voxels`` the number that entered.
    ``net_changed_fraction`` is the share of the surface that is new (positive) or gone
    (negative) on balance, counting only places that the other epoch looked across. ``free`` is the mean
    probability of being free, in the other epoch, of the places where it holds nothing.
    Of buildings, ``height_bounds`` and ``volume_bounds`` are what space carving leaves
    possible (Decision 17), ``delta_h`` and ``delta_v`` their middles; ``volume_resolution``
    is the volume below which carving shows no change. ``gained`` and ``lost`` are the volumes [m3] of which
    ``volume_bounds`` is the difference; ``gained_surface`` and ``lost_surface`` are the areas of their
    walls whose place the other epoch saw free on both sides [m2].
    """

    iou: float
    d_perp: float
    delta_c: float
    delta_h: float
    delta_v: float
    delta_v_surface: float
    volume: float
    gone_share: float
    new_share: float
    observed_fraction: float
    observed_voxels: int
    net_changed_fraction: float = 0.0
    height_bounds: Interval | None = None
    volume_bounds: Interval | None = None
    free: float = 1.0
    volume_resolution: float = 0.0
    gained: Interval | None = None
    lost: Interval | None = None
    gained_surface: float = 0.0
    lost_surface: float = 0.0

    @property
    def stated_volume(self) -> Interval | None:
        """Bounds of the change of volume, the resolution of the carving included [m3]."""
        return self.volume_bounds and self.volume_bounds.widened(self.volume_resolution)


def measure(
    before: Voxels,
    after: Voxels,
    config: MeasureConfig,
    ground: OpenGround = BUILT_UP,
    building: bool = False,
) -> Measures:
    """Compare the voxels of one object in two epochs; either may be empty. Buildings are carved."""
    seen_b, seen_a = before.select(before.observed), after.select(after.observed)
    alone_b, alone_a = (
        int(np.count_nonzero(~seen_b.occupied_in_other)),
        int(np.count_nonzero(~seen_a.occupied_in_other)),
    )
    whole_b, whole_a = (
        own.add(other.select(other.occupied_in_other)) for own, other in ((seen_b, seen_a), (seen_a, seen_b))
    )
    common = 0.5 * (len(seen_b) - alone_b + len(seen_a) - alone_a)
    both = len(before) > 0 and len(after) > 0
    measures = Measures(
        iou=common / max(common + alone_b + alone_a, 1e-9) if both else 0.0,
        d_perp=_separation(seen_b, seen_a, config),
        delta_c=_distance(whole_b, whole_a) if both else float("nan"),
        delta_h=_top(whole_a, config) - _top(whole_b, config) if both else float("nan"),
        delta_v=0.0,
        delta_v_surface=float(alone_a - alone_b) * config.voxel**3,
        volume=0.0,
        gone_share=alone_b / max(len(seen_b), 1),
        new_share=alone_a / max(len(seen_a), 1),
        observed_fraction=observed_fraction(before, after, config),
        observed_voxels=len(seen_b) + len(seen_a),
        net_changed_fraction=_net_changed_fraction(before, after),
    )
    if building:
        return _carved(measures, before, after, config, ground)
    volumes = compare_volumes(before, after, config.voxel, config.closing, ground)
    return replace(measures, delta_v=volumes.change, volume=volumes.whole)


def _carved(
    measures: Measures, before: Voxels, after: Voxels, config: MeasureConfig, ground: OpenGround
) -> Measures:
    """Add height and volume of a building by space carving (Decision 17)."""
    carved = carve(
        CarvingEpoch(before, ground.empty[0], ground.bare(0)),
        CarvingEpoch(after, ground.empty[1], ground.bare(1)),
        config.carving,
    )
    both = len(before) > 0 and len(after) > 0
    volume = carved.volume
    if not both and ground.empty[0 if len(after) else 1] is None:  # its absence is assumed, so is its volume
        own = carved.whole if len(after) else -carved.whole
        volume = Interval(own, own)
    return replace(
        measures,
        delta_h=carved.height.middle if both else float("nan"),
        delta_v=volume.middle,
        volume=carved.whole,
        height_bounds=carved.height if both else None,
        volume_bounds=volume,
        volume_resolution=carved.resolution,
        gained=carved.gained,
        lost=carved.lost,
        gained_surface=carved.confirmed[0] * config.voxel**2,
        lost_surface=carved.confirmed[1] * config.voxel**2,
    )


def observed_fraction(before: Voxels, after: Voxels, config: MeasureConfig) -> float:
    """Fraction of the voxels that the other epoch observed, of those high enough to differ from ground."""
    standing = same_place(config).standing
    high = sum(int(np.count_nonzero(v.observed | (v.height > standing))) for v in (before, after))
    return sum(int(np.count_nonzero(v.observed)) for v in (before, after)) / max(high, 1)


def _net_changed_fraction(before: Voxels, after: Voxels) -> float:
    """Surface that is new less surface that is gone, relative to the mean surface of the two.

    Of a part that stands in one epoch alone all is new, or gone, also what the other never looked at.
    """
    after_new, before_gone = (
        int(np.count_nonzero(v.free_space_confirmed | exists_in_one_epoch(v))) for v in (after, before)
    )
    net = after_new - before_gone
    return net / max(0.5 * (len(before) + len(after)), 1.0)


def _separation(before: Voxels, after: Voxels, config: MeasureConfig) -> float:
    """Median distance along the normal of *before* over the shared voxels [m]."""
    if len(before) == 0 or len(after) == 0:
        return float("nan")
    distance, slot = cKDTree(after.xyz).query(before.xyz, distance_upper_bound=config.tolerance)
    shared = np.isfinite(distance)
    if not shared.any():
        return float("nan")
    step = after.xyz[slot[shared]] - before.xyz[shared]
    return float(np.median(np.einsum("ij,ij->i", before.normal[shared], step)))


def _distance(before: Voxels, after: Voxels) -> float:
    if len(before) == 0 or len(after) == 0:
        return float("nan")
    return float(np.linalg.norm(after.xyz.mean(axis=0) - before.xyz.mean(axis=0)))


def _top(voxels: Voxels, config: MeasureConfig) -> float:
    return quantile_of(voxels.height, config.top_quantile) if len(voxels) else float("nan")


def oriented_rectangle(xy: Floats) -> BaseGeometry:
    """Smallest-area rectangle around points (N, 2), at least 0.25 m wide."""
    hull = shapely.MultiPoint(xy).convex_hull.buffer(0.125, cap_style="square", join_style="mitre")
    return shapely.minimum_rotated_rectangle(hull)


def footprint_sides(xyz: Floats) -> tuple[float, float]:
    """Shorter and longer side of the footprint of places (M, 3) [m]."""
    corners = np.array(oriented_rectangle(xyz[:, :2]).exterior.coords)
    narrow, long = np.sort(np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)).tolist()
    return narrow, long


def rectangle_iou(first: BaseGeometry, second: BaseGeometry) -> float:
    """Area of the intersection over the union of two footprints."""
    common = float(first.intersection(second).area)
    return common / max(float(first.area) + float(second.area) - common, 1e-9)


def footprint(parts: Sequence[Floats], cell: float = 0.5) -> BaseGeometry:
    """Outline [m] of the cells that points (N, 2) occupy, small gaps closed."""
    xy = np.concatenate(list(parts))
    outline = outline_of_cells(unique_cells(np.floor(xy / cell).astype(np.int64))[0], np.zeros(2), cell)
    closed = outline.buffer(cell, join_style="mitre").buffer(-cell, join_style="mitre")
    return closed.simplify(0.2 * cell)


def absence(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    spaces: KnownSpaces,
    patch: float = MeasureConfig().patch_voxels,
) -> float:
    """Probability that the object is absent where the other epoch holds nothing.

    The mean log odds of the places, times the square root of the number of patches that they form: places
    next to one another are crossed by the same beams, so their errors are correlated. What all patches of an
    object have in common does not average out: the probability stays below the mean certainty.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
        Parts of the object in both epochs.
    spaces : (KnownSpace, KnownSpace)
        What *before* and *after* know to be free, and how certainly.
    patch : float
        Number of voxels that form a patch.
    """
    chances, bound = [np.zeros(0)], 1.0
    for objects, other in ((before, spaces[1]), (after, spaces[0])):
        if objects and other.free is not None:
            voxels = join_voxels(objects)
            places = voxels.xyz[voxels.observed_unoccupied]
            bound = min(bound, mean_certainty(other.certain, places))
            chances.append(porous_chance(other.free(places), opacity(objects)))
    joined = np.concatenate(chances)
    return 1.0 if len(joined) == 0 else bound * pooled(float(joined.mean()), len(joined), patch)


def mean_certainty(certain: Certainty | None, places: Floats) -> float:
    """Return the mean probability that the evidence at places (N, 3) is right as a whole."""
    return 1.0 if certain is None or len(places) == 0 else float(certain(places).mean())


def pooled(mean: float, voxels: int, patch: float = MeasureConfig().patch_voxels) -> float:
    """Probability that places are free together: ``mean`` of so many voxels, some of which form a patch."""
    within = min(max(mean, _SURE), 1.0 - _SURE)
    return float(expit(logit(within) * max(voxels / patch, 1.0) ** 0.5))


def opacity(objects: Sequence[ObjectInstance]) -> float | None:
    """Share of the beams of its own survey that an object returned; None where nothing counted them."""
    passed = np.concatenate([t.passed for t in objects])
    return None if len(passed) == 0 else float(1.0 / (1.0 + passed.mean()))


@switchable("porous_absence", first_argument)
def porous_chance(chance: Floats, returned: float | None) -> Floats:
    """Probability (N,) that no object with this fraction of returned beams is at the places.

    ``chance`` (N,) is that of the place being free whatever stood there: (k + 1/2) / (k + 1) after k beams
    that crossed it. Had the object stood there, k beams would all have missed it with (1 - returned)^k.
    """
    if returned is None:
        return chance
    beams = np.maximum(chance - 0.5, 0.0) / np.maximum(1.0 - chance, _SURE)
    return np.asarray(1.0 / (1.0 + (1.0 - min(returned, 1.0 - _SURE)) ** beams))
