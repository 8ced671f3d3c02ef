"""Parts of plants that the field of view of both epochs reached.

A field of view that ends in a crown cuts it at the same height everywhere: what lies above was not seen, and
is neither new nor gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from subiaco_change.geometry import column_keys, in_box_around
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import switchable
from subiaco_change.objects.known_space import Empty, KnownSpaces
from subiaco_change.objects.plant_tops import expected_top
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_change.quantiles import quantile_of
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import unique_cells
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

_EVERY_VIEW = NUMBERS.view_of_crowns.every_view
_BESIDE = NUMBERS.view_of_crowns.beside_plant
_COLUMN = NUMBERS.view_of_crowns.crown_column
_CROWN_TOP = NUMBERS.view_of_crowns.crown_top
_CROWN_COLUMNS = NUMBERS.view_of_crowns.crown_columns
_CUT_DEPTH = NUMBERS.view_of_crowns.cut_depth
_CUT_SHARE = NUMBERS.view_of_crowns.cut_share
_AROUND = NUMBERS.view_of_crowns.around
_AROUND_COLUMN = NUMBERS.view_of_crowns.around_column
_AROUND_COLUMNS = NUMBERS.view_of_crowns.around_columns
_AROUND_POINTS = NUMBERS.view_of_crowns.around_points
_AS_HIGH = NUMBERS.view_of_crowns.as_high
_GOES_ON = NUMBERS.view_of_crowns.goes_on
_GOES_ON_SHARE = NUMBERS.view_of_crowns.goes_on_share


def within_view(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    semantic: Semantic,
    spaces: KnownSpaces,
) -> tuple[Sequence[ObjectInstance], Sequence[ObjectInstance]]:
    """Parts of an object that are compared: of plants, those that the view of the other epoch reached.

    Of a plant of one epoch its own top tells whether a field of view ends in crowns. It may be the upper part
    of what the other epoch holds beside it; an isolated object was added, or removed, as a whole.
    """
    alone = not (before and after)
    if semantic is not Semantic.VEGETATION:
        return before, after
    if alone and not _adjoins((*before, *after), spaces[int(bool(before))].standing):
        return before, after
    standing = spaces[0].standing, spaces[1].standing
    return (
        _in_view(before, after or before, spaces[1].below_view, standing),
        _in_view(after, before or after, spaces[0].below_view, standing[::-1]),
    )


def _adjoins(objects: Sequence[ObjectInstance], standing: Floats) -> bool:
    """Tell whether standing points (N, 3) of the other epoch lie beside the points of objects."""
    xyz = np.concatenate([t.xyz for t in objects])
    near = standing[in_box_around(standing, xyz, _BESIDE)]
    return len(near) > 0 and float(cKDTree(xyz).query(near)[0].min()) <= _BESIDE


def _all_parts(objects: Sequence[ObjectInstance], *_: object) -> list[ObjectInstance]:
    """Return the parts of a plant as they are."""
    return list(objects)


@switchable("view_height", _all_parts)
def _in_view(
    objects: Sequence[ObjectInstance],
    other: Sequence[ObjectInstance],
    below_view: Empty | None,
    standing: tuple[Floats, Floats],
) -> list[ObjectInstance]:
    """Parts of a plant, what is higher than the view of the other epoch reached not observed.

    Where the parts ``other`` of the plant show its top, the view reached that, unless what is ``standing``
    around in the own epoch goes on above the height at which it ends in the other one.
    """
    if not objects or below_view is None or all(below_view(t.xyz).all() for t in objects):
        return list(objects)
    if is_top_seen(other) and not goes_on_above(objects, other, standing):
        return list(objects)
    ceiling = max(float(t.xyz[:, 2].max()) for t in other)  # what is beside points is not above them
    found = []
    for instance in objects:
        voxels = instance.voxels
        known = _below_view(voxels, below_view) | (voxels.occupied_in_other & (voxels.xyz[:, 2] <= ceiling))
        limited = replace(
            voxels, observed=voxels.observed & known, free_space_confirmed=voxels.free_space_confirmed & known
        )
        slot = cKDTree(voxels.xyz).query(instance.xyz)[1]
        low = (voxels.height <= _EVERY_VIEW)[slot] | (instance.xyz[:, 2] <= ceiling)
        points = known[slot] & (low | below_view(instance.xyz))
        xyz = instance.xyz[points] if points.any() else instance.xyz
        found.append(replace(instance, voxels=limited, xyz=xyz))
    return found


def _below_view(voxels: Voxels, below_view: Empty) -> Mask:
    """Tell which voxels (M,) lie no higher than the view is known to reach, or than every view does."""
    return np.asarray((voxels.height <= _EVERY_VIEW) | below_view(voxels.xyz))


def is_top_seen(objects: Sequence[ObjectInstance]) -> bool:
    """Tell whether the points of a plant end at its top, and not where the field of view of a sensor ends.

    A crown is round: few of its columns reach its top. A field of view that ends in a crown cuts all columns
    at about the same height.
    """
    xyz = np.concatenate([t.xyz for t in objects])
    tops = _column_tops(xyz)
    top = quantile_of(tops, _CROWN_TOP)
    upper = tops[tops > 0.5 * (top + float(xyz[:, 2].min()))]
    return len(upper) >= _CROWN_COLUMNS and float(np.mean(upper >= top - _CUT_DEPTH)) < _CUT_SHARE


def goes_on_above(
    objects: Sequence[ObjectInstance], other: Sequence[ObjectInstance], standing: tuple[Floats, Floats]
) -> bool:
    """Tell whether what ends around a plant as high as the plant, in the other epoch, ends higher in its own.

    A plant that grew leaves the tops around as they are. A field of view that ends lower in one of two
    surveys lowers all tops that reach it, and the rings of its beams end at so many heights that cut crowns
    look round.

    Parameters
    ----------
    objects, other : sequence of ObjectInstance
        Parts of the plant in its own and in the other epoch.
    standing : (N, 3) and (M, 3) float64
        Points above the ground of both epochs, of any class [m].
    """
    plant = [np.concatenate([t.xyz for t in parts]) for parts in (objects, other)]
    whole = np.concatenate(plant)
    near = [xyz[in_box_around(xyz, whole, _AROUND)] for xyz in standing]
    if min(len(xyz) for xyz in near) == 0:
        return False
    columns, slot = unique_cells(_columns_of(np.concatenate(near)))
    slots = np.split(slot, [len(near[0])])
    fewest = np.min([np.bincount(s, minlength=len(columns)) for s in slots], axis=0)
    tops = [expected_top(xyz[:, 2], s, fewest) for xyz, s in zip(near, slots, strict=True)]
    beside = cKDTree(unique_cells(_columns_of(whole))[0]).query(columns)[0] > 1.5  # not even a corner touches
    level = (
        beside
        & (fewest >= _AROUND_POINTS)
        & (np.abs(tops[1] - quantile_of(_column_tops(plant[1]), _CROWN_TOP)) <= _AS_HIGH)
    )
    rises = (tops[0] - tops[1])[level]
    return len(rises) >= _AROUND_COLUMNS and float(np.mean(rises > _GOES_ON)) >= _GOES_ON_SHARE


def _columns_of(xyz: Floats) -> Ints:
    """Return the columns (N, 2) around a plant that points (N, 3) stand in."""
    return np.asarray(np.floor(xyz[:, :2] / _AROUND_COLUMN).astype(np.int64))


def _column_tops(xyz: Floats) -> Floats:
    """Heights (C,) of the tops of the columns of a plant of points (N, 3) [m]."""
    columns, slot = np.unique(column_keys(xyz, _COLUMN), return_inverse=True)
    tops = np.full(len(columns), -np.inf)
    np.maximum.at(tops, slot, xyz[:, 2])
    return tops
