"""Columns of objects: volumes in both epochs, changes of height, and tops that no survey saw (Decision 13).

A volume lies between the ground and the tops of an object, in columns that both epochs observed. Of most
houses the street sees half of the roof: the tops of the other half are interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.geometry import column_keys
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import first_argument, switchable
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.voxel_objects import Voxels
from subiaco_change.segmentation.bounding_rectangles import box_coordinates
from subiaco_change.segmentation.ground_model import Mask
from subiaco_geo.clouds import unique_keys
from subiaco_geo.frames import Floats, Ints

_ALONE = NUMBERS.column_volumes.one_epoch_share
_CROSSED = NUMBERS.column_volumes.crossed_share
_STRAY = NUMBERS.column_volumes.stray_share
_PROBES = NUMBERS.column_volumes.probe_heights

NO_COLUMNS: Ints = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class OpenGround:
    """Where nothing stands: columns in which an epoch met the ground (sorted keys), what it saw through."""

    before: Ints
    after: Ints
    empty: tuple[Empty | None, Empty | None] = (None, None)
    cell: float = 0.5

    def bare(self, epoch: int) -> Empty:
        """Return what tells of columns (N, 2) whether an epoch, 0 or 1, met the ground there."""
        keys = (self.before, self.after)[epoch]

        def met(xy: Floats) -> Mask:
            return _among(column_keys(np.column_stack([xy, np.zeros(len(xy))]), self.cell), keys)

        return met


#: Nobody met the ground.
BUILT_UP = OpenGround(NO_COLUMNS, NO_COLUMNS)


@dataclass(frozen=True)
class Volumes:
    """Change of the volume, after minus before, and the volume that it is a share of [m3]."""

    change: float
    whole: float


def ground_columns(xyz: Floats, cell: float) -> Ints:
    """Return the sorted keys of the columns of ground points (N, 3)."""
    return unique_keys(column_keys(xyz, cell))


def tops_of_columns(index: Ints, height: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the largest of the heights (N,) in every column (nx, ny) of a grid, 0 for none [m].

    ``index`` (N, 2): the column of every height.
    """
    tops = np.zeros(shape)
    np.maximum.at(tops, tuple(index.T), height)
    return tops


def compare_volumes(
    before: Voxels, after: Voxels, cell: float, closing: float, ground: OpenGround
) -> Volumes:
    """Compare the columns of one object in two epochs; either may be empty.

    Evidence shows which parts are new or gone; their size is measured in the epoch that contains them. Of
    parts in both epochs, the places that both observed count; of parts in one epoch alone, all places.
    A column that one of the epochs neither saw standing nor open is no change. The share is one of
    what stood before, as far as either epoch saw it.
    """
    if len(before) + len(after) == 0:
        return Volumes(0.0, 0.0)
    alone = [exists_in_one_epoch(v) for v in (before, after)]
    sides = [v.select(v.observed | new) for v, new in zip((before, after), alone, strict=True)]
    sides = [own.add(other.select(other.occupied_in_other)) for own, other in (sides, sides[::-1])]
    frame = _Frame.around(np.concatenate([v.xyz for v in (before, after)]), cell, round(closing / cell))
    stand, bare = [], []
    for side, keys, empty in zip(sides, (ground.before, ground.after), ground.empty, strict=True):
        tops, free = _standing(side, frame, keys, empty)
        stand.append(tops)
        bare.append(free)
    known = np.ones(frame.shape, dtype=bool)
    for epoch in (0, 1):
        unknown = (stand[epoch] == 0) & (stand[1 - epoch] > 0) & ~bare[epoch]
        unknown[unknown] = ~_open(frame, unknown, stand[1 - epoch], sides[1 - epoch], ground.empty[epoch])
        new = (before, after)[1 - epoch].select(alone[1 - epoch])
        unknown[unknown] = ~_within(new, frame.middles(unknown))
        known &= ~unknown
    change = float((stand[1] - stand[0])[known].sum()) * cell**2
    first = 0 if len(before) else 1
    outline = [before.xyz, after.xyz[~alone[1]]] if first == 0 else [after.xyz]
    return Volumes(change, _whole(stand[first], np.concatenate(outline), cell))


def exists_in_one_epoch(voxels: Voxels) -> Mask:
    """Tell which voxels (M,) are of parts that stand in one epoch alone, and were looked across."""
    if len(voxels) == 0:
        return np.zeros(0, dtype=bool)
    part = np.unique(voxels.owner, return_inverse=True)[1]
    seen = np.bincount(part, voxels.observed)
    free = np.bincount(part, voxels.observed_unoccupied)
    crossed = np.bincount(part, voxels.free_space_confirmed)
    return np.asarray(((free >= _ALONE * seen) & (crossed > _CROSSED * free))[part])


@dataclass(frozen=True)
class _Frame:
    """Columns of a place: first of them, how many, their edge [m], and half the widest gap that is filled."""

    corner: Ints
    shape: tuple[int, ...]
    cell: float
    margin: int

    @staticmethod
    def around(xyz: Floats, cell: float, margin: int) -> _Frame:
        index = np.floor(xyz[:, :2] / cell).astype(np.int64)
        corner = index.min(axis=0) - margin
        return _Frame(corner, tuple((index.max(axis=0) + 1 + margin - corner).tolist()), cell, margin)

    def middles(self, where: Mask) -> Floats:
        """Middles (C, 2) of the columns of a mask [m]."""
        return np.asarray((np.argwhere(where) + self.corner + 0.5) * self.cell)


def _standing(voxels: Voxels, frame: _Frame, ground: Ints, empty: Empty | None) -> tuple[Floats, Mask]:
    """Tops of columns, gaps between them filled, and where nothing stands instead, both (rows, columns).

    Columns that nobody looked into, but that stand between others no more than twice the margin apart,
    are filled to the lower of these: an extension whose walls were seen has a volume although its roof was
    not. Where the epoch met the ground (sorted keys) or saw free space there is nothing to fill.
    """
    tops = _tops(voxels, frame)
    bare = tops == 0.0
    middle = frame.middles(bare)
    bare[bare] = _among(column_keys(np.column_stack([middle, np.zeros(len(middle))]), frame.cell), ground)
    if frame.margin == 0 or len(voxels) == 0:
        return tops, bare
    size = 2 * frame.margin + 1
    closed = ndimage.grey_closing(tops, size=(size, size), mode="constant")
    filled = (closed > 0) & (tops == 0) & ~bare
    bare[filled] = empty is not None and _open(frame, filled, closed, voxels, empty)
    return np.where(bare, 0.0, closed), bare


def _among(keys: Ints, known: Ints) -> Mask:
    """Tell which keys (N,) are among the known ones (M,), sorted: many, and the same for every object."""
    if len(known) == 0:
        return np.zeros(len(keys), dtype=bool)
    return np.asarray(known[np.minimum(np.searchsorted(known, keys), len(known) - 1)] == keys)


def _tops(voxels: Voxels, frame: _Frame) -> Floats:
    index = np.floor(voxels.xyz[:, :2] / frame.cell).astype(np.int64) - frame.corner
    return tops_of_columns(index, voxels.height, frame.shape)


def _open(frame: _Frame, where: Mask, tops: Floats, standing: Voxels, empty: Empty | None) -> Mask:
    """Tell in which columns of a mask (C,) a survey saw the space free up to the top of the object.

    Without a record of beams everything counts as seen free.
    """
    middle = frame.middles(where)
    if empty is None or len(middle) == 0:
        return np.ones(len(middle), dtype=bool)
    near = cKDTree(standing.xyz[:, :2]).query(middle)[1]
    foot = standing.xyz[near, 2] - standing.height[near]
    passed = [empty(np.column_stack([middle, foot + share * tops[where]])) for share in _PROBES]
    return np.asarray(np.sum(passed, axis=0) >= 1)


def _within(new: Voxels, middle: Floats) -> Mask:
    """Tell which columns (C, 2) lie inside the smallest rectangles around parts that stand alone."""
    inside = np.zeros(len(middle), dtype=bool)
    if len(middle) == 0:
        return inside
    for owner in np.unique(new.owner):
        outline = shapely.MultiPoint(new.xyz[new.owner == owner, :2]).buffer(0.25).minimum_rotated_rectangle
        inside |= shapely.contains_xy(outline, middle[:, 0], middle[:, 1])
    return inside


def _whole(tops: Floats, xyz: Floats, cell: float) -> float:
    """Volume of a body of which a part was seen: the rectangle around it at its mean height [m3].

    Of most houses the street sees the front, half of the roof and no inside.
    """
    area = float(np.count_nonzero(tops > 0)) * cell**2
    if area == 0.0:
        return 0.0
    low, high = np.quantile(box_coordinates(xyz[:, :2]), [_STRAY, 1.0 - _STRAY], axis=0)
    return float(tops.sum()) * cell**2 * max(1.0, float(np.prod(high - low + cell)) / area)


Cells = NDArray[np.bool_]


@switchable("unseen_tops", first_argument)
def body_tops(tops: Floats, inside: Cells, free: Cells, levels: Floats) -> Floats:
    """Tops (nx, ny) of a body [m], those interpolated that were not seen; 0 outside.

    Columns at its edge count whole, as those of a change do: a change is a share of what is measured alike.

    Parameters
    ----------
    tops : (nx, ny) float64
        Highest surface seen in every column [m]; 0 where none.
    inside : (nx, ny) bool
        Rectangle around the body.
    free : (nx, ny, nz) bool
        Cells that were seen free; a column of mostly free cells is no part of the body.
    levels : (nz,) float64
        Heights of the middles of the cells [m].
    """
    filled = interpolated_tops(tops)
    below = levels < filled[:, :, None]
    opened = 2 * (free & below).sum(axis=2) >= below.sum(axis=2)
    return np.where((tops > 0) | (inside & ~opened), filled, 0.0)


def interpolated_tops(tops: Floats) -> Floats:
    """Tops (nx, ny) [m], where none was seen (0) the mean of the interpolations along both walls.

    Of a pitched roof the half in front is seen, and the walls at its ends.
    """
    total, count = np.zeros_like(tops), np.zeros_like(tops)
    for filled, known in ((total, tops), (total.T, tops.T)):
        place = np.arange(known.shape[1])
        for number, row in enumerate(known):
            if row.any():
                filled[number] += np.interp(place, place[row > 0], row[row > 0])
    for axis in (0, 1):
        count += np.any(tops > 0, axis=axis, keepdims=True)
    return np.asarray(np.where(tops > 0, tops, total / np.maximum(count, 1.0)))
