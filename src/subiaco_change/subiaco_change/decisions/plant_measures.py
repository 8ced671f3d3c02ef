"""Measures of one plant in both epochs at equal point density, and the shift of its outline (Decision 18).

Two drives see different leaves of one tree, from different sides and with different densities. Voxels that
are occupied in one epoch alone then say little, and half a metre hides a trim. The reach of the foliage in
one direction can be compared where both epochs have points in that direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from subiaco_change.decisions.vegetation_null import PlantMeasures, VegetationNullConfig
from subiaco_change.geometry import column_keys, in_box_around
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.objects.known_space import ALL_FREE, KnownSpace, KnownSpaces
from subiaco_change.objects.measures import Measures, absence, mean_certainty, pooled
from subiaco_change.objects.plant_tops import TopChange, TopConfig, change_of_tops
from subiaco_change.objects.voxel_objects import ObjectInstance, join_voxels
from subiaco_change.quantiles import median_and_spread, quantile_of
from subiaco_geo.clouds import stable_order, voxel_indices, voxel_keys
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

_SAMPLE = NUMBERS.plant_measures.surface_sample
_MOST = NUMBERS.plant_measures.place_cap
_NOT_KNOWN = NUMBERS.plant_measures.unknown_free
_TOP = NUMBERS.plant_measures.top_quantile
_PATCH = NUMBERS.plant_measures.voxels_per_patch


class OutlineConfig(StrictModel):
    """Sectors in which outlines are compared."""

    sectors: int = Field(
        12, ge=4, description="Number of horizontal directions in which outlines are compared"
    )
    rings: int = Field(
        5,
        ge=1,
        description="Number of vertical directions, from bottom to top, in which outlines are compared",
    )
    points: int = Field(3, ge=1, description="Number of points that a direction needs in either epoch")
    directions: int = Field(16, ge=4, description="Number of directions that an outline needs to be compared")


@dataclass(frozen=True)
class Outline:
    """Median shift outwards [m], its standard error [m], and the median shift relative to the reach."""

    shift: float = math.nan
    sigma: float = math.nan
    relative: float = math.nan

    @property
    def reach(self) -> float:
        """Reach that the relative shift is a share of [m]; NaN where unknown."""
        return abs(self.shift / self.relative) if self.relative else math.nan

    @property
    def known(self) -> bool:
        """Whether enough directions were seen in both epochs."""
        return math.isfinite(self.shift)


def compare_outlines(before: Floats, after: Floats, config: OutlineConfig) -> Outline:
    """Compare the reach of two point sets (N, 3), (M, 3) [m] from their common middle.

    In every direction the epoch with more points is read at the quantile that
    the outermost of as few points as the other has would have: density alone
    moves nothing. The error is that of a median over the directions.
    """
    if min(len(before), len(after)) < config.points * config.directions:
        return Outline()
    both = np.concatenate([before, after])
    middle = 0.5 * (np.quantile(both, 0.05, axis=0) + np.quantile(both, 0.95, axis=0))
    sides = [_radii_by_direction(xyz - middle, config) for xyz in (before, after)]
    shifts, reaches = [], []
    for direction in sorted(sides[0].keys() & sides[1].keys()):
        first, second = (radii[direction] for radii in sides)
        fewest = min(len(first), len(second))
        if fewest < config.points:
            continue
        low, high = (quantile_of(radius, fewest / (fewest + 1)) for radius in (first, second))
        shifts.append(high - low)
        reaches.append(0.5 * (low + high))
    if len(shifts) < config.directions:
        return Outline()
    shift = np.array(shifts)
    middle_shift, spread = median_and_spread(shift)
    relative = float(np.median(shift / np.maximum(reaches, 1e-6)))
    return Outline(middle_shift, 1.2533 * spread / math.sqrt(len(shift)), relative)


def _radii_by_direction(step: Floats, config: OutlineConfig) -> dict[int, Floats]:
    """Distances of steps (N, 3) in every direction that holds some."""
    code, radius = _directions(step, config)
    order = stable_order(code)
    found, starts = np.unique(code[order], return_index=True)
    return dict(zip(found.tolist(), np.split(radius[order], starts[1:]), strict=True))


def _directions(step: Floats, config: OutlineConfig) -> tuple[Ints, Floats]:
    """Direction (N,) and distance (N,) of steps (N, 3); directions share the sphere equally."""
    radius = np.linalg.norm(step, axis=1)
    turn = np.arctan2(step[:, 1], step[:, 0]) / (2 * np.pi) + 0.5
    sector = np.minimum((turn * config.sectors).astype(np.int64), config.sectors - 1)
    rise = 0.5 * (step[:, 2] / np.maximum(radius, 1e-9) + 1.0)
    ring = np.minimum((rise * config.rings).astype(np.int64), config.rings - 1)
    return sector * config.rings + ring, radius


class PlantConfig(StrictModel):
    """How plants are measured."""

    voxel: float = Field(
        0.5,
        gt=0,
        description="Edge of the voxels in which the point densities of two epochs are compared [m]",
    )
    shared: int = Field(
        8, ge=1, description="Number of voxels occupied in both epochs that a ratio of point densities needs"
    )
    low: float = Field(3.0, gt=0, description="Top height below which plants are hedges or shrubs [m]")
    shell: float = Field(
        0.3,
        gt=0,
        description="Distance without points of the other epoch from which a point is surface of its own "
        "epoch alone [m]",
    )
    base_columns: int = Field(
        12, ge=1, description="Number of columns of a crown in both epochs by which its base is compared"
    )
    base_clearance: float = Field(
        1.5,
        ge=0,
        description="Height above the foot of a plant below which a column is of its trunk or of what "
        "grows beneath [m]",
    )
    side_depth: float = Field(
        0.75,
        gt=0,
        description="Distance from the plant of the other epoch beyond which surface of one epoch alone is "
        "of a bough that was cut or has grown, and not of leaves that differ [m]",
    )
    side_adjoins: float = Field(
        0.1,
        gt=0,
        lt=1,
        description="Fraction of the surface of one epoch alone that must lie nearer to the plant of the "
        "other epoch: a plant of its own, which one instance holds together with the crown, stands apart",
    )
    one_sided: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Length of the mean of the directions, as unit vectors from the middle of a crown, in "
        "which such surface lies, from which it lies on one side; 0.5 for half of a sphere, as a fraction "
        "of 1",
    )
    outline: OutlineConfig = OutlineConfig()
    tops: TopConfig = TopConfig()
    null_model: VegetationNullConfig = VegetationNullConfig()


def measure_plant(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    measures: Measures,
    config: PlantConfig,
    spaces: KnownSpaces = ALL_FREE,
) -> PlantMeasures:
    """Measure a plant that both epochs hold; the denser epoch is thinned to the density of the other.

    ``spaces``: what *before* and *after* know of the space around it.
    """
    first, second = (np.concatenate([t.xyz for t in objects]) for objects in (before, after))
    old, new = spaces
    lost = free_shell(first, new, config)
    lost = min(lost, absence(before, (), spaces))
    gained = free_shell(second, old, config)
    gained = min(gained, absence((), after, spaces))
    tops = _tops(first, second, spaces, config)
    first, second, density = equal_density(first, second, config)
    outline = compare_outlines(first, second, config.outline)
    base, base_sigma = change_of_base(first, second, config)
    both = np.concatenate([first, second])
    heights = np.concatenate([t.voxels.height for t in (*before, *after)])
    height = float(np.quantile(heights, 0.98))
    low = height <= config.low
    return PlantMeasures(
        kind="hedge" if low else "crown",
        density=density,
        size=_size(both),
        voxels=measures.observed_voxels,
        reach=outline.reach,
        outline=outline.shift,
        outline_sigma=outline.sigma,
        top=measures.delta_h,
        volume=measures.delta_v / max(measures.volume, 1e-6),
        surface=measures.net_changed_fraction,
        rise=tops.median,
        rise_sigma=tops.sigma,
        rise_of_part=tops.rise_of_part,
        fall_of_part=tops.fall_of_part,
        free_gained=gained,
        free_lost=lost,
        tops_unseen=tops.unseen,
        base=base,
        base_sigma=base_sigma,
        height=height,
        gained_on_side=0.0 if low else part_on_side(after, before, config),
        lost_on_side=0.0 if low else part_on_side(before, after, config),
        top_sigma=math.hypot(*(quantile_sigma(_heights(objects), _TOP) for objects in (before, after))),
    )


def change_of_base(before: Floats, after: Floats, config: PlantConfig) -> tuple[float, float]:
    """Return how far the base of a crown came down from *before* to *after*, and its standard error [m].

    Of points (N, 3), (M, 3). From the street the lower side of a crown is seen best: lower branches that were
    cut raise it while the top and the outline stay. The median over the columns that hold leaves in both
    epochs, and in neither what begins near the ground: the trunk, or a shrub beneath. NaN for few columns.
    """
    ground = min(float(before[:, 2].min()), float(after[:, 2].min()))
    lowest = []
    for xyz in (before, after):
        column = column_keys(xyz, config.voxel)
        order = np.lexsort((xyz[:, 2], column))
        found, first = np.unique(column[order], return_index=True)
        lowest.append((found, xyz[order[first], 2]))
    _, at_b, at_a = np.intersect1d(lowest[0][0], lowest[1][0], assume_unique=True, return_indices=True)
    low_b, low_a = lowest[0][1][at_b], lowest[1][1][at_a]
    above = np.minimum(low_b, low_a) > ground + config.base_clearance
    if np.count_nonzero(above) < config.base_columns:
        return math.nan, math.nan
    fall = (low_b - low_a)[above]
    middle, spread = median_and_spread(fall)
    return middle, 1.2533 * spread / math.sqrt(len(fall))


def part_on_side(
    objects: Sequence[ObjectInstance], other: Sequence[ObjectInstance], config: PlantConfig
) -> float:
    """Return which fraction of a crown's voxels is a part of it that one epoch alone has, on one side of it.

    The part was observed to be free in the other epoch, and reaches deeper into that free space than leaves
    that differ do. Leaves fall on all sides of a crown: then the directions cancel, and the answer is 0.
    """
    own = join_voxels(objects)
    high = own.height >= config.base_clearance
    ask = np.flatnonzero(own.observed_unoccupied & high)
    if len(ask) == 0:  # as of most crowns
        return 0.0
    there = cKDTree(join_voxels(other).xyz)
    deep = ask[np.isinf(there.query(own.xyz[ask], distance_upper_bound=config.side_depth)[0])]
    if len(deep) == 0 or len(deep) > (1.0 - config.side_adjoins) * len(ask):
        return 0.0
    step = own.xyz[deep] - own.xyz[high].mean(axis=0)
    mean = (step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)).mean(axis=0)
    return len(deep) / len(own) if float(np.linalg.norm(mean)) >= config.one_sided else 0.0


@switchable("tops_of_columns", lambda *_: TopChange())
def _tops(before: Floats, after: Floats, spaces: KnownSpaces, config: PlantConfig) -> TopChange:
    """Measure how far the tops of the columns of a plant moved."""
    return change_of_tops(before, after, spaces, config.tops)


def free_shell(xyz: Floats, other: KnownSpace, config: PlantConfig) -> float:
    """Return how probable it is that the surface that one epoch alone has was free in the other.

    Of points (N, 3) with no standing point of the other epoch within ``config.shell``, taken together as the
    places of an object are; 0.5 where there are none. Surface that the other epoch did not look at may have
    stood there as well.
    """
    if other.free is None:
        return 1.0
    alone = xyz[:: -(-len(xyz) // _SAMPLE)]
    near = other.standing[in_box_around(other.standing, alone, config.shell)]
    if len(near):
        alone = alone[np.isinf(cKDTree(near).query(alone, distance_upper_bound=config.shell)[0])]
    if len(alone) == 0:
        return _NOT_KNOWN
    odds = logit(np.clip(other.free(alone), 1.0 - _MOST, _MOST))
    chance = float(expit(odds.mean()))
    together = pooled(chance, len(np.unique(voxel_keys(voxel_indices(alone, config.voxel)))))
    return mean_certainty(other.certain, alone) * together


def _as_dense_as_they_are(before: Floats, after: Floats, *_: object) -> tuple[Floats, Floats, float]:
    """Return two point sets as they are, and no ratio of their densities."""
    return before, after, 0.0


@switchable("equal_density", _as_dense_as_they_are)
def equal_density(before: Floats, after: Floats, config: PlantConfig) -> tuple[Floats, Floats, float]:
    """Thin the denser of two point sets (N, 3), (M, 3) [m] of one plant to the density of the other.

    Densities are compared in voxels that both occupy: a plant that grew is not a plant that is denser.
    Every so many points in the order of their voxels stay, so that no place loses more than its share.

    Returns
    -------
    (N', 3), (M', 3), float
        Points, and the log of the density of *after* over that of *before*.
    """
    keys = [voxel_keys(voxel_indices(xyz, config.voxel)) for xyz in (before, after)]
    found = [np.unique(key, return_counts=True) for key in keys]
    _, slot_b, slot_a = np.intersect1d(found[0][0], found[1][0], assume_unique=True, return_indices=True)
    if len(slot_b) < config.shared:
        return before, after, 0.0
    counts = float(found[0][1][slot_b].sum()), float(found[1][1][slot_a].sum())
    density = math.log(counts[1] / counts[0])
    share = math.exp(-abs(density))
    if density > 0:
        after = _thinned(after, keys[1], share)
    else:
        before = _thinned(before, keys[0], share)
    return before, after, density


def _thinned(xyz: Floats, keys: np.ndarray, share: float) -> Floats:
    """Keep a share of points (N, 3), evenly over the voxels of the sorted keys (N,)."""
    order = np.lexsort((xyz[:, 2], xyz[:, 1], xyz[:, 0], keys))
    step = np.floor((np.arange(len(order)) + 1) * share) > np.floor(np.arange(len(order)) * share)
    kept = np.sort(order[step])
    return np.asarray(xyz[kept])


def quantile_sigma(values: Floats, quantile: float) -> float:
    """Return the standard error of a quantile of values (N,), of which neighbours were sampled together.

    The binomial error of the rank, times the slope of the quantiles within two of these errors: a top of few
    voxels, or one that is not level, is known less well.
    """
    if len(values) < 2:
        return math.inf
    step = math.sqrt(quantile * (1.0 - quantile) / max(len(values) / _PATCH, 1.0))
    low, high = max(quantile - 2.0 * step, 0.0), min(quantile + 2.0 * step, 1.0)
    slope = float(np.diff(np.quantile(values, [low, high]))[0]) / (high - low)
    return slope * step


def _heights(objects: Sequence[ObjectInstance]) -> Floats:
    """Heights (M,) of the voxels of objects above ground [m]."""
    return np.concatenate([t.voxels.height for t in objects])


def _size(xyz: Floats) -> float:
    """Mean distance of points (N, 3) from their middle [m]."""
    middle = 0.5 * (np.quantile(xyz, 0.05, axis=0) + np.quantile(xyz, 0.95, axis=0))
    return max(float(np.linalg.norm(xyz - middle, axis=1).mean()), 0.1)
