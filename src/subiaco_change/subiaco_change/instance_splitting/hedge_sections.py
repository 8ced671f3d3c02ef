"""Sections of a hedge that grew or were trimmed, where one instance holds several hedges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import always, switchable
from subiaco_change.objects.column_volumes import tops_of_columns
from subiaco_change.objects.known_space import ALL_FREE, Free, KnownSpaces
from subiaco_change.objects.plant_tops import TopConfig, open_above, stands_between
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels, join_voxels
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.frames import Floats, Ints

_CELL = NUMBERS.hedge_sections.cell
_LOW = NUMBERS.hedge_sections.largest_height
_FOOT = NUMBERS.hedge_sections.foot
_POINTS = NUMBERS.hedge_sections.column_points
_CELLS = NUMBERS.hedge_sections.section_columns
_LENGTH = NUMBERS.hedge_sections.section_length
_SEEN = NUMBERS.hedge_sections.observed_share


@dataclass(frozen=True)
class HedgeSection:
    """Columns whose tops moved alike: their middles (C, 2), the median rise and the gate it passed, in m."""

    xy: Floats
    rise: float
    gate: float


def changed_sections(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    threshold: float,
    spaces: KnownSpaces = ALL_FREE,
    config: TopConfig | None = None,
    *,
    alone: bool = False,
) -> tuple[list[HedgeSection], Floats]:
    """Find where tops of a low plant moved by over a threshold [m], and beyond their spread.

    The epoch with the lower tops must have observed the space above them, where ``spaces`` of *before* and of
    *after* tell. ``alone``: nor may anything else stand between the tops of most columns. Returns the
    sections, and all columns compared (C, 2).
    """
    first, second = (np.concatenate([t.xyz for t in objects]) for objects in (before, after))
    corner, tops = _tops(first, second)
    known = np.isfinite(tops).all(axis=0)
    low = _low_columns([join_voxels(objects) for objects in (before, after)], corner, known.shape)
    tops = np.where(low, tops, np.nan)
    rise = _smooth(tops[1] - tops[0])
    if not np.isfinite(rise).any():
        return [], np.zeros((0, 2))
    threshold = max(threshold, 1.96 * math.hypot(_roughness(tops[0]), _roughness(tops[1])))
    sections = []
    for sign in (1.0, -1.0):
        labels, count = ndimage.label(np.nan_to_num(sign * rise, nan=0.0) > threshold, np.ones((3, 3)))
        for number in range(1, count + 1):
            cells = np.argwhere(labels == number)
            if len(cells) < _CELLS or (np.ptp(cells, axis=0).max() + 1) * _CELL < _LENGTH:
                continue
            xy = _middles(cells + corner)
            lower = 0 if sign > 0 else 1
            pair, space = tops[:, *cells.T], spaces[lower]
            if alone and _is_hidden(cells + corner, pair, pair[lower], space.standing):
                continue
            if _observed((after, before)[lower], xy, tops[lower], cells) and _is_open(
                xy, pair[lower], pair[1 - lower], space.above, config
            ):
                sections.append(HedgeSection(xy, float(np.median(rise[labels == number])), threshold))
    columns = np.argwhere(np.isfinite(rise) | (known & ~low))
    return sections, _middles(columns + corner)


def _low_columns(sides: Sequence[Voxels], corner: Ints, shape: tuple[int, int]) -> Mask:
    """Tell which columns of a plant are of a hedge in both epochs, where others are of a crown.

    A hedge begins at the ground, and its top is low enough to be seen from above.
    """
    found = np.ones(shape, dtype=bool)
    if np.quantile(np.concatenate([v.height for v in sides]), 0.98) <= _LOW:
        return found
    for voxels in sides:
        slots = np.floor(voxels.xyz[:, :2] / _CELL).astype(np.int64) - corner
        rooted = np.zeros(shape, dtype=bool)
        rooted[tuple(slots[voxels.height <= _FOOT].T)] = True
        found &= rooted & (tops_of_columns(slots, voxels.height, shape) <= _LOW)
    return found


def _spread(values: Floats) -> float:
    """Robust standard deviation of values (N,) about zero."""
    return 1.4826 * float(np.median(np.abs(values)))


def _middles(cells: Ints) -> Floats:
    """Middles [m] of columns, both (C, 2)."""
    return (cells.astype(np.float64) + 0.5) * _CELL


def _tops(before: Floats, after: Floats) -> tuple[Ints, Floats]:
    """Lowest column, and tops (2, rows, columns) of two clouds (N, 3); NaN where one of the clouds is thin.

    The highest of m points stands at m / (m + 1) of the height, so that tops of which few points tell look
    lower. Both clouds are read at the quantile that the fewer have, and what is missing is added to both.
    """
    index = np.floor(np.concatenate([before, after])[:, :2] / _CELL).astype(np.int64)
    corner = index.min(axis=0) - 1
    shape = tuple((index.max(axis=0) + 2 - corner).tolist())
    keys = np.split(np.ravel_multi_index(tuple((index - corner).T), shape), [len(before)])
    counts = [np.bincount(key, minlength=shape[0] * shape[1]) for key in keys]
    fewest = np.minimum(counts[0], counts[1])
    share = fewest / (fewest + 1)
    heights = before[:, 2], after[:, 2]
    bottom = np.minimum(*(_quantiles(z, key, 0.0 * share) for z, key in zip(heights, keys, strict=True)))
    tops = np.array([_quantiles(z, key, share) for z, key in zip(heights, keys, strict=True)])
    known = fewest >= _POINTS
    whole = bottom + (tops - bottom) / np.where(known, share, 1.0)
    return corner, np.where(known, whole, np.nan).reshape(2, *shape)


def _quantiles(values: Floats, group: Ints, share: Floats) -> Floats:
    """Quantile ``share`` (G,) of the values (N,) of every group; of an empty one whatever stands next."""
    order = np.lexsort((values, group))
    count = np.bincount(group, minlength=len(share))
    place = np.cumsum(count) - count + share * np.maximum(count - 1, 0)
    found: Floats = np.interp(place, np.arange(len(values)), values[order])
    return found


def _roughness(tops: Floats) -> float:
    """Spread of tops about those around them [m]: of a plant that few beams met, few tops are its own."""
    step = np.abs(tops - _smooth(tops))
    return _spread(step[np.isfinite(step)]) if np.isfinite(step).any() else 0.0


def _smooth(rise: Floats) -> Floats:
    """Median over 3 by 3 columns, of at least four that are known."""
    padded = np.pad(rise, 1, constant_values=np.nan)
    rows, columns = rise.shape
    stack = np.stack([padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)])
    enough = np.isfinite(rise) & (np.isfinite(stack).sum(axis=0) >= 4)
    smooth = np.full(rise.shape, np.nan)
    smooth[enough] = np.nanmedian(stack[:, enough], axis=0)
    return smooth


def _observed(objects: Sequence[ObjectInstance], xy: Floats, other_tops: Floats, cells: Ints) -> bool:
    """Tell whether the other epoch looked where the surface of this one stands above its tops."""
    voxels = np.concatenate([t.voxels.xyz for t in objects])
    seen = np.concatenate([t.voxels.observed for t in objects])
    distance, slot = cKDTree(xy).query(voxels[:, :2], distance_upper_bound=_CELL)
    inside = np.isfinite(distance)
    above = voxels[inside, 2] > other_tops[tuple(cells[slot[inside]].T)] + 0.1
    return bool(above.any() and seen[inside][above].mean() >= _SEEN)


def _is_hidden(cells: Ints, tops: Floats, own: Floats, standing: Floats) -> bool:
    """Tell whether points (N, 3) of something else stand between the tops (2, C) of most columns (C, 2)."""
    return bool(stands_between(_CELL, cells, tops, own, standing).mean() > _SEEN)


@switchable("space_above_sections", always)
def _is_open(xy: Floats, own: Floats, other: Floats, free: Free | None, config: TopConfig | None) -> bool:
    """Tell whether an epoch observed free space above its ``own`` tops (C,) of most columns of a section.

    A surface within the tolerance of voxels of another counts as occupied there, which says nothing of the
    space between them.
    """
    if free is None:
        return True
    return float(open_above(xy, own, other, free, config or TopConfig()).mean()) >= _SEEN


def section_labels(obj: ObjectInstance, sections: Sequence[HedgeSection], columns: Floats) -> Ints:
    """Section (M,) of every voxel of an object, counted from 1; 0 for what did not move."""
    owner = np.zeros(len(columns), dtype=np.int64)
    for number, section in enumerate(sections, start=1):
        owner[np.isfinite(cKDTree(section.xy).query(columns, distance_upper_bound=1e-6)[0])] = number
    return owner[cKDTree(columns).query(obj.voxels.xyz[:, :2])[1]]
